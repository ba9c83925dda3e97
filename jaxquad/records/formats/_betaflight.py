"""Blackbox logs (.bbl, .bfl) as tables: values from coded frames, and which of them are right.

Source: "Blackbox logging internals" of the Betaflight documentation, field predictors and
log validation. The documentation gives the straight line (2) with the wrong sign.
"""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from .._log import Log, ReadError, Table
from ._betaflight_columns import scaled, with_derived, with_mixed_axes
from ._betaflight_frames import (
    ADJUSTMENT,
    Event,
    Frame,
    Frames,
    Header,
    headers,
    MARKER,
    payload,
    RESUME,
    STRAY,
)


Rows = Int[np.ndarray, " rows"]


def sniff(head: bytes, path: Path) -> bool:
    return MARKER[:40] in head


def load(path: Path) -> Log:
    """All logs of a file that have frames: the tables `slow` and `gps`, of several `log2.slow`."""
    data = path.read_bytes()
    tables, remarks, settings, failures = {}, [], {}, []
    logs = headers(data)
    for number, header in enumerate(logs, start=1):
        label = f"log{number}" if len(logs) > 1 else ""
        try:
            if isinstance(header, ReadError):
                raise header
            log, said = _log(data, header)
        except ReadError as error:
            failures.append(error)
            remarks.append(f"{label or 'log'}: {error}".rstrip("."))
            continue
        tables |= {".".join(filter(None, (label, name))): table for name, table in log.items()}
        remarks += [f"{label or 'log'}: {remark}" for remark in said]
        settings |= {f"{label} {k}".lstrip(): v for k, v in header.settings.items()}
    if not tables:
        raise failures[0] if failures else ReadError("the file holds no blackbox log", offset=0)
    return Log(tables, tuple(remarks), "betaflight", settings)


def _log(data: bytes, header: Header) -> tuple[dict[str, Table], list[str]]:
    content = payload(data, header)
    main, damage = content.main, content.damage
    parts = _segments(main, header, damage)
    _add_predictions(main, header, parts)
    rows, as_scheduled = _trusted_rows(main, header, parts, content.events)
    if not rows.size:
        raise ReadError("the log holds no readable frame", offset=header.payload)
    count = lambda number, noun: f"{number} {noun}{'s' if number > 1 else ''}"
    remarks = []
    if damage:
        size = sum(end - begin for begin, end in damage)
        remarks.append(
            f"{count(len(damage), 'damaged block')} ({size} bytes) without frames skipped, "
            f"the first at byte {damage[0][0]}"
        )
    logged = main.offsets.size
    if logged > rows.size:
        mask = np.ones(logged, bool)
        mask[rows] = False
        remarks.append(
            f"{logged - rows.size} of {logged} frames were left out, because they refer "
            f"to lost or damaged ones or are out of order, the first at byte "
            f"{main.offsets[mask.argmax()]}"
        )
        main = Frames(*(part[rows] for part in main))
    changed = [event for event in content.events if event.name == ADJUSTMENT]
    if changed:
        remarks.append(
            f"{count(len(changed), 'setting')} changed in flight, first at byte "
            f"{changed[0].offset}: the gains in the header do not hold for the whole log"
        )
    if not as_scheduled:
        remarks.append(
            "the frames between key frames differ from the I and P intervals of the header: "
            "loopIteration is not reliable, and lost frames cannot be detected"
        )
    counter = main.coded[:, 1]
    start = int(counter[:1].view(np.uint32)[0])
    time = np.concatenate([[start], start + np.cumsum(_elapsed(counter), dtype=np.int64)]) / 1e6
    table = _table(main.coded, "I", time, header)
    columns = with_mixed_axes(with_derived(table.columns), header.settings, time)
    tables = {"": dataclasses.replace(table, columns=columns)}
    # Flight modes and positions are stamped with the last main frame before. GPS frames that no
    # home position precedes are left out, as they are relative to it.
    for letter, name in (("S", "slow"), ("G", "gps")):
        frames = content.slow.get(letter)
        if frames is None or not frames.offsets.size:
            continue
        frame = header.frames[letter]
        before = np.searchsorted(main.offsets, frames.offsets) - 1
        if 10 not in frame.predictors:  # What was noted before the first frame held then, too.
            before = np.maximum(before, 0)
        rows = np.flatnonzero(before >= 0)
        from_home = frame.predictors == 7
        home = np.zeros((0, int(from_home.sum())), np.int32)
        if from_home.any():
            homes = content.slow.get("H")
            if homes is None or not homes.offsets.size or homes.coded.shape[1] < home.shape[1]:
                rows = rows[:0]
            else:
                last = np.searchsorted(homes.offsets, frames.offsets) - 1
                rows = rows[last[rows] >= 0]
                home = homes.coded[last[rows], : home.shape[1]]
        values = frames.coded[rows]
        _add_constants(values, frame, _constants(frame, header))
        if from_home.any():
            values[:, from_home] += home
        values[:, frame.predictors == 10] += main.coded[before[rows], 1][:, None]
        tables[name] = _table(values, letter, time[before[rows]], header)
    return tables, remarks


def _table(
    values: Int[np.ndarray, "samples fields"], letter: str, time: Float[np.ndarray, " samples"],
    header: Header,
) -> Table:  # fmt: skip
    """Views of the decoded columns with the units that the header gives them."""
    frame = header.frames[letter]
    columns = {
        name: values[:, i] if frame.signed[i] else values[:, i].view(np.uint32)
        for i, name in enumerate(frame.names)
        if name != "time"
    }
    factors = scaled(frame.names, header.settings)
    units = {name: unit for name, (_, unit) in factors.items()}
    return Table(columns, time, units, {name: factor for name, (factor, _) in factors.items()})


# Where bytes were lost, a frame spliced of two may by chance end where another seems to begin,
# so that the damage shows later. Each further frame has a chance of some percent.
_DOUBTFUL = 4
_LEAP = 10_000_000  # us: a longer step between two frames is damage
_SLOWEST, _FASTEST = 2 / 3, 3 / 2  # pace of a key frame relative to the others


class _Segments(NamedTuple):
    """Key frames, each with the frames after it that refer to it."""

    begin: Int[np.ndarray, " segments"]  # row of the key frame
    size: Int[np.ndarray, " segments"]  # rows up to the next one
    usable: Int[np.ndarray, " segments"]  # rows before the first that damage makes unreadable
    intact: Bool[np.ndarray, " segments"]  # no frame was damaged before the next one


def _segments(main: Frames, header: Header, damage: list[tuple[int, int]]) -> _Segments:
    begin = np.flatnonzero(main.key)
    size, most = np.diff(np.append(begin, main.key.size)), header.scheduled.size
    offsets = main.offsets[begin]
    damaged, until = np.array(damage, np.int64).reshape(-1, 2).T
    hits = np.append(damaged, np.iinfo(np.int64).max)
    hit = hits[np.searchsorted(hits, offsets)]
    undamaged = np.searchsorted(main.offsets, hit) - begin
    intact = undamaged >= size
    intact[:-1] &= hit[:-1] >= offsets[1:]  # none between the last frame and the next
    if damage and begin.size:
        # A segment may have all its frames although a few stray bytes stand between them.
        segment = np.searchsorted(offsets, damaged, "right") - 1
        lost = np.zeros(begin.size, np.int64)
        np.add.at(lost, segment[segment >= 0], (until - damaged)[segment >= 0])
        complete = (size == most) & (lost <= STRAY)
        complete[:-1] &= _elapsed(main.coded[begin, 0]) == header.interval
        complete[-1] = False
        intact |= complete
    usable = np.where(intact, size, np.maximum(undamaged - _DOUBTFUL, 0))
    return _Segments(begin, size, np.minimum(usable, most), intact)


def _add_predictions(main: Frames, header: Header, parts: _Segments) -> None:
    """Turn the coded numbers of all usable rows into values, in place.

    Frame after frame, for all segments at once: the average of two values is rounded.
    """
    frame, interval = header.frames["P"], header.interval
    constant = _constants(frame, header)
    # Neighbouring fields with the same predictor and sign are predicted together.
    kinds = list(zip(frame.predictors.tolist(), frame.signed.tolist(), strict=True))
    begins = [i for i in range(len(kinds)) if i == 0 or kinds[i] != kinds[i - 1]]
    runs = [
        (*kinds[a], slice(a, b)) for a, b in zip(begins, [*begins[1:], len(kinds)], strict=True)
    ]
    logged, iteration = np.append(header.scheduled, interval), np.arange(interval)
    wait = (logged[np.searchsorted(logged, iteration, "right")] - iteration).astype(np.int32)
    order = np.argsort(-parts.usable, kind="stable")
    begin, usable = parts.begin[order], parts.usable[order]
    last = older = main.coded[begin]
    _add_constants(last, header.frames["I"], _constants(header.frames["I"], header))
    main.coded[begin] = last
    frames = np.arange(1, usable.max(initial=1))
    for k, active in zip(frames, np.searchsorted(-usable, -frames), strict=True):
        rows = begin[:active] + k
        last, older = last[:active], older[:active]
        value = main.coded[rows]
        _add_constants(value, frame, constant)
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


def _constants(frame: Frame, header: Header) -> Int[np.ndarray, " fields"]:
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


def _add_constants(value: np.ndarray, frame: Frame, constant: Int[np.ndarray, " fields"]) -> None:
    """Add what depends on the header and, for predictor 5, on motor[0] of the same frame."""
    if constant.any():
        value += constant
    after_motor = np.flatnonzero(frame.predictors == 5)
    if after_motor.size:
        value[:, after_motor] += value[:, [frame.names.index("motor[0]")]]


def _trusted_rows(
    main: Frames, header: Header, parts: _Segments, events: list[Event]
) -> tuple[Rows, bool]:
    """The rows that are in order, and whether frames come as the intervals of the header say.

    A segment that ends elsewhere than the next key frame says is left out, unless most are so.
    """
    begin, most = parts.begin, header.scheduled.size
    in_order = _in_order(main, begin)
    usable = np.where(in_order, parts.usable, 0)
    # Segments without visible damage that hold other frames than up to the next key frame.
    ended = parts.size != most
    ended[:-1] |= _elapsed(main.coded[begin, 0]) != header.interval
    resumes = [event.offset for event in events if event.name == RESUME]
    resumed = np.searchsorted(resumes, main.offsets[begin])
    judged = parts.intact & (parts.size > most)
    judged[:-1] |= parts.intact[:-1] & in_order[1:] & (resumed[1:] == resumed[:-1])
    lost = in_order & judged & ended
    as_scheduled = bool(2 * lost.sum() <= in_order.sum())
    if as_scheduled:
        usable[lost] = 0
    rows = _spread(begin, usable)
    if not rows.size:
        return rows, as_scheduled
    # Segments end where time does not increase, jumps, or passes that of the next key frame.
    segment, time = np.repeat(np.arange(begin.size), usable), main.coded[rows, 1].view(np.uint32)
    step = _elapsed(time)
    bad = np.zeros(rows.size, bool)
    bad[1:] = (segment[1:] == segment[:-1]) & ((step <= 0) | (step > _LEAP))
    kept = np.flatnonzero(usable)
    key = main.coded[begin[kept], 1].view(np.uint32)
    until_next = np.full(begin.size, 2**32)
    until_next[kept[:-1]] = key[1:] - key[:-1]
    bad |= time - np.repeat(key, usable[kept]) >= until_next[segment]
    np.minimum.at(usable, segment[bad], (rows - begin[segment])[bad])
    return _spread(begin, usable), as_scheduled


def _in_order(main: Frames, begin: np.ndarray) -> Bool[np.ndarray, " segments"]:
    """Key frames whose iteration and time go on together from those before.

    Neighbours that agree on the time per iteration form a run; a run that goes back is left out.
    """
    iteration, time = main.coded[begin, 0], main.coded[begin, 1]
    steps, spans = _elapsed(iteration).astype(np.float64), _elapsed(time).astype(np.float64)
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
            _elapsed(np.array(pair))[0] > 0 for pair in zip(last, key, strict=True)
        )
        last = (iteration[end - 1], time[end - 1]) if kept[number] else last
    return kept[run]


def _spread(begin: np.ndarray, size: np.ndarray) -> Rows:
    """The rows `begin` .. `begin + size` of all segments, one after the other."""
    return np.repeat(begin - np.cumsum(size) + size, size) + np.arange(size.sum())


def _elapsed(counter: Integer[np.ndarray, " rows"]) -> Int[np.ndarray, " steps"]:
    """Steps of a counter of 32 bits, whose overflow is no step back."""
    return np.diff(counter.view(np.uint32)).view(np.int32)
