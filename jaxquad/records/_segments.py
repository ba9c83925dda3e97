"""Records of a file, one for each segment, from mixes that may hold powers of channels."""

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ._errors import RecordError
from ._read import read
from ._record import Record


Mix = dict[str, dict[str, float]]  # name -> channel, or its power `m1^2`, -> weight

_NAME = r"(?![\d.])(?:\[[^\]]*\]|[^\s+*\[\]^-])+"  # a channel; within brackets anything goes
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_TERM = re.compile(rf"\s*([+-]?)\s*(?:({_NUMBER})\s*\*\s*)?({_NAME})\s*(\^\s*[2-9](?![\d.]))?\s*")


def parse_mix(text: str) -> Mix:
    """`M`, or a sum of weighted channels and of their powers: name -> channel -> weight.

    `roll=-m1-m2+0.5*m[4]`, `thrust=0.02*m1+0.1*m1^2`. Raises ValueError for what is neither.
    """
    name, sign, terms = (part.strip() for part in text.partition("="))
    weights: dict[str, float] = {} if sign or not name else {name: 1.0}
    place = 0
    while place < len(terms):
        term = _TERM.match(terms, place)
        if not term or (place and not term[1]):
            raise ValueError(
                f"{text!r}: cannot read {terms[place:]!r}; write NAME=-a+b+0.5*c, or 0.1*c^2"
            )
        power = f"^{term[4][1:].strip()}" if term[4] else ""
        weight, channel = float(f"{term[1]}{term[2] or 1}"), f"{term[3]}{power}"
        weights[channel] = weights.get(channel, 0.0) + weight
        place = term.end()
    if not name or not weights:
        raise ValueError(f"{text!r} names no channel; write NAME=-a+b+0.5*c")
    return {name: weights}


def power_of(term: str) -> tuple[str, int]:
    """The channel and the power of a term of a mix: `m1^2` is `m1` and 2."""
    channel, sign, power = term.rpartition("^")
    return (channel, int(power)) if sign and channel and power in set("23456789") else (term, 1)


Number = float | int
Segment = tuple[Number | None, Number | None]  # start and stop in the file's time, s
Term = tuple[str, int, float]  # channel, power, weight


def read_segments(
    path: Path,
    segments: Sequence[Segment],
    *,
    inputs: Mix,
    outputs: Mix,
    references: Mix | None = None,
    sample_rate: Number | None = None,
    time: str | None = None,
    time_unit: Any = None,
    units: Mapping[str, str] | None = None,
) -> list[Record]:
    """The segments of a file, at one sample rate; a remark on the file is made once.

    `references` and the rest are as `jq.read` takes them. Raises RecordError for segments that
    overlap, are empty or leave the file's time, and what `jq.read` raises.
    """
    _check(segments)
    roles = (inputs, outputs, references or {})
    options = {"time": time, "time_unit": time_unit, "units": units}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        records = [_mixed(path, roles, each, sample_rate, options) for each in segments]
        slowest = min(record.sample_rate for record in records)
        if max(record.sample_rate for record in records) > (1 + 1e-6) * slowest:
            rate = float(f"{slowest:.3g}")
            records = [_mixed(path, roles, each, rate, options) for each in segments]
    for each in {str(one.message): one for one in caught}.values():
        warnings.warn(str(each.message), each.category, stacklevel=2)
    return records


def _check(segments: Sequence[Segment]) -> None:
    if len(segments) < 2:
        return
    for start, stop in segments:
        if start is None or stop is None or not start < stop:
            raise RecordError(f"the segment {start} .. {stop} s does not rise: give START:STOP.")
    ordered = sorted((start, stop) for start, stop in segments if start is not None)
    for (start, stop), (after, end) in zip(ordered, ordered[1:], strict=False):
        if stop is not None and after < stop:
            raise RecordError(
                f"the segments {start:.6g} .. {stop:.6g} s and {after:.6g} .. {end:.6g} s overlap: "
                f"what they share would count twice."
            )


def _mixed(
    path: Path,
    roles: Sequence[Mix],
    segment: Segment,
    rate: Number | None,
    options: Mapping[str, Any],
) -> Record:
    """One segment. Powers are taken of the channels as they are read, after resampling."""
    span: dict[str, Any] = {"sample_rate": rate, "start": segment[0], "stop": segment[1]}
    terms = [{name: _terms(name, mix) for name, mix in role.items()} for role in roles]
    each = [term for role in terms for terms_of in role.values() for term in terms_of]
    if all(power == 1 for _, power, _ in each):
        named = dict(zip(("inputs", "outputs", "references"), roles, strict=True))
        return read(path, **named, **span, **options)
    names = {channel: {channel: 1.0} for channel, _, _ in each}
    any_output = {"any output": dict.fromkeys(list(names)[:1], 1.0)}  # A record needs one.
    clock = {name: options[name] for name in ("time", "time_unit")}
    raw = read(path, inputs=names, outputs=any_output, **span, **clock)
    return _assembled(raw, terms, options["units"] or {})


def _terms(name: str, mix: Mapping[str, float]) -> list[Term]:
    """A channel by itself may have any name, one that looks like a power too."""
    if mix == {name: 1.0}:
        return [(name, 1, 1.0)]
    return [(*power_of(term), weight) for term, weight in mix.items()]


def _assembled(
    raw: Record, terms: Sequence[Mapping[str, list[Term]]], given: Mapping[str, str]
) -> Record:
    units = {name: _unit(raw, each) for role in terms for name, each in role.items()}
    if unknown := set(given) - set(units):
        raise RecordError(f"a unit for {unknown.pop()!r}: the channels are {', '.join(units)}.")
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
    )


def _unit(raw: Record, terms: Sequence[Term]) -> str:
    """That of a plain sum, where its channels agree."""
    found = {raw.unit(channel) if power == 1 else "" for channel, power, _ in terms}
    return found.pop() if len(found) == 1 else ""


def _sum(raw: Record, terms: Sequence[Term]) -> Float[np.ndarray, " samples"]:
    return sum(
        (weight * raw.channel(channel) ** power for channel, power, weight in terms),
        np.zeros(raw.samples),
    )
