"""Axes of a figure laid out in inches, their ticks, lines and marks, and names as texts of them.

A layout that measures every text first draws a figure twice. Here margins are fixed, and the room
for a legend and a title is counted in lines.
"""

import contextlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from math import ceil
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from jaxquad._core import readable


WIDTH = 6.5
_LEFT, _RIGHT, _TOP, _BOTTOM, _GAP = 0.9, 0.15, 0.2, 0.5, 0.12
_LABEL = 0.68  # from a panel to the label of its vertical axis
_LINE = 0.2  # of a legend or a title
_LETTER = 0.072  # of a legend, on average
_HANDLE = 0.55  # of a legend, with the space around it

AxesLike = Axes | Sequence[Axes] | np.ndarray | None  # to draw into; None for a new figure
_HEADLESS = ContextVar("headless", default=False)


class Panels(tuple[Axes, ...]):
    """The axes of a figure: from top to bottom, and a grid row by row.

    `.figure.savefig(path)` stores the figure. A notebook shows the figure, and no text for this.
    """

    new: bool  # a new figure, laid out here; else axes of the caller

    def __new__(cls, axes: Sequence[Axes], *, new: bool) -> "Panels":
        self = super().__new__(cls, axes)
        self.new = new
        return self

    @property
    def figure(self) -> Figure:
        """The figure that holds the axes."""
        return self[0].figure.figure  # of an axes within a sub-figure the whole

    def _ipython_display_(self) -> None:
        """Shown by matplotlib's own backend, at the end of the cell."""


@contextlib.contextmanager
def headless() -> Iterator[None]:
    """Make figures without pyplot inside a `with` block: no window, no display, quicker to start.

    For figures that only go to a file or a page, from many threads or in large numbers: pyplot
    keeps each of its figures until it is closed.
    """
    token = _HEADLESS.set(True)
    try:
        yield
    finally:
        _HEADLESS.reset(token)


def stacked(count: int, ax: AxesLike = None, *, columns: int = 1, shared: bool = True) -> Panels:
    """So many panels of a new figure, or those of `ax`; with columns in rows of so many.

    New ones have one horizontal axis if it is `shared`, with numbers at the lowest panels only.
    `arrange` gives new ones their places. Raises ValueError for another number of axes.
    """
    if ax is not None:
        axes = [ax] if isinstance(ax, Axes) else list(np.ravel(np.asarray(ax, dtype=object)))
        if len(axes) != count or not all(isinstance(panel, Axes) for panel in axes):
            raise ValueError(
                f"ax holds {len(axes)} axes, but this plot draws {count}: give {count} axes, for "
                f"instance those of matplotlib.pyplot.subplots({count}), or leave ax= out"
            )
        return Panels(axes, new=False)
    if _HEADLESS.get():
        figure = Figure()
    else:
        import matplotlib.pyplot as plt  # here: it is slow to import, and no report needs it

        figure = plt.figure()
    panels: list[Axes] = []
    for k in range(count):
        other = panels[0] if shared and panels else None
        panels.append(figure.add_axes((0, 0, 1, 1), sharex=other, label=f"{k}"))
    for panel in panels[:-columns] if shared else ():
        panel.tick_params(labelbottom=False)
    return Panels(panels, new=True)


def arrange(
    panels: Panels, heights: Sequence[float], *, columns: int = 1, width: float = WIDTH,
    left: float = _LEFT, right: float = _RIGHT, above: float = 0.0,
    gap: float | Sequence[float] = _GAP, title: str = "",
    legend: Mapping[str, Artist] | None = None, handle_length: float = 2.0,
) -> Panels:  # fmt: skip
    """Give new panels their places, all in inches, a title above and a legend below.

    `heights` are those of the rows, `gap` the room below each of them, `above` that between the
    title and the first row, for what stands on it; `left` and `right` are margins of each column.
    Panels of the caller stay where they are: title and legend go into the first of them.
    """
    title = visible(title)
    legend = {visible(name): artist for name, artist in (legend or {}).items()}
    if not panels.new:
        if title:
            panels[0].set_title(title, fontsize=10)
        if legend:
            panels[0].legend(legend.values(), legend.keys(), fontsize=8, handlelength=3.0)
        return panels
    left += _LINE * max(panel.get_ylabel().count("\n") for panel in panels)
    gaps = list(gap) if isinstance(gap, Sequence) else [gap] * (len(heights) - 1)
    top = _TOP + _LINE * len(title.splitlines()) + above
    longest = max(map(len, legend), default=0)
    across_legend = max(1, min(len(legend), 3, int(width / (_HANDLE + _LETTER * longest))))
    rows = ceil(len(legend) / across_legend)
    bottom = _BOTTOM + (_LINE * rows + 0.15 if rows else 0.0)
    total = top + sum(heights) + sum(gaps) + bottom
    panels.figure.set_size_inches(width, total)
    column, edge = width / columns, total - top
    across = column - left - right
    for row, (height, space) in enumerate(zip(heights, [*gaps, 0.0], strict=True)):
        for k, panel in enumerate(panels[row * columns : (row + 1) * columns]):
            x, y = (k * column + left) / width, (edge - height) / total
            panel.set_position((x, y, across / width, height / total))
            # Else every tick is measured in order to stand beside it.
            panel.yaxis.set_label_coords(-_LABEL / across, 0.5)
            panel.xaxis.set_label_coords(0.5, -0.35 / height)
        edge -= height + space
    if title:
        panels.figure.suptitle(title, fontsize=10, y=1 - 0.08 / total, va="top")
    if legend:
        place = {"loc": "lower center", "bbox_to_anchor": (0.5, 0.04 / total), "borderaxespad": 0}
        panels.figure.legend(
            legend.values(), legend.keys(), ncols=across_legend, fontsize=9,
            handlelength=handle_length, **place,
        )  # fmt: skip
    return panels


def legend_of(panels: Sequence[Axes]) -> dict[str, Artist]:
    """What the panels have drawn, each text once."""
    named: dict[str, Artist] = {}
    for panel in panels:
        handles, labels = panel.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    return named


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
    """A few ticks at round numbers of a logarithmic axis."""

    MOST = 6
    STEPS = ((1, 1.5, 2, 3, 4, 5, 7), (1, 2, 5), (1,))  # of a decade

    def tick_values(self, vmin: float, vmax: float) -> np.ndarray:
        low, high = sorted((vmin, vmax))
        decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
        ticks = np.empty(0)
        for steps in self.STEPS:
            round_numbers = np.multiply.outer(decades, steps).ravel()
            inside = (round_numbers >= low * (1 - 1e-9)) & (round_numbers <= high * (1 + 1e-9))
            ticks = round_numbers[inside]
            if ticks.size <= self.MOST:
                break
        if ticks.size < 2:
            return np.asarray(MaxNLocator(self.MOST).tick_values(low, high))
        return ticks[:: -(-ticks.size // self.MOST)]


def few_ticks(axis: Axis, most: int) -> None:
    """At most so many intervals of a linear axis, at round numbers."""
    axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]))


def plain_ticks(axis: Axis) -> None:
    """At most six ticks of a logarithmic axis, as plain numbers, not as 2 x 10^1."""
    axis.set_major_locator(_Ticks())
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


# Controls, overrides of the reading direction, halves of surrogate pairs: they break HTML, XML or
# UTF-8, or make a text look like another one.
_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]"
)
_SHORT = 28  # characters of a name in a figure
COHERENT = 0.6  # magnitude-squared coherence from which a frequency is commonly used


def visible(text: str) -> str:
    """A text with U+FFFD for characters that control a display instead of showing on it."""
    return _HIDDEN.sub("\ufffd", readable(text))


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
