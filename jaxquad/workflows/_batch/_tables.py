import csv
import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from jaxquad._core import write_file

from ._jobs import Content


Row = Content  # "log", "key", and what the work returned
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
    write_file(out / "table.csv", text.getvalue())
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


def _cell(value: object) -> object:
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
    write_file(out / "table.parquet", buffer.getvalue())
    return [out / "table.parquet"]


def _typed(value: object, is_text: bool) -> str | float | None:
    if is_text and value is not None:
        return str(value).encode("utf-8", "replace").decode()
    return float(value) if isinstance(value, int | float) else None


_STATES = ("failed", "not identifiable", "identified")  # what needs a look comes first


def write_summary(out: Path, rows: Sequence[Row], *, title: str) -> Path:
    """Write `summary.html`: the state of each log, with a link to its report."""
    from jaxquad.report import render_page

    counts = Counter(row["status"] for row in rows)
    states = [*_STATES, *sorted(set(counts) - set(_STATES))]
    counted = ", ".join(f"{counts[state]} {state}" for state in states if counts[state])
    parts = [_part(state, [row for row in rows if row["status"] == state]) for state in states]
    text = render_page(
        "summary.html",
        title=f"{title}: {counted}",
        folder=title,
        count=len(rows),
        counts=counted,
        parts=[part for part in parts if part],
    )
    return write_file(out / "summary.html", text)


def _part(state: str, rows: Sequence[Row]) -> dict[str, object]:
    """The logs of one state, as a table."""
    from jaxquad.report import Cell, Table

    if not rows:
        return {}
    flat = [flattened(row) for row in rows]
    failed = state == "failed"
    numbers = [n for n in columns(flat) if n not in ("log", "status", "error", "report", "key")]
    heads = ["log", "error", "seconds"] if failed else ["log", *numbers]
    body = [
        [
            Cell(str(row["log"]), link=quote(row["report"] or "")),
            *(_text(row[n]) for n in heads[1:]),
        ]
        for row in ({n: None for n in heads} | row for row in flat)
    ]
    title = state.capitalize()
    table = Table(title, heads, body, texts=1 + failed)
    return {"key": state.replace(" ", "-"), "title": title, "table": table}


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.5g}" if isinstance(value, int | float) else str(value)
