"""Finds the frames of a blackbox log, which carry neither a length nor a checksum.

A frame counts where the letter of another frame follows it, as the documentation advises.
"""

from bisect import bisect_left
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from ._betaflight_bytes import block, fields, SLACK
from ._betaflight_events import Event, event, LOG_END
from ._betaflight_header import Header
from ._limits import check_size


BLOCK = 1 << 20  # bytes decoded at a time
_NUMBERS = 1 << 22  # decoded at a time, wherever a frame may begin


class Damage(NamedTuple):
    """Bytes that belong to no frame."""

    offset: int
    size: int


class Found(NamedTuple):
    """Frames with the same fields, as coded: what their predictors foretold is still missing."""

    offsets: Int[np.ndarray, " frames"]
    coded: Int[np.ndarray, "frames fields"]
    key: Bool[np.ndarray, " frames"]  # an I frame, which needs no earlier one


class Payload(NamedTuple):
    """What one log holds, each in the order of the file."""

    main: Found  # I and P
    slow: dict[str, Found]  # S, G, H
    events: list[Event]
    damage: list[Damage]


class _Piece(NamedTuple):
    """All places in a stretch of the log where a frame may begin, and the frame found there."""

    stop: int
    places: Int[np.ndarray, " places"]
    ends: Int[np.ndarray, " places"]  # -1 where no letter of a frame follows
    coded: dict[str, Found]  # by letter, I and P together under M


def payload(data: bytes, header: Header) -> Payload:
    """Walk from frame to frame; after damage, on to the next place from which that works."""
    result = Payload(_nothing(header, "I"), {}, [], [])
    found: dict[str, list[Found]] = {}
    at, stored = header.payload, 0
    while at < header.stop:
        piece = _piece(data, header, at)
        at, on_path = _walk(data, header, piece, at, result)
        for letter, every in piece.coded.items():
            taken = on_path[np.searchsorted(piece.places, every.offsets)]
            found.setdefault(letter, []).append(Found(*(part[taken] for part in every)))
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


def _joined(parts: list[Found]) -> Found:
    return Found(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _nothing(header: Header, letter: str) -> Found:
    fields = len(header.frames[letter].names)
    return Found(np.empty(0, int), np.empty((0, fields), np.int32), np.empty(0, bool))


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
    ends = np.where((ends >= 0) & follows[np.maximum(ends, 0)], ends + at, -1)
    moved = {letter: f._replace(offsets=f.offsets + at) for letter, f in coded.items()}
    return _Piece(stop, places + at, ends, moved)


def _decoded(
    raw: np.ndarray, header: Header, places: np.ndarray
) -> tuple[dict[str, Found], np.ndarray]:
    prepared = block(raw)
    letters = raw[places]
    ends = np.full(places.size, -1)
    coded = {}
    for letter, frame in header.frames.items():
        rows = np.flatnonzero(letters == ord(letter))
        values, ends[rows] = fields(prepared, frame, places[rows])
        coded[letter] = Found(places[rows], values, np.full(rows.size, letter == "I"))
    key, between = coded.pop("I"), coded.pop("P")
    order = np.argsort(np.concatenate([key.offsets, between.offsets]))
    coded["M"] = Found(*(part[order] for part in _joined([key, between])))
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
        if places[rank] > at:
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
        rank += 1
        if noted and (noted.end == header.stop or data[noted.end] in letters):
            result.events.append(noted)
            at = noted.end
            rank = bisect_left(places, at, rank)
    if at < piece.stop:
        _damaged(result.damage, at, piece.stop)
        at = piece.stop
    return at, _mask(path, len(places))


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
