"""Several logs in one DataFlash file: each begins with its own definitions and its own clock."""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np


class Part(NamedTuple):
    """A part of a file from definitions of its messages to the next ones.

    `begin` and `end` are its first byte and the one after its last, `span` its first and last time
    in s, None where nothing has a time, and `chirped` says whether it holds a SystemID chirp. One
    of `other_layout` begins anew, and defines messages otherwise than the part before.
    """

    begin: int
    end: int
    span: tuple[float, float] | None
    chirped: bool
    other_layout: bool = False


MOST_PARTS = 100  # of one file
CUT_IT = "it is damaged, or holds too many logs: cut it into files of one log each"
_BACKWARD = 1.0  # s by which the clock goes back at a restart: messages are not quite in order
_ENDS = 5  # messages at each end of a part whose median is its first and last time


def span_of(times: np.ndarray) -> tuple[float, float] | None:
    """First and last time of the messages of one type, whatever a damaged one says."""
    if not times.size:
        return None
    return float(np.median(times[:_ENDS])), float(np.median(times[-_ENDS:]))


def choose_log(parts: Sequence[Part]) -> tuple[list[int], list[str]]:
    """The numbers of the parts of the log to read, and a remark on those that are left out.

    It is the longest one with a chirp, else the longest.
    """
    logs = _logs_of(parts)
    if len(logs) == 1:
        return logs[0], []
    ends = [_ends([parts[i] for i in log]) for log in logs]
    chirped = [any(parts[i].chirped for i in log) for log in logs]
    best = max(range(len(logs)), key=lambda k: (chirped[k], ends[k][1] - ends[k][0]))
    why = "the longest one with a chirp" if chirped[best] else "the longest one"
    left_out = ", ".join(
        f"number {k + 1} (t = {ends[k][0]:.6g} .. {ends[k][1]:.6g} s, bytes {parts[log[0]].begin} "
        f".. {parts[log[-1]].end - 1})"
        for k, log in enumerate(logs)
        if k != best
    )
    remark = (
        f"the file holds {len(logs)} logs, as after a restart of the flight controller: number "
        f"{best + 1} is read (t = {ends[best][0]:.6g} .. {ends[best][1]:.6g} s), {why}. Left out: "
        f"{left_out}. To read another one, cut it out into its own file"
    )
    return logs[best], [remark]


def _logs_of(parts: Sequence[Part]) -> list[list[int]]:
    """The parts of each log: one begins where the clock goes back, or with other definitions."""
    logs: list[list[int]] = [[]]
    last = -np.inf
    for i, part in enumerate(parts):
        restarted = part.span is not None and part.span[0] < last - _BACKWARD
        if i and (restarted or part.other_layout):
            logs.append([])
        logs[-1].append(i)
        last = last if part.span is None else part.span[1]
    return logs


def _ends(parts: Iterable[Part]) -> tuple[float, float]:
    spans = [part.span for part in parts if part.span is not None]
    return (spans[0][0], spans[-1][1]) if spans else (0.0, 0.0)


_FIRMWARE = re.compile(r"\b[A-Z][\w:]*\w V\d+\.\d+[^\0,]*")


def firmware_of(messages: Iterable[str]) -> str:
    """Name and version, `ArduCopter V4.5.7 (2a3dc4b7)`, from the texts of VER and MSG."""
    hits = filter(None, map(_FIRMWARE.search, messages))
    hit = next(hits, None)
    return "" if hit is None else hit.group().strip()
