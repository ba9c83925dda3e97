"""Axes of a figure, laid out in inches, on the screen of a notebook or off it.

A layout that measures every text first draws a figure twice. Here margins are fixed, and the room
for a legend and a title is counted in lines.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from math import ceil

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure


WIDTH = 6.5
_LEFT, _RIGHT, _TOP, _BOTTOM, _GAP = 0.9, 0.15, 0.2, 0.5, 0.12
_LABEL = 0.68  # from a panel to the label of its vertical axis
_LINE = 0.2  # of a legend or a title
_LETTER = 0.072  # of a legend, on average
_HANDLE = 0.55  # of a legend, with the space around it

Given = Axes | Sequence[Axes] | np.ndarray | None
_HEADLESS = ContextVar("headless", default=False)


class Panels(tuple[Axes, ...]):
    """The axes of a figure: from top to bottom, and a grid row by row.

    `.figure.savefig(path)` stores the figure. A notebook shows the figure, and no text for this.
    """

    own: bool  # a new figure, laid out here; else axes that the caller gave

    def __new__(cls, axes: Sequence[Axes], *, own: bool) -> "Panels":
        made = super().__new__(cls, axes)
        made.own = own
        return made

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


def _new_figure() -> Figure:
    if _HEADLESS.get():
        return Figure()
    import matplotlib.pyplot as plt  # here: it is slow to import, and needs no place in a report

    return plt.figure()


def stacked(count: int, ax: Given = None, *, columns: int = 1, shared: bool = True) -> Panels:
    """So many panels of a new figure, or those that are given; with columns in rows of so many.

    New ones have one horizontal axis if it is `shared`, with numbers at the lowest panels only.
    `arrange` gives new ones their places. Raises ValueError for another number of given ones.
    """
    if ax is not None:
        return _given(count, ax)
    figure = _new_figure()
    first = figure.add_axes((0, 0, 1, 1), label="0")
    panels = [first]
    for k in range(1, count):
        other = first if shared else None
        panels.append(figure.add_axes((0, 0, 1, 1), sharex=other, label=f"{k}"))
    for panel in panels[:-columns] if shared else ():
        panel.tick_params(labelbottom=False)
    return Panels(panels, own=True)


def _given(count: int, ax: Given) -> Panels:
    axes = [ax] if isinstance(ax, Axes) else list(np.ravel(np.asarray(ax, dtype=object)))
    if len(axes) != count or not all(isinstance(each, Axes) for each in axes):
        raise ValueError(
            f"ax holds {len(axes)} axes, but this plot draws {count}: give {count} axes, for "
            f"instance those of matplotlib.pyplot.subplots({count}), or leave ax= out"
        )
    return Panels(axes, own=False)


def arrange(
    panels: Panels,
    heights: Sequence[float],
    *,
    columns: int = 1,
    width: float = WIDTH,
    left: float = _LEFT,
    right: float = _RIGHT,
    above: float = 0.0,
    gap: float | Sequence[float] = _GAP,
    title: str = "",
    legend: Mapping[str, Artist] | None = None,
    handle_length: float = 2.0,
) -> Panels:
    """Give new panels their places, all in inches, a title above and a legend below.

    `heights` are those of the rows, `gap` the room below each of them, `above` that between the
    title and the first row, for what stands on it; `left` and `right` are margins of each column.
    Panels that the caller gave stay where they are: title and legend go into the first of them.
    """
    if not panels.own:
        return _annotate(panels, title, legend)
    left += _LINE * max(panel.get_ylabel().count("\n") for panel in panels)
    gaps = list(gap) if isinstance(gap, Sequence) else [gap] * (len(heights) - 1)
    lines = len(title.splitlines())
    top = _TOP + _LINE * lines + above
    across_legend, rows = _columns(legend or {}, width)
    bottom = _BOTTOM + (_LINE * rows + 0.15 if rows else 0.0)
    total = top + sum(heights) + sum(gaps) + bottom
    panels.figure.set_size_inches(width, total)
    column = width / columns
    across = column - left - right
    edge = total - top
    for row, (height, space) in enumerate(zip(heights, [*gaps, 0.0], strict=True)):
        for k, panel in enumerate(panels[row * columns : (row + 1) * columns]):
            x = k * column + left
            place = (x / width, (edge - height) / total, across / width, height / total)
            panel.set_position(place)
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


def _annotate(panels: Panels, title: str, legend: Mapping[str, Artist] | None) -> Panels:
    if title:
        panels[0].set_title(title, fontsize=10)
    if legend:
        panels[0].legend(legend.values(), legend.keys(), fontsize=8, handlelength=3.0)
    return panels


def _columns(legend: Mapping[str, Artist], width: float) -> tuple[int, int]:
    """Columns and rows."""
    if not legend:
        return 0, 0
    longest = max(map(len, legend))
    columns = max(1, min(len(legend), 3, int(width / (_HANDLE + _LETTER * longest))))
    return columns, ceil(len(legend) / columns)


def legend_of(panels: Sequence[Axes]) -> dict[str, Artist]:
    """What the panels have drawn, each text once."""
    named: dict[str, Artist] = {}
    for panel in panels:
        handles, labels = panel.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    return named
