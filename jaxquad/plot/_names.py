"""Names and units as figures and pages show them."""

import re
from collections.abc import Sequence

import numpy as np


# Controls, overrides of the reading direction, halves of surrogate pairs: they break HTML, XML or
# UTF-8, or make a text look like another one.
_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]"
)
_SHORT = 28  # characters of a name in a figure
COHERENT = 0.6  # magnitude-squared coherence from which a frequency is commonly used


def visible(text: str) -> str:
    """A text with U+FFFD for characters that control a display instead of showing on it."""
    return _HIDDEN.sub("\ufffd", text)


def short_names(names: Sequence[str]) -> tuple[str, ...]:
    """Names for the labels of a figure: one line, not long, and distinct if there are several."""
    short: list[str] = []
    for name in names:
        line = " ".join(visible(name).split()) or "(no name)"
        half = (_SHORT - 1) // 2
        line = line if len(line) <= _SHORT else f"{line[:half]}\u2026{line[-half:]}"
        while line in short:
            line += "\u2032"
        short.append(line)
    return tuple(short)


def unit_label(unit: str) -> tuple[float, str]:
    """Factor and label of a unit as it is drawn: angles in degrees."""
    if unit in ("rad", "rad/s"):
        return float(np.degrees(1.0)), ", " + unit.replace("rad", "deg")
    return 1.0, f", {unit}" if unit else ""


_RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def raise_powers(text: str) -> str:
    """`deg s^2` with its exponent raised; a letter of the font, which takes no formula."""
    return re.sub(r"\^(\d+)", lambda power: power[1].translate(_RAISED), text)
