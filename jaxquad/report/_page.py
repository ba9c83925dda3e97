"""The parts of a page: templates, tables, headlines, and figures with the numbers of their curves.

Figures are as wide as a phone shows them.
"""

import base64
import functools as ft
import hashlib
import io
import json
import re
import warnings
from collections.abc import Callable, Sequence
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.legend import Legend

from jaxquad.plot import headless, Panels, visible

from ._results import reason_of


class Cell(NamedTuple):
    """A cell of a table that is a name from a log, a `link` to a file, or too `high` a number."""

    text: str
    link: str = ""
    high: bool = False


class Table(NamedTuple):
    """A table of a page, with notes below; the first `texts` columns hold words, others numbers."""

    title: str
    heads: Sequence[str | Cell]
    rows: Sequence[Sequence[str | Cell]]
    texts: int = 1
    notes: Sequence[str] = ()


class Headline(NamedTuple):
    """`level` is good, warn or bad; `word` is the verdict, `reason` why."""

    level: str
    word: str
    reason: str


_TEMPLATES = Path(__file__).parent / "templates"


@ft.cache
def _environment() -> Environment:
    # Control characters and overrides of the reading direction do not reach the page.
    show = lambda value: value if isinstance(value, Markup) else visible(str(value))
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, finalize=show,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    script = (_TEMPLATES / "figures.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    environment.globals |= {"script": Markup(script), "script_digest": f"sha256-{digest}"}
    return environment


def render_page(template: str, **content: object) -> str:
    """A whole document from a template of `jaxquad/report/templates`.

    **Arguments:**

    - `template`: its file name.
    - `content`: what the template names. Texts in it are escaped.
    """
    return _environment().get_template(template).render(**content)


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
    draw: Callable[[], Panels | Figure], *, alt: str, caption: str = "",
    ratio: tuple[str, str] | None = None, is_map: bool = False,
) -> Image:  # fmt: skip
    """What `draw()` returns as an image. Texts in it are drawn as they are, dollar signs too.

    Where that cannot be drawn, the page says why in its place.
    """
    settings = {"svg.hashsalt": "jaxquad", "svg.fonttype": "path", "text.parse_math": False}
    silent = warnings.catch_warnings()
    try:
        with headless(), silent, rc_context(settings):  # pyright: ignore[reportArgumentType]
            # A letter that the font does not have is drawn as a box: the caption holds it.
            warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
            figure = draw().figure  # a figure is its own
            _make_narrow(figure)
            kind, data = _encode(figure)
        width, height = (f"{_WIDTH * inches:.0f}" for inches in figure.get_size_inches())
        source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
        return Image(alt, width, height, source, caption, ratio, _curves(figure), is_map)
    except Exception as error:
        return Image(alt, "", "", "", failure=reason_of(error))


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
    rows = lambda across: sum(
        ceil(len(legend.get_texts()) / _columns(legend, across)) for legend in figure.legends
    )
    extra = _ROW * (rows(narrow) - rows(width))
    figure.set_size_inches(narrow, height + extra)
    for panel in figure.axes:
        left, low, across, high = panel.get_position().bounds
        low, high = ((low * height + extra) / (height + extra), high * height / (height + extra))
        panel.set_position((left, low, across, high))
    for legend in list(figure.legends):
        labels, columns = [text.get_text() for text in legend.get_texts()], _columns(legend, narrow)
        legend.remove()
        figure.legend(
            [handle for handle in legend.legend_handles if handle is not None], labels,
            ncols=columns, fontsize=9, loc="lower center", borderaxespad=0, handlelength=2.0,
            bbox_to_anchor=(0.5, 0.04 / (height + extra)),
        )  # fmt: skip
    if title := figure.get_suptitle():
        letters = _TITLE * narrow / _NARROW / max(map(len, title.splitlines()))
        top = 1 - 0.08 / (height + extra)
        figure.suptitle(title, fontsize=10 * min(1.0, letters), y=top, va="top")


def _columns(legend: Legend, width: float) -> int:
    longest = max(len(text.get_text()) for text in legend.get_texts())
    return max(1, min(len(legend.get_texts()), 3, int(width / (_HANDLE + _LETTER * longest))))


def _encode(figure: Figure) -> tuple[str, bytes]:
    """As SVG, or as PNG where that is smaller: before it is drawn, which takes longest of all.

    Coordinates to a hundredth of a point, which nobody sees, take half of the room.
    """
    lines = [line for panel in figure.axes for line in panel.get_lines()]
    marked = sum(np.size(line.get_xdata()) for line in lines if line.get_marker() != "None")
    joined = sum(np.size(line.get_xdata()) for line in lines if line.get_linestyle() != "None")
    file = io.BytesIO()
    if _OF_TEXTS + _OF_A_MARK * marked + _OF_A_CORNER * joined > _LARGEST:
        figure.savefig(file, format="png", dpi=_DPI, metadata={"Software": None})
        return "png", file.getvalue()
    figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    shorten = lambda path: _DECIMALS.sub(rb"\1", path[0]).replace(b" \n", b"\n")
    return "svg+xml", _PATH.sub(shorten, file.getvalue())


_READ = 250  # points of a curve that a pointer reads
_FEWEST = 3  # points of a curve; less are limits and marks


def _curves(figure: Figure) -> str:
    """Places, scales and curves of all panels, for the script of the page."""
    below, panels = figure.axes[-1].get_xlabel() if figure.axes else "", []
    short = lambda values: [float(f"{value:.4g}") for value in values]
    for panel in figure.axes:
        series = []
        for line in panel.get_lines():
            x, y = np.ravel(line.get_xdata()), np.ravel(line.get_ydata())
            label = str(line.get_label())
            if label == "_nolegend_" or x.size < _FEWEST or x.dtype.kind not in "fi":
                continue
            if np.ptp(x) == 0:
                continue
            finite = np.flatnonzero(np.isfinite(x.astype(float)) & np.isfinite(y.astype(float)))
            places = finite[:: max(1, -(-finite.size // _READ))]
            name = "" if label.startswith("_") else visible(label)
            series.append([name, short(x[places]), short(y[places])])
        if not series:
            continue
        left, low, across, high = panel.get_position().bounds
        panels.append(
            {
                "box": [round(float(x), 4) for x in (left, 1 - low - high, across, high)],
                "x": [*map(float, panel.get_xlim()), panel.get_xscale() == "log"],
                "across": visible(panel.get_xlabel() or below),
                "up": visible(panel.get_ylabel() or panel.get_title(loc="left")),
                "series": series,
            }
        )
    return json.dumps(panels, separators=(",", ":"))
