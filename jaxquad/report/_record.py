"""The time domain: the record that was flown, and the model simulated on records."""

from collections.abc import Mapping
from dataclasses import replace

from jaxquad.identify import Verification
from jaxquad.plot import (
    channels_of,
    compare,
    record_figure,
    ROWS,
    short_names,
    unit_label,
)
from jaxquad.records import clock_start, Record, show_times

from ._figure import embed_figure, Image
from ._page import Cell, short_unit, Table


GOOD_TIC = 0.25  # Theil inequality coefficient, below which agreement is good
_DASH = "\u2013"


def record_section(records: Mapping[str, Record]) -> list[dict[str, object]]:
    """Every channel over time, and its size."""
    shown = lambda name: name if len(records) > 1 else ""
    return [{"name": shown(name), **_record(record)} for name, record in records.items()]


def _record(record: Record) -> dict[str, object]:
    channels = channels_of(record)
    drawn, rest = channels[:ROWS], channels[ROWS:]
    names = ", ".join(f"{role} {name}" for role, name in drawn)
    text = (
        f"{record.samples} samples, {record.duration:.6g} s at {record.sample_rate:.6g} Hz, "
        f"t = {show_times(record.time[0], record.time[-1], start=clock_start(record.time))}."
    )
    outside = "" if record.reference_names else " There is no external reference."
    image = embed_figure(
        lambda: record_figure(record, drawn),
        alt=f"Over time, from top to bottom: {names}.",
        caption=f"{len(rest)} more channels are not drawn." if rest else "",
    )
    table = _channels(record, channels)
    return {"source": record.source, "text": text + outside, "image": image, "channels": table}


def _channels(record: Record, channels: list[tuple[str, str]]) -> Table:
    rows = []
    for role, name in channels:
        scale, unit = unit_label(record.unit(name))
        values = scale * record.channel(name)
        numbers = (values.mean(), values.std(), values.min(), values.max())
        rows.append([Cell(name), role, _unit(unit), *(f"{x:.4g}" for x in numbers)])
    heads = ("channel", "role", "unit", "mean", "std. deviation", "minimum", "maximum")
    return Table("Channels", heads, rows, texts=3)


def _unit(label: str) -> str | Cell:
    return Cell(label.removeprefix(", ")) if label else _DASH


def check_section(checks: Mapping[str, Verification]) -> dict[str, object]:
    """Measured and simulated outputs of each check."""
    shown = [
        {
            "name": name,
            "image": _overlay(name, check),
            "measures": _measures(check),
            "omitted": str(check.omitted) if check.omitted else "",
        }
        for name, check in checks.items()
    ]
    return {"good": GOOD_TIC, "checks": shown}


def _overlay(name: str, check: Verification) -> Image:
    outputs = zip(check.outputs, short_names([one.name for one in check.outputs]), strict=True)
    short = replace(
        check,
        outputs=tuple(replace(one, name=n, unit=short_unit(one.unit)) for one, n in outputs),
    )
    return embed_figure(
        lambda: compare(short),
        alt=f"Measured and simulated {check.output_name} over time, {name}: fit "
        f"{check.fit_percent:.1f} %, TIC {check.tic:.3f}.",
    )


def _measures(check: Verification) -> Table:
    rows = []
    for one in check.outputs:
        scale, unit = unit_label(one.unit)
        numbers = (f"{one.fit_percent:.1f}", f"{one.variance_percent:.1f}", f"{one.tic:.3f}")
        rows.append([Cell(one.name), _unit(unit), *numbers, f"{scale * one.rms:.4g}"])
    heads = ("output", "unit", "fit, %", "variance accounted for, %", "TIC", "rms difference")
    return Table(f"Agreement, {_band(check)}", heads, rows, texts=2)


def _band(check: Verification) -> str:
    if check.band is None:
        return "whole band"
    low, high = check.band
    return f"within {low:.4g} .. {high:.4g} rad/s"
