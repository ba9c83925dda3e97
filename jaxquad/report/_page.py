"""Pages from templates: every text that is filled in is made visible and escaped."""

import functools as ft
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from jaxquad.plot import visible


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
