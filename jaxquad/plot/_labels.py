"""Names, units, ticks and marks: what figures share."""

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter


# Controls, overrides of the reading direction, halves of surrogate pairs: they break HTML, XML or
# UTF-8, or make a text look like another one.
_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]"
)
_SHORT = 28  # characters of a name in a figure
_MARKS = (
    {"marker": "o", "color": "black", "mfc": "black", "ms": 4.0, "mew": 0.8},
    {"marker": "s", "color": "tab:red", "mfc": "none", "ms": 4.0, "mew": 0.8},
    {"marker": "^", "color": "tab:orange", "mfc": "none", "ms": 4.5, "mew": 0.8},
    {"marker": "D", "color": "tab:blue", "mfc": "none", "ms": 3.5, "mew": 0.8},
    {"marker": "+", "color": "tab:green", "mfc": "none", "ms": 5.5, "mew": 1.0},
    {"marker": "v", "color": "tab:purple", "mfc": "none", "ms": 4.5, "mew": 0.8},
    {"marker": "*", "color": "0.4", "mfc": "0.7", "ms": 6.0, "mew": 0.6},
)
Style = dict[str, Any]  # keyword arguments of `Axes.plot`


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


def raise_powers(text: str) -> str:
    """`deg s^2` with its exponent raised."""
    return re.sub(r"\^(\d+)", r"$^{\1}$", text)


def plain_ticks(axis: Axis, subs: Sequence[float | int] = (1, 2, 5)) -> None:
    """Ticks at `subs` of every decade as plain numbers, not as 2 x 10^1."""
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def marks(names: Iterable[str]) -> dict[str, Style]:
    """A mark for each design, by its place. Raises ValueError for more than there are."""
    names = list(names)
    if len(names) > len(_MARKS):
        raise ValueError(
            f"{len(names)} designs are too many to be distinguished, {len(_MARKS)} is the most: "
            f"leave some of {names} out"
        )
    return {name: dict(mark) for name, mark in zip(names, _MARKS, strict=False)}


def draw_limit(panel: Axes, bound: float, text: str) -> None:
    """A dashed line with a text at its right end."""
    panel.axhline(bound, color="black", lw=1.0, ls="--", zorder=3.5)
    box = {"boxstyle": "square,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
    panel.annotate(
        text, (1.0, bound), xycoords=("axes fraction", "data"), xytext=(-3, 2),
        textcoords="offset points", ha="right", va="bottom", fontsize=8, bbox=box, zorder=5,
    )  # fmt: skip
