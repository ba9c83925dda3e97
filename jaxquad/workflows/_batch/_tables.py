import csv
import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jaxquad.report import element, given, Html, joined, page, section, table

from ._store import write_whole


Row = dict[str, Any]  # "log", "status", "key", and what the work returned
_FIRST = ("log", "status")
_LAST = ("remarks", "seconds", "error", "report", "key")


def write_tables(out: Path, rows: Sequence[Row]) -> list[Path]:
    """Write `table.csv`, and `table.parquet` where pyarrow is installed."""
    flat = [flattened(row) for row in rows]
    names = columns(flat)
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, names, restval="")
    writer.writeheader()
    writer.writerows({name: _cell(row.get(name)) for name in names} for row in flat)
    write_whole(out / "table.csv", text.getvalue().encode("utf-8", "replace"))
    return [out / "table.csv", *_parquet(out, flat, names)]


def flattened(row: Row) -> Row:
    """One column for the value of each parameter and one for its standard error."""
    flat = {name: row.get(name) for name in (*_FIRST, *_LAST)}
    flat["remarks"] = len(row.get("remarks", ()))
    for parameter in row.get("parameters", ()):
        flat[parameter["name"]] = parameter["value"]
        flat[f"{parameter['name']} std.err."] = parameter["standard_error"]
    return flat


def columns(flat: Sequence[Row]) -> list[str]:
    """The names of all parameters, between what identifies a log and what is said of it."""
    found = dict.fromkeys(name for row in flat for name in row)
    return [*_FIRST, *(n for n in found if n not in (*_FIRST, *_LAST)), *_LAST]


def _cell(value: Any) -> Any:
    """What a spreadsheet would take for a formula becomes a text."""
    risky = isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r")
    return f"'{value}" if risky else value


def _parquet(out: Path, flat: Sequence[Row], names: Sequence[str]) -> list[Path]:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        return []
    buffer = io.BytesIO()
    texts = {*_FIRST, "error", "report", "key"}
    arrays = {
        name: pa.array([_typed(row.get(name), name in texts) for row in flat],
                       pa.string() if name in texts else pa.float64())
        for name in names
    }  # fmt: skip
    pq.write_table(pa.table(arrays), buffer)
    write_whole(out / "table.parquet", buffer.getvalue())
    return [out / "table.parquet"]


def _typed(value: Any, is_text: bool) -> Any:
    if value is None:
        return None
    return str(value).encode("utf-8", "replace").decode() if is_text else float(value)


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
