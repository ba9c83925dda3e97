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
SLACK = 16  # bytes that may be looked at beyond a frame
_TOO_LONG = 6  # bytes: a 32-bit number takes at most 5


class Block(NamedTuple):
    """A piece of the log and, for every byte of it, the number that would begin there."""

    raw: np.ndarray  # uint8
    length: np.ndarray  # uint8, bytes of a variable-byte number
    unsigned: np.ndarray  # int32, its value with the bits of a uint32
    signed: np.ndarray  # int32, after ZigZag


def block(raw: np.ndarray) -> Block:
    """Prepare bytes that end in SLACK bytes of padding."""
    value = (raw & 0x7F).astype(np.uint32)
    length = np.ones(raw.size, np.uint8)
    first = np.flatnonzero(raw[:-SLACK] & 0x80)
    following = first + 1
    for shift in (7, 14, 21, 28):
        value[first] |= (raw[following] & 0x7F).astype(np.uint32) << np.uint32(shift)
        length[first] += 1
        more = raw[following] >= 0x80
        first, following = first[more], following[more] + 1
    length[first] = _TOO_LONG
    signed = (value >> 1) ^ -(value & 1)
    return Block(raw, length, value.view(np.int32), signed.view(np.int32))


def fields(
    data: Block, frame: Frame, starts: Positions
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
            part[:, 0] = _single(data, encoding, at)
            length = data.length[at]
            np.maximum(worst, length, out=worst)
            at += length
        elif encoding == 6 and count == 1:
            part[:, 0] = data.signed[at]
            at += data.length[at]
        elif encoding != 9:
            at = _CODED_TOGETHER[encoding](data, at, part)
    return out, np.where(worst < _TOO_LONG, at, -1)


def _single(data: Block, encoding: int, at: Positions) -> np.ndarray:
    if encoding == 0:
        return data.signed[at]
    if encoding == 1:
        return data.unsigned[at]
    return -((data.unsigned[at] & 0x3FFF) << 18 >> 18)  # 14 bits with a sign


def _flagged(data: Block, at: Positions, out: np.ndarray) -> Positions:
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


def _four_nibbles(data: Block, at: Positions, out: np.ndarray) -> Positions:
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


def _three(data: Block, at: Positions, out: np.ndarray) -> Positions:
    """TAG2_3S32: three fields of 2, 4, 6 bits, or of 1 to 4 bytes each."""
    return _three_of(data, at, out, ((4, 4, 4), (6, 6, 6)), ((4, 8, 12), (2, 10, 18)))


def _three_variable(data: Block, at: Positions, out: np.ndarray) -> Positions:
    """TAG2_3SVARIABLE: three fields of 2, of 5, 5, 4, of 8, 7, 7 bits, or of 1 to 4 bytes each."""
    return _three_of(data, at, out, ((5, 5, 4), (8, 7, 7)), ((2, 7, 12), (2, 10, 17)))


def _three_of(
    data: Block,
    at: Positions,
    out: np.ndarray,
    widths: tuple[tuple[int, ...], ...],
    begins: tuple[tuple[int, ...], ...],
) -> Positions:
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
_CODED_TOGETHER = {6: _flagged, 7: _three, 8: _four_nibbles, 10: _three_variable}


BLOCK = 1 << 20  # bytes decoded at a time
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
    """All places in a stretch of the log where a frame may begin, and the frame found there."""

    stop: int
    places: Int[np.ndarray, " places"]
    ends: Int[np.ndarray, " places"]  # -1 where no letter of a frame follows
    reach: Int[np.ndarray, " places"]  # the same whatever follows; -1 for a number too long
    coded: dict[str, Frames]  # by letter, I and P together under M


def payload(data: bytes, header: Header) -> Payload:
    """Walk from frame to frame; after damage, on to the next place from which that works."""
    result = Payload(_nothing(header, "I"), {}, [], [])
    found: dict[str, list[Frames]] = {}
    at, stored = header.payload, 0
    while at < header.stop:
        piece = _piece(data, header, at)
        at, on_path = _walk(data, header, piece, at, result)
        for letter, every in piece.coded.items():
            taken = on_path[np.searchsorted(piece.places, every.offsets)]
            found.setdefault(letter, []).append(Frames(*(part[taken] for part in every)))
            stored += found[letter][-1].coded.nbytes
        check_size("the blackbox log", stored, len(data), offset=header.offset)
    _forgive_cut(result.damage, header)
    joined = {letter: _joined(parts) for letter, parts in found.items()}
    return result._replace(main=joined.pop("M", result.main), slow=joined)


def _forgive_cut(damage: list[Damage], header: Header) -> None:
    """A log may stop in the middle of its last frame, which loses nothing else."""
    most = max(frame.most_bytes for frame in header.frames.values())
    if damage and sum(damage[-1]) == header.stop and damage[-1].size < most:
        damage.pop()


def _joined(parts: list[Frames]) -> Frames:
    return Frames(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _nothing(header: Header, letter: str) -> Frames:
    fields = len(header.frames[letter].names)
    return Frames(np.empty(0, int), np.empty((0, fields), np.int32), np.empty(0, bool))


def _piece(data: bytes, header: Header, at: int) -> _Piece:
    stop = min(at + BLOCK, header.stop)
    margin = max(frame.most_bytes for frame in header.frames.values()) + SLACK
    raw = np.zeros(stop - at + margin, np.uint8)
    inside = np.frombuffer(data, np.uint8, min(raw.size, header.stop - at), at)
    raw[: inside.size] = inside
    begins = np.zeros(256, bool)
    begins[[ord(letter) for letter in (*header.frames, "E")]] = True
    places = np.flatnonzero(begins[raw[: stop - at]])
    most = _NUMBERS // max(len(frame.names) for frame in header.frames.values())
    if places.size > most:
        stop, places = at + int(places[most]), places[:most]
    coded, ends = _decoded(raw, header, places)
    follows = begins[raw]
    follows[header.stop - at :] = False
    if header.stop - at < raw.size:
        follows[header.stop - at] = True
    reach = np.where(ends >= 0, ends + at, -1)
    ends = np.where((ends >= 0) & follows[np.maximum(ends, 0)], ends + at, -1)
    moved = {letter: f._replace(offsets=f.offsets + at) for letter, f in coded.items()}
    return _Piece(stop, places + at, ends, reach, moved)


def _decoded(
    raw: np.ndarray, header: Header, places: np.ndarray
) -> tuple[dict[str, Frames], np.ndarray]:
    prepared = block(raw)
    letters = raw[places]
    ends = np.full(places.size, -1)
    coded = {}
    for letter, frame in header.frames.items():
        rows = np.flatnonzero(letters == ord(letter))
        values, ends[rows] = fields(prepared, frame, places[rows])
        coded[letter] = Frames(places[rows], values, np.full(rows.size, letter == "I"))
    key, between = coded.pop("I"), coded.pop("P")
    order = np.argsort(np.concatenate([key.offsets, between.offsets]))
    coded["M"] = Frames(*(part[order] for part in _joined([key, between])))
    return coded, ends


def _walk(
    data: bytes, header: Header, piece: _Piece, at: int, result: Payload
) -> tuple[int, Bool[np.ndarray, " places"]]:
    """Where the walk leaves the piece, and which places it came through."""
    places, ends = piece.places.tolist(), piece.ends.tolist()
    good = piece.ends >= 0
    following = np.where(good, np.searchsorted(piece.places, piece.ends), -1).tolist() + [-1]
    letters = {ord(letter) for letter in (*header.frames, "E")}
    path, rank = [], bisect_left(places, at)
    while rank < len(places):
        if skipped := places[rank] > at:
            _damaged(result.damage, at, places[rank])
        begin = rank
        while (after := following[rank]) >= 0:
            path.append(rank)
            rank = after
        at = ends[path[-1]] if rank > begin else places[rank]
        if rank == len(places):
            break
        noted = event(data, at, header.stop)
        if noted and noted.name == LOG_END:
            result.events.append(noted)
            return header.stop, _mask(path, len(places))
        resumed = None if skipped and rank == begin else _behind_key(data, piece, following, rank)
        if resumed is not None:
            path.append(rank)
            at, rank = int(piece.reach[rank]), resumed
            continue
        rank += 1
        if noted and (noted.end == header.stop or data[noted.end] in letters):
            result.events.append(noted)
            at = noted.end
            rank = bisect_left(places, at, rank)
    if at < piece.stop:
        _damaged(result.damage, at, piece.stop)
        at = piece.stop
    return at, _mask(path, len(places))


def _behind_key(data: bytes, piece: _Piece, following: list[int], rank: int) -> int | None:
    """Where frames go on behind an I frame that a few stray bytes follow; None where they do not.

    The I frame begins where the frame before it ends.
    """
    end = int(piece.reach[rank])
    if data[int(piece.places[rank])] != ord("I") or end < 0:
        return None
    first, last = np.searchsorted(piece.places, [end, end + STRAY + 1])
    return next((k for k in range(first, last) if following[k] >= 0), None)


def _mask(path: list[int], places: int) -> Bool[np.ndarray, " places"]:
    mask = np.zeros(places, bool)
    mask[path] = True
    return mask


def _damaged(damage: list[Damage], begin: int, end: int) -> None:
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
_END_TEXT = b"End of log"


def event(data: bytes, at: int, stop: int) -> Event | None:
    """The event frame at `at`, or None where there is none that is known and whole."""
    if data[at : at + 1] != b"E" or at + 2 >= stop:
        return None
    kind = data[at + 1]
    if kind == _END:
        return _log_end(data, at, stop)
    if kind == _ADJUSTED:
        return _adjustment(data, at, stop)
    if kind not in _COUNTED:
        return None
    name, count = _COUNTED[kind]
    values, end = [], at + 2
    for _ in range(count):
        value, end = _variable(data, end, stop)
        values.append(value)
    return Event(at, name, tuple(values), end) if end <= stop else None


def _log_end(data: bytes, at: int, stop: int) -> Event | None:
    if not data.startswith(_END_TEXT, at + 2):
        return None
    null = data.find(b"\0", at + 2, min(stop, at + 80))
    return Event(at, LOG_END, (), null + 1) if null >= 0 else None


def _adjustment(data: bytes, at: int, stop: int) -> Event | None:
    """A setting changed in flight: its number, and its value unless that is a float."""
    setting = data[at + 2]
    if setting >= 128:
        return Event(at, ADJUSTMENT, (setting,), at + 7) if at + 7 <= stop else None
    value, end = _variable(data, at + 3, stop)
    signed = value >> 1 ^ -(value & 1)
    return Event(at, ADJUSTMENT, (setting, signed), end) if end <= stop else None


def _variable(data: bytes, at: int, stop: int) -> tuple[int, int]:
    """A number of at most five bytes and the offset behind it, which is beyond `stop` if none."""
    value = 0
    for i, byte in enumerate(data[at : min(at + 5, stop)]):
        value |= (byte & 0x7F) << 7 * i
        if byte < 0x80:
            return value & 0xFFFFFFFF, at + i + 1
    return 0, stop + 1
