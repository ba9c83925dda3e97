"""Finds the frames of a blackbox log, which carry neither a length nor a checksum.

A frame counts where the letter of another frame follows it, as the documentation advises.
"""

from bisect import bisect_left
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from .._log import check_size
from ._betaflight_header import Frame, Header


class Event(NamedTuple):
    """A transition that the flight controller noted; `end` is the offset behind it."""

    offset: int
    name: str
    values: tuple[int, ...]
    end: int


Positions = Int[np.ndarray, " frames"]
_SLACK = 16  # bytes that may be looked at beyond a frame
_TOO_LONG = 6  # bytes: a 32-bit number takes at most 5


class _Block(NamedTuple):
    """A piece of the log and, for every byte of it, the number that would begin there."""

    raw: np.ndarray  # uint8
    length: np.ndarray  # uint8, bytes of a variable-byte number
    unsigned: np.ndarray  # int32, its value with the bits of a uint32
    signed: np.ndarray  # int32, after ZigZag


def _prepare(raw: np.ndarray) -> _Block:
    """Bytes that end in _SLACK bytes of padding, decoded as if a number began at every one."""
    value = (raw & 0x7F).astype(np.uint32)
    length = np.ones(raw.size, np.uint8)
    first = np.flatnonzero(raw[:-_SLACK] & 0x80)
    following = first + 1
    for shift in (7, 14, 21, 28):
        value[first] |= (raw[following] & 0x7F).astype(np.uint32) << np.uint32(shift)
        length[first] += 1
        more = raw[following] >= 0x80
        first, following = first[more], following[more] + 1
    length[first] = _TOO_LONG
    signed = (value >> 1) ^ -(value & 1)
    return _Block(raw, length, value.view(np.int32), signed.view(np.int32))


def _fields(
    data: _Block, frame: Frame, starts: Positions
) -> tuple[Int[np.ndarray, "frames fields"], Positions]:
    """What the frames whose letters stand at `starts` would hold, and where each would end.

    The numbers are as coded, without their predictors. The end is -1 for a number too long.
    """
    out = np.zeros((starts.size, len(frame.names)), np.int32)
    at = starts + 1
    worst = np.zeros(starts.size, np.uint8)
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
        elif encoding == 6:
            at = _flagged(data, at, part)
        elif encoding == 8:
            at = _four_nibbles(data, at, part)
        elif encoding != 9:
            at = _three(data, at, part, variable=encoding == 10)
    return out, np.where(worst < _TOO_LONG, at, -1)


def _flagged(data: _Block, at: Positions, out: np.ndarray) -> Positions:
    """TAG8_8SVB: a bit for each field that is not zero, then those numbers."""
    flags = data.raw[at]
    at = at + 1
    rows = np.flatnonzero(flags)
    flags, here = flags[rows], at[rows]
    for field in range(out.shape[1]):
        there = (flags >> field & 1).astype(bool)
        out[rows[there], field] = data.signed[here[there]]
        here[there] += data.length[here[there]]
    at[rows] = here
    return at


def _four_nibbles(data: _Block, at: Positions, out: np.ndarray) -> Positions:
    """TAG8_4S16: two bits for the width of each field (0, 4, 8, 16), then a stream of bits."""
    tags = data.raw[at]
    at = at + 1
    rows = np.flatnonzero(tags)
    tags, nibble = tags[rows], 2 * at[rows]
    for field in range(4):
        width = _NIBBLES[tags >> 2 * field & 3]
        byte = nibble >> 1
        word = _word(data.raw, byte, (24, 16, 8)) << (4 * (nibble & 1)).astype(np.int32)
        out[rows, field] = np.where(width > 0, word >> (32 - 4 * np.maximum(width, 1)), 0)
        nibble += width
    at[rows] = nibble + 1 >> 1
    return at


def _three(data: _Block, at: Positions, out: np.ndarray, *, variable: bool) -> Positions:
    """TAG2_3S32 or TAG2_3SVARIABLE.

    Three fields of 2, of 4, of 6 bits, or of 1 to 4 bytes each. In the second they have 2 bits, 5,
    5, 4 bits, 8, 7, 7 bits, or 1 to 4 bytes.
    """
    widths = ((5, 5, 4), (8, 7, 7)) if variable else ((4, 4, 4), (6, 6, 6))
    begins = ((2, 7, 12), (2, 10, 17)) if variable else ((4, 8, 12), (2, 10, 18))
    tags = data.raw[at]
    out[:] = _PAIRS[tags]
    for choice in (1, 2):
        rows = np.flatnonzero(tags >> 6 == choice)
        word = _word(data.raw, at[rows], (24, 16, 8))
        for field in range(3):
            left = word << begins[choice - 1][field]
            out[rows, field] = left >> (32 - widths[choice - 1][field])
    end = at + 1 + (tags >> 6).clip(max=2)
    rows = np.flatnonzero(tags >> 6 == 3)
    here = at[rows] + 1
    for field in range(3):
        size = (tags[rows] >> 2 * field & 3).astype(np.int32)
        word = _word(data.raw, here, (0, 8, 16, 24)) << 8 * (3 - size)
        out[rows, field] = word >> 8 * (3 - size)
        here += size + 1
    end[rows] = here
    return end


def _word(raw: np.ndarray, at: Positions, shifts: tuple[int, ...]) -> np.ndarray:
    """The bytes from `at` on, each moved left by its shift, as the bits of an int32."""
    word = np.zeros(at.size, np.uint32)
    for i, shift in enumerate(shifts):
        word |= raw[at + i].astype(np.uint32) << np.uint32(shift)
    return word.view(np.int32)


_NIBBLES = np.array([0, 1, 2, 4], np.int32)
_PAIRS = np.stack([(np.arange(256, dtype=np.int32) << s) >> 30 for s in (26, 28, 30)], axis=1)


_BLOCK = 1 << 20  # bytes decoded at a time
STRAY = 8  # bytes between two frames behind which both may be intact
_NUMBERS = 1 << 22  # decoded at a time, wherever a frame may begin


class Damage(NamedTuple):
    """Bytes that belong to no frame."""

    offset: int
    size: int


class Frames(NamedTuple):
    """Frames with the same fields, as coded: the predictions are not yet added."""

    offsets: Int[np.ndarray, " frames"]
    coded: Int[np.ndarray, "frames fields"]
    key: Bool[np.ndarray, " frames"]  # an I frame, which needs no earlier one


class Payload(NamedTuple):
    """What one log holds, each in the order of the file."""

    main: Frames  # I and P
    slow: dict[str, Frames]  # S, G, H
    events: list[Event]
    damage: list[Damage]


class _Piece(NamedTuple):
    """All places in a stretch of the log where a frame may begin, and what is coded there."""

    stop: int
    places: Int[np.ndarray, " places"]
    ends: Int[np.ndarray, " places"]  # -1 where no letter of a frame follows
    reach: Int[np.ndarray, " places"]  # the same whatever follows; -1 for a number too long
    coded: dict[str, Frames]  # by letter, I and P together under M


def payload(data: bytes, header: Header) -> Payload:
    """Walk from frame to frame; after damage, on to the next place from which that works."""
    fields = len(header.frames["I"].names)
    none = Frames(np.empty(0, int), np.empty((0, fields), np.int32), np.empty(0, bool))
    result = Payload(none, {}, [], [])
    frames: dict[str, list[Frames]] = {}
    at, stored = header.payload, 0
    while at < header.stop:
        piece = _decode_piece(data, header, at)
        at, path = _walk(data, header, piece, at, result)
        on_path = np.zeros(piece.places.size, bool)
        on_path[path] = True
        for letter, every in piece.coded.items():
            taken = on_path[np.searchsorted(piece.places, every.offsets)]
            frames.setdefault(letter, []).append(Frames(*(part[taken] for part in every)))
            stored += frames[letter][-1].coded.nbytes
        check_size("the blackbox log", stored, len(data), offset=header.offset)
    # A log may stop in the middle of its last frame, which loses nothing else.
    most = max(frame.most_bytes for frame in header.frames.values())
    damage = result.damage
    if damage and sum(damage[-1]) == header.stop and damage[-1].size < most:
        damage.pop()
    joined = {letter: _join(parts) for letter, parts in frames.items()}
    return result._replace(main=joined.pop("M", result.main), slow=joined)


def _join(parts: list[Frames]) -> Frames:
    return Frames(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _decode_piece(data: bytes, header: Header, at: int) -> _Piece:
    stop = min(at + _BLOCK, header.stop)
    margin = max(frame.most_bytes for frame in header.frames.values()) + _SLACK
    raw = np.zeros(stop - at + margin, np.uint8)
    inside = np.frombuffer(data, np.uint8, min(raw.size, header.stop - at), at)
    raw[: inside.size] = inside
    begins = np.zeros(256, bool)
    begins[[ord(letter) for letter in (*header.frames, "E")]] = True
    places = np.flatnonzero(begins[raw[: stop - at]])
    most = _NUMBERS // max(len(frame.names) for frame in header.frames.values())
    if places.size > most:
        stop, places = at + int(places[most]), places[:most]
    prepared, letters = _prepare(raw), raw[places]
    ends, coded = np.full(places.size, -1), {}
    for letter, frame in header.frames.items():
        rows = np.flatnonzero(letters == ord(letter))
        values, ends[rows] = _fields(prepared, frame, places[rows])
        coded[letter] = Frames(places[rows] + at, values, np.full(rows.size, letter == "I"))
    key, between = coded.pop("I"), coded.pop("P")
    order = np.argsort(np.concatenate([key.offsets, between.offsets]))
    coded["M"] = Frames(*(part[order] for part in _join([key, between])))
    follows = begins[raw]
    follows[header.stop - at :] = False
    if header.stop - at < raw.size:
        follows[header.stop - at] = True
    reach = np.where(ends >= 0, ends + at, -1)
    ends = np.where((ends >= 0) & follows[np.maximum(ends, 0)], ends + at, -1)
    return _Piece(stop, places + at, ends, reach, coded)


def _walk(
    data: bytes, header: Header, piece: _Piece, at: int, result: Payload
) -> tuple[int, list[int]]:
    """Where the walk leaves the piece, and the numbers of the places it came through."""
    places, ends = piece.places.tolist(), piece.ends.tolist()
    good = piece.ends >= 0
    following = np.where(good, np.searchsorted(piece.places, piece.ends), -1).tolist() + [-1]
    letters = {ord(letter) for letter in (*header.frames, "E")}
    path, rank = [], bisect_left(places, at)
    while rank < len(places):
        if skipped := places[rank] > at:
            _add_damage(result.damage, at, places[rank])
        begin = rank
        while (after := following[rank]) >= 0:
            path.append(rank)
            rank = after
        at = ends[path[-1]] if rank > begin else places[rank]
        if rank == len(places):
            break
        event = _event(data, at, header.stop)
        if event and event.name == LOG_END:
            result.events.append(event)
            return header.stop, path
        end = int(piece.reach[rank])
        if data[places[rank]] == ord("I") and end >= 0 and not (skipped and rank == begin):
            # An I frame that begins where the frame before it ends: a few stray bytes may follow
            # it, behind which frames go on.
            first, last = np.searchsorted(piece.places, [end, end + STRAY + 1])
            resumed = next((k for k in range(first, last) if following[k] >= 0), None)
            if resumed is not None:
                path.append(rank)
                at, rank = end, resumed
                continue
        rank += 1
        if event and (event.end == header.stop or data[event.end] in letters):
            result.events.append(event)
            at = event.end
            rank = bisect_left(places, at, rank)
    if at < piece.stop:
        _add_damage(result.damage, at, piece.stop)
        at = piece.stop
    return at, path


def _add_damage(damage: list[Damage], begin: int, end: int) -> None:
    """Note the bytes `begin` .. `end`, as part of the stretch before where they follow on it."""
    if damage and damage[-1].offset + damage[-1].size == begin:
        damage[-1] = Damage(damage[-1].offset, end - damage[-1].offset)
    else:
        damage.append(Damage(begin, end - begin))


LOG_END = "log end"
RESUME = "logging resume"
ADJUSTMENT = "inflight adjustment"

# Event type: its name and how many variable-byte numbers it carries.
_COUNTED = {
    0: ("sync beep", 1),
    14: (RESUME, 2),
    15: ("disarm", 1),
    30: ("flight mode", 2),
}
_ADJUSTED = 13
_END = 255


def _event(data: bytes, at: int, stop: int) -> Event | None:
    """The event frame at `at`, or None where there is none that is known and whole."""
    if data[at : at + 1] != b"E" or at + 2 >= stop:
        return None
    kind = data[at + 1]
    if kind == _END:
        null = data.find(b"\0", at + 2, min(stop, at + 80))
        ends = null >= 0 and data.startswith(b"End of log", at + 2)
        return Event(at, LOG_END, (), null + 1) if ends else None
    if kind == _ADJUSTED:  # the number of a setting, and its value unless that is a float
        setting = data[at + 2]
        if setting >= 128:
            return Event(at, ADJUSTMENT, (setting,), at + 7) if at + 7 <= stop else None
        value, end = _variable(data, at + 3, stop)
        values = [setting, value >> 1 ^ -(value & 1)]
        return Event(at, ADJUSTMENT, tuple(values), end) if end <= stop else None
    if kind not in _COUNTED:
        return None
    name, count = _COUNTED[kind]
    values, end = [], at + 2
    for _ in range(count):
        value, end = _variable(data, end, stop)
        values.append(value)
    return Event(at, name, tuple(values), end) if end <= stop else None


def _variable(data: bytes, at: int, stop: int) -> tuple[int, int]:
    """A number of at most five bytes and the offset behind it, which is beyond `stop` if none."""
    value = 0
    for i, byte in enumerate(data[at : min(at + 5, stop)]):
        value |= (byte & 0x7F) << 7 * i
        if byte < 0x80:
            return value & 0xFFFFFFFF, at + i + 1
    return 0, stop + 1
