"""How often the forward kernel of a time loop keeps the carry for the reverse one.

The reverse kernel computes the samples between two kept carries once more, and puts their carries
down until it comes back to them. In the memory that a processor of the GPU shares among its threads
they cost next to nothing, but few have room there: so carries are kept as often as a part of the
device's memory allows. Where that is not often enough, they are kept every sqrt(samples) samples,
and put down in the device's memory.

What a thread holds from sample to sample (constants, the sums of their cotangents, the carry's
cotangents) goes to the shared memory first where its registers have no room for it, as in double
precision: what the compiler has no register for it puts down in memory that is slow.
"""

import math
from typing import NamedTuple

import jax


_LEAST = 2  # samples: a carry is then written in less time than a sample takes
_SHARE = 0.15  # of the device's free memory, for what is kept: a program may have some loops
BLOCKS = 2  # that a processor runs at once, by their registers
_OWN = 1024  # bytes of a block that are the driver's
# Bytes of shared memory of a processor, by compute capability; 64 KB are everywhere.
_SHARED = {"8.0": 164, "8.7": 164, "9.0": 228, "10.0": 228, "10.3": 228, "8.6": 100, "8.9": 100}
_SHARED |= {"12.0": 100, "12.1": 100}
_KILOBYTE = 1024
_HELD = 170  # of 255 registers, that leave room for a sample's own numbers


class Segments(NamedTuple):
    """Of a loop of `count` samples."""

    count: int
    length: int  # samples, of all but the last
    are_shared: bool  # whether a segment's carries lie in shared memory
    held: int = 0  # bytes of a thread there, for numbers of eight bytes that it holds

    @property
    def number(self) -> int:
        return -(-self.count // self.length)


def segments_of(count: int, carry: int, members: int, block: int, held: int = 0) -> Segments:
    """For `members` whose carry has so many bytes, in blocks of so many threads.

    `held` are the bytes of each that `held_bytes` found.
    """
    room = _memory()[0]
    most = (_shared_by_block() - held * block) // max(carry * block, 1)
    length = max(_LEAST, math.ceil(count * carry * members / (_SHARE * room))) if room else count
    if length <= min(most, count):
        return Segments(count, length, True, held)
    return Segments(count, math.isqrt(max(count - 1, 0)) + 1, False, held)


def held_bytes(held: int, of_eight: int, block: int) -> int:
    """Bytes of a thread that go to shared memory, of those that it holds from sample to sample.

    `of_eight` are those of numbers with eight bytes. None where registers have room for all, and
    where that memory has none.
    """
    registers = held // 4
    return of_eight if registers > _HELD and of_eight * block <= _shared_by_block() else 0


def _shared_by_block() -> int:
    return _memory()[1] // BLOCKS - _OWN


def _memory() -> tuple[int, int]:
    """Bytes that are free on this machine's GPU, and shared ones; 0 where there is no GPU."""
    try:
        device = jax.local_devices(backend="gpu")[0]
    except RuntimeError:  # a program for another machine
        return 0, 0
    known = device.memory_stats() or {}
    free = known.get("bytes_limit", 0) - known.get("bytes_in_use", 0)
    return free, _KILOBYTE * _SHARED.get(str(device.compute_capability), 64)
