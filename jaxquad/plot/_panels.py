"""Figures of panels one above the other, laid out in inches.

A layout that measures every text first draws a figure twice. Here margins are fixed, and the room
for a legend and a title is counted in lines.
"""

from collections.abc import Mapping, Sequence
from math import ceil

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure


WIDTH = 6.5
_LEFT, _RIGHT, _TOP, _BOTTOM, _GAP = 0.9, 0.15, 0.2, 0.5, 0.12
_LABEL = 0.68  # from a panel to the label of its vertical axis
_LINE = 0.2  # of a legend or a title
_LETTER = 0.072  # of a legend, on average
_HANDLE = 0.55  # of a legend, with the space around it


def stacked(count: int) -> tuple[Figure, list[Axes]]:
    """A figure and its panels, with one horizontal axis; `arrange` gives them their places."""
    figure = Figure()
    first = figure.add_axes((0, 0, 1, 1), label="0")
    panels = [first]
    for k in range(1, count):
        panels.append(figure.add_axes((0, 0, 1, 1), sharex=first, label=f"{k}"))
    for panel in panels[:-1]:
        panel.tick_params(labelbottom=False)
    return figure, panels


def arrange(
    figure: Figure,
    panels: Sequence[Axes],
    heights: Sequence[float],
    *,
    width: float = WIDTH,
    left: float = _LEFT,
    above: float = 0.0,
    gap: float = _GAP,
    title: str = "",
    legend: Mapping[str, Artist] | None = None,
    handle_length: float = 2.0,
) -> None:
    """Give panels their places, all in inches, a title above and a legend below.

    `above` is room between the title and the first panel, for what stands on it.
    """
    lines = len(title.splitlines())
    top = _TOP + _LINE * lines + above
    columns, rows = _columns(legend or {}, width)
    bottom = _BOTTOM + (_LINE * rows + 0.15 if rows else 0.0)
    total = top + sum(heights) + gap * (len(heights) - 1) + bottom
    figure.set_size_inches(width, total)
    across = width - left - _RIGHT
    edge = total - top
    for panel, height in zip(panels, heights, strict=True):
        panel.set_position((left / width, (edge - height) / total, across / width, height / total))
        # Else every tick is measured in order to stand beside it.
        panel.yaxis.set_label_coords(-_LABEL / across, 0.5)
        panel.xaxis.set_label_coords(0.5, -0.35 / height)
        edge -= height + gap
    if title:
        figure.suptitle(title, fontsize=10, y=1 - 0.08 / total, va="top")
    if legend:
        place = {"loc": "lower center", "bbox_to_anchor": (0.5, 0.04 / total), "borderaxespad": 0}
        figure.legend(
            legend.values(), legend.keys(), ncols=columns, fontsize=9, handlelength=handle_length,
            **place,
        )  # fmt: skip


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
