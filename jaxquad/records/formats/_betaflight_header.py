"""The text header of a blackbox log: which fields its frames hold and how they are coded.

Source: "Blackbox logging internals" of the Betaflight documentation.
"""

import re
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .._errors import ReadError


MARKER = b"H Product:Blackbox flight data recorder by Nicholas Sherlock\n"
MOST_LOGS = 1000
MOST_FIELDS = 256
MOST_INTERVAL = 65536  # loop iterations between key frames
_LINE = re.compile(rb"H ([^:\x00-\x1f]{1,80}):([^\n]{0,16384})\n")
_GROUP = {0: 1, 1: 1, 3: 1, 6: 8, 7: 3, 8: 4, 9: 1, 10: 3}  # encoding: fields coded together
_PREDICTORS = {"I": {0, 4, 5, 8, 9, 11}, "P": set(range(12)) - {7, 10}}
_SLOW_PREDICTORS = {0, 4, 7, 8, 9, 10, 11}


class Group(NamedTuple):
    """Fields `first` .. `first + count` of a frame, which one encoding writes together."""

    encoding: int
    first: int
    count: int


class Frame(NamedTuple):
    """What a frame of one letter holds, in the order of the log."""

    letter: str
    names: tuple[str, ...]
    signed: np.ndarray  # bool (fields,)
    predictors: np.ndarray  # int (fields,)
    groups: tuple[Group, ...]

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
    limits = [*_starts(data), len(data)]
    return [_guarded(data, start, stop) for start, stop in pairwise(limits)]


def _starts(data: bytes) -> list[int]:
    starts, at = [], data.find(MARKER)
    while at >= 0:
        starts.append(at)
        if len(starts) > MOST_LOGS:
            raise ReadError(f"more than {MOST_LOGS} blackbox logs in one file.", offset=at)
        at = data.find(MARKER, at + len(MARKER))
    return starts


def _guarded(data: bytes, start: int, stop: int) -> Header | ReadError:
    try:
        return _header(data, start, stop)
    except ReadError as error:
        return ReadError(error.args[0], offset=start)


def _header(data: bytes, start: int, stop: int) -> Header:
    settings, at = {}, start
    while (line := _LINE.match(data, at, stop)) is not None:
        settings[line[1].decode(errors="replace")] = line[2].decode(errors="replace").strip()
        at = line.end()
    if settings.get("Data version", "2") != "2":
        raise ReadError(f"blackbox data version {settings['Data version']!r}: only 2 is read.")
    frames = {letter: _frame(settings, letter) for letter in "IP"}
    slow = [letter for letter in "SGH" if f"Field {letter} name" in settings]
    frames |= {letter: _frame(settings, letter) for letter in slow}
    logged, every = _logged(settings)
    return Header(start, at, stop, settings, frames, _interval(settings), logged, every)


def _frame(settings: dict[str, str], letter: str) -> Frame:
    names = tuple(_setting(settings, f"Field {'I' if letter == 'P' else letter} name").split(","))
    if len(names) > MOST_FIELDS or len(set(names)) < len(names):
        raise ReadError(f"{len(names)} fields in frame {letter}: at most {MOST_FIELDS}, no twins.")
    if not all(name.isascii() and name.isprintable() and 0 < len(name) < 80 for name in names):
        raise ReadError(f"a field name of frame {letter} is empty, too long or no plain text.")
    if letter in "IP" and names[:2] != ("loopIteration", "time"):
        raise ReadError(f"frame {letter} begins with {names[:2]}, not with loopIteration, time.")
    signs = f"Field {'I' if letter == 'P' else letter} signed"
    signed = _integers(settings, signs, len(names)) if signs in settings else [0] * len(names)
    predictors = _integers(settings, f"Field {letter} predictor", len(names))
    strange = set(predictors) - _PREDICTORS.get(letter, _SLOW_PREDICTORS)
    if strange:
        raise ReadError(f"frame {letter} uses predictor {min(strange)}, which it cannot have.")
    if 5 in predictors and "motor[0]" not in names[: predictors.index(5)]:
        raise ReadError(f"predictor 5 in frame {letter} needs motor[0] before it.")
    encodings = _integers(settings, f"Field {letter} encoding", len(names))
    groups = _groups(encodings, letter)
    if encodings.count(9) > 4 and letter in "IP":
        raise ReadError(f"{encodings.count(9)} fields of frame {letter} take no room (limit 4).")
    return Frame(letter, names, np.array(signed) != 0, np.array(predictors), groups)


def _groups(encodings: list[int], letter: str) -> tuple[Group, ...]:
    groups, at = [], 0
    while at < len(encodings):
        encoding = encodings[at]
        if encoding not in _GROUP:
            raise ReadError(
                f"encoding {encoding} of field {at} in frame {letter} is not one of "
                f"{', '.join(map(str, _GROUP))}."
            )
        size, count = _GROUP[encoding], 1
        while count < size and encodings[at + count : at + count + 1] == [encoding]:
            count += 1
        if encoding != 6 and count < size:
            raise ReadError(f"encoding {encoding} in frame {letter} takes {size} fields together.")
        groups.append(Group(encoding, at, count))
        at += count
    return tuple(groups)


def _interval(settings: dict[str, str]) -> int:
    text = settings.get("I interval", "32")
    if not (text.isascii() and text.isdecimal() and 0 < int(text[:9]) <= MOST_INTERVAL):
        raise ReadError(f"I interval {text[:20]!r}: it is 1 .. {MOST_INTERVAL} loop iterations.")
    return int(text)


def _logged(settings: dict[str, str]) -> tuple[int, int]:
    """`1/4` and, since Betaflight 4, `4` both mean one of four; 0 means key frames only."""
    text = settings.get("P interval", "1/1")
    parts = text.split("/") if "/" in text else ["1", text]
    if len(parts) != 2 or not all(p.isascii() and p.isdecimal() and len(p) < 7 for p in parts):
        raise ReadError(f"P interval {text[:20]!r}: it is a whole number or a fraction.")
    logged, every = map(int, parts)
    if logged > every > 0 or (logged == 0 and every > 0):
        raise ReadError(f"P interval {text[:20]!r}: it is a fraction of at most 1.")
    return logged, every


def _setting(settings: dict[str, str], name: str) -> str:
    if name not in settings:
        raise ReadError(f"the blackbox header has no line {name!r}.")
    return settings[name]


def _integers(settings: dict[str, str], name: str, count: int) -> list[int]:
    cells = _setting(settings, name).split(",")
    if len(cells) != count or not all(c.isascii() and c.isdecimal() and len(c) < 4 for c in cells):
        raise ReadError(f"{name!r} has {len(cells)} cells for {count} fields, or no numbers.")
    return [int(cell) for cell in cells]
