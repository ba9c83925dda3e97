"""What an identification reads: the channels that a log proposes, its records, a demo's log."""

import dataclasses
import functools as ft
import operator
import shlex
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxquad._core import announce, write_file
from jaxquad.datasets import FILES, locate
from jaxquad.excitation import sweep
from jaxquad.records import (
    channel_names,
    keep_logs,
    Mix,
    other_axes,
    parse_mix,
    Proposal,
    propose,
    read_segments,
    Record,
    RecordError,
    RecordWarning,
    Segment,
    select,
)
from jaxquad.report import sha256_of

from ._options import mix_text, SettingsError
from ._result_file import load_result, StoredResult
from ._settings import IdentifySettings


_MOST_OTHERS = 8  # commands of other axes that are looked at


def propose_settings(
    path: Path, settings: IdentifySettings, *, several: bool = False
) -> tuple[IdentifySettings, Proposal | None]:
    """Settings with input and output, from the log's proposal where they are not given.

    What the settings say stays.

    **Raises:** what `jaxquad.propose` raises, and SettingsError where `several` logs are to have
    one input and output.
    """
    if settings.input is not None:
        return settings, None
    if several:
        raise SettingsError(
            "several logs need `input` and `output`: run jaxquad identify "
            f"{shlex.quote(str(path))} alone, and give what it proposes"
        )
    ends, factor = (settings.start, settings.stop), settings.time_factor or 1.0
    if settings.segments:
        starts, stops = zip(*settings.segments, strict=True)
        ends = min(starts), max(stops)
    # The log itself is in the time of its stamps.
    start, stop = (None if end is None else end / factor for end in ends)
    proposal = propose(
        path, axis=settings.axis, chirp=settings.chirp, flight=settings.flight, start=start,
        stop=stop,
    )  # fmt: skip
    offered, setup = proposal.options, proposal.setup
    changes = {"input": mix_text(offered["inputs"]), "output": offered["outputs"]}
    changes |= {"axis": None, "chirp": None, "flight": None}  # the names of the channels say them
    if settings.reference is None:
        changes["reference"] = offered["references"]
    if settings.rate is None:
        changes["rate"] = float(f"{offered['sample_rate'] / factor:.3g}")
    if settings.hold is None:
        changes["hold"] = offered["hold"]
    if setup.band and settings.band is settings.band_rad is None:
        changes["band"] = setup.band
    scaled = lambda end: None if end is None else end * factor
    if not settings.segments and len(proposal.segments) > 1:  # all injections that were found
        segments = [(scaled(first), scaled(last)) for first, last in proposal.segments]
        changes |= {"segments": segments, "start": None, "stop": None}
    elif not settings.segments:  # the time in flight
        changes |= dict(zip(("start", "stop"), map(scaled, setup.longest), strict=True))
    return dataclasses.replace(settings, **changes), proposal


class OpenedLogs(NamedTuple):
    """What `identify_opened` computes with: one log, or several of one vehicle, as records."""

    paths: tuple[Path, ...]
    settings: IdentifySettings  # with what the log proposes
    proposal: Proposal | None  # where the log itself said what is input and output
    records: tuple[Record, ...]  # one for each segment of each log
    others: Mapping[str, tuple[np.ndarray, ...]] = {}  # other axes' commands, for each record

    def with_inputs(self, more: Mapping[str, tuple[np.ndarray, ...]]) -> "OpenedLogs":
        """With further inputs, by their mixes: their samples at the times of each record."""
        records = tuple(
            dataclasses.replace(
                record, inputs=np.column_stack([record.inputs, *signals]),
                input_names=(*record.input_names, *more),
                input_units=(*record.input_units, *[""] * len(more)),
            )
            for record, *signals in zip(self.records, *more.values(), strict=True)
        )  # fmt: skip
        return self._replace(records=records)


def open_logs(
    path: str | Path | Sequence[str | Path], settings: IdentifySettings | None = None,
    proposal: Proposal | None = None,
) -> OpenedLogs:  # fmt: skip
    """Read what `identify` takes, without JAX; `proposal` is what the settings were proposed by.

    **Raises:** `RecordError` or `ReadError` (both ValueErrors) for a log that cannot be used, and
    ValueError for settings that do not go with it.
    """
    paths = (Path(path),) if isinstance(path, str | Path) else tuple(map(Path, path))
    settings = settings or IdentifySettings()
    with keep_logs():
        if proposal is None:
            settings, proposal = propose_settings(paths[0], settings, several=len(paths) > 1)
        logs = {path: read_records(path, settings) for path in paths}
        rates = [records[0].sample_rate for records in logs.values()]
        if max(rates) > (1 + 1e-6) * min(rates):
            common = dataclasses.replace(settings, rate=float(f"{min(rates):.3g}"))
            logs = {path: read_records(path, common) for path in paths}
        (first, [reference, *_]), *others = logs.items()
        for path, [record, *_] in others:
            for name in (*reference.input_names, *reference.output_names):
                if record.unit(name) != reference.unit(name):
                    raise RecordError(
                        f"the unit of {name} is {reference.unit(name) or 'not known'} in {first}, "
                        f"but {record.unit(name) or 'not known'} in {path}: logs that are "
                        f"identified together need one unit. Leave one of them out."
                    )
        records = tuple(record for of_one in logs.values() for record in of_one)
        if proposal is not None and settings.reference == proposal.options["references"]:
            names = records[0].reference_names
            if names and not any(np.ptp(x.channel(name)) > 0 for x in records for name in names):
                # It rests in the analysed part, and excites nothing there.
                settings = dataclasses.replace(settings, reference=None)
                records = tuple(
                    select(x, inputs=x.input_names, outputs=x.output_names) for x in records
                )
        return OpenedLogs(paths, settings, proposal, records, _other_commands(logs, settings))


def open_again(result: str | Path | StoredResult, *, log: str | Path | None = None) -> OpenedLogs:
    """Read the logs of a stored result with its settings, see `identify_again`."""
    stored = result if isinstance(result, StoredResult) else load_result(result)
    paths = list(stored.logs)
    if log is not None:
        paths = [Path(log) / path.name for path in paths] if len(paths) > 1 else [Path(log)]
    verified = stored.settings.verify
    files = [*paths, *([Path(verified)] if verified else [])]
    for file, identified in zip(files, stored.hashes, strict=True):
        try:
            digest = sha256_of(file)
        except FileNotFoundError as error:
            text = f"{file}: the log is gone: give the place that it was moved to (--log)"
            raise ValueError(text) from error
        if digest != identified:
            raise ValueError(
                f"{file}: this is not the log that was identified (SHA-256 {digest[:12]}... "
                f"instead of {identified[:12]}...)"
            )
    return open_logs(paths, stored.settings)


def read_records(
    path: Path, settings: IdentifySettings, *, further_inputs: Mix | None = None
) -> tuple[Record, ...]:
    """One record for each segment. Raises RecordError, ReadError."""
    announce(f"reading {path.name}")
    return _read(path, settings, further_inputs or {})


def _read(path: Path, settings: IdentifySettings, further_inputs: Mix) -> tuple[Record, ...]:
    inputs, outputs, references = map(mix_of, (settings.input, settings.output, settings.reference))
    others = (mix_of(text) for text in settings.other_inputs)
    inputs = ft.reduce(operator.or_, (*others, further_inputs), inputs)
    names = {*inputs, *outputs, *references}
    segments: list[Segment] = list(settings.segments) or [(settings.start, settings.stop)]
    records = read_segments(
        path, segments, inputs=inputs, outputs=outputs, references=references,
        sample_rate=settings.rate, time=settings.time, time_unit=settings.time_unit,
        dt=settings.dt, time_factor=settings.time_factor,
        units={name: unit for name, unit in settings.units.items() if name in names},
        max_gap=settings.max_gap, valid=settings.valid, hold=settings.hold,
    )  # fmt: skip
    return tuple(records)


def _other_commands(
    logs: Mapping[Path, Sequence[Record]], settings: IdentifySettings
) -> dict[str, tuple[np.ndarray, ...]]:
    """Commands of other axes that move in all logs, at the times of the records."""
    texts = (*settings.other_inputs, settings.reference, settings.output)
    taken = [weights for text in texts for weights in mix_of(text).values()]
    names = set.intersection(*map(channel_names, logs))
    others = other_axes(mix_of(settings.input), names)
    others = [mix for mix in others if not any(w in taken for w in mix.values())][:_MOST_OTHERS]
    settings = dataclasses.replace(settings, reference=None, other_inputs=())

    def read(*mixes: Mix) -> list[tuple[np.ndarray, ...]]:
        """Of each mix the samples; what is missing, or missing in places, is left out."""
        parts: list[list[np.ndarray]] = [[] for _ in mixes]
        together = ft.reduce(operator.or_, mixes)
        try:
            for path, records in logs.items():
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", RecordWarning)
                    commands = _read(path, settings, together)
                for x, y in zip(records, commands, strict=True):
                    for part, name in zip(parts, together, strict=True):
                        part.append(np.interp(x.time, y.time, y.channel(name)))
        except ValueError:  # other gaps, or records of other parts
            return [samples for mix in mixes for samples in read(mix)] if len(mixes) > 1 else [()]
        return list(map(tuple, parts))

    samples = read(*others) if others else []
    return {
        mix_text(mix): signals
        for mix, signals in zip(others, samples, strict=True)
        if any(np.ptp(signal) > 0 for signal in signals)
    }


def mix_of(text: str | None) -> Mix:
    return {} if text is None else parse_mix(text)


_RATE, _GAIN, _LAG, _DELAY = 250.0, 280.0, 0.02, 0.008  # Hz, rad/s^2 per unit of M, s, s
_FEEDBACK = 0.02  # of M per rad/s
_GUST, _CORNER, _NOISE = 2.0, 3.0, 0.01  # rad/s^2, rad/s, rad/s
DEMO_TRUTH: Mapping[str, float] = {"gain": _GAIN, "lag": _LAG, "delay": _DELAY}
DEMO = IdentifySettings(
    input="M", output="q", reference="x0", units={"q": "rad/s"}, band=(0.5, 12.0), hold="dt"
)


def write_demo_log(path: str | Path, seed: int = 0) -> Path:
    """Write time, reference x0, command M and rate q as CSV; the same for the same seed.

    An axis under rate feedback, in gusts, is excited by a sweep of its command. `DEMO` are the
    settings to identify it with.
    """
    low, high = 2 * np.pi * 0.4, 2 * np.pi * 15
    signal = sweep(low, high, duration=40, sample_rate=_RATE, amplitude=0.06)
    # M = x0 - feedback q, held for a sample; q' = gain M(t - delay) behind a lag, and gusts.
    random, samples = np.random.default_rng(seed), signal.signal.size
    noise, shocks = random.standard_normal((2, samples))
    dt, late = 1 / _RATE, round(_DELAY * _RATE)
    stay, decay = np.exp(-dt / _LAG), np.exp(-_CORNER * dt)
    command, measured = np.zeros((2, samples))
    rate = moment = gust = 0.0
    for k in range(samples):
        measured[k] = rate + _NOISE * noise[k]
        command[k] = signal.signal[k] - _FEEDBACK * measured[k]
        delayed = command[k - late] if k >= late else 0.0
        # The lag's exact mean over the sample, in which its input is constant.
        mean = delayed + (moment - delayed) * (1 - stay) * _LAG / dt
        rate += dt * (_GAIN * mean + gust)
        moment = delayed + (moment - delayed) * stay
        gust = decay * gust + _GUST * np.sqrt(1 - decay**2) * shocks[k]
    columns = (signal.time, signal.signal, command, measured)
    rows = ("{:.6f},{:.8g},{:.8g},{:.8g}\n".format(*row) for row in zip(*columns, strict=True))
    return write_file(Path(path), f"time,x0,M,q\n{''.join(rows)}")


def find_demo_flight() -> tuple[Path, IdentifySettings]:
    """The measured flight of `jaxquad demo --flight`, and the settings to identify it with.

    **Raises:**

    - `ReadError`: it is neither on this machine nor can it be downloaded.
    """
    path = locate(FILES["antx_pitch prbs"])
    field = ".value" if path.suffix == ".mat" else ""  # its publisher's file has structs
    return path, IdentifySettings(
        input=f"M{field}", output=f"q{field}", reference=f"x0{field}",
        units={f"q{field}": "rad/s"}, rate=250.0, start=50.0, stop=76.0, band=(0.7, 12.0),
    )  # fmt: skip
