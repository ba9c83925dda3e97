"""Names from a log as labels of a figure or a page."""

import re
from collections.abc import Sequence


# Controls, overrides of the reading direction, halves of surrogate pairs: they break HTML, XML or
# UTF-8, or make a text look like another one.
_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]"
)
_SHORT = 28  # characters of a name in a figure


def visible(text: str) -> str:
    """With U+FFFD for characters that control a display instead of showing on it."""
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
