"""What `jaxquad identify` leaves behind: `result.json`, `report.html` and its figures."""

import json
import shlex
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxquad.identify import Combination, Fit, NotIdentifiable, Verification
from jaxquad.models import LaggedIntegrator, TransferFunction
from jaxquad.plot import bode, overlay, record_figure
from jaxquad.records import Record
from jaxquad.report import Provenance, provenance, write_report, write_results
from jaxquad.spectra import FrequencyResponse


Model = LaggedIntegrator | TransferFunction


def model_content(outcome: Fit | NotIdentifiable) -> dict[str, Any]:
    """The model's kind and numbers; nothing where there is none."""
    if isinstance(outcome, NotIdentifiable):
        return {}
    model = outcome.model
    return {
        "model": {"kind": type(model).__name__} | {k: _plain(v) for k, v in vars(model).items()}
    }


def setup_content(options: Namespace, frf: FrequencyResponse) -> dict[str, Any]:
    """What another record needs to be read in the same way, and the band that was fitted."""
    names = ("input", "output", "rate", "time", "time_unit")
    setup = {name: getattr(options, name) for name in names}
    band = [float(frf.omega[0]), float(frf.omega[-1])]
    return {"setup": setup | {"unit": [list(each) for each in options.unit], "band_rad": band}}


def stored(path: Path) -> dict[str, Any]:
    """What `jaxquad identify` left in a folder, or its `result.json` itself.

    Raises ValueError for a file that it did not write.
    """
    path = path / "result.json" if path.is_dir() else path
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such result: run jaxquad identify first") from error
    except ValueError as error:
        raise ValueError(f"{path}: no result of jaxquad identify: {error}") from error
    if not isinstance(content, dict) or not {"fit", "setup", "provenance"} <= set(content):
        raise ValueError(f"{path}: no result of this jaxquad identify: identify the record again")
    return content


def stored_model(content: dict[str, Any]) -> Model:
    """The model of a stored result. Raises NotIdentifiable where there is none."""
    if "model" not in content:
        raise NotIdentifiable(f"the result holds no model: {' '.join(content['fit']['remarks'])}")
    numbers = dict(content["model"])
    kinds = {"LaggedIntegrator": LaggedIntegrator, "TransferFunction": TransferFunction}
    kind = numbers.pop("kind", None)
    if kind not in kinds:
        raise ValueError(f"the result holds a model of kind {kind!r}: none of {', '.join(kinds)}")
    try:
        return kinds[kind](**numbers)
    except TypeError as error:
        raise ValueError(f"the result's model is incomplete: {error}") from error


def _plain(value: Any) -> Any:
    return value if isinstance(value, int) else np.asarray(value).tolist()


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
