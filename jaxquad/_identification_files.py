"""What `jaxquad identify` leaves behind: `result.json`, `report.html` and its figures."""

import shlex
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ._identification_model import model_content, setup_content
from .identify import Combination, Fit, NotIdentifiable, Verification
from .records import Record
from .report import (
    bode,
    overlay,
    Provenance,
    provenance,
    record_figure,
    write_report,
    write_results,
)
from .spectra import FrequencyResponse


_MIXES = ("input", "output", "reference")
_NO_OPTIONS = ("file", "run", "json")


def write_identification(
    options: Namespace,
    records: Sequence[Record],
    frfs: Mapping[str, FrequencyResponse],
    outcome: Fit | NotIdentifiable,
    check: Verification | None,
    *,
    formula: str = "",
    derived: Sequence[Combination] = (),
) -> tuple[Path, list[str]]:
    """Write the folder; returns the path of `result.json` and the names of the other files.

    The first of `frfs` was fitted, the others are drawn beside it.
    """
    folder = options.out or Path("results") / options.file.stem
    method, *rest = frfs
    spans = [[float(record.time[0]), float(record.time[-1])] for record in records]
    source = {"file": str(options.file), "start_s": min(start for start, _ in spans)}
    source |= {"stop_s": max(stop for _, stop in spans), "segments_s": spans}
    source |= {"sample_rate_hz": records[0].sample_rate}
    origin = _origin(options)
    extra = {"record": source, "provenance": origin.content()}
    extra |= {"derived": [_row(each) for each in derived]}
    extra |= model_content(outcome) | setup_content(options, frfs[method])
    path = write_results(folder, fit=outcome, frf=frfs[method], check=check, extra=extra)
    others = {f"{name} estimate": frfs[name] for name in rest}
    names = _draw(folder, options, records, frfs[method], outcome, check, others)
    write_report(
        folder / "report.html",
        fit=outcome,
        frf=frfs[method],
        others=others,
        record={_span(each): each for each in records},
        checks=None if check is None else {options.verify.name: check},
        derived=derived,
        provenance=origin,
        formula=formula,
    )
    return path, ["report.html", *names]


def _draw(
    folder: Path,
    options: Namespace,
    records: Sequence[Record],
    frf: FrequencyResponse,
    outcome: Fit | NotIdentifiable,
    check: Verification | None,
    others: Mapping[str, FrequencyResponse],
) -> list[str]:
    models = {"identified": outcome.model} if isinstance(outcome, Fit) else None
    figures = {
        **{_figure(k): record_figure(record) for k, record in enumerate(records, start=1)},
        "bode.png": bode(frf, models, others=others, title=options.file.name),
    }
    if check is not None:
        figures["verification.png"] = overlay(check, title=options.verify.name)
    for earlier in (folder / "verification.png", *folder.glob("record_*.png")):
        if earlier.name not in figures:
            earlier.unlink(missing_ok=True)
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=130)
    return list(figures)


def _row(each: Combination) -> dict[str, Any]:
    return {"name": each.name, "value": each.value, "standard_error": each.standard_error}


def _figure(k: int) -> str:
    return "record.png" if k == 1 else f"record_{k}.png"


def _span(record: Record) -> str:
    return f"t = {record.time[0]:.6g} .. {record.time[-1]:.6g} s"


def _origin(options: Namespace) -> Provenance:
    files = [options.file] + ([options.verify] if options.verify else [])
    return provenance(*files, command=command_of(options))


def command_of(options: Namespace) -> str:
    """The command line that these options stand for, with the defaults that were in force."""
    words = ["jaxquad", "identify", str(options.file)]
    for name, value in vars(options).items():
        if name not in _NO_OPTIONS:
            words += _words(name, value)
    return shlex.join(words)


def _words(name: str, value: Any) -> list[str]:
    flag = f"--{name.replace('_', '-')}"
    if value is None or value is False:
        return []
    if value is True:
        return [flag]
    if name in _MIXES:
        return [flag, _mix(value)]
    if name == "unit":
        return [word for channel, unit in value for word in (flag, f"{channel}={unit}")]
    if name == "segment":  # as one word, or a negative start would be taken for an option
        return [f"{flag}={start!r}:{stop!r}" for start, stop in value]
    if isinstance(value, list | tuple):
        return [flag, *map(str, value)] if value else []
    return [flag, str(value)]


def _mix(mix: Mapping[str, Mapping[str, float]]) -> str:
    """As `jaxquad.cli.parse_mix` reads it."""
    [(name, weights)] = mix.items()
    if dict(weights) == {name: 1.0}:
        return name
    return f"{name}=" + "".join(f"{weight:+}*{channel}" for channel, weight in weights.items())
