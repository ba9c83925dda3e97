"""The parts of a page: templates, tables, and figures as SVG, or as PNG where that is smaller."""

import base64
import functools as ft
import io
import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure

from jaxquad.plot import short_names, visible


class Cell(NamedTuple):
    """A cell of a table that is a name from a log, a `link` to a file, or too `high` a number."""

    text: str
    link: str = ""
    high: bool = False


class Table(NamedTuple):
    """A table of a page; the first `texts` columns hold words, the others numbers."""

    title: str
    heads: Sequence[str | Cell]
    rows: Sequence[Sequence[str | Cell]]
    texts: int = 1


class Headline(NamedTuple):
    """`level` is good, warn or bad; `word` is the verdict, `reason` why."""

    level: str
    word: str
    reason: str


@ft.cache
def _environment() -> Environment:
    return Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        finalize=_visible,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _visible(value: object) -> str:
    """Control characters and overrides of the reading direction do not reach the page."""
    return value if isinstance(value, Markup) else visible(str(value))


def render_page(template: str, **content: object) -> str:
    """A whole document from a template of `jaxquad/report/templates`.

    **Arguments:**

    - `template`: its file name.
    - `content`: what the template names. Texts in it are escaped.
    """
    return _environment().get_template(template).render(**content)


_LARGEST = 220_000  # bytes of an SVG; a PNG of the figures here has about half of that
_OF_TEXTS, _OF_A_MARK, _OF_A_CORNER = 45_000, 145, 14  # bytes
_DPI = 150  # of a PNG
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


def embed_figure(
    draw: Callable[[], Figure],
    *,
    alt: str,
    caption: str = "",
    ratio: tuple[str, str] | None = None,
) -> Image:
    """What `draw()` returns as an image. Texts in it are drawn as they are, dollar signs too."""
    settings = {"svg.hashsalt": "jaxquad", "svg.fonttype": "path", "text.parse_math": False}
    with warnings.catch_warnings(), rc_context(settings):  # pyright: ignore[reportArgumentType]
        # A letter that the font does not have is drawn as a box: the caption holds it.
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        drawn = draw()
        kind, data = _encoded(drawn)
    width, height = (f"{_WIDTH * inches:.0f}" for inches in drawn.get_size_inches())
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return Image(alt, width, height, source, caption, ratio)


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


def short_unit(unit: str) -> str:
    """A unit for the label of a figure."""
    return short_names([unit])[0] if unit else ""
