"""Decodes the fields of many frames at once, from wherever in the file they may begin.

Source of the encodings: "Blackbox logging internals" of the Betaflight documentation.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ._betaflight_header import Frame


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
