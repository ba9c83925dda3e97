"""ArduPilot DataFlash logs, which describe their own messages: binary (.bin), and as text (.log).

Format: ardupilot.org/dev, "Adding a new log message", and the FMT, FMTU, UNIT and MULT messages
that every log begins with. Ground stations write the text from the binary.
"""

import collections
import dataclasses
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .._log import changes_of, describe_skips, Log, number_in, ReadError, Table


_FORMAT_TYPE = 128
_CODES = {
    "a": "(32,)<i2", "b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4",
    "f": "<f4", "d": "<f8", "g": "<f2", "n": "S4", "N": "S16", "Z": "S64", "c": "<i2", "C": "<u2",
    "e": "<i4", "E": "<u4", "L": "<i4", "M": "u1", "q": "<i8", "Q": "<u8",
}  # fmt: skip
_BUILT_IN = {"c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01, "L": 1e-7}
_CLOCKS = {"TimeUS": 1e-6, "TimeMS": 1e-3}  # s
_ABOUT = ("FMT", "FMTU", "UNIT", "MULT", "PARM")  # tables about the log, not of signals
_MOST_INSTANCES = 64

Offsets = dict[int, list[int]]  # of the messages of each type, in bytes
Stamped = list[tuple[float | None, str, str]]  # time in s, name and value of parameters


class _Format(NamedTuple):
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
        *offsets, size = np.cumsum([3, *(dtype.itemsize for dtype in formats)]).tolist()
        if size != self.length:
            return None
        return np.dtype(
            {"names": list(columns), "formats": formats, "offsets": offsets, "itemsize": size}
        )


class _Scaling(NamedTuple):
    """What FMTU, UNIT and MULT say about the columns of the other messages."""

    units: Mapping[str, str]  # by letter
    multipliers: Mapping[str, float]  # by letter
    letters: Mapping[str, tuple[str, str]]  # by message: one letter per column, of either kind


_RATES = ("RDes", "R", "PDes", "P", "YDes", "Y")  # of RATE: set-points and rates
_GYROS = {"R": "GyrX", "P": "GyrY", "Y": "GyrZ"}  # of IMU, in rad/s
_DEGREES = {1.0: ("rad/s", 1.0), 57.3: ("deg/s", 1.0), 5730.0: ("deg/s", 0.01)}  # rate over gyro
_FIRMWARE = re.compile(r"\b[A-Z][\w:]*\w V\d+\.\d+[^\0,]*")


def _log(
    logged: Iterable[tuple[_Format, Mapping[str, np.ndarray]]], scaling: _Scaling,
    remarks: list[str], stamped: Stamped, texts: Iterable[str], *, applied: bool,
) -> Log:  # fmt: skip
    """The messages of each type with a time stamp as a table, or one per instance: `IMU[0]`.

    Their columns have their own scale `applied` or not; `texts` of VER and MSG name the firmware.
    """
    tables: dict[str, Table] = {}
    for layout, rows in logged:
        clock = next((name for name in layout.columns if name in _CLOCKS), None)
        if clock is None or clock not in rows:
            continue
        if rows[clock].ndim != 1 or rows[clock].dtype.kind not in "iuf":
            continue
        time = rows[clock] * _CLOCKS[clock]
        unit_ids, mult_ids = scaling.letters.get(layout.name, ("", ""))
        units, scales, instance = {}, {}, ""
        for i, (name, code) in enumerate(zip(layout.columns, layout.codes, strict=True)):
            letter = unit_ids[i : i + 1]
            units[name] = scaling.units.get(letter, "")
            scales[name] = scaling.multipliers.get(mult_ids[i : i + 1], 1.0)
            if code in _BUILT_IN:
                scales[name] = 1.0 if applied else _BUILT_IN[code]
            if letter == "#":  # of the column that numbers the sensors of one kind
                instance = name
        columns = {name: rows[name] for name in layout.columns if name in rows and name != clock}
        numbers = np.unique(columns[instance]) if instance in columns else np.empty(0)
        if not 0 < numbers.size <= _MOST_INSTANCES:
            tables[layout.name] = Table(columns, time, units, scales)
            continue
        for number in numbers.tolist():
            kept = columns[instance] == number
            values = {name: column[kept] for name, column in columns.items() if name != instance}
            tables[f"{layout.name}[{number:.0f}]"] = Table(values, time[kept], units, scales)
    rate = tables.get("RATE")
    if rate is not None and not scaling.letters.get("RATE"):
        # Logs before FMTU do not say its unit: it follows from the deviations over all axes of the
        # first gyro, `IMU` or `IMU[0]`.
        imus = (name for name in tables if name.partition("[")[0] == "IMU")
        imu = tables.get(min(imus, default=""))
        gyros = {} if imu is None else imu.columns
        pairs = [(rate.columns.get(r), gyros.get(g)) for r, g in _GYROS.items()]
        pairs = [(r, g) for r, g in pairs if r is not None and g is not None]
        turned = np.sqrt(sum(float(np.var(r)) for r, _ in pairs))
        measured = np.sqrt(sum(float(np.var(g)) for _, g in pairs))
        usual, why = 57.3, "as ArduPilot 3.4 and later log it"
        if measured > 1e-3 and turned > 0:
            ratio = float(turned / measured)
            usual = min(_DEGREES, key=lambda usual: abs(np.log(ratio / usual)))
            why = f"because its rates are {ratio:.3g} times those of IMU's gyro in rad/s"
        unit, scale = _DEGREES[usual]
        named = [name for name in _RATES if name in rate.columns]
        tables["RATE"] = dataclasses.replace(
            rate,
            units={**rate.units, **dict.fromkeys(named, unit)},
            scales={**rate.scales, **dict.fromkeys(named, scale)},
        )
        hundredths = " (logged in hundredths)" if scale != 1.0 else ""
        remark = f"the log does not say the unit of RATE: taken as {unit}{hundredths}, {why}"
        remarks = [*remarks, remark]
    settings = {name: value for _, name, value in stamped}
    changes = changes_of(stamped, lambda time: time)
    hit = next(filter(None, map(_FIRMWARE.search, texts)), None)
    firmware = "" if hit is None else hit.group().strip()
    return Log(tables, tuple(remarks), "ardupilot", settings, changes, firmware)


@dataclasses.dataclass
class _Part:
    """A part of a file, from definitions of its messages to the next ones."""

    begin: int  # its first byte
    formats: dict[int, _Format] = dataclasses.field(default_factory=dict)  # by message type
    offsets: Offsets = dataclasses.field(default_factory=lambda: collections.defaultdict(list))
    defined: set[int] = dataclasses.field(default_factory=set)  # types that it defines itself
    # Place, old and new format of those that the part before defined otherwise.
    redefined: list[tuple[int, _Format, _Format]] = dataclasses.field(default_factory=list)
    end: int = 0  # the byte after its last
    span: tuple[float, float] | None = None  # first and last time in s
    chirped: bool = False  # whether it holds a SystemID chirp


_MOST_PARTS = 100  # of one file
_CUT_IT = "it is damaged, or holds too many logs: cut it into files of one log each"
_BACKWARD = 1.0  # s by which the clock goes back at a restart: messages are not quite in order
_ENDS = 5  # messages at each end of a part whose median is its first and last time


def _span(times: np.ndarray) -> tuple[float, float] | None:
    """First and last time of the messages of one type, whatever a damaged one says."""
    if not times.size:
        return None
    return float(np.median(times[:_ENDS])), float(np.median(times[-_ENDS:]))


def _choose_log(parts: Sequence[_Part]) -> tuple[list[int], list[str]]:
    """The numbers of the parts of the longest log, with a chirp if any; a remark on the others."""
    logs: list[list[int]] = [[]]
    last = -np.inf
    for i, part in enumerate(parts):  # a log begins where the clock goes back, or definitions do
        restarted = part.span is not None and part.span[0] < last - _BACKWARD
        anew = bool(part.redefined) and _FORMAT_TYPE in part.defined
        if i and (restarted or anew):
            logs.append([])
        logs[-1].append(i)
        last = last if part.span is None else part.span[1]
    if len(logs) == 1:
        return logs[0], []
    spans = [[span for i in log if (span := parts[i].span) is not None] for log in logs]
    ends = [(span[0][0], span[-1][1]) if span else (0.0, 0.0) for span in spans]
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


_HEAD = b"\xa3\x95"  # of a message, before its type
_FMT_LENGTH = 89
_FIRST = _HEAD + bytes([_FORMAT_TYPE, _FORMAT_TYPE, _FMT_LENGTH])  # of a log: the FMT of FMT


def sniff(head: bytes, path: Path) -> bool:
    return head.startswith(_FIRST[:3])


def load(path: Path) -> Log:
    """The message types of a DataFlash log as tables, those with instances as `IMU[0]`, ..."""
    data = path.read_bytes()
    parts, remarks = _scan(data)
    if not parts[0].formats:
        raise ReadError(
            "there is no FMT message: the file is not a DataFlash log, or its beginning is missing",
            offset=0,
        )
    ends = [*(part.begin for part in parts[1:]), len(data)]
    for part, end in zip(parts, ends, strict=True):
        part.end = end
        stored = [x for kind, x in part.formats.items() if part.offsets.get(kind)]
        part.chirped = any(layout.name == "SIDD" for layout in stored)
        timed = [x for x in stored if x.columns[0] in _CLOCKS and x.name not in _ABOUT]
        timed = [layout for layout in timed if layout.dtype() is not None]
        if timed:
            most = max(timed, key=lambda layout: len(part.offsets[layout.kind]))
            rows, _ = _rows(data, {most.kind: most}, part.offsets)
            clock = most.columns[0]
            part.span = _span(_CLOCKS[clock] * rows[most.name][clock].astype(np.float64))
    numbers, left_out = _choose_log(parts)
    offsets: Offsets = collections.defaultdict(list)
    for i in numbers:
        if parts[i].redefined and (i == 0 or i - 1 in numbers):
            place, old, new = parts[i].redefined[0]
            raise ReadError(
                f"message type {new.kind} ({old.name}) is defined a second time, differently "
                f"({new.name}): if the file holds two logs, cut it there",
                offset=place,
            )
        for kind, places in parts[i].offsets.items():
            offsets[kind] += places
    formats = parts[numbers[-1]].formats
    rows, odd = _rows(data, formats, offsets)
    remarks += left_out
    if odd:
        remarks.append(f"messages with an inconsistent format were left out: {', '.join(odd)}")
    units, mults = _cells(rows.get("UNIT"), "Id", "Label"), _cells(rows.get("MULT"), "Id", "Mult")
    scaling = _Scaling(
        {chr(letter & 0xFF): _text(label) for letter, label in dict(units).items()},
        {chr(letter & 0xFF): mult for letter, mult in dict(mults).items() if 0 < mult < np.inf},
        {
            formats[kind].name: (_text(units), _text(mults))
            for kind, units, mults in _cells(rows.get("FMTU"), "FmtType", "UnitIds", "MultIds")
            if kind in formats
        },
    )
    logged = [
        (layout, {name: rows[layout.name][name] for name in layout.columns})
        for layout in formats.values()
        if layout.name in rows and layout.name not in _ABOUT
    ]
    parameters = list(_cells(rows.get("PARM"), "Name", "Value"))
    times = [1e-6 * time for (time,) in _cells(rows.get("PARM"), "TimeUS")]
    stamped: Stamped = [
        (time, name.decode("latin-1"), f"{value:.9g}")
        for time, (name, value) in zip(times or [None] * len(parameters), parameters, strict=False)
    ]
    named = (*_cells(rows.get("VER"), "FWS"), *_cells(rows.get("MSG"), "Message"))
    texts = (_text(message) for (message,) in named)
    return _log(logged, scaling, remarks, stamped, texts, applied=False)


def _rows(
    data: bytes, formats: Mapping[int, _Format], offsets: Offsets
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The messages by name as structured arrays, and the names of what cannot be laid out."""
    buffer = np.frombuffer(data, np.uint8)
    rows, odd = {}, []
    for kind, layout in formats.items():
        dtype = layout.dtype()
        if not offsets.get(kind):
            continue
        if dtype is None or layout.name in rows:
            odd.append(layout.name)
        else:
            windows = np.lib.stride_tricks.sliding_window_view(buffer, layout.length)
            rows[layout.name] = windows[np.array(offsets[kind])].view(dtype)[:, 0]
    return rows, odd


def _scan(data: bytes) -> tuple[list[_Part], list[str]]:
    """The parts of a file, and what was skipped. A log may end within a message."""
    parts = [part := _Part(0)]
    lengths = [0] * 256
    lengths[_FORMAT_TYPE] = _FMT_LENGTH
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
            after = place + 1  # where a message begins that another one, or the end, follows
            while (after := data.find(_HEAD, after)) >= 0 and after + 3 <= end:
                length = lengths[data[after + 2]]
                follows = after + length == end or data.startswith(_HEAD, after + length)
                if length and follows:
                    break
                after += 1
            else:
                after = end
            skipped.append((place, after))
            place, last = after, -1
        elif place + length > end:
            break
        else:
            if kind == _FORMAT_TYPE:  # which begins a part where it defines its type once more
                body = data[place + 3 : place + _FMT_LENGTH]
                new_kind, size = body[0], body[1]
                if new_kind in part.defined and part.offsets.keys() != {_FORMAT_TYPE}:
                    if len(parts) == _MOST_PARTS:
                        raise ReadError(
                            f"the file defines its messages more than {_MOST_PARTS} times: "
                            f"{_CUT_IT}",
                            offset=place,
                        )
                    parts.append(part := _Part(place, dict(part.formats)))
                part.defined.add(new_kind)
                name, codes, columns = (_text(body[a:b]) for a, b in ((2, 6), (6, 22), (22, 86)))
                old = part.formats.get(new_kind)
                new = _Format(new_kind, size, name, codes, tuple(columns.split(",")))
                if old is not None and old != new:
                    part.redefined.append((place, old, new))
                part.formats[new_kind] = new
                if new_kind == _FORMAT_TYPE and size != _FMT_LENGTH:
                    raise ReadError(
                        f"the FMT message declares a length of {size} bytes; it has 89",
                        offset=place,
                    )
                lengths[new_kind] = size if size > 3 else 0
            part.offsets[kind].append(place)
            last = place
            place += length
    if skipped and skipped[-1][1] == end and not data[skipped[-1][0] :].strip(b"\0\xff"):
        skipped.pop()  # what a file was prepared with, and not written
    return parts, describe_skips(skipped, end, end)


def _text(field: bytes) -> str:
    """A padded field as text; where a log is damaged, it may not be UTF-8."""
    return field.split(b"\0")[0].decode("latin-1").strip()


_KINDS = {
    "Label": "S", "UnitIds": "S", "MultIds": "S", "Mult": "f", "Id": "iu", "FmtType": "iu",
    "Name": "S", "Value": "f", "TimeUS": "iuf", "FWS": "S", "Message": "S",
}  # fmt: skip


def _cells(rows: np.ndarray | None, *columns: str) -> Iterator[tuple]:
    """The rows of the columns; none where one is missing, or of another type than it should be."""
    if rows is None or not set(columns) <= set(rows.dtype.names or ()):
        return iter(())
    if not all(rows.dtype[column].kind in _KINDS[column] for column in columns):
        return iter(())
    return zip(*(rows[column].tolist() for column in columns), strict=True)


_MOST_TYPES = 1000
_MOST_COLUMNS = 64
_BEGIN = re.compile(rb"^[ \t]*FMT, *128,", re.MULTILINE)


def sniff_text(head: bytes, path: Path) -> bool:
    return head.lstrip().startswith(b"FMT,")


def load_text(path: Path) -> Log:
    """The same of a text log, in the units of its format letters; those of FMTU are applied."""
    content = path.read_bytes()
    begins = [hit.start() for hit in _BEGIN.finditer(content)][1:]
    if len(begins) >= _MOST_PARTS:
        raise ReadError(
            f"the file defines its messages {len(begins) + 1} times: {_CUT_IT}", offset=0
        )
    parts = []
    for begin, end in itertools.pairwise([0, *begins, len(content)]) if begins else ():
        lines, _ = _lines(content[begin:end])
        timed = [x for x in _text_formats(lines) if x.name not in _ABOUT and x.name in lines]
        timed = [layout for layout in timed if layout.columns[0] in _CLOCKS]
        parts.append(part := _Part(begin, end=end, chirped=bool(timed) and "SIDD" in lines))
        if timed:
            most = max(timed, key=lambda layout: len(lines[layout.name]))
            cells = (line.partition(b",")[0] for line in lines[most.name])
            stamps = np.array([number_in(cell.decode("latin-1")) for cell in cells])
            part.span = _span(_CLOCKS[most.columns[0]] * stamps)
    numbers, remarks = _choose_log(parts)
    if begins:
        content = b"".join(content[parts[i].begin : parts[i].end] for i in numbers)
    lines, skipped = _lines(content)
    formats = _text_formats(lines)
    if not formats:
        raise ReadError(
            "there is no valid FMT line: the file is not a DataFlash log, or its beginning is "
            "missing",
            offset=0,
        )
    names = {layout.kind: layout.name for layout in formats}
    units, mults = (
        {
            chr(int(cells[-2])): cells[-1]
            for cells in _split(lines.get(name, []))
            if len(cells) >= 2 and cells[-2].isdecimal() and len(cells[-2]) <= 3
        }
        for name in ("UNIT", "MULT")
    )
    letters = {
        names[int(kind)]: (unit_ids, mult_ids)
        for kind, unit_ids, mult_ids in (c[-3:] for c in _split(lines.get("FMTU", [])) if c[2:])
        if kind.isdecimal() and len(kind) < 9 and int(kind) in names
    }
    factors = {letter: number_in(text) for letter, text in mults.items()}
    factors = {letter: factor for letter, factor in factors.items() if 0 < factor < np.inf}
    logged = []
    for layout in formats:
        if layout.name not in lines or layout.name in _ABOUT:
            continue
        width = len(layout.columns)
        fitting = [line for line in lines[layout.name] if line.count(b",") == width - 1]
        skipped += len(lines[layout.name]) - len(fitting)
        try:  # all numbers at once, where there is nothing else
            table = np.fromstring(b",".join(fitting).decode("latin-1"), sep=",")
        except ValueError:
            table = np.empty(0)
        if table.size == width * len(fitting):
            columns = dict(zip(layout.columns, table.reshape(-1, width).T, strict=True))
        else:  # the columns that hold numbers
            texts = zip(layout.columns, zip(*_split(fitting), strict=True), strict=True)
            columns = {name: np.array([number_in(cell) for cell in cells]) for name, cells in texts}
            columns = {name: x for name, x in columns.items() if np.isfinite(x).any()}
        logged.append((layout, columns))
    remarks += [f"{skipped} lines that match no format were left out"] if skipped else []
    columns = next((layout.columns for layout in formats if layout.name == "PARM"), ())
    name, value = -2, -1  # Later versions log a parameter's default behind its value.
    if {"Name", "Value"} <= set(columns):
        name, value = columns.index("Name"), columns.index("Value")
    cells = [c for c in _split(lines.get("PARM", [])) if len(c) >= max(2, name + 1, value + 1)]
    timed = columns[:1] == ("TimeUS",)
    stamped = [(1e-6 * number_in(c[0]) if timed else None, c[name], c[value]) for c in cells]
    texts = (line.decode("latin-1") for name in ("VER", "MSG") for line in lines.get(name, []))
    return _log(logged, _Scaling(units, factors, letters), remarks, stamped, texts, applied=True)


def _lines(content: bytes) -> tuple[dict[str, list[bytes]], int]:
    """What follows the name of a message on its lines, by name; and how many lines have none."""
    lines: dict[bytes, list[bytes]] = {}
    skipped = 0
    for line in content.split(b"\n"):
        name, comma, rest = line.partition(b",")
        if comma and (name in lines or len(lines) < _MOST_TYPES):
            lines.setdefault(name, []).append(rest)
        else:
            skipped += bool(line.strip())
    return {name.decode("latin-1").strip(): rests for name, rests in lines.items()}, skipped


def _split(lines: Sequence[bytes]) -> list[list[str]]:
    return [[cell.strip() for cell in line.decode("latin-1").split(",")] for line in lines]


def _text_formats(lines: dict[str, list[bytes]]) -> list[_Format]:
    """From `140, 27, RATE, Qfff, TimeUS,RDes,R,ROut`; the first of a name counts."""
    formats: dict[str, _Format] = {}
    for kind, length, name, codes, *columns in (c for c in _split(lines.get("FMT", [])) if c[4:]):
        plausible = kind.isdecimal() and length.isdecimal() and name
        if plausible and len(codes) == len(columns) == len(set(columns)) <= _MOST_COLUMNS:
            layout = _Format(int(kind[:9]), int(length[:9]), name, codes, tuple(columns))
            formats.setdefault(name, layout)
    return list(formats.values())
