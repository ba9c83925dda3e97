"""HTML from strings that nobody vouches for: what is not `Html` already is escaped."""

import html
from collections.abc import Mapping, Sequence

from jaxquad.plot import visible


class Html(str):
    """Markup that is safe as it stands."""


def escaped(text: str) -> Html:
    """A text as it is: markup in it is shown, not obeyed."""
    return text if isinstance(text, Html) else Html(html.escape(visible(text)))


def joined(*parts: str) -> Html:
    return Html("".join(escaped(part) for part in parts))


def element(
    name: str, *content: str, css: str = "", attributes: Mapping[str, str] | None = None
) -> Html:
    """`<name>content</name>`; `css` is its class."""
    known = ({"class": css} if css else {}) | dict(attributes or {})
    inside = "".join(f' {key}="{html.escape(visible(value))}"' for key, value in known.items())
    return Html(f"<{name}{inside}>{joined(*content)}</{name}>")


def given(name: str) -> Html:
    """A name from a log, whose reading direction ends with it."""
    return element("bdi", name)


def section(name: str, title: str, *content: str) -> Html:
    """A part of the page that links can point at."""
    return element("section", element("h2", title), *content, attributes={"id": name})


def items(texts: Sequence[str], *, css: str = "") -> Html:
    return element("ul", *(element("li", text) for text in texts), css=css)


def table(
    heads: Sequence[str], rows: Sequence[Sequence[str]], *, title: str, texts: int = 1
) -> Html:
    """The first of each row is its heading; the first `texts` columns are words, not numbers."""
    place = lambda k: "" if k < texts else "number"
    scope = lambda name: {"scope": name}
    head = [element("th", h, css=place(k), attributes=scope("col")) for k, h in enumerate(heads)]
    body = [
        element(
            "tr",
            element("th", row[0], attributes=scope("row")),
            *(element("td", cell, css=place(k + 1)) for k, cell in enumerate(row[1:])),
        )
        for row in rows
    ]
    inside = element(
        "table",
        element("caption", title),
        element("thead", element("tr", *head)),
        element("tbody", *body),
    )
    return scrolling(inside, title)


def scrolling(content: Html, label: str) -> Html:
    """What may be wider than a narrow screen; keys can scroll it too."""
    names = {"role": "region", "tabindex": "0", "aria-label": label}
    return element("div", content, css="wide", attributes=names)
