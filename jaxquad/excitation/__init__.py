"""Test signals, such as sweeps and multisines, and the guidelines for them."""

from ._excitation import (
    check_guidelines as check_guidelines,
    check_lines as check_lines,
    doublet as doublet,
    Excitation as Excitation,
    Guideline as Guideline,
    Guidelines as Guidelines,
    harmonics as harmonics,
    multisine as multisine,
    sweep as sweep,
    sweep_frequency as sweep_frequency,
    three_two_one_one as three_two_one_one,
)
