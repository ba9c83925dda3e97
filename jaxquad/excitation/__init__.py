"""Test signals, such as sweeps and multisines, and the guidelines for them."""

from ._excitation import (
    check_guidelines as check_guidelines,
    Excitation as Excitation,
    Guideline as Guideline,
    Guidelines as Guidelines,
)
from ._multisine import check_lines as check_lines, harmonics as harmonics, multisine as multisine
from ._pulse import doublet as doublet, three_two_one_one as three_two_one_one
from ._sweep import sweep as sweep, sweep_frequency as sweep_frequency
