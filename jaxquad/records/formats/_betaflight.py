"""Betaflight, Cleanflight and INAV blackbox logs (.bbl, .bfl).

Source: "Blackbox logging internals" of the Betaflight documentation.
"""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from .._errors import ReadError
from .._log import Log, Table
from ._betaflight_frames import ADJUSTMENT, Frames, Payload, payload
from ._betaflight_header import Frame, Header, headers, MARKER, scaled, with_axis_sums
from ._betaflight_predict import add_constants, believed, constants, elapsed, predicted, segments


def slow_tables(
    slow: dict[str, Frames], main: Frames, time: Float[np.ndarray, " samples"], header: Header
) -> dict[str, Table]:
    """The tables `slow` (flight modes) and `gps`, stamped with the last main frame before.

    GPS frames that no home position precedes are left out, as they are relative to it.
    """
    tables = {}
    for letter, name in (("S", "slow"), ("G", "gps")):
        found = slow.get(letter)
        if found is None or not found.offsets.size:
            continue
        frame = header.frames[letter]
        before = np.searchsorted(main.offsets, found.offsets) - 1
        if 10 not in frame.predictors:  # What was noted before the first frame held then, too.
            before = np.maximum(before, 0)
        rows = np.flatnonzero(before >= 0)
        home, rows = _home(slow.get("H"), frame, found.offsets, rows)
        values = found.coded[rows]
        add_constants(values, frame, constants(frame, header))
        values[:, frame.predictors == 7] += home
        values[:, frame.predictors == 10] += main.coded[before[rows], 1][:, None]
        stamps = time[before[rows]]
        tables[name] = table(values, frame, stamps, header)
    return tables


def table(
    values: Int[np.ndarray, "samples fields"],
    frame: Frame,
    time: Float[np.ndarray, " samples"],
    header: Header,
) -> Table:
    """Views of the decoded columns with the units that the header gives them."""
    columns = {
        name: values[:, i] if frame.signed[i] else values[:, i].view(np.uint32)
        for i, name in enumerate(frame.names)
        if name != "time"
    }
    known = scaled(frame.names, header.settings)
    units = {name: unit for name, (_, unit) in known.items()}
    return Table(columns, time, units, {name: factor for name, (factor, _) in known.items()})


def _home(
    homes: Frames | None, frame: Frame, offsets: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The home coordinates for the fields that refer to them, and the rows that have one."""
    fields = int((frame.predictors == 7).sum())
    if not fields:
        return np.zeros((rows.size, 0), np.int32), rows
    if homes is None or not homes.offsets.size or homes.coded.shape[1] < fields:
        return np.zeros((0, fields), np.int32), rows[:0]
    last = np.searchsorted(homes.offsets, offsets) - 1
    rows = rows[last[rows] >= 0]
    return homes.coded[last[rows], :fields], rows


def sniff(head: bytes, path: Path) -> bool:
    return MARKER[:40] in head


def load(path: Path) -> Log:
    """All logs of a file that have frames."""
    return decode(path.read_bytes())


def decode(data: bytes) -> Log:
    """The logs in the bytes of a blackbox file.

    A single log has the tables `""`, `slow` and `gps`; of several, the second is `log2`,
    `log2.slow`, `log2.gps`. Raises ReadError where no log has frames.
    """
    tables, remarks, settings, failures = {}, [], {}, []
    found = headers(data)
    for number, header in enumerate(found, start=1):
        label = f"log{number}" if len(found) > 1 else ""
        try:
            if isinstance(header, ReadError):
                raise header
            mine, said = _log(data, header)
        except ReadError as error:
            failures.append(error)
            remarks.append(f"{label or 'log'}: {error}".rstrip("."))
            continue
        tables |= {".".join(filter(None, (label, name))): each for name, each in mine.items()}
        remarks += [f"{label or 'log'}: {each}" for each in said]
        settings |= {f"{label} {k}".lstrip(): v for k, v in header.settings.items()}
    if not tables:
        raise failures[0] if failures else ReadError("the file holds no blackbox log", offset=0)
    return Log(tables, tuple(remarks), "betaflight", settings)


def _log(data: bytes, header: Header) -> tuple[dict[str, Table], list[str]]:
    held = payload(data, header)
    parts = segments(held.main, header, held.damage)
    predicted(held.main, header, parts)
    rows, as_scheduled = believed(held.main, header, parts, held.events)
    if not rows.size:
        raise ReadError("the log holds no readable frame", offset=header.payload)
    left_out = held.main.offsets.size - rows.size
    main = Frames(*(part[rows] for part in held.main)) if left_out else held.main
    time = _seconds(main.coded[:, 1])
    tables = {"": _main_table(main, time, header)} | slow_tables(held.slow, main, time, header)
    remarks = _remarks(held, rows)
    if not as_scheduled:
        remarks.append(
            "the frames between key frames differ from the I and P intervals of the header: "
            "loopIteration is not reliable, and lost frames cannot be detected"
        )
    return tables, remarks


def _seconds(counter: np.ndarray) -> np.ndarray:
    counter = np.ascontiguousarray(counter)
    start = int(counter[:1].view(np.uint32)[0])
    passed = np.cumsum(elapsed(counter), dtype=np.int64)
    return np.concatenate([[start], start + passed]) / 1e6


def _main_table(main: Frames, time: np.ndarray, header: Header) -> Table:
    fields = table(main.coded, header.frames["I"], time, header)
    return dataclasses.replace(fields, columns=with_axis_sums(fields.columns))


def _remarks(held: Payload, rows: np.ndarray) -> list[str]:
    remarks = []
    if held.damage:
        size = sum(each.size for each in held.damage)
        remarks.append(
            f"{_count(len(held.damage), 'damaged block')} ({size} bytes) without frames skipped, "
            f"the first at byte {held.damage[0].offset}"
        )
    left_out = held.main.offsets.size - rows.size
    if left_out:
        mask = np.ones(held.main.offsets.size, bool)
        mask[rows] = False
        remarks.append(
            f"{left_out} of {mask.size} frames were left out, because they refer to lost or "
            f"damaged ones or are out of order, the first at byte "
            f"{held.main.offsets[mask.argmax()]}"
        )
    changed = [each for each in held.events if each.name == ADJUSTMENT]
    if changed:
        remarks.append(
            f"{_count(len(changed), 'setting')} changed in flight, first at byte "
            f"{changed[0].offset}: the gains in the header do not hold for the whole log"
        )
    return remarks


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number > 1 else ''}"
