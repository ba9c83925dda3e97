"""Records of the segments of a file, from weighted sums of channels and of their powers."""

import functools as ft
import itertools
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ._channel import clock_start, Number, show_times, TimeUnit, Valid
from ._errors import GapError, RecordError, RecordWarning
from ._read import read
from ._record import assemble, Hold, Record


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


Segment = tuple[Number | None, Number | None]  # start and stop in the file's time, s
_MOST_GAPS = 30  # in a segment
_SHORTEST = 1.0  # s, of a part between two gaps


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
    if len(segments) > 1:
        for begin, end in segments:
            if begin is None or end is None or not begin < end:
                raise RecordError(
                    f"the segment {begin} .. {end} s is empty: give START:STOP with START before "
                    f"STOP."
                )
        ordered = sorted((begin, end) for begin, end in segments if begin is not None)
        for (begin, end), (after, last) in itertools.pairwise(ordered):
            if end is not None and after < end:
                raise RecordError(
                    f"the segments {begin:.6g} .. {end:.6g} s and {after:.6g} .. {last:.6g} s "
                    f"overlap, so samples would count twice. Choose segments that do not overlap."
                )
    roles = (inputs, outputs, references or {})
    select = ft.partial(
        read,
        path,
        time=time,
        time_unit=time_unit,
        dt=dt,
        time_factor=time_factor,
        hold=hold,
        max_gap=max_gap,
        valid=valid or {},
    )
    mixed = lambda segment, rate: _mixed(
        ft.partial(select, sample_rate=rate, start=segment[0], stop=segment[1]), roles, units or {}
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        parts = [
            part
            for segment in segments
            for part in _without_gaps(lambda span: mixed(span, sample_rate), segment)
        ]
        records = [record for _, record in parts]
        slowest = min(record.sample_rate for record in records)
        if max(record.sample_rate for record in records) > (1 + 1e-6) * slowest:
            rate = float(f"{slowest:.3g}")
            records = [mixed(segment, rate) for segment, _ in parts]
    for warning in {str(warning.message): warning for warning in caught}.values():
        warnings.warn(str(warning.message), warning.category, stacklevel=2)
    return records


def _without_gaps(
    mixed: Callable[[Segment], Record], segment: Segment
) -> list[tuple[Segment, Record]]:
    """The parts of a segment between gaps that are too long to be interpolated."""
    try:
        return [(segment, mixed(segment))]
    except GapError as error:
        gaps = error.gaps
        begins, ends = (segment[0], *(b for _, b in gaps)), (*(a for a, _ in gaps), segment[1])
        spans = [
            (a, b)
            for a, b in zip(begins, ends, strict=True)
            if a is None or b is None or b - a >= _SHORTEST
        ]
        if len(gaps) > _MOST_GAPS or not spans:
            raise
        parts: list[tuple[Segment, Record]] = []
        for span in spans:
            try:
                several = _without_gaps(mixed, span)
            except RecordError:  # too few samples between two gaps
                continue
            parts += [part for part in several if part[1].duration >= _SHORTEST]
        if not parts:
            raise
    records = [record for _, record in parts]
    origin = min(clock_start(record.time) for record in records)
    *others, last = [(float(record.time[0]), float(record.time[-1])) for record in records]
    texts = [f"{a - origin:.6g} .. {b - origin:.6g}" for a, b in others]
    (left, right) = max(gaps, key=lambda gap: gap[1] - gap[0])
    warnings.warn(
        f"samples are missing in {'one place' if len(gaps) == 1 else f'{len(gaps)} places'}, for "
        f"up to {1e3 * (right - left):.4g} ms at t = {show_times(left, start=origin)}: the record "
        f"is cut there into {len(parts)} segments, t = "
        f"{', '.join([*texts, show_times(*last, start=origin)])}. "
        f"A gap up to a length in s is bridged instead where that is allowed («max_gap=»).",
        RecordWarning,
        stacklevel=4,
    )
    return parts


def _mixed(select: Callable[..., Record], roles: Sequence[Mix], units: Mapping[str, str]) -> Record:
    """One segment. Powers are taken of the channels as they are read, after resampling."""
    # A single channel may have any name, even one that looks like a power.
    terms = {
        name: [(name, 1, 1.0)]
        if mix == {name: 1.0}
        else [(*power_of(term), weight) for term, weight in mix.items()]
        for role in roles
        for name, mix in role.items()
    }
    every = [term for terms_of_one in terms.values() for term in terms_of_one]
    if all(power == 1 for _, power, _ in every):
        inputs, outputs, references = roles
        return select(inputs=inputs, outputs=outputs, references=references, units=units)
    names = {channel: {channel: 1.0} for channel, _, _ in every}
    any_output = {"any output": dict.fromkeys(list(names)[:1], 1.0)}  # A record needs one.
    raw = select(inputs=names, outputs=any_output)
    if unknown := set(units) - set(terms):
        raise RecordError(
            f"a unit is given for {unknown.pop()!r}, but the channels are {', '.join(terms)}."
        )
    units_of = {name: {raw.unit(c) if p == 1 else "" for c, p, _ in terms[name]} for name in terms}
    agreed = {name: unit.pop() if len(unit) == 1 else "" for name, unit in units_of.items()}
    powers = lambda name: (weight * raw.channel(c) ** power for c, power, weight in terms[name])
    return assemble(
        raw.time,
        roles,
        lambda name: sum(powers(name), np.zeros(raw.samples)),
        (agreed | dict(units)).__getitem__,
        source=raw.source,
        hold=raw.hold,
        repaired=raw.repaired,
    )
