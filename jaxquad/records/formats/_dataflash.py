"""ArduPilot DataFlash logs (.bin), which describe themselves.

Format: ardupilot.org/dev, "Adding a new log message", and the FMT, FMTU, UNIT and MULT messages
that every log begins with.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from .._errors import ReadError
from .._log import Log, Table
from ._dataflash_format import Format, FORMAT_TYPE, parse_format, scaling, tables_of
from ._skips import describe_skips


HEAD = b"\xa3\x95"
_FMT_LENGTH = 89
_ABOUT = ("FMT", "FMTU", "UNIT", "MULT", "PARM")  # tables about the log, not of signals


def sniff(head: bytes, path: Path) -> bool:
    return head.startswith(HEAD + bytes([FORMAT_TYPE]))


def load(path: Path) -> Log:
    """The message types of a DataFlash log as tables, those with instances as `IMU[0]`, ..."""
    data = path.read_bytes()
    formats, offsets, remarks = _scan(data)
    if not formats:
        raise ReadError("no FMT message: it is no DataFlash log, or its head is lost", offset=0)
    rows, odd = _all_rows(np.frombuffer(data, np.uint8), formats, offsets)
    if odd:
        remarks.append(f"messages whose format contradicts itself left out: {', '.join(odd)}")
    scaled = scaling(rows, {kind: each.name for kind, each in formats.items()})
    tables: dict[str, Table] = {}
    for each in formats.values():
        if each.name in rows and each.name not in _ABOUT:
            columns = {name: rows[each.name][name] for name in each.columns}
            tables |= tables_of(each, columns, scaled)
    return Log(tables, tuple(remarks), "ardupilot", _parameters(rows.get("PARM")))


def _all_rows(
    buffer: UInt8[np.ndarray, " bytes"], formats: Mapping[int, Format], offsets: list[list[int]]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The messages by name as structured arrays, and the names of what cannot be laid out."""
    rows, odd = {}, []
    for kind, each in formats.items():
        dtype = each.dtype()
        if dtype is None or each.name in rows:
            odd += [each.name] if offsets[kind] else []
        elif offsets[kind]:
            windows = np.lib.stride_tricks.sliding_window_view(buffer, each.length)
            rows[each.name] = windows[np.array(offsets[kind])].view(dtype)[:, 0]
    return rows, odd


def _scan(data: bytes) -> tuple[dict[int, Format], list[list[int]], list[str]]:
    """The formats by message type, the offsets of each type's messages, what was skipped."""
    formats: dict[int, Format] = {}
    offsets: list[list[int]] = [[] for _ in range(256)]
    lengths = [0] * 256
    lengths[FORMAT_TYPE] = _FMT_LENGTH
    skipped: list[tuple[int, int]] = []
    place, end = 0, len(data)
    while place + 3 <= end:
        kind = data[place + 2]
        length = lengths[kind]
        if not length or data[place] != 0xA3 or data[place + 1] != 0x95:
            after = _next_message(data, place + 1, lengths)
            skipped.append((place, after))
            place = after
        elif place + length > end:
            break
        else:
            if kind == FORMAT_TYPE:
                _define(data, place, formats, lengths)
            offsets[kind].append(place)
            place += length
    return formats, offsets, describe_skips(skipped, place, end)


def _define(data: bytes, place: int, formats: dict[int, Format], lengths: list[int]) -> None:
    new = parse_format(data[place + 3 : place + _FMT_LENGTH])
    old = formats.get(new.kind)
    if old is not None and old != new:
        raise ReadError(
            f"message type {new.kind} ({old.name}) is defined again and otherwise ({new.name}): "
            f"are two logs in one file? Cut it there",
            offset=place,
        )
    if new.kind == FORMAT_TYPE and new.length != _FMT_LENGTH:
        raise ReadError(f"FMT declares itself {new.length} bytes long, not 89", offset=place)
    formats[new.kind] = new
    lengths[new.kind] = new.length if new.length > 3 else 0


def _next_message(data: bytes, place: int, lengths: list[int]) -> int:
    """Where a message begins that another one, or the end of the file, follows."""
    while (place := data.find(HEAD, place)) >= 0 and place + 3 <= len(data):
        length = lengths[data[place + 2]]
        after = place + length
        if length and (after == len(data) or data[after : after + 2] == HEAD):
            return place
        place += 1
    return len(data)


def _parameters(rows: np.ndarray | None) -> Mapping[str, str]:
    if rows is None or not {"Name", "Value"} <= set(rows.dtype.names or ()):
        return {}
    if rows["Name"].dtype.kind != "S" or rows["Value"].dtype.kind != "f":
        return {}
    names = (name.decode("latin-1") for name in rows["Name"].tolist())
    return {name: f"{value:.9g}" for name, value in zip(names, rows["Value"].tolist(), strict=True)}
