"""Figures inside a page: as wide as a phone shows them, with the numbers behind their curves."""

import base64
import io
import json
import re
import warnings
from collections.abc import Callable, Sequence
from math import ceil
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D

from jaxquad.plot import headless, Panels, visible

from ._attempt import reason_of


Section = dict[str, Any]  # what a template of the page shows

_LARGEST = 220_000  # bytes of an SVG; a PNG of the figures here has about half of that
_OF_TEXTS, _OF_A_MARK, _OF_A_CORNER = 45_000, 145, 14  # bytes
_DPI = 200  # of a PNG
_PATH = re.compile(rb' d="[^"]*"')
_DECIMALS = re.compile(rb"(\.\d\d)\d+")
_WIDTH = 110  # pixels of a page for an inch


class Image(NamedTuple):
    """A figure inside a page, with a text for those who cannot see it."""

    alt: str
    width: str  # pixels
    height: str
    source: str  # a data: URL
    caption: str = ""
    ratio: tuple[str, str] | None = None  # output and input, in front of the caption
    curves: str = "[]"  # JSON: what a pointer reads on each panel
    is_map: bool = False  # its colours are a scale, which a dark page must not invert
    failure: str = ""  # why it could not be drawn


def embed_figure(
    draw: Callable[[], Panels | Figure],
    *,
    alt: str,
    caption: str = "",
    ratio: tuple[str, str] | None = None,
    is_map: bool = False,
) -> Image:
    """What `draw()` returns as an image. Texts in it are drawn as they are, dollar signs too.

    Where that cannot be drawn, the page says why in its place.
    """
    try:
        return _embedded(draw, alt, caption, ratio, is_map)
    except Exception as error:
        return Image(alt, "", "", "", failure=reason_of(error))


def _embedded(
    draw: Callable[[], Panels | Figure],
    alt: str,
    caption: str,
    ratio: tuple[str, str] | None,
    is_map: bool,
) -> Image:
    settings = {"svg.hashsalt": "jaxquad", "svg.fonttype": "path", "text.parse_math": False}
    silent = warnings.catch_warnings()
    with headless(), silent, rc_context(settings):  # pyright: ignore[reportArgumentType]
        # A letter that the font does not have is drawn as a box: the caption holds it.
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        drawn = draw().figure  # a figure is its own
        _make_narrow(drawn)
        kind, data = _encoded(drawn)
    width, height = (f"{_WIDTH * inches:.0f}" for inches in drawn.get_size_inches())
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return Image(alt, width, height, source, caption, ratio, _curves(drawn), is_map)


_NARROW = 5.0  # inches: letters of 10 points are 10 pixels high on a screen of 390
_TAKEN = 1.5  # inches, off a figure that is wider than usual
_ROW, _LETTER, _HANDLE = 0.2, 0.072, 0.6  # inches, of a legend
_TITLE = 68  # letters of a title in one line


def _make_narrow(figure: Figure) -> None:
    """Take the figure's width off its panels: texts keep their size, legends get more rows."""
    width, height = figure.get_size_inches()
    narrow = max(_NARROW, width - _TAKEN)
    if width <= narrow:
        return
    extra = sum(_ROW * (_rows(each, narrow) - _rows(each, width)) for each in figure.legends)
    figure.set_size_inches(narrow, height + extra)
    for panel in figure.axes:
        left, low, across, high = panel.get_position().bounds
        low, high = ((low * height + extra) / (height + extra), high * height / (height + extra))
        panel.set_position((left, low, across, high))
    for legend in list(figure.legends):
        _lay_again(figure, legend, narrow, height + extra)
    if title := figure.get_suptitle():
        letters = _TITLE * narrow / _NARROW / max(map(len, title.splitlines()))
        top = 1 - 0.08 / (height + extra)
        figure.suptitle(title, fontsize=10 * min(1.0, letters), y=top, va="top")


def _labels(legend: Legend) -> list[str]:
    return [text.get_text() for text in legend.get_texts()]


def _columns(legend: Legend, width: float) -> int:
    labels = _labels(legend)
    return max(1, min(len(labels), 3, int(width / (_HANDLE + _LETTER * max(map(len, labels))))))


def _rows(legend: Legend, width: float) -> int:
    return ceil(len(_labels(legend)) / _columns(legend, width))


def _lay_again(figure: Figure, legend: Legend, width: float, height: float) -> None:
    handles = [each for each in legend.legend_handles if each is not None]
    legend.remove()
    figure.legend(
        handles, _labels(legend), ncols=_columns(legend, width), fontsize=9, loc="lower center",
        bbox_to_anchor=(0.5, 0.04 / height), borderaxespad=0, handlelength=2.0,
    )  # fmt: skip


def _encoded(drawn: Figure) -> tuple[str, bytes]:
    file = io.BytesIO()
    if _svg_size(drawn) > _LARGEST:
        drawn.savefig(file, format="png", dpi=_DPI, metadata={"Software": None})
        return "png", file.getvalue()
    drawn.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return "svg+xml", _rounded(file.getvalue())


def _svg_size(drawn: Figure) -> int:
    """In bytes, about: before it is drawn, because that takes longest of all."""
    lines = [line for panel in drawn.axes for line in panel.get_lines()]
    marked = sum(np.size(line.get_xdata()) for line in lines if line.get_marker() != "None")
    joined = sum(np.size(line.get_xdata()) for line in lines if line.get_linestyle() != "None")
    return _OF_TEXTS + _OF_A_MARK * marked + _OF_A_CORNER * joined


def _rounded(svg: bytes) -> bytes:
    """Coordinates to a hundredth of a point, which nobody sees, take half of the room."""
    return _PATH.sub(lambda path: _DECIMALS.sub(rb"\1", path[0]).replace(b" \n", b"\n"), svg)


_READ = 250  # points of a curve that a pointer reads
_FEWEST = 3  # points of a curve; less are limits and marks


def _curves(figure: Figure) -> str:
    """Places, scales and curves of all panels, for the script of the page."""
    below = figure.axes[-1].get_xlabel() if figure.axes else ""
    found = [_panel(panel, below) for panel in figure.axes]
    return json.dumps([each for each in found if each["series"]], separators=(",", ":"))


def _panel(panel: Axes, below: str) -> dict[str, object]:
    left, low, across, high = panel.get_position().bounds
    lines = [line for line in panel.get_lines() if line.get_label() != "_nolegend_"]
    return {
        "box": [round(float(x), 4) for x in (left, 1 - low - high, across, high)],
        "x": [*map(float, panel.get_xlim()), panel.get_xscale() == "log"],
        "across": visible(panel.get_xlabel() or below),
        "up": visible(panel.get_ylabel() or panel.get_title(loc="left")),
        "series": [each for each in map(_series, lines) if each is not None],
    }


def _series(line: Line2D) -> list[object] | None:
    x, y = np.ravel(line.get_xdata()), np.ravel(line.get_ydata())
    if x.size < _FEWEST or x.dtype.kind not in "fi" or np.ptp(x) == 0:
        return None
    known = np.flatnonzero(np.isfinite(x.astype(float)) & np.isfinite(y.astype(float)))
    kept = known[:: max(1, -(-known.size // _READ))]
    label = str(line.get_label())
    name = "" if label.startswith("_") else visible(label)
    return [name, _short(x[kept]), _short(y[kept])]


def _short(values: Sequence[float] | np.ndarray) -> list[float]:
    return [float(f"{value:.4g}") for value in values]
