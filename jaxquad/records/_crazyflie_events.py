"""Finds the events of a Crazyflie micro-SD log, which are as long as their type says."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int


_WINDOW = 60  # s: the most between the two events with which reading goes on
_TRIES = 200_000  # places looked at after damage, in one file


class Kind(NamedTuple):
    """One type of event."""

    number: int
    name: str
    layout: np.dtype  # event id, time stamp, then the variables in order


class Events(NamedTuple):
    """Where the events of each type begin, and the stretches (offset, bytes) in between."""

    offsets: dict[int, Int[np.ndarray, " events"]]
    skipped: list[tuple[int, int]]


def events(data: bytes, kinds: dict[int, Kind], begin: int, end: int, per_second: float) -> Events:
    """Walk from event to event up to `end`; after damage, on to the next two that fit together.

    The event before a place where none of a known type begins has lost or gained bytes itself,
    and is left out.
    """
    sizes = {number: kind.layout.itemsize for number, kind in kinds.items()}
    found: dict[int, list[int]] = {number: [] for number in kinds}
    skipped: list[tuple[int, int]] = []
    last: list[int] = []
    at, tries = begin, _TRIES
    smallest = min(sizes.values())
    while at + smallest <= end:
        number = data[at] | data[at + 1] << 8
        size = sizes.get(number)
        if size is not None and at + size <= end:
            last = found[number]
            last.append(at)
            at += size
            continue
        bad = last.pop() if size is None and last else at
        at, tries = _next(data, kinds, bad, end, int(_WINDOW * per_second), tries)
        skipped.append((bad, at - bad))
        last = []
    return Events({number: np.array(each, int) for number, each in found.items()}, skipped)


def _next(
    data: bytes, kinds: dict[int, Kind], at: int, end: int, window: int, tries: int
) -> tuple[int, int]:
    """Where two events follow each other with stamps that go on, else `end`; tries left."""
    for place in range(at + 1, end):
        if tries == 0:
            break
        tries -= 1
        first = _stamp(data, kinds, place, end)
        if first is None:
            continue
        size = kinds[data[place] | data[place + 1] << 8].layout.itemsize
        second = _stamp(data, kinds, place + size, end)
        if second is not None and first <= second <= first + window:
            return place, tries
    return end, tries


def _stamp(data: bytes, kinds: dict[int, Kind], at: int, end: int) -> int | None:
    """The time stamp of the event at `at`, None where there is no whole event of a known type."""
    kind = kinds.get(data[at] | data[at + 1] << 8) if at + 1 < end else None
    if kind is None or at + kind.layout.itemsize > end:
        return None
    return int.from_bytes(data[at + 2 : at + 2 + kind.layout["time stamp"].itemsize], "little")
