from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from jaxquad.report._html_page import page
from jaxquad.report._html_text import element, given, Html, joined, section, table

from ._store import write_whole
from ._table import columns, flattened, Row


_WORDS = ("failed", "not identifiable", "identified")  # what needs a look comes first


def write_summary(out: Path, rows: Sequence[Row], *, title: str) -> Path:
    """Write `summary.html`: what became of each log, with a link to its report."""
    counts = Counter(row["status"] for row in rows)
    states = [*_WORDS, *sorted(set(counts) - set(_WORDS))]
    said = ", ".join(f"{counts[word]} {word}" for word in states if counts[word])
    heading = element("h1", given(title), f": {len(rows)} logs, {said or 'none done'}")
    parts = [_part(word, [r for r in rows if r["status"] == word]) for word in states]
    files = element(
        "p", "The same as ", element("a", "table.csv", attributes={"href": "table.csv"})
    )
    body = joined(element("header", heading, files), element("main", *filter(None, parts)))
    path = out / "summary.html"
    write_whole(path, page(f"{title}: {said}", body).encode())
    return path


def _part(word: str, rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    flat = [flattened(row) for row in rows]
    failed = word == "failed"
    numbers = [n for n in columns(flat) if n not in ("log", "status", "error", "report", "key")]
    heads = ["log", "error", "seconds"] if failed else ["log", *numbers]
    body = [
        [_link(row), *(_text(row.get(name)) for name in heads[1:])]
        for row in flat
    ]  # fmt: skip
    title = word.capitalize()
    return section(word.replace(" ", "-"), title, table(heads, body, title=title, texts=1 + failed))


def _link(row: Row) -> Html:
    if not row.get("report"):
        return given(row["log"])
    return element("a", given(row["log"]), attributes={"href": quote(row["report"])})


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.5g}" if isinstance(value, int | float) else str(value)
