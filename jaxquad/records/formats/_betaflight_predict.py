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
    intact: Bool[np.ndarray, " segments"]  # no frame was damaged before the next one


def segments(main: Frames, header: Header, damage: list[Damage]) -> Segments:
    begin = np.flatnonzero(main.key)
    size, most = np.diff(np.append(begin, main.key.size)), scheduled(header).size
    offsets = main.offsets[begin]
    damaged = np.array([d.offset for d in damage], np.int64)
    hits = np.append(damaged, np.iinfo(np.int64).max)
    hit = hits[np.searchsorted(hits, offsets)]
    undamaged = np.searchsorted(main.offsets, hit) - begin
    intact = undamaged >= size
    intact[:-1] &= hit[:-1] >= offsets[1:]  # none between the last frame and the next
    if damage and begin.size:
        # A segment may have all its frames although a few stray bytes stand between them.
        segment = np.searchsorted(offsets, damaged, "right") - 1
        lost = np.zeros(begin.size, np.int64)
        np.add.at(lost, segment[segment >= 0], np.array([d.size for d in damage])[segment >= 0])
        complete = (size == most) & (lost <= STRAY)
        complete[:-1] &= elapsed(_column(main, begin, 0)) == header.interval
        complete[-1] = False
        intact |= complete
    usable = np.where(intact, size, np.maximum(undamaged - _DOUBTFUL, 0))
    return Segments(begin, size, np.minimum(usable, most), intact)


def scheduled(header: Header) -> Int[np.ndarray, " logged"]:
    """The loop iterations of one interval that are logged, the key frame's 0 among them."""
    iteration = np.arange(header.interval)
    if header.every == 0:
        return iteration[:1]
    return np.flatnonzero(
        (iteration == 0) | ((iteration + header.logged - 1) % header.every < header.logged)
    )


def add_predictions(main: Frames, header: Header, parts: Segments) -> None:
    """Turn the coded numbers of all usable rows into values, in place.

    Frame after frame, but for all segments at once: the average of the last two values is
    rounded, so that no cumulative sum can stand for it.
    """
    frame, interval = header.frames["P"], header.interval
    constant = constants(frame, header)
    # Neighbouring fields with the same predictor and sign are predicted together.
    kinds = list(zip(frame.predictors.tolist(), frame.signed.tolist(), strict=True))
    begins = [i for i in range(len(kinds)) if i == 0 or kinds[i] != kinds[i - 1]]
    runs = [
        (*kinds[a], slice(a, b)) for a, b in zip(begins, [*begins[1:], len(kinds)], strict=True)
    ]
    logged = np.append(scheduled(header), interval)
    iteration = np.arange(interval)
    wait = (logged[np.searchsorted(logged, iteration, "right")] - iteration).astype(np.int32)
    order = np.argsort(-parts.usable, kind="stable")
    begin, usable = parts.begin[order], parts.usable[order]
    last = older = main.coded[begin]
    add_constants(last, header.frames["I"], constants(header.frames["I"], header))
    main.coded[begin] = last
    frames = np.arange(1, usable.max(initial=1))
    for k, active in zip(frames, np.searchsorted(-usable, -frames), strict=True):
        rows = begin[:active] + k
        last, older = last[:active], older[:active]
        value = main.coded[rows]
        add_constants(value, frame, constant)
        for predictor, signed, run in runs:
            before = last[:, run]
            if predictor == 1:
                value[:, run] += before
            elif predictor == 2:
                value[:, run] += 2 * before - older[:, run]
            elif predictor == 3:
                dtype = np.int32 if signed else np.uint32
                total = before.view(dtype).astype(np.int64) + older[:, run].view(dtype)
                value[:, run] += ((total + (total < 0)) >> 1).astype(np.int32)
            elif predictor == 6:
                value[:, run] += before + wait[before % interval]
        main.coded[rows] = value
        last, older = value, last


def constants(frame: Frame, header: Header) -> Int[np.ndarray, " fields"]:
    """What predictors add that depends on the header alone. Raises ReadError if it is missing."""
    values = {8: 1500}
    for predictor, name in ((4, "minthrottle"), (9, "vbatref"), (11, "motorOutput")):
        if predictor not in frame.predictors:
            continue
        text = header.settings.get(name, "").split(",")[0].strip()
        digits = text.removeprefix("-")
        if not (digits.isascii() and digits.isdecimal() and len(digits) < 10):
            raise ReadError(
                f"predictor {predictor} needs a number in the header line {name!r}, not "
                f"{text[:20]!r}",
                offset=header.offset,
            )
        values[predictor] = int(text)
    return np.array([values.get(int(p), 0) for p in frame.predictors], np.int32)


def add_constants(value: np.ndarray, frame: Frame, constant: Int[np.ndarray, " fields"]) -> None:
    """Add what depends on the header and, for predictor 5, on motor[0] of the same frame."""
    if constant.any():
        value += constant
    after_motor = np.flatnonzero(frame.predictors == 5)
    if after_motor.size:
        value[:, after_motor] += value[:, [frame.names.index("motor[0]")]]


_LEAP = 10_000_000  # us: a longer step between two frames is damage
_SLOWEST, _FASTEST = 2 / 3, 3 / 2  # pace of a key frame relative to the others


def trusted_rows(
    main: Frames, header: Header, parts: Segments, events: list[Event]
) -> tuple[Int[np.ndarray, " rows"], bool]:
    """The rows that are in order, and whether frames come as the intervals of the header say.

    A segment that ends at another iteration than the next key frame says has lost frames
    somewhere, if not part of its key frame: it is left out, unless most segments are like that.
    """
    in_order = _in_order(main, parts)
    usable = np.where(in_order, parts.usable, 0)
    # Segments without visible damage that hold other frames than up to the next key frame.
    most = scheduled(header).size
    ended = parts.size != most
    ended[:-1] |= elapsed(_column(main, parts.begin, 0)) != header.interval
    resumes = [event.offset for event in events if event.name == RESUME]
    resumed = np.searchsorted(resumes, main.offsets[parts.begin])
    judged = parts.intact & (parts.size > most)
    judged[:-1] |= parts.intact[:-1] & in_order[1:] & (resumed[1:] == resumed[:-1])
    lost = in_order & judged & ended
    as_scheduled = 2 * lost.sum() <= in_order.sum()
    if as_scheduled:
        usable[lost] = 0
    usable = _until_time_leaps(main, parts.begin, usable)
    return _spread(parts.begin, usable), bool(as_scheduled)


def _in_order(main: Frames, parts: Segments) -> Bool[np.ndarray, " segments"]:
    """Key frames whose iteration and time go on together from those before.

    Neighbours that agree on the time per iteration form a run. A key frame that agrees with
    neither neighbour is damaged, if others do agree; a run that goes back is left out.
    """
    iteration, time = _column(main, parts.begin, 0), _column(main, parts.begin, 1)
    steps, spans = elapsed(iteration).astype(np.float64), elapsed(time).astype(np.float64)
    forward = (steps > 0) & (spans > 0)
    pace = np.divide(spans, steps, out=np.zeros_like(spans), where=forward)
    usual = np.median(pace[forward]) if forward.any() else 1.0
    agree = forward & (pace > _SLOWEST * usual) & (pace < _FASTEST * usual)
    run = np.concatenate([[0], np.cumsum(~agree)])[: iteration.size]
    alone = np.bincount(run) == 1 if run.size else np.empty(0, bool)
    kept = np.ones(alone.size, bool) if alone.all() else ~alone
    last = None
    for number in np.flatnonzero(kept):
        first, end = np.searchsorted(run, [number, number + 1])
        key = iteration[first], time[first]
        kept[number] = last is None or all(
            elapsed(np.array(pair))[0] > 0 for pair in zip(last, key, strict=True)
        )
        last = (iteration[end - 1], time[end - 1]) if kept[number] else last
    return kept[run]


def _until_time_leaps(
    main: Frames, begin: Int[np.ndarray, " segments"], usable: Int[np.ndarray, " segments"]
) -> Int[np.ndarray, " segments"]:
    """Cut segments where time does not increase, jumps, or passes that of the next key frame."""
    usable = usable.copy()
    rows = _spread(begin, usable)
    segment = np.repeat(np.arange(begin.size), usable)
    if not rows.size:
        return usable
    time = _column(main, rows, 1).view(np.uint32)
    step = elapsed(time)
    bad = np.zeros(rows.size, bool)
    bad[1:] = (segment[1:] == segment[:-1]) & ((step <= 0) | (step > _LEAP))
    kept = np.flatnonzero(usable)
    key = _column(main, begin[kept], 1).view(np.uint32)
    until_next = np.full(begin.size, 2**32)
    until_next[kept[:-1]] = key[1:] - key[:-1]
    since = time - np.repeat(key, usable[kept])
    bad |= since >= until_next[segment]
    local = rows - begin[segment]
    np.minimum.at(usable, segment[bad], local[bad])
    return usable


def _spread(
    begin: Int[np.ndarray, " segments"], size: Int[np.ndarray, " segments"]
) -> Int[np.ndarray, " rows"]:
    """The rows `begin` .. `begin + size` of all segments, one after the other."""
    return np.repeat(begin - np.cumsum(size) + size, size) + np.arange(size.sum())


def elapsed(counter: Integer[np.ndarray, " rows"]) -> Int[np.ndarray, " steps"]:
    """Steps of a counter of 32 bits, whose overflow is no step back."""
    return np.diff(counter.view(np.uint32)).view(np.int32)


def _column(main: Frames, rows: Int[np.ndarray, " rows"], field: int) -> np.ndarray:
    return np.ascontiguousarray(main.coded[rows, field])
