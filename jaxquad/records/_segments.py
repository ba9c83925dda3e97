"""Records of the segments of a file, from weighted sums of channels and of their powers."""

import functools as ft
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._clock import clock_start, show_times, TimeUnit
from ._errors import GapError, RecordError, RecordWarning
from ._read import read
from ._record import Hold, Record
from ._repair import Valid


Mix = dict[str, dict[str, float]]  # name -> channel, or its power `m1^2`, -> weight

_NAME = r"(?![\d.])(?:\[[^\]]*\]|[^\s+*\[\]^-])+"  # a channel; brackets may hold anything
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_TERM = re.compile(rf"\s*([+-]?)\s*(?:({_NUMBER})\s*\*\s*)?({_NAME})\s*(\^\s*[2-9](?![\d.]))?\s*")


class MixError(ValueError):
    """A weighted sum that cannot be read, and the `reason` without its text."""

    def __init__(self, text: str, reason: str):
        super().__init__(f"{text!r}: {reason}")
        self.reason = reason


def parse_mix(text: str) -> Mix:
    """Parse the name of a channel, or a weighted sum of channels and of their powers.

    **Arguments:**

    - `text`: `M`, `roll=-m1-m2+0.5*m[4]` or `thrust=0.02*m1+0.1*m1^2`.

    **Returns:** name -> channel -> weight, as `read_segments` takes it.

    **Raises:**

    - `ValueError`: for anything else.
    """
    name, sign, terms = (part.strip() for part in text.partition("="))
    weights: dict[str, float] = {} if sign or not name else {name: 1.0}
    place = 0
    while place < len(terms):
        term = _TERM.match(terms, place)
        if not term or (place and not term[1]):
            raise MixError(
                text, f"cannot read {terms[place:]!r}; write NAME=-a+b+0.5*c, or 0.1*c^2"
            )
        power = f"^{term[4][1:].strip()}" if term[4] else ""
        weight, channel = float(f"{term[1]}{term[2] or 1}"), f"{term[3]}{power}"
        weights[channel] = weights.get(channel, 0.0) + weight
        place = term.end()
    if not name or not weights:
        raise ValueError(f"{text!r} names no channel; write CHANNEL, or NAME=-a+b+0.5*c")
    return {name: weights}


def power_of(term: str) -> tuple[str, int]:
    """The channel and the power in a term of a sum: `m1^2` is `m1` and 2."""
    channel, sign, power = term.rpartition("^")
    return (channel, int(power)) if sign and channel and power in set("23456789") else (term, 1)


Number = float | int
Segment = tuple[Number | None, Number | None]  # start and stop in the file's time, s
Term = tuple[str, int, float]  # channel, power, weight


class _Options(NamedTuple):
    """Options of `read` for a file."""

    time: str | None
    time_unit: TimeUnit | None
    dt: float | int | None
    time_factor: float | int | None
    units: Mapping[str, str]
    hold: Hold
    max_gap: float | int | None
    valid: Valid


def read_segments(
    path: Path,
    segments: Sequence[Segment],
    *,
    inputs: Mix,
    outputs: Mix,
    references: Mix | None = None,
    sample_rate: Number | None = None,
    time: str | None = None,
    time_unit: TimeUnit | None = None,
    dt: Number | None = None,
    time_factor: Number | None = None,
    units: Mapping[str, str] | None = None,
    hold: Hold = None,
    max_gap: Number | None = None,
    valid: Valid | None = None,
) -> list[Record]:
    """Read several segments of a file as records with one sample rate.

    **Arguments:**

    - `path`: the file.
    - `segments`: pairs of start and stop in s of the file's own time.
    - `inputs`, `outputs`, `references`: name -> channel or its power (`m1^2`) -> weight, as
        `parse_mix` returns it.
    - `sample_rate`: in Hz; by default that of the slowest segment.
    - `time`, `time_unit`, `dt`, `time_factor`, `units`, `hold`, `max_gap`, `valid`: as in `read`.

    **Returns:** a `Record` for each segment; several where samples are missing for longer than
    `max_gap`, by default 10 samples or 0.05 s: a segment is cut there, and parts shorter than 1 s
    are left out, with a `RecordWarning`. Each warning about the file is given once.

    **Raises:**

    - `RecordError`: for segments that overlap, are empty or leave the file's time, and for more
        than 30 gaps in one of them.
    - `ReadError`: as `read` raises it.
    """
    _check(segments)
    roles = (inputs, outputs, references or {})
    options = _Options(time, time_unit, dt, time_factor, units or {}, hold, max_gap, valid or {})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        every = [_without_gaps(path, roles, each, sample_rate, options) for each in segments]
        parts, records = zip(*(each for found in every for each in found), strict=True)
        slowest = min(record.sample_rate for record in records)
        if max(record.sample_rate for record in records) > (1 + 1e-6) * slowest:
            rate = float(f"{slowest:.3g}")
            records = [_mixed(path, roles, each, rate, options) for each in parts]
    for each in {str(one.message): one for one in caught}.values():
        warnings.warn(str(each.message), each.category, stacklevel=2)
    return list(records)


_MOST_GAPS = 30  # in a segment
_SHORTEST = 1.0  # s, of a part between two gaps


def _without_gaps(
    path: Path,
    roles: Sequence[Mix],
    segment: Segment,
    rate: Number | None,
    options: _Options,
) -> list[tuple[Segment, Record]]:
    """The parts of a segment between gaps that are too long to be interpolated."""
    try:
        return [(segment, _mixed(path, roles, segment, rate, options))]
    except GapError as error:
        gaps = error.gaps
        begins, ends = (segment[0], *(b for _, b in gaps)), (*(a for a, _ in gaps), segment[1])
        lasts = [
            (a, b)
            for a, b in zip(begins, ends, strict=True)
            if a is None or b is None or b - a >= _SHORTEST
        ]
        if len(gaps) > _MOST_GAPS or not lasts:
            raise
        parts = [part for each in lasts for part in _part_if_any(path, roles, each, rate, options)]
        if not parts:
            raise
    origin = min(clock_start(record.time) for _, record in parts)
    (left, right) = max(gaps, key=lambda each: each[1] - each[0])
    warnings.warn(
        f"samples are missing in {'one place' if len(gaps) == 1 else f'{len(gaps)} places'}, for "
        f"up to {1e3 * (right - left):.4g} ms at t = {show_times(left, start=origin)}: the record "
        f"is cut there into {len(parts)} segments, {_in_words([record for _, record in parts])}. "
        f"A gap up to a length in s is bridged instead where that is allowed («max_gap=»).",
        RecordWarning,
        stacklevel=4,
    )
    return parts


def _part_if_any(
    path: Path,
    roles: Sequence[Mix],
    segment: Segment,
    rate: Number | None,
    options: _Options,
) -> list[tuple[Segment, Record]]:
    """The record of a part, or of its parts; none where it is too short for one."""
    try:
        parts = _without_gaps(path, roles, segment, rate, options)
    except RecordError:  # too few samples between two gaps
        return []
    return [part for part in parts if part[1].duration >= _SHORTEST]


def _in_words(records: Sequence[Record]) -> str:
    start = min(clock_start(record.time) for record in records)
    *others, last = [(float(record.time[0]), float(record.time[-1])) for record in records]
    spans = [f"{a - start:.6g} .. {b - start:.6g}" for a, b in others]
    return f"t = {', '.join([*spans, show_times(*last, start=start)])}"


def _check(segments: Sequence[Segment]) -> None:
    if len(segments) < 2:
        return
    for start, stop in segments:
        if start is None or stop is None or not start < stop:
            raise RecordError(
                f"the segment {start} .. {stop} s is empty: give START:STOP with START before STOP."
            )
    ordered = sorted((start, stop) for start, stop in segments if start is not None)
    for (start, stop), (after, end) in zip(ordered, ordered[1:], strict=False):
        if stop is not None and after < stop:
            raise RecordError(
                f"the segments {start:.6g} .. {stop:.6g} s and {after:.6g} .. {end:.6g} s overlap, "
                f"so samples would count twice. Choose segments that do not overlap."
            )


def _mixed(
    path: Path,
    roles: Sequence[Mix],
    segment: Segment,
    rate: Number | None,
    options: _Options,
) -> Record:
    """One segment. Powers are taken of the channels as they are read, after resampling."""
    select = ft.partial(
        read,
        path,
        sample_rate=rate,
        start=segment[0],
        stop=segment[1],
        time=options.time,
        time_unit=options.time_unit,
        dt=options.dt,
        time_factor=options.time_factor,
        hold=options.hold,
        max_gap=options.max_gap,
        valid=options.valid,
    )
    terms = [{name: _terms(name, mix) for name, mix in role.items()} for role in roles]
    each = [term for role in terms for terms_of in role.values() for term in terms_of]
    if all(power == 1 for _, power, _ in each):
        inputs, outputs, references = roles
        return select(inputs=inputs, outputs=outputs, references=references, units=options.units)
    names = {channel: {channel: 1.0} for channel, _, _ in each}
    any_output = {"any output": dict.fromkeys(list(names)[:1], 1.0)}  # A record needs one.
    raw = select(inputs=names, outputs=any_output)
    return _assembled(raw, terms, options.units)


def _terms(name: str, mix: Mapping[str, float]) -> list[Term]:
    """A single channel may have any name, even one that looks like a power."""
    if mix == {name: 1.0}:
        return [(name, 1, 1.0)]
    return [(*power_of(term), weight) for term, weight in mix.items()]


def _assembled(
    raw: Record, terms: Sequence[Mapping[str, list[Term]]], given: Mapping[str, str]
) -> Record:
    units = {name: _unit(raw, each) for role in terms for name, each in role.items()}
    if unknown := set(given) - set(units):
        raise RecordError(
            f"a unit is given for {unknown.pop()!r}, but the channels are {', '.join(units)}."
        )
    units |= given
    columns = [
        np.stack([_sum(raw, each) for each in role.values()], axis=1)
        if role
        else np.empty((raw.samples, 0))
        for role in terms
    ]
    inputs, outputs, references = terms
    return Record(
        raw.time,
        *columns,
        input_names=tuple(inputs),
        output_names=tuple(outputs),
        reference_names=tuple(references),
        input_units=[units[name] for name in inputs],
        output_units=[units[name] for name in outputs],
        reference_units=[units[name] for name in references],
        source=raw.source,
        hold=raw.hold,
        time_unit="s",
        repaired=raw.repaired,
    )


def _unit(raw: Record, terms: Sequence[Term]) -> str:
    """The unit of a sum without powers whose channels agree."""
    found = {raw.unit(channel) if power == 1 else "" for channel, power, _ in terms}
    return found.pop() if len(found) == 1 else ""


def _sum(raw: Record, terms: Sequence[Term]) -> Float[np.ndarray, " samples"]:
    return sum(
        (weight * raw.channel(channel) ** power for channel, power, weight in terms),
        np.zeros(raw.samples),
    )
