"""The text header of a blackbox log: which fields its frames hold and how they are coded.

Source: "Blackbox logging internals" of the Betaflight documentation.
"""

import re
import struct
from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .._errors import ReadError


MARKER = b"H Product:Blackbox flight data recorder by Nicholas Sherlock\n"
_MOST_LOGS = 1000
_MOST_FIELDS = 256
_MOST_INTERVAL = 65536  # loop iterations between key frames
_LINE = re.compile(rb"H ([^:\x00-\x1f]{1,80}):([^\n]{0,16384})\n")
_GROUP = {0: 1, 1: 1, 3: 1, 6: 8, 7: 3, 8: 4, 9: 1, 10: 3}  # encoding: fields coded together
_PREDICTORS = {"I": {0, 4, 5, 8, 9, 11}, "P": set(range(12)) - {7, 10}}
_SLOW_PREDICTORS = {0, 4, 7, 8, 9, 10, 11}


class Frame(NamedTuple):
    """What a frame of one letter holds, in the order of the log."""

    letter: str
    names: tuple[str, ...]
    signed: np.ndarray  # bool (fields,)
    predictors: np.ndarray  # int (fields,)
    groups: tuple[tuple[int, int, int], ...]  # encoding, first field, fields that it writes as one

    @property
    def most_bytes(self) -> int:
        """No frame is longer than this, its letter included."""
        return 2 + 5 * len(self.names) + len(self.groups)


class Header(NamedTuple):
    """The header of one log within a file."""

    offset: int  # of its first byte
    payload: int  # offset of the first frame
    stop: int  # offset where the next log or the file ends
    settings: dict[str, str]
    frames: dict[str, Frame]  # by letter: I, P and, where logged, S, G, H
    interval: int  # loop iterations from key frame to key frame
    logged: int  # of `every` iterations between key frames, this many are logged
    every: int


def headers(data: bytes) -> list[Header | ReadError]:
    """The logs in a file, in order; for one whose header is damaged, what is wrong with it."""
    starts, at = [], data.find(MARKER)
    while at >= 0:
        starts.append(at)
        if len(starts) > _MOST_LOGS:
            raise ReadError(f"the file holds more than {_MOST_LOGS} blackbox logs", offset=at)
        at = data.find(MARKER, at + len(MARKER))
    logs: list[Header | ReadError] = []
    for start, stop in pairwise([*starts, len(data)]):
        try:
            logs.append(_header(data, start, stop))
        except ReadError as error:
            logs.append(ReadError(error.reason, offset=start))
    return logs


def _header(data: bytes, start: int, stop: int) -> Header:
    settings, at = {}, start
    while (line := _LINE.match(data, at, stop)) is not None:
        settings[line[1].decode(errors="replace")] = line[2].decode(errors="replace").strip()
        at = line.end()
    if settings.get("Data version", "2") != "2":
        raise ReadError(f"blackbox data version {settings['Data version']!r}: only 2 is read")
    slow = [letter for letter in "SGH" if f"Field {letter} name" in settings]
    frames = {letter: _frame(settings, letter) for letter in ("I", "P", *slow)}
    # `1/4` and, since Betaflight 4, `4` both mean one of four; 0 means key frames only.
    text = settings.get("P interval", "1/1")
    parts = text.split("/") if "/" in text else ["1", text]
    if len(parts) != 2 or not all(p.isascii() and p.isdecimal() and len(p) < 7 for p in parts):
        raise ReadError(f"P interval {text[:20]!r}: an integer or a fraction is valid")
    logged, every = map(int, parts)
    if logged > every > 0 or (logged == 0 and every > 0):
        raise ReadError(f"P interval {text[:20]!r}: a fraction of at most 1 is valid")
    key = settings.get("I interval", "32")
    if not (key.isascii() and key.isdecimal() and 0 < int(key[:9]) <= _MOST_INTERVAL):
        raise ReadError(f"I interval {key[:20]!r}: 1 .. {_MOST_INTERVAL} loop iterations are valid")
    return Header(start, at, stop, settings, frames, int(key), logged, every)


def _frame(settings: dict[str, str], letter: str) -> Frame:
    described = "I" if letter == "P" else letter
    names = tuple(_setting(settings, f"Field {described} name").split(","))
    if len(names) > _MOST_FIELDS or len(set(names)) < len(names):
        raise ReadError(
            f"frame {letter} has {len(names)} fields: at most {_MOST_FIELDS} are allowed, none "
            f"twice"
        )
    if not all(name.isascii() and name.isprintable() and 0 < len(name) < 80 for name in names):
        raise ReadError(f"a field name of frame {letter} is empty, too long or not plain text")
    if letter in "IP" and names[:2] != ("loopIteration", "time"):
        raise ReadError(f"frame {letter} begins with {names[:2]}, not with loopIteration, time")
    signs = f"Field {described} signed"
    signed = _integers(settings, signs, len(names)) if signs in settings else [0] * len(names)
    predictors = _integers(settings, f"Field {letter} predictor", len(names))
    strange = set(predictors) - _PREDICTORS.get(letter, _SLOW_PREDICTORS)
    if strange:
        raise ReadError(f"frame {letter} cannot have predictor {min(strange)}")
    if 5 in predictors and "motor[0]" not in names[: predictors.index(5)]:
        raise ReadError(f"predictor 5 in frame {letter} needs motor[0] before it")
    encodings = _integers(settings, f"Field {letter} encoding", len(names))
    groups, at = [], 0
    while at < len(encodings):
        encoding = encodings[at]
        if encoding not in _GROUP:
            raise ReadError(
                f"encoding {encoding} of field {at} in frame {letter} is unknown: "
                f"{', '.join(map(str, _GROUP))} are known"
            )
        size, count = _GROUP[encoding], 1
        while count < size and encodings[at + count : at + count + 1] == [encoding]:
            count += 1
        if encoding != 6 and count < size:
            raise ReadError(f"encoding {encoding} in frame {letter} needs {size} fields together")
        groups.append((encoding, at, count))
        at += count
    if encodings.count(9) > 4 and letter in "IP":
        raise ReadError(f"{encodings.count(9)} fields of frame {letter} are empty (limit 4)")
    return Frame(letter, names, np.array(signed) != 0, np.array(predictors), tuple(groups))


def _setting(settings: dict[str, str], name: str) -> str:
    if name not in settings:
        raise ReadError(f"the blackbox header has no line {name!r}")
    return settings[name]


def _integers(settings: dict[str, str], name: str, count: int) -> list[int]:
    cells = _setting(settings, name).split(",")
    if len(cells) != count or not all(c.isascii() and c.isdecimal() and len(c) < 4 for c in cells):
        raise ReadError(
            f"header line {name!r} needs {count} numbers, one for each field; it has {len(cells)} "
            f"cells"
        )
    return [int(cell) for cell in cells]


_FINE = ("gyroADC", "gyroUnfilt", "rcCommand", "setpoint")  # tenths in high-resolution logs
_TURN = 2 * np.pi * 5e3  # of debug[0] in debug mode CHIRP
_FEWEST_TURNS = 3


def scaled(names: tuple[str, ...], settings: dict[str, str]) -> dict[str, tuple[float, str]]:
    """Factor and unit of the fields for which the header gives them.

    Rates come in deg/s: gyro by `gyro_scale`, set-points as they are. Accelerations come in g by
    `acc_1G`. Where `blackbox_high_resolution` is set, gyro, set-points and sticks are tenths.
    """
    fine = 0.1 if settings.get("blackbox_high_resolution", "0").strip() == "1" else 1.0
    text = settings.get("gyro_scale", settings.get("gyro.scale", "")).strip()
    try:  # deg/s per count
        if text.lower().startswith("0x"):
            [gyro] = struct.unpack(">f", int(text, 16).to_bytes(4, "big"))
        else:
            gyro = float(text)
    except (ValueError, OverflowError):
        gyro = 0.0
    plausible = np.isfinite(gyro) and 1e-4 < gyro < 10
    text = settings.get("acc_1G", "")
    one_g = float(text) if text.isascii() and text.isdecimal() and len(text) < 9 else 0.0
    factors = {}
    for name in names:
        kind, index = name.partition("[")[::2]
        tenth = fine if kind in _FINE else 1.0
        if kind in ("gyroADC", "gyroUnfilt") and plausible:
            factors[name] = gyro * tenth, "deg/s"
        elif (kind == "setpoint" and index != "3]") or kind == "axisRate":
            factors[name] = tenth, "deg/s"
        elif kind == "accSmooth" and one_g > 0:
            factors[name] = 1 / one_g, "g"
        elif kind == "GPS_coord":
            factors[name] = 1e-7, "deg"
        elif tenth != 1.0:
            factors[name] = tenth, ""
    return factors


def with_derived(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns, and what follows from them.

    `axisSum[i]` is the output of the controller of axis i before its limit, the sum of the P, I, D,
    feed-forward (F) and S terms that were logged. `chirp` is the sine of the phase of a sweep,
    5000 a radian in debug[0], where firmware before betaflight pull request 15113 logs nothing else
    of it. Firmware that injects the cosine has the same sweep a quarter of a turn ahead: as the
    external reference of a joint estimate it serves as well.
    """
    sums = {}
    for axis in range(3):
        terms = [f"axis{term}[{axis}]" for term in "PIDFS"]
        logged = [columns[term] for term in terms if term in columns]
        if logged and f"axisSum[{axis}]" not in columns:
            sums[f"axisSum[{axis}]"] = sum(logged[1:], start=logged[0])
    derived = {**columns, **sums}
    # A phase lies within a turn, and jumps back from its end. The other debug channels rest, which
    # later firmware fills.
    debug = [columns[name] for i in range(4) if (name := f"debug[{i}]") in columns]
    if "chirp" in columns or not debug or any(x.ndim != 1 or x.any() for x in debug[1:]):
        return derived
    phase = np.nan_to_num(np.asarray(debug[0], np.float64))
    if not phase.size or phase.min() < 0 or not 0.9 * _TURN < phase.max() <= _TURN + 1:
        return derived
    turns = (phase[:-1] > 0.9 * _TURN) & (phase[1:] < 0.1 * _TURN)
    return derived | ({"chirp": np.sin(phase / 5e3)} if turns.sum() >= _FEWEST_TURNS else {})
