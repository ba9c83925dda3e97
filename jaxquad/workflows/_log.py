"""What an identification reads: the channels that a log proposes, and its records."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxquad._core import announce
from jaxquad.records import (
    Mix,
    parse_mix,
    Proposal,
    propose,
    read_segments,
    Record,
    RecordError,
    Segment,
    select,
)
from jaxquad.report import sha256_of

from ._options import mix_text, SettingsError
from ._result_file import load_result, StoredResult
from ._settings import IdentifySettings


def propose_settings(
    path: Path, settings: IdentifySettings, *, several: bool = False
) -> tuple[IdentifySettings, Proposal | None]:
    """Settings with input and output, from the log's proposal where they are not given.

    What the settings say stays. Raises what `jaxquad.propose` raises, and SettingsError where
    `several` logs are to have one input and output.
    """
    if settings.input is not None:
        return settings, None
    if several:
        raise SettingsError(
            f"several logs need `input` and `output`: run jaxquad identify {path} alone, and give "
            "what it proposes"
        )
    start, stop = _given_span(settings)
    if settings.time_factor:  # the log itself is in the time of its stamps
        start, stop = (None if x is None else x / settings.time_factor for x in (start, stop))
    proposal = propose(
        path, axis=settings.axis, chirp=settings.chirp, flight=settings.flight, start=start,
        stop=stop,
    )  # fmt: skip
    offered, factor = proposal.options, settings.time_factor or 1.0
    found = {"input": mix_text(offered["inputs"]), "output": offered["outputs"]}
    found |= {"axis": None, "chirp": None, "flight": None}  # the names of the channels say them
    if settings.reference is None:
        found["reference"] = offered["references"]
    if settings.rate is None:
        found["rate"] = float(f"{offered['sample_rate'] / factor:.3g}")
    if settings.hold is None:
        found["hold"] = offered["hold"]
    if proposal.setup.band and settings.band is settings.band_rad is None:
        found["band"] = proposal.setup.band
    return dataclasses.replace(settings, **found | _proposed_span(settings, proposal)), proposal


def _proposed_span(settings: IdentifySettings, proposal: Proposal) -> dict[str, object]:
    """All injections that were found, or the time in flight, within `start` and `stop`."""
    if settings.segments:
        return {}
    scaled = lambda end: None if end is None else end * (settings.time_factor or 1.0)
    if len(proposal.segments) > 1:
        segments = [(scaled(a), scaled(b)) for a, b in proposal.segments]
        return {"segments": segments, "start": None, "stop": None}
    return {"start": scaled(proposal.setup.start), "stop": scaled(proposal.setup.stop)}


def _given_span(settings: IdentifySettings) -> tuple[float | None, float | None]:
    """What the settings say of the part to use: the ends of all segments."""
    if settings.segments:
        return min(a for a, _ in settings.segments), max(b for _, b in settings.segments)
    return settings.start, settings.stop


class OpenedLogs(NamedTuple):
    """What `identify_opened` computes with: one log, or several of one vehicle, as records.

    **Attributes:**

    - `paths`: of the logs.
    - `settings`: those given, with what the log proposes.
    - `proposal`: where the log itself said what is input and output.
    - `records`: one for each segment of each log.
    """

    paths: tuple[Path, ...]
    settings: IdentifySettings
    proposal: Proposal | None
    records: tuple[Record, ...]


def open_logs(
    path: str | Path | Sequence[str | Path],
    settings: IdentifySettings | None = None,
    proposal: Proposal | None = None,
) -> OpenedLogs:
    """Read what `identify` takes, with the same arguments; it needs no JAX.

    **Raises:** `RecordError` or `ReadError` (both ValueErrors) for a log that cannot be used, and
    ValueError for settings that do not go with it.
    """
    paths = (Path(path),) if isinstance(path, str | Path) else tuple(map(Path, path))
    if proposal is None:
        given = settings or IdentifySettings()
        settings, proposal = propose_settings(paths[0], given, several=len(paths) > 1)
    settings = settings or IdentifySettings()
    records = read_logs(paths, settings)
    if proposal is not None and settings.reference == proposal.options["references"]:
        settings, records = _without_resting(settings, records)
    return OpenedLogs(paths, settings, proposal, records)


def _without_resting(
    settings: IdentifySettings, records: tuple[Record, ...]
) -> tuple[IdentifySettings, tuple[Record, ...]]:
    """Without a proposed reference that rests in the analysed part: it excites nothing there."""
    names = records[0].reference_names
    if not names or any(np.ptp(record.channel(x)) > 0 for record in records for x in names):
        return settings, records
    bare = [select(x, inputs=x.input_names, outputs=x.output_names) for x in records]
    return dataclasses.replace(settings, reference=None), tuple(bare)


def open_again(result: str | Path | StoredResult, *, log: str | Path | None = None) -> OpenedLogs:
    """Read the logs of a stored result with its settings, see `identify_again`."""
    stored = result if isinstance(result, StoredResult) else load_result(result)
    paths = stored.logs
    if log is not None:
        paths = [Path(log) / path.name for path in paths] if len(paths) > 1 else [Path(log)]
    verified = stored.settings.verify
    files = [*paths, *([Path(verified)] if verified else [])]
    for file, known in zip(files, stored.hashes, strict=True):
        _check_unchanged(file, known)
    return open_logs(list(paths), stored.settings)


def _check_unchanged(path: Path, known: str) -> None:
    try:
        found = sha256_of(path)
    except FileNotFoundError as error:
        raise ValueError(
            f"{path}: the log is gone: give the place that it was moved to (--log)"
        ) from error
    if found != known:
        raise ValueError(
            f"{path}: this is not the log that was identified (SHA-256 {found[:12]}... instead of "
            f"{known[:12]}...)"
        )


def read_logs(paths: Sequence[Path], settings: IdentifySettings) -> tuple[Record, ...]:
    """The records of all logs, with one sample rate. Raises RecordError where units differ."""
    logs = {path: read_records(path, settings) for path in paths}
    rates = [records[0].sample_rate for records in logs.values()]
    if max(rates) > (1 + 1e-6) * min(rates):
        common = dataclasses.replace(settings, rate=float(f"{min(rates):.3g}"))
        logs = {path: read_records(path, common) for path in paths}
    _check_units(logs)
    return tuple(record for records in logs.values() for record in records)


def _check_units(logs: Mapping[Path, tuple[Record, ...]]) -> None:
    (first, [known, *_]), *others = logs.items()
    for path, [record, *_] in others:
        for name in (*known.input_names, *known.output_names):
            if record.unit(name) != known.unit(name):
                raise RecordError(
                    f"the unit of {name} is {known.unit(name) or 'not known'} in {first}, but "
                    f"{record.unit(name) or 'not known'} in {path}: logs that are identified "
                    f"together need one unit. Leave one of them out."
                )


def read_records(
    path: Path, settings: IdentifySettings, *, beside: Mix | None = None
) -> tuple[Record, ...]:
    """One record for each segment, with further inputs. Raises RecordError, ReadError."""
    announce(f"reading {path.name}")
    inputs, outputs, references = map(mix_of, (settings.input, settings.output, settings.reference))
    inputs = inputs | (beside or {})
    asked = {*inputs, *outputs, *references}
    segments: list[Segment] = list(settings.segments) or [(settings.start, settings.stop)]
    records = read_segments(
        path,
        segments,
        inputs=inputs,
        outputs=outputs,
        references=references,
        sample_rate=settings.rate,
        time=settings.time,
        time_unit=settings.time_unit,
        dt=settings.dt,
        time_factor=settings.time_factor,
        units={name: unit for name, unit in settings.units.items() if name in asked},
        max_gap=settings.max_gap,
        valid=settings.valid,
        hold=settings.hold,
    )
    return tuple(records)


def mix_of(text: str | None) -> Mix:
    return {} if text is None else parse_mix(text)
