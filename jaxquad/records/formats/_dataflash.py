"""ArduPilot DataFlash logs, binary (.bin), which describe their own messages.

Format: ardupilot.org/dev, "Adding a new log message", and the FMT, FMTU, UNIT and MULT messages
that every log begins with.
"""

import collections
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from jaxtyping import UInt8

from .._errors import ReadError
from .._log import changes_of, describe_skips, Log, Table
from ._dataflash_boots import choose_log, CUT_IT, firmware_of, MOST_PARTS, Part, span_of


FORMAT_TYPE = 128
HEAD_SIZE = 3  # bytes of a message before its columns
_CODES = {
    "a": "(32,)<i2", "b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4",
    "f": "<f4", "d": "<f8", "g": "<f2", "n": "S4", "N": "S16", "Z": "S64", "c": "<i2", "C": "<u2",
    "e": "<i4", "E": "<u4", "L": "<i4", "M": "u1", "q": "<i8", "Q": "<u8",
}  # fmt: skip
_BUILT_IN = {"c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01, "L": 1e-7}
CLOCKS = {"TimeUS": 1e-6, "TimeMS": 1e-3}  # s


Offsets = dict[int, list[int]]  # of the messages of each type, in bytes


class Format(NamedTuple):
    """The layout of one message type."""

    kind: int
    length: int  # bytes, with the head of three
    name: str
    codes: str
    columns: tuple[str, ...]

    def dtype(self) -> np.dtype | None:
        """Of a whole message; None where the layout is inconsistent."""
        columns = self.columns
        if not set(self.codes) <= set(_CODES) or len(self.codes) != len(columns):
            return None
        if len(set(columns)) < len(columns) or "" in columns or not self.name:
            return None
        formats = [np.dtype(_CODES[code]) for code in self.codes]
        ends = np.cumsum([HEAD_SIZE, *(each.itemsize for each in formats)]).tolist()
        if ends[-1] != self.length:
            return None
        return np.dtype(
            {
                "names": list(columns),
                "formats": formats,
                "offsets": ends[:-1],
                "itemsize": self.length,
            }
        )


class Scaling(NamedTuple):
    """What FMTU, UNIT and MULT say about the columns of the other messages."""

    units: Mapping[str, str]  # by letter
    multipliers: Mapping[str, float]  # by letter
    letters: Mapping[str, tuple[str, str]]  # by message: one letter per column, of either kind


HEAD = b"\xa3\x95"
_FMT_LENGTH = 89
ABOUT = ("FMT", "FMTU", "UNIT", "MULT", "PARM")  # tables about the log, not of signals


def sniff(head: bytes, path: Path) -> bool:
    return head.startswith(HEAD + bytes([FORMAT_TYPE]))


def load(path: Path) -> Log:
    """The message types of a DataFlash log as tables, those with instances as `IMU[0]`, ..."""
    data = path.read_bytes()
    parts, remarks = _scan(data)
    if not parts[0].formats:
        raise ReadError(
            "there is no FMT message: the file is not a DataFlash log, or its beginning is missing",
            offset=0,
        )
    buffer = np.frombuffer(data, np.uint8)
    formats, offsets, left_out = _one_log(buffer, parts)
    rows, odd = _all_rows(buffer, formats, offsets)
    remarks += left_out
    if odd:
        remarks.append(f"messages with an inconsistent format were left out: {', '.join(odd)}")
    scaled = scaling(rows, {kind: each.name for kind, each in formats.items()})
    tables: dict[str, Table] = {}
    for each in formats.values():
        if each.name in rows and each.name not in ABOUT:
            columns = {name: rows[each.name][name] for name in each.columns}
            tables |= tables_of(each, columns, scaled)
    remarks += find_rate_unit(tables, scaled)
    stamped = _parameters(rows.get("PARM"))
    settings = {name: value for _, name, value in stamped}
    changes = changes_of(stamped, lambda time: time)
    firmware = firmware_of(_texts(rows))
    return Log(tables, tuple(remarks), "ardupilot", settings, changes, firmware)


def _texts(rows: Mapping[str, np.ndarray]) -> Iterator[str]:
    """What the messages that name the firmware say."""
    for name, column in (("VER", "FWS"), ("MSG", "Message")):
        table = rows.get(name)
        if table is not None and column in (table.dtype.names or ()):
            if table.dtype[column].kind == "S":
                yield from map(text, table[column].tolist())


def _all_rows(
    buffer: UInt8[np.ndarray, " bytes"], formats: Mapping[int, Format], offsets: Offsets
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The messages by name as structured arrays, and the names of what cannot be laid out."""
    rows, odd = {}, []
    for kind, each in formats.items():
        dtype = each.dtype()
        if dtype is None or each.name in rows:
            odd += [each.name] if offsets.get(kind) else []
        elif offsets.get(kind):
            windows = np.lib.stride_tricks.sliding_window_view(buffer, each.length)
            rows[each.name] = windows[np.array(offsets[kind])].view(dtype)[:, 0]
    return rows, odd


@dataclasses.dataclass(frozen=True)
class _Part:
    """From definitions of messages to the next ones: formats by message type, offsets of each.

    `defined` are the types that it defines itself, and `redefined` place, old and new format of
    those that the part before defined otherwise.
    """

    begin: int
    formats: dict[int, Format]
    offsets: dict[int, list[int]] = dataclasses.field(
        default_factory=lambda: collections.defaultdict(list)
    )
    defined: set[int] = dataclasses.field(default_factory=set)
    redefined: list[tuple[int, Format, Format]] = dataclasses.field(default_factory=list)


_FIRST = HEAD + bytes([FORMAT_TYPE, FORMAT_TYPE, _FMT_LENGTH])  # of a log: the FMT of FMT


def _scan(data: bytes) -> tuple[list[_Part], list[str]]:
    """The parts of a file, and what was skipped.

    A log ends within a message, wherever the writer's buffer did, which is no damage.
    """
    parts = [part := _Part(0, {})]
    lengths = [0] * 256
    lengths[FORMAT_TYPE] = _FMT_LENGTH
    skipped: list[tuple[int, int]] = []
    place, last, end = 0, -1, len(data)
    while place + 3 <= end:
        kind = data[place + 2]
        length = lengths[kind]
        if not length or data[place] != 0xA3 or data[place + 1] != 0x95:
            begin = data.find(_FIRST, last + 3, place) if last >= 0 else -1
            if begin >= 0:  # the log before ended within its last message
                part.offsets[data[last + 2]].pop()
                place = last = begin
                continue
            after = _next_message(data, place + 1, lengths)
            skipped.append((place, after))
            place, last = after, -1
        elif place + length > end:
            break
        else:
            if kind == FORMAT_TYPE:
                part = _part_at(place, data[place + 3], parts)
                _define(data, place, part, lengths)
            part.offsets[kind].append(place)
            last = place
            place += length
    if skipped and skipped[-1][1] == end and not data[skipped[-1][0] :].strip(b"\0\xff"):
        skipped.pop()  # what a file was prepared with, and not written
    return parts, describe_skips(skipped, end, end)


def _part_at(place: int, kind: int, parts: list[_Part]) -> _Part:
    """The part that a definition belongs to: a new one where its type is defined once more."""
    part = parts[-1]
    if kind in part.defined and part.offsets.keys() != {FORMAT_TYPE}:
        if len(parts) == MOST_PARTS:
            raise ReadError(
                f"the file defines its messages more than {MOST_PARTS} times: {CUT_IT}",
                offset=place,
            )
        parts.append(part := _Part(place, dict(part.formats)))
    part.defined.add(kind)
    return part


def _define(data: bytes, place: int, part: _Part, lengths: list[int]) -> None:
    new = parse_format(data[place + 3 : place + _FMT_LENGTH])
    old = part.formats.get(new.kind)
    if old is not None and old != new:
        part.redefined.append((place, old, new))
    if new.kind == FORMAT_TYPE and new.length != _FMT_LENGTH:
        raise ReadError(
            f"the FMT message declares a length of {new.length} bytes; it has 89", offset=place
        )
    part.formats[new.kind] = new
    lengths[new.kind] = new.length if new.length > 3 else 0


def _one_log(
    buffer: UInt8[np.ndarray, " bytes"], parts: Sequence[_Part]
) -> tuple[Mapping[int, Format], Offsets, list[str]]:
    """Formats and offsets of one of the logs that a file holds, and a remark on the others."""
    ends = [*(part.begin for part in parts[1:]), buffer.size]
    described = [
        Part(
            part.begin,
            end,
            _span(buffer, part),
            _holds(part, "SIDD"),
            bool(part.redefined) and FORMAT_TYPE in part.defined,
        )
        for part, end in zip(parts, ends, strict=True)
    ]
    numbers, remarks = choose_log(described)
    offsets: Offsets = collections.defaultdict(list)
    for i in numbers:
        if parts[i].redefined and (i == 0 or i - 1 in numbers):
            _refuse_other_definition(*parts[i].redefined[0])
        for kind, places in parts[i].offsets.items():
            offsets[kind] += places
    return parts[numbers[-1]].formats, offsets, remarks


def _refuse_other_definition(place: int, old: Format, new: Format) -> NoReturn:
    raise ReadError(
        f"message type {new.kind} ({old.name}) is defined a second time, differently "
        f"({new.name}): if the file holds two logs, cut it there",
        offset=place,
    )


def _span(buffer: UInt8[np.ndarray, " bytes"], part: _Part) -> tuple[float, float] | None:
    """First and last time of a part in s, by its most frequent messages with a time."""
    timed = [layout for layout in part.formats.values() if layout.columns[0] in CLOCKS]
    timed = [x for x in timed if part.offsets.get(x.kind) and x.name not in ABOUT]
    timed = [layout for layout in timed if layout.dtype() is not None]
    if not timed:
        return None
    most = max(timed, key=lambda layout: len(part.offsets[layout.kind]))
    rows, _ = _all_rows(buffer, {most.kind: most}, part.offsets)
    return span_of(CLOCKS[most.columns[0]] * rows[most.name][most.columns[0]].astype(np.float64))


def _holds(part: _Part, name: str) -> bool:
    return any(x.name == name and part.offsets.get(kind) for kind, x in part.formats.items())


def _next_message(data: bytes, place: int, lengths: list[int]) -> int:
    """Where a message begins that another one, or the end of the file, follows."""
    while (place := data.find(HEAD, place)) >= 0 and place + 3 <= len(data):
        length = lengths[data[place + 2]]
        after = place + length
        if length and (after == len(data) or data[after : after + 2] == HEAD):
            return place
        place += 1
    return len(data)


def _parameters(rows: np.ndarray | None) -> list[tuple[float | None, str, str]]:
    """Time in s where the messages have one, name and value of each."""
    columns = set() if rows is None else set(rows.dtype.names or ())
    if rows is None or not {"Name", "Value"} <= columns:
        return []
    if rows["Name"].dtype.kind != "S" or rows["Value"].dtype.kind != "f":
        return []
    timed = "TimeUS" in columns and rows["TimeUS"].dtype.kind in "iuf"
    times = (1e-6 * rows["TimeUS"]).tolist() if timed else [None] * len(rows)
    names = (name.decode("latin-1") for name in rows["Name"].tolist())
    values = (f"{value:.9g}" for value in rows["Value"].tolist())
    return list(zip(times, names, values, strict=True))


_MOST_INSTANCES = 64
_INSTANCE = "#"  # the unit letter of the column that numbers the sensors of one kind


def parse_format(body: bytes) -> Format:
    """From the 86 bytes of a FMT message."""
    name, codes, columns = (text(body[a:b]) for a, b in ((2, 6), (6, 22), (22, 86)))
    return Format(body[0], body[1], name, codes, tuple(columns.split(",")))


def text(field: bytes) -> str:
    """A padded field as text; where a log is damaged, it may not be UTF-8."""
    return field.split(b"\0")[0].decode("latin-1").strip()


def scaling(rows: Mapping[str, np.ndarray], names: Mapping[int, str]) -> Scaling:
    """From the rows of those three messages, where the log has them."""
    units = dict(_cells(rows.get("UNIT"), "Id", "Label"))
    multipliers = dict(_cells(rows.get("MULT"), "Id", "Mult"))
    letters = {
        names[kind]: (text(unit_ids), text(mult_ids))
        for kind, unit_ids, mult_ids in _cells(rows.get("FMTU"), "FmtType", "UnitIds", "MultIds")
        if kind in names
    }
    return Scaling(
        {chr(letter & 0xFF): text(label) for letter, label in units.items()},
        {chr(letter & 0xFF): mult for letter, mult in multipliers.items() if 0 < mult < np.inf},
        letters,
    )


def _cells(rows: np.ndarray | None, *columns: str) -> Iterator[tuple]:
    kinds = {"Label": "S", "UnitIds": "S", "MultIds": "S", "Mult": "f", "Id": "iu", "FmtType": "iu"}
    if rows is None or not set(columns) <= set(rows.dtype.names or ()):
        return iter(())
    if not all(rows.dtype[column].kind in kinds[column] for column in columns):
        return iter(())
    return zip(*(rows[column].tolist() for column in columns), strict=True)


def tables_of(
    layout: Format, rows: Mapping[str, np.ndarray], scaled: Scaling, *, applied: bool = False
) -> dict[str, Table]:
    """The messages of one type as a table, or one table per instance: `IMU[0]`, `IMU[1]`, ...

    `rows` are columns by name, with their own scale `applied` or not. Messages without a time
    stamp (formats, parameters) make no table.
    """
    clock = next((name for name in layout.columns if name in CLOCKS), None)
    if clock is None or clock not in rows:
        return {}
    if rows[clock].ndim != 1 or rows[clock].dtype.kind not in "iuf":
        return {}
    time = rows[clock] * CLOCKS[clock]
    units, scales, instance = _labels(layout, scaled, applied)
    columns = {name: rows[name] for name in layout.columns if name in rows and name != clock}
    numbers = np.unique(columns[instance]) if instance in columns else np.empty(0)
    if not 0 < numbers.size <= _MOST_INSTANCES:
        return {layout.name: Table(columns, time, units, scales)}
    tables = {}
    for number in numbers.tolist():
        kept = columns[instance] == number
        own = {name: values[kept] for name, values in columns.items() if name != instance}
        tables[f"{layout.name}[{number:.0f}]"] = Table(own, time[kept], units, scales)
    return tables


def _labels(
    layout: Format, scaled: Scaling, applied: bool
) -> tuple[dict[str, str], dict[str, float], str]:
    """Units and scales by column, and the column that numbers the instances."""
    unit_ids, mult_ids = scaled.letters.get(layout.name, ("", ""))
    units, scales, instance = {}, {}, ""
    for i, (name, code) in enumerate(zip(layout.columns, layout.codes, strict=True)):
        letter = unit_ids[i : i + 1]
        units[name] = scaled.units.get(letter, "")
        own = 1.0 if applied else _BUILT_IN.get(code, 1.0)
        multiplier = scaled.multipliers.get(mult_ids[i : i + 1], 1.0)
        scales[name] = own if code in _BUILT_IN else multiplier
        instance = name if letter == _INSTANCE else instance
    return units, scales, instance


_RATES = ("RDes", "R", "PDes", "P", "YDes", "Y")  # of RATE: set-points and rates
_GYROS = {"R": "GyrX", "P": "GyrY", "Y": "GyrZ"}  # of IMU, in rad/s
_DEGREES = {1.0: ("rad/s", 1.0), 57.3: ("deg/s", 1.0), 5730.0: ("deg/s", 0.01)}  # rate over gyro


def find_rate_unit(tables: dict[str, Table], scaled: Scaling) -> list[str]:
    """Give RATE its unit in logs before FMTU, by the size of IMU's gyro; returns the remark."""
    rate, imu = tables.get("RATE"), tables.get(_first_instance(tables, "IMU"))
    if rate is None or scaled.letters.get("RATE"):
        return []
    ratio = _rate_over_gyro(rate, imu)
    near = 57.3 if ratio is None else min(_DEGREES, key=lambda each: abs(np.log(ratio / each)))
    unit, scale = _DEGREES[near]
    named = [name for name in _RATES if name in rate.columns]
    tables["RATE"] = Table(
        rate.columns,
        rate.time,
        {**rate.units, **dict.fromkeys(named, unit)},
        {**rate.scales, **dict.fromkeys(named, scale)},
    )
    why = "as ArduPilot 3.4 and later log it"
    if ratio is not None:
        why = f"because its rates are {ratio:.3g} times those of IMU's gyro in rad/s"
    hundredths = " (logged in hundredths)" if scale != 1.0 else ""
    return [f"the log does not say the unit of RATE: taken as {unit}{hundredths}, {why}"]


def _first_instance(tables: Mapping[str, Table], kind: str) -> str:
    """Messages of a kind without instances, or of the first one: `IMU`, `IMU[0]`, ..."""
    return min((name for name in tables if name.partition("[")[0] == kind), default="")


def _rate_over_gyro(rate: Table, imu: Table | None) -> float | None:
    """Of the deviations over all axes; None where there is no gyro, or nothing turned."""
    pairs = [] if imu is None else [(rate.columns.get(r), imu.columns.get(g)) for r, g in
                                    _GYROS.items()]  # fmt: skip
    known = [(r, g) for r, g in pairs if r is not None and g is not None]
    turned, measured = (np.sqrt(sum(float(np.var(c)) for c in each)) for each in
                        (zip(*known, strict=True) if known else ((), ())))  # fmt: skip
    return float(turned / measured) if measured > 1e-3 and turned > 0 else None
