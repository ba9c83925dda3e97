"""The parts of a page: templates, the script of its figures, tables, headlines."""

import base64
import functools as ft
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

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


_TEMPLATES = Path(__file__).parent / "templates"


@ft.cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        finalize=_visible,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    script = (_TEMPLATES / "figures.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    environment.globals |= {"script": Markup(script), "script_digest": f"sha256-{digest}"}
    return environment


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


def short_unit(unit: str) -> str:
    """A unit for the label of a figure."""
    return short_names([unit])[0] if unit else ""
