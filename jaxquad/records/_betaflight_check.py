"""Which frames of a blackbox log to believe: nothing but their own order speaks for them.

Source: "Blackbox logging internals" of the Betaflight documentation, log validation; the
comparison with the next key frame, which finds lost frames, is our own.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int, Integer

from ._betaflight_events import Event, RESUME
from ._betaflight_frames import Found
from ._betaflight_header import Header
from ._betaflight_predict import scheduled, Segments


_LEAP = 10_000_000  # us: a longer step between two frames is damage
_SLOWEST, _FASTEST = 2 / 3, 3 / 2  # pace of a key frame relative to the others


class Believed(NamedTuple):
    rows: Int[np.ndarray, " rows"]  # of the decoded frames
    scheduled: bool  # whether frames come as the intervals of the header say


def believed(main: Found, header: Header, parts: Segments, events: list[Event]) -> Believed:
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


def in_order(main: Found, parts: Segments) -> Bool[np.ndarray, " segments"]:
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
    main: Found,
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
    main: Found, begin: Int[np.ndarray, " segments"], usable: Int[np.ndarray, " segments"]
) -> Int[np.ndarray, " segments"]:
    """Cut segments where time stands still, leaps, or passes that of the next key frame."""
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
    room = np.full(begin.size, 2**32)
    room[kept[:-1]] = key[1:] - key[:-1]
    since = time - np.repeat(key, usable[kept])
    bad |= since >= room[segment]
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


def _counters(main: Found, rows: Int[np.ndarray, " rows"]) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(main.coded[rows, 0]), np.ascontiguousarray(main.coded[rows, 1])
