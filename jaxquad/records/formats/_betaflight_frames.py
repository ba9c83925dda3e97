"""Blackbox logs of Betaflight, Cleanflight and INAV: their headers, and where their frames are.

Frames carry neither a length nor a checksum: one counts where the letter of another follows it.
Source: "Blackbox logging internals" of the Betaflight documentation.
"""

import re
from bisect import bisect_left
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from .._log import check_size, ReadError


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

    names: tuple[str, ...]
    signed: np.ndarray  # bool (fields,)
    predictors: np.ndarray  # int (fields,)
    groups: tuple[tuple[int, int, int], ...]  # encoding, first field, fields that it writes as one
    most_bytes: int  # with its letter


class Header(NamedTuple):
    """The header of one log within a file."""

    offset: int  # of its first byte
    payload: int  # offset of the first frame
    stop: int  # offset where the next log or the file ends
    settings: dict[str, str]
    frames: dict[str, Frame]  # by letter: I, P and, where logged, S, G, H
    interval: int  # loop iterations from key frame to key frame
    scheduled: Int[np.ndarray, " logged"]  # those of them that are logged, the key frame's 0 first


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
    iteration = np.arange(int(key))
    scheduled = iteration[:1]
    if every:
        due = (iteration + logged - 1) % every < logged
        scheduled = np.flatnonzero((iteration == 0) | due)
    return Header(start, at, stop, settings, frames, int(key), scheduled)


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
    most = 2 + 5 * len(names) + len(groups)
    return Frame(names, np.array(signed) != 0, np.array(predictors), tuple(groups), most)


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


Positions = Int[np.ndarray, " frames"]
_SLACK = 16  # bytes that may be looked at beyond a frame
_TOO_LONG = 6  # bytes: a 32-bit number takes at most 5
_NIBBLES = np.array([0, 1, 2, 4], np.int32)
_PAIRS = np.stack([(np.arange(256, dtype=np.int32) << s) >> 30 for s in (26, 28, 30)], axis=1)


# TAG2_3S32 and TAG2_3SVARIABLE: first bit and bits of three fields, in two and in three bytes.
_WIDTHS = {
    7: (((4, 4), (8, 4), (12, 4)), ((2, 6), (10, 6), (18, 6))),
    10: (((2, 5), (7, 5), (12, 4)), ((2, 8), (10, 7), (17, 7))),
}


class _Numbers(NamedTuple):
    """A piece of the log and, for every byte of it, the number that would begin there."""

    raw: np.ndarray  # uint8
    length: np.ndarray  # uint8, bytes of a variable-byte number
    unsigned: np.ndarray  # int32, its value with the bits of a uint32
    signed: np.ndarray  # int32, after ZigZag


def _decode(data: _Numbers, frame: Frame, starts: Positions) -> tuple[np.ndarray, Positions]:
    """What frames with letters at `starts` would hold, as coded, and their ends, -1 for none."""
    out = np.zeros((starts.size, len(frame.names)), np.int32)
    at, worst = starts + 1, np.zeros(starts.size, np.uint8)
    for encoding, first, count in frame.groups:
        part = out[:, first : first + count]
        if encoding in (0, 1, 3):
            number = data.signed[at] if encoding == 0 else data.unsigned[at]
            # Encoding 3: 14 bits with a sign.
            part[:, 0] = -((number & 0x3FFF) << 18 >> 18) if encoding == 3 else number
            length = data.length[at]
            np.maximum(worst, length, out=worst)
            at += length
        elif encoding == 6 and count == 1:
            part[:, 0] = data.signed[at]
            at += data.length[at]
        elif encoding == 6:  # TAG8_8SVB: a bit for each field that is not zero, then those numbers
            rows = np.flatnonzero(data.raw[at])
            flags, here = data.raw[at[rows]], at[rows] + 1
            for field in range(count):
                there = (flags >> field & 1).astype(bool)
                part[rows[there], field] = data.signed[here[there]]
                here[there] += data.length[here[there]]
            at += 1
            at[rows] = here
        elif encoding == 8:  # TAG8_4S16: two bits for each field's width, then a stream of bits
            rows = np.flatnonzero(data.raw[at])
            tags, nibble = data.raw[at[rows]], 2 * (at[rows] + 1)
            for field in range(4):
                width = _NIBBLES[tags >> 2 * field & 3]
                word = _word(data.raw, nibble >> 1, (24, 16, 8)) << (4 * (nibble & 1)).astype("i4")
                part[rows, field] = np.where(width > 0, word >> (32 - 4 * np.maximum(width, 1)), 0)
                nibble += width
            at += 1
            at[rows] = nibble + 1 >> 1
        elif encoding != 9:  # three fields of 2 bits, of the widths below, or of 1 to 4 bytes each
            tags = data.raw[at]
            part[:] = _PAIRS[tags]
            for choice, widths in enumerate(_WIDTHS[encoding], start=1):
                rows = np.flatnonzero(tags >> 6 == choice)
                word = _word(data.raw, at[rows], (24, 16, 8))
                for field, (begin, width) in enumerate(widths):
                    part[rows, field] = word << begin >> (32 - width)
            rows = np.flatnonzero(tags >> 6 == 3)
            here = at[rows] + 1
            for field in range(3):
                size = (tags[rows] >> 2 * field & 3).astype(np.int32)
                word = _word(data.raw, here, (0, 8, 16, 24)) << 8 * (3 - size)
                part[rows, field] = word >> 8 * (3 - size)
                here += size + 1
            at += 1 + (tags >> 6).clip(max=2)
            at[rows] = here
    return out, np.where(worst < _TOO_LONG, at, -1)


def _word(raw: np.ndarray, at: Positions, shifts: tuple[int, ...]) -> np.ndarray:
    """The bytes from `at` on, each moved left by its shift, as the bits of an int32."""
    word = np.zeros(at.size, np.uint32)
    for i, shift in enumerate(shifts):
        word |= raw[at + i].astype(np.uint32) << np.uint32(shift)
    return word.view(np.int32)


class Frames(NamedTuple):
    """Frames with the same fields, as coded: the predictions are not yet added."""

    offsets: Int[np.ndarray, " frames"]
    coded: Int[np.ndarray, "frames fields"]
    key: Bool[np.ndarray, " frames"]  # an I frame, which needs no earlier one


class Event(NamedTuple):
    """A transition that the flight controller noted; `end` is the offset behind it."""

    offset: int
    name: str
    end: int


class Payload(NamedTuple):
    """What one log holds, each in the order of the file."""

    main: Frames  # I and P
    slow: dict[str, Frames]  # S, G, H
    events: list[Event]
    damage: list[tuple[int, int]]  # offsets of bytes that belong to no frame, and behind them


_BLOCK = 1 << 20  # bytes decoded at a time
_MOST_NUMBERS = 1 << 22  # decoded at a time, wherever a frame may begin
STRAY = 8  # bytes between two frames behind which both may be intact


def payload(data: bytes, header: Header) -> Payload:
    """Walk from frame to frame; after damage, on to the next place from which that works."""
    begins = np.isin(np.arange(256), [ord(letter) for letter in (*header.frames, "E")])
    most = max(frame.most_bytes for frame in header.frames.values())
    most_places = _MOST_NUMBERS // max(len(frame.names) for frame in header.frames.values())
    frames: dict[str, list[Frames]] = {}
    events, damage, at, stored = [], [], header.payload, 0
    while at < header.stop:
        # All places in a stretch of the log where a frame may begin, and what is coded there.
        base, stop = at, min(at + _BLOCK, header.stop)
        raw = np.zeros(stop - base + most + _SLACK, np.uint8)
        inside = np.frombuffer(data, np.uint8, min(raw.size, header.stop - base), base)
        raw[: inside.size] = inside
        places = np.flatnonzero(begins[raw[: stop - base]])
        if places.size > most_places:
            stop, places = base + int(places[most_places]), places[:most_places]
        value, length = (raw & 0x7F).astype(np.uint32), np.ones(raw.size, np.uint8)
        first = np.flatnonzero(raw[:-_SLACK] & 0x80)
        following = first + 1
        for shift in (7, 14, 21, 28):
            value[first] |= (raw[following] & 0x7F).astype(np.uint32) << np.uint32(shift)
            length[first] += 1
            more = raw[following] >= 0x80
            first, following = first[more], following[more] + 1
        length[first] = _TOO_LONG
        signed = (value >> 1) ^ -(value & 1)
        numbers = _Numbers(raw, length, value.view(np.int32), signed.view(np.int32))
        reach, coded = np.full(places.size, -1), {}
        for letter, frame in header.frames.items():
            rows = np.flatnonzero(raw[places] == ord(letter))
            values, reach[rows] = _decode(numbers, frame, places[rows])
            coded[letter] = Frames(places[rows] + base, values, np.full(rows.size, letter == "I"))
        both = _join([coded.pop("I"), coded.pop("P")])
        order = np.argsort(both.offsets)
        coded["M"] = Frames(*(part[order] for part in both))
        follows = begins[raw]  # whether a frame may begin there, or the log ends
        follows[header.stop - base :] = False
        follows[header.stop - base : header.stop - base + 1] = True
        good = (reach >= 0) & follows[np.maximum(reach, 0)]
        places, reach = places + base, np.where(reach >= 0, reach + base, -1)
        at, path = _walk(data, header, places, reach, good, at, stop, events, damage)
        on_path = np.zeros(places.size, bool)
        on_path[path] = True
        for letter, every in coded.items():
            taken = on_path[np.searchsorted(places, every.offsets)]
            frames.setdefault(letter, []).append(Frames(*(part[taken] for part in every)))
            stored += frames[letter][-1].coded.nbytes
        check_size("the blackbox log", stored, len(data), offset=header.offset)
    # A log may stop in the middle of its last frame, which loses nothing else.
    if damage and damage[-1][1] == header.stop and header.stop - damage[-1][0] < most:
        damage.pop()
    joined = {letter: _join(parts) for letter, parts in frames.items()}
    fields = len(header.frames["I"].names)
    none = Frames(np.empty(0, int), np.empty((0, fields), np.int32), np.empty(0, bool))
    return Payload(joined.pop("M", none), joined, events, damage)


def _join(parts: list[Frames]) -> Frames:
    return Frames(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _walk(
    data: bytes, header: Header, begins: np.ndarray, reach: np.ndarray, good: np.ndarray,
    at: int, stop: int, events: list[Event], damage: list[tuple[int, int]],
) -> tuple[int, list[int]]:  # fmt: skip
    """Where the walk leaves the piece, and the numbers of the places it came through.

    A frame at a place ends at its `reach`, which is `good` where another letter follows.
    """
    places, ends = begins.tolist(), reach.tolist()
    following = np.where(good, np.searchsorted(begins, reach), -1).tolist() + [-1]
    letters = (*header.frames, "E")
    path, rank = [], bisect_left(places, at)

    def skip_to(place: int) -> None:
        first = damage.pop()[0] if damage and damage[-1][1] == at else at
        damage.append((first, place))

    while rank < len(places):
        if skipped := places[rank] > at:
            skip_to(places[rank])
        begin = rank
        while (after := following[rank]) >= 0:
            path.append(rank)
            rank = after
        at = ends[path[-1]] if rank > begin else places[rank]
        if rank == len(places):
            break
        event = _event(data, at, header.stop)
        if event and event.name == LOG_END:
            events.append(event)
            return header.stop, path
        if data[places[rank]] == ord("I") and ends[rank] >= 0 and not (skipped and rank == begin):
            # An I frame that begins where the frame before it ends: a few stray bytes may follow
            # it, behind which frames go on.
            first, last = np.searchsorted(begins, [ends[rank], ends[rank] + STRAY + 1])
            resumed = next((k for k in range(first, last) if following[k] >= 0), None)
            if resumed is not None:
                path.append(rank)
                at, rank = ends[rank], resumed
                continue
        rank += 1
        if event and (event.end == header.stop or chr(data[event.end]) in letters):
            events.append(event)
            at = event.end
            rank = bisect_left(places, at, rank)
    if at < stop:
        skip_to(stop)
        at = stop
    return at, path


LOG_END = "log end"
RESUME = "logging resume"
ADJUSTMENT = "inflight adjustment"
# Event type: its name and how many variable-byte numbers it carries.
_COUNTED = {0: ("sync beep", 1), 14: (RESUME, 2), 15: ("disarm", 1), 30: ("flight mode", 2)}


def _event(data: bytes, at: int, stop: int) -> Event | None:
    """The event frame at `at`, or None where there is none that is known and whole."""
    if data[at : at + 1] != b"E" or at + 2 >= stop:
        return None
    kind, end = data[at + 1], at + 2
    if kind == 255:
        null = data.find(b"\0", end, min(stop, at + 80))
        ended = null >= 0 and data.startswith(b"End of log", end)
        return Event(at, LOG_END, null + 1) if ended else None
    if kind == 13:  # the number of a setting, and its value: of a float four bytes
        name, count = ADJUSTMENT, int(data[end] < 128)
        end += 1 if count else 5
    elif kind in _COUNTED:
        name, count = _COUNTED[kind]
    else:
        return None
    for _ in range(count):
        number = data[end : min(end + 5, stop)]
        end += next((i for i, byte in enumerate(number, start=1) if byte < 0x80), stop)
    return Event(at, name, end) if end <= stop else None
