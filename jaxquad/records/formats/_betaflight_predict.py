"""From coded frames to values: add the predictions, and drop frames that cannot be right.

Source: "Blackbox logging internals" of the Betaflight documentation, field predictors and
log validation. The documentation gives the straight line (2) with the wrong sign.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int, Integer

from .._errors import ReadError
from ._betaflight_frames import Damage, Event, Frames, RESUME, STRAY
from ._betaflight_header import Frame, Header


# Where bytes were lost, a frame spliced of two may by chance end where another seems to begin,
# so that the damage shows later. Each further frame has a chance of some percent.
_DOUBTFUL = 4


class Segments(NamedTuple):
    """Key frames, each with the frames after it that refer to it."""

    begin: Int[np.ndarray, " segments"]  # row of the key frame
    size: Int[np.ndarray, " segments"]  # rows up to the next one
    usable: Int[np.ndarray, " segments"]  # rows before the first that damage makes unreadable
    whole: Bool[np.ndarray, " segments"]  # no frame was damaged before the next one


def segments(main: Frames, header: Header, damage: list[Damage]) -> Segments:
    begin = np.flatnonzero(main.key)
    size = np.diff(np.append(begin, main.key.size))
    hits = np.array([d.offset for d in damage] + [np.iinfo(np.int64).max])
    hit = hits[np.searchsorted(hits, main.offsets[begin])]
    intact = np.searchsorted(main.offsets, hit) - begin
    whole = intact >= size
    whole[:-1] &= hit[:-1] >= main.offsets[begin[1:]]  # none between the last frame and the next
    whole |= _complete(main, header, damage, begin, size)
    usable = np.where(whole, size, np.maximum(intact - _DOUBTFUL, 0))
    return Segments(begin, size, np.minimum(usable, scheduled(header).size), whole)


def _complete(
    main: Frames, header: Header, damage: list[Damage],
    begin: Int[np.ndarray, " segments"], size: Int[np.ndarray, " segments"],
) -> Bool[np.ndarray, " segments"]:  # fmt: skip
    """Whether a segment has all its frames although a few stray bytes stand between them."""
    complete = np.zeros(begin.size, bool)
    if not damage or not begin.size:
        return complete
    segment = np.searchsorted(main.offsets[begin], [d.offset for d in damage], "right") - 1
    lost = np.zeros(begin.size, np.int64)
    np.add.at(lost, segment[segment >= 0], np.array([d.size for d in damage])[segment >= 0])
    iteration = np.ascontiguousarray(main.coded[begin, 0])
    complete[:-1] = elapsed(iteration) == header.interval
    return complete & (size == scheduled(header).size) & (lost <= STRAY)


def scheduled(header: Header) -> Int[np.ndarray, " logged"]:
    """The loop iterations of one interval that are logged, the key frame's 0 among them."""
    iteration = np.arange(header.interval)
    if header.every == 0:
        return iteration[:1]
    return np.flatnonzero(
        (iteration == 0) | ((iteration + header.logged - 1) % header.every < header.logged)
    )


def predicted(main: Frames, header: Header, parts: Segments) -> None:
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
            f"predictor {predictor} needs a number in the header line {name!r}, not {text[:20]!r}",
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


_LEAP = 10_000_000  # us: a longer step between two frames is damage
_SLOWEST, _FASTEST = 2 / 3, 3 / 2  # pace of a key frame relative to the others


class Believed(NamedTuple):
    rows: Int[np.ndarray, " rows"]  # of the decoded frames
    scheduled: bool  # whether frames come as the intervals of the header say


def believed(main: Frames, header: Header, parts: Segments, events: list[Event]) -> Believed:
    """The rows that are in order, from the first to the last.

    A segment that ends at another iteration than the next key frame says has lost frames
    somewhere, if not part of its key frame: it is left out, unless most segments are like that.
    """
    keep = in_order(main, parts)
    usable = np.where(keep, parts.usable, 0)
    lost = keep & short(main, header, parts, keep, events)
    as_scheduled = 2 * lost.sum() <= keep.sum()
    if as_scheduled:
        usable[lost] = 0
    usable = until_time_leaps(main, parts.begin, usable)
    return Believed(spread(parts.begin, usable), bool(as_scheduled))


def in_order(main: Frames, parts: Segments) -> Bool[np.ndarray, " segments"]:
    """Key frames whose iteration and time go on together from those before.

    Neighbours that agree on the time per iteration form a run. A key frame that agrees with
    neither neighbour is damaged, if others do agree; a run that goes back is left out.
    """
    iteration, time = _counters(main, parts.begin)
    steps, spans = elapsed(iteration).astype(np.float64), elapsed(time).astype(np.float64)
    forward = (steps > 0) & (spans > 0)
    pace = np.divide(spans, steps, out=np.zeros_like(spans), where=forward)
    usual = np.median(pace[forward]) if forward.any() else 1.0
    agree = forward & (pace > _SLOWEST * usual) & (pace < _FASTEST * usual)
    run = np.concatenate([[0], np.cumsum(~agree)])[: iteration.size]
    alone = np.bincount(run) == 1 if run.size else np.empty(0, bool)
    kept = np.ones(alone.size, bool) if alone.all() else ~alone
    last = None
    for each in np.flatnonzero(kept):
        first, end = np.searchsorted(run, [each, each + 1])
        key = iteration[first], time[first]
        kept[each] = last is None or all(
            elapsed(np.array(pair))[0] > 0 for pair in zip(last, key, strict=True)
        )
        last = (iteration[end - 1], time[end - 1]) if kept[each] else last
    return kept[run]


def short(
    main: Frames,
    header: Header,
    parts: Segments,
    keep: Bool[np.ndarray, " segments"],
    events: list[Event],
) -> Bool[np.ndarray, " segments"]:
    """Segments without visible damage that hold other frames than up to the next key frame."""
    iteration, _ = _counters(main, parts.begin)
    ended = parts.size != scheduled(header).size
    ended[:-1] |= elapsed(iteration) != header.interval
    offsets = main.offsets[parts.begin]
    resumed = np.searchsorted([e.offset for e in events if e.name == RESUME], offsets)
    judged = parts.whole & (parts.size > scheduled(header).size)
    judged[:-1] |= parts.whole[:-1] & keep[1:] & (resumed[1:] == resumed[:-1])
    return judged & ended


def until_time_leaps(
    main: Frames, begin: Int[np.ndarray, " segments"], usable: Int[np.ndarray, " segments"]
) -> Int[np.ndarray, " segments"]:
    """Cut segments where time does not increase, jumps, or passes that of the next key frame."""
    usable = usable.copy()
    rows = spread(begin, usable)
    segment = np.repeat(np.arange(begin.size), usable)
    if not rows.size:
        return usable
    time = np.ascontiguousarray(main.coded[rows, 1]).view(np.uint32)
    step = elapsed(time)
    bad = np.zeros(rows.size, bool)
    bad[1:] = (segment[1:] == segment[:-1]) & ((step <= 0) | (step > _LEAP))
    kept = np.flatnonzero(usable)
    key = np.ascontiguousarray(main.coded[begin[kept], 1]).view(np.uint32)
    until_next = np.full(begin.size, 2**32)
    until_next[kept[:-1]] = key[1:] - key[:-1]
    since = time - np.repeat(key, usable[kept])
    bad |= since >= until_next[segment]
    local = rows - begin[segment]
    np.minimum.at(usable, segment[bad], local[bad])
    return usable


def spread(
    begin: Int[np.ndarray, " segments"], size: Int[np.ndarray, " segments"]
) -> Int[np.ndarray, " rows"]:
    """The rows `begin` .. `begin + size` of all segments, one after the other."""
    return np.repeat(begin - np.cumsum(size) + size, size) + np.arange(size.sum())


def elapsed(counter: Integer[np.ndarray, " rows"]) -> Int[np.ndarray, " steps"]:
    """Steps of a counter of 32 bits, whose overflow is no step back."""
    return np.diff(counter.view(np.uint32)).view(np.int32)


def _counters(main: Frames, rows: Int[np.ndarray, " rows"]) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(main.coded[rows, 0]), np.ascontiguousarray(main.coded[rows, 1])
