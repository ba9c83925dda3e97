"""Figures as part of a page: SVG where that is small, PNG where it is not."""

import base64
import io
import re
import warnings
from collections.abc import Callable
from typing import NamedTuple

from matplotlib import rc_context
from matplotlib.figure import Figure

from jaxquad.plot import short_names


_LARGEST = 220_000  # bytes of an SVG; a PNG of the figures here has about half of that
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
    formulas: bool = False,
) -> Image:
    """What `draw()` returns as an image.

    Texts in it are drawn as they are, dollar signs too, unless they are known to hold `formulas`.
    """
    settings = {"svg.hashsalt": "jaxquad", "svg.fonttype": "path", "text.parse_math": formulas}
    with warnings.catch_warnings(), rc_context(settings):  # pyright: ignore[reportArgumentType]
        # A letter that the font does not have is drawn as a box: the caption holds it.
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        drawn = draw()
        kind, data = _encoded(drawn)
    width, height = (f"{_WIDTH * inches:.0f}" for inches in drawn.get_size_inches())
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return Image(alt, width, height, source, caption, ratio)


def _encoded(drawn: Figure) -> tuple[str, bytes]:
    if (layout := drawn.get_layout_engine()) is not None:
        layout.execute(drawn)  # once: savefig would do it twice, which takes longest of all
        drawn.set_layout_engine("none")
    svg = io.BytesIO()
    drawn.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
    if len(lines := _rounded(svg.getvalue())) <= _LARGEST:
        return "svg+xml", lines
    png = io.BytesIO()
    drawn.savefig(png, format="png", dpi=_DPI, metadata={"Software": None})
    return "png", png.getvalue()


def _rounded(svg: bytes) -> bytes:
    """Coordinates to a hundredth of a point, which nobody sees, take half of the room."""
    return _PATH.sub(lambda path: _DECIMALS.sub(rb"\1", path[0]).replace(b" \n", b"\n"), svg)


def short_unit(unit: str) -> str:
    """A unit for the label of a figure."""
    return short_names([unit])[0] if unit else ""
