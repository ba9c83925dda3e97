"""What was flown: every channel over time, and its size."""

from collections.abc import Mapping

from jaxquad.plot import channels_of, record_overview, ROWS, unit_label
from jaxquad.records import Record

from ._html_figure import figure
from ._html_text import element, given, Html, joined, section, table


def record_section(records: Mapping[str, Record]) -> Html:
    parts = []
    for name, record in records.items():
        parts += [element("h3", given(name))] if len(records) > 1 else []
        parts += [_record(record)]
    return section("record", "Record and excitation", *parts)


def _record(record: Record) -> Html:
    channels = channels_of(record)
    drawn, rest = channels[:ROWS], channels[ROWS:]
    names = ", ".join(f"{role} {name}" for role, name in drawn)
    told = (
        f"{record.samples} samples, {record.duration:.6g} s at {record.sample_rate:.6g} Hz, from "
        f"t = {record.time[0]:.6g} s to {record.time[-1]:.6g} s."
    )
    outside = "" if record.reference_names else " There is no outside reference."
    return joined(
        element("p", given(record.source), css="soft") if record.source else "",
        element("p", told, outside),
        figure(
            lambda: record_overview(record, drawn),
            alt=f"Over time, from top to bottom: {names}.",
            caption=f"{len(rest)} more channels are not drawn." if rest else "",
        ),
        _channels(record, channels),
    )  # fmt: skip


def _channels(record: Record, channels: list[tuple[str, str]]) -> Html:
    rows = []
    for role, name in channels:
        scale, unit = unit_label(record.unit(name))
        values = scale * record.channel(name)
        numbers = (values.mean(), values.std(), values.min(), values.max())
        named = given(unit.removeprefix(", ")) if unit else "\u2013"
        rows.append([given(name), role, named, *(f"{x:.4g}" for x in numbers)])
    heads = ("channel", "role", "unit", "mean", "std. deviation", "minimum", "maximum")
    return table(heads, rows, title="Channels", texts=3)
