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
    record: Record,
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
    source = {"file": str(options.file), "start_s": float(record.time[0])}
    source |= {"stop_s": float(record.time[-1]), "sample_rate_hz": record.sample_rate}
    origin = _origin(options)
    extra = {"record": source, "provenance": origin.content()}
    extra |= model_content(outcome) | setup_content(options, frfs[method])
    path = write_results(folder, fit=outcome, frf=frfs[method], check=check, extra=extra)
    others = {f"{name} estimate": frfs[name] for name in rest}
    names = _draw(folder, options, record, frfs[method], outcome, check, others)
    write_report(
        folder / "report.html",
        fit=outcome,
        frf=frfs[method],
        others=others,
        record=record,
        checks=None if check is None else {options.verify.name: check},
        derived=derived,
        provenance=origin,
        formula=formula,
    )
    return path, ["report.html", *names]


def _draw(
    folder: Path,
    options: Namespace,
    record: Record,
    frf: FrequencyResponse,
    outcome: Fit | NotIdentifiable,
    check: Verification | None,
    others: Mapping[str, FrequencyResponse],
) -> list[str]:
    models = {"identified": outcome.model} if isinstance(outcome, Fit) else None
    figures = {
        "record.png": record_figure(record),
        "bode.png": bode(frf, models, others=others, title=options.file.name),
    }
    if check is not None:
        figures["verification.png"] = overlay(check, title=options.verify.name)
    if check is None:
        (folder / "verification.png").unlink(missing_ok=True)  # of an earlier run
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=130)
    return list(figures)


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
    if isinstance(value, list | tuple):
        return [flag, *map(str, value)] if value else []
    return [flag, str(value)]


def _mix(mix: Mapping[str, Mapping[str, float]]) -> str:
    """As `jaxquad.cli.parse_mix` reads it."""
    [(name, weights)] = mix.items()
    if dict(weights) == {name: 1.0}:
        return name
    return f"{name}=" + "".join(f"{weight:+}*{channel}" for channel, weight in weights.items())
