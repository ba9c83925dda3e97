"""Ticks, lines and marks: what figures share."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator


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
LINES: tuple[Style, ...] = (  # told apart by dash, by lightness and by colour
    {"color": "tab:blue", "ls": "-", "lw": 1.6},
    {"color": "tab:red", "ls": "--", "lw": 1.6},
    {"color": "tab:green", "ls": "-.", "lw": 1.4},
    {"color": "tab:purple", "ls": (0, (1, 1.2)), "lw": 1.8},
    {"color": "0.45", "ls": (0, (6, 1, 1, 1, 1, 1)), "lw": 1.4},
)


def look_of(k: int, name: str) -> Style:
    """The line of one of several models. Raises ValueError beyond the last there is."""
    if k >= len(LINES):
        raise ValueError(
            f"{name} is curve {k + 1}, too many to be distinguished, {len(LINES)} is the most: "
            "split them over several figures"
        )
    return LINES[k] | {"label": name}


class _Ticks(LogLocator):
    """At most so many ticks at round numbers of a logarithmic axis."""

    STEPS = ((1, 1.5, 2, 3, 4, 5, 7), (1, 2, 5), (1,))  # of a decade

    def __init__(self, most: int):
        super().__init__()
        self.most = most

    def tick_values(self, vmin: float, vmax: float) -> np.ndarray:
        low, high = sorted((vmin, vmax))
        decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
        ticks = np.empty(0)
        for steps in self.STEPS:
            each = np.multiply.outer(decades, steps).ravel()
            ticks = each[(each >= low * (1 - 1e-9)) & (each <= high * (1 + 1e-9))]
            if ticks.size <= self.most:
                break
        if ticks.size < 2:
            return np.asarray(MaxNLocator(self.most).tick_values(low, high))
        return ticks[:: -(-ticks.size // self.most)]


def few_ticks(axis: Axis, most: int) -> None:
    """At most so many intervals of a linear axis, at round numbers."""
    axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]))


def plain_ticks(axis: Axis, most: int = 6) -> None:
    """At most so many ticks of a logarithmic axis, as plain numbers, not as 2 x 10^1."""
    axis.set_major_locator(_Ticks(most))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


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


def add_hertz(panel: Axes, side: str = "top", text: str = "frequency, Hz") -> None:
    """A second axis in Hz of one in rad/s: above ("top") the horizontal one, or on the "right"."""
    turn = 2 * np.pi
    functions = (lambda omega: omega / turn, lambda hertz: hertz * turn)
    if side == "top":
        hertz = panel.secondary_xaxis("top", functions=functions)
        hertz.set_xlabel(text)
        plain_ticks(hertz.xaxis)
    else:
        panel.secondary_yaxis("right", functions=functions).set_ylabel(text)
