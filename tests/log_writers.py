"""Small writers of autopilot logs, from the formats' public descriptions, for the tests."""

import struct
import tempfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxquad.records.formats import Log, READERS


CODES = {
    "b": "b", "B": "B", "h": "h", "H": "H", "i": "i", "I": "I", "f": "f", "d": "d", "n": "4s",
    "N": "16s", "Z": "64s", "c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "M": "B", "q": "q",
    "Q": "Q", "g": "e",
}  # fmt: skip
HEAD = b"\xa3\x95"
ULOG_HEAD = b"ULog\x01\x12\x35"
SYNC = bytes((0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12))


class DataFlash:
    """An ArduPilot log: define messages, then write them."""

    def __init__(self):
        self.content = bytearray()
        self._types = {}
        self.define("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", kind=128)
        self.define("UNIT", "QbZ", "TimeUS,Id,Label", kind=129)
        self.define("MULT", "Qbd", "TimeUS,Id,Mult", kind=130)
        self.define("FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds", kind=131)
        self.define("PARM", "QNf", "TimeUS,Name,Value", kind=132)
        for letter, label in (("s", "s"), ("k", "deg/s"), ("E", "rad/s"), ("#", "instance")):
            self.write("UNIT", 0, ord(letter), label.encode())
        for letter, scale in (("F", 1e-6), ("0", 1.0), ("B", 1e-2), ("-", 0.0)):
            self.write("MULT", 0, ord(letter), scale)

    def define(self, name, codes, columns, *, kind=None, units="", mults=""):
        kind = 140 + len(self._types) if kind is None else kind
        layout = struct.Struct("<" + "".join(CODES[code] for code in codes))
        self._types[name] = kind, layout
        body = (kind, layout.size + 3, name.encode(), codes.encode(), columns.encode())
        self.content += HEAD + bytes([128]) + struct.pack("<BB4s16s64s", *body)
        if units:
            self.write("FMTU", 0, kind, units.encode(), mults.encode())

    def kind(self, name):
        return self._types[name][0]

    def write(self, name, *values):
        kind, layout = self._types[name]
        self.content += HEAD + bytes([kind]) + layout.pack(*values)

    def write_rows(self, name, *columns):
        for row in zip(*(np.asarray(column).tolist() for column in columns), strict=True):
            self.write(name, *row)


class ULog:
    """A PX4 log: define formats, subscribe to topics, then write them."""

    def __init__(self, *, appended=0):
        self.content = bytearray(ULOG_HEAD + b"\x01" + struct.pack("<Q", 112_000))
        flags = bytearray(16)
        flags[8] = bool(appended)
        self.message("B", bytes(flags) + struct.pack("<3Q", appended, 0, 0))

    def message(self, kind, body):
        self.content += struct.pack("<H", len(body)) + kind.encode() + body

    def define(self, text):
        self.message("F", text.encode())

    def info(self, key, value, *, kind="I"):
        self.message(kind, bytes([len(key)]) + key.encode() + value)

    def subscribe(self, number, name, instance=0):
        self.message("A", struct.pack("<BH", instance, number) + name.encode())

    def write_rows(self, number, rows):
        """A structured array, of which each row is a message."""
        head = struct.pack("<HcH", rows.dtype.itemsize + 2, b"D", number)
        for row in rows:
            self.content += head + row.tobytes()

    def dropout(self, milliseconds):
        self.message("O", struct.pack("<H", milliseconds))

    def sync(self):
        self.message("S", SYNC)


def crazyflie_log(kinds, events, *, version=2):
    """A file of `events` (which of the kinds, time stamp, values)."""
    data = struct.pack("<BHH", 0xBC, version, len(kinds))
    for number, name, variables in kinds:
        data += struct.pack("<H", number) + name.encode() + b"\0"
        data += struct.pack("<H", len(variables))
        data += b"".join(f"{each}({letter})".encode() + b"\0" for each, letter in variables)
    for kind, time, values in events:
        number, _, variables = kinds[kind]
        letters = ("Q" if version == 2 else "I") + "".join(letter for _, letter in variables)
        data += struct.pack(f"<H{letters}", number, time, *values)
    return data + struct.pack("<I", zlib.crc32(data))


def structured(columns: Mapping[str, tuple[str, np.ndarray]]) -> np.ndarray:
    """Columns with their dtypes as a packed structured array."""
    size = len(next(iter(columns.values()))[1])
    rows = np.zeros(size, dtype=[(name, kind) for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        rows[name] = values
    return rows


def decode(kind: str, data: bytes) -> Log:
    """What the reader of this kind makes of the bytes of a file, with nothing caught."""
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        return READERS[kind].load(Path(file.name))
