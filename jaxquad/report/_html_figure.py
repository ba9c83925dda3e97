"""Figures as part of a page: SVG where that is small, PNG where it is not."""

import base64
import io
import re
import warnings
from collections.abc import Callable
from typing import Any

from jaxquad.plot import short_names

from ._html_text import element, Html


_LARGEST = 220_000  # bytes of an SVG; a PNG of the figures here has about half of that
_DPI = 150  # of a PNG
_PATH = re.compile(rb' d="[^"]*"')
_DECIMALS = re.compile(rb"(\.\d\d)\d+")
_WIDTH = 110  # pixels of a page for an inch


def figure(draw: Callable[[], Any], *, alt: str, caption: str = "", formulas: bool = False) -> Html:
    """What `draw()` returns, a `matplotlib.figure.Figure`, with a text for those who cannot see it.

    Texts in it are drawn as they are, dollar signs too, unless they are known to hold `formulas`.
    """
    from matplotlib import rc_context

    settings: Any = {"svg.hashsalt": "jaxquad", "svg.fonttype": "path", "text.parse_math": formulas}
    with warnings.catch_warnings(), rc_context(settings):
        # A letter that the font does not have is drawn as a box: the caption holds it.
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        drawn = draw()
        kind, data = _encoded(drawn)
    width, height = (f"{_WIDTH * inches:.0f}" for inches in drawn.get_size_inches())
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    named = {"alt": alt, "width": width, "height": height, "src": source}
    image = Html(element("img", attributes=named).removesuffix("</img>"))
    return element("figure", image, element("figcaption", caption) if caption else Html(""))


def _encoded(drawn: Any) -> tuple[str, bytes]:
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
