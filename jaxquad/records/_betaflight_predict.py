"""From coded frames to values: adds what the predictors foretold, drops what cannot be right.

Source: "Blackbox logging internals" of the Betaflight documentation, field predictors and
log validation. The documentation has the straight line (2) with its sign turned round.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from ._betaflight_frames import Damage, Found
from ._betaflight_header import Frame, Header
from ._errors import ReadError


# Where bytes were lost, a frame spliced of two may by chance end where another seems to begin,
# so that the damage shows later. Each further frame has a chance of some percent.
_DOUBTFUL = 4


class Segments(NamedTuple):
    """Key frames, each with the frames after it that refer to it."""

    begin: Int[np.ndarray, " segments"]  # row of the key frame
    size: Int[np.ndarray, " segments"]  # rows up to the next one
    usable: Int[np.ndarray, " segments"]  # rows before the first that damage makes unreadable
    whole: Bool[np.ndarray, " segments"]  # no damage before the next one


def segments(main: Found, header: Header, damage: list[Damage]) -> Segments:
    begin = np.flatnonzero(main.key)
    size = np.diff(np.append(begin, main.key.size))
    hits = np.array([d.offset for d in damage] + [np.iinfo(np.int64).max])
    hit = hits[np.searchsorted(hits, main.offsets[begin])]
    intact = np.searchsorted(main.offsets, hit) - begin
    whole = intact >= size
    usable = np.where(whole, size, np.maximum(intact - _DOUBTFUL, 0))
    return Segments(begin, size, np.minimum(usable, scheduled(header).size), whole)


def scheduled(header: Header) -> Int[np.ndarray, " logged"]:
    """The loop iterations of one interval that are logged, the key frame's 0 among them."""
    iteration = np.arange(header.interval)
    if header.every == 0:
        return iteration[:1]
    return np.flatnonzero(
        (iteration == 0) | ((iteration + header.logged - 1) % header.every < header.logged)
    )


def predicted(main: Found, header: Header, parts: Segments) -> None:
    """Turn the coded numbers of all usable rows into values, in place.

    Frame after frame, but for all segments at once: the average of the last two values is
    rounded, so that no cumulative sum can stand for it.
    """
    order = np.argsort(-parts.usable, kind="stable")
    begin, usable = parts.begin[order], parts.usable[order]
    steps = _Steps(header)
    last = older = main.coded[begin]
    add_constants(last, header.frames["I"], constants(header.frames["I"], header))
    main.coded[begin] = last
    frames = np.arange(1, usable.max(initial=1))
    for k, active in zip(frames, np.searchsorted(-usable, -frames), strict=True):
        rows = begin[:active] + k
        last, older = last[:active], older[:active]
        value = main.coded[rows]
        steps.add(value, last, older)
        main.coded[rows] = value
        last, older = value, last


class _Steps:
    """What the predictors of a P frame add to it."""

    def __init__(self, header: Header):
        self.frame, self.interval = header.frames["P"], header.interval
        self.constant = constants(self.frame, header)
        self.runs = [
            (predictor, slice(first, last), np.int32 if signed else np.uint32)
            for predictor, signed, first, last in _runs(self.frame)
        ]
        logged = np.append(scheduled(header), header.interval)
        every = np.arange(header.interval)
        self.wait = (logged[np.searchsorted(logged, every, "right")] - every).astype(np.int32)

    def add(self, value: np.ndarray, last: np.ndarray, older: np.ndarray) -> None:
        add_constants(value, self.frame, self.constant)
        for predictor, run, dtype in self.runs:
            before = last[:, run]
            if predictor == 1:
                value[:, run] += before
            elif predictor == 2:
                value[:, run] += 2 * before - older[:, run]
            elif predictor == 3:
                total = before.view(dtype).astype(np.int64) + older[:, run].view(dtype)
                value[:, run] += ((total + (total < 0)) >> 1).astype(np.int32)
            elif predictor == 6:
                value[:, run] += before + self.wait[before % self.interval]


def _runs(frame: Frame) -> list[tuple[int, bool, int, int]]:
    """Neighbouring fields with the same predictor and sign: predictor, signed, first, last + 1."""
    kinds = list(zip(frame.predictors.tolist(), frame.signed.tolist(), strict=True))
    begin = [i for i in range(len(kinds)) if i == 0 or kinds[i] != kinds[i - 1]]
    return [(*kinds[a], a, b) for a, b in zip(begin, [*begin[1:], len(kinds)], strict=True)]


def constants(frame: Frame, header: Header) -> Int[np.ndarray, " fields"]:
    """What predictors add that depends on the header alone. Raises ReadError if it is missing."""
    names = {4: "minthrottle", 9: "vbatref", 11: "motorOutput"}
    known = {p: setting(header, name, p) for p, name in names.items() if p in frame.predictors}
    known[8] = 1500
    return np.array([known.get(int(p), 0) for p in frame.predictors], np.int32)


def setting(header: Header, name: str, predictor: int) -> int:
    text = header.settings.get(name, "").split(",")[0].strip()
    digits = text.removeprefix("-")
    if not (digits.isascii() and digits.isdecimal() and len(digits) < 10):
        raise ReadError(
            f"predictor {predictor} needs the header line {name!r}, which is {text[:20]!r}.",
            offset=header.offset,
        )
    return int(text)


def add_constants(value: np.ndarray, frame: Frame, constant: Int[np.ndarray, " fields"]) -> None:
    """Add what depends on the header and, for predictor 5, on motor[0] of the same frame."""
    if constant.any():
        value += constant
    after_motor = np.flatnonzero(frame.predictors == 5)
    if after_motor.size:
        value[:, after_motor] += value[:, [frame.names.index("motor[0]")]]
