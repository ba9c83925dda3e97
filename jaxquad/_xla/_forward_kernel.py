"""A time loop as one kernel. See `_loop_kernels`."""

from collections.abc import Sequence

import jax
import numpy as np
from jax.experimental import pallas as pl
from jaxtyping import Array

from ._lanes import Lane
from ._loop_kernels import (
    blocks_of,
    bounds,
    call,
    evaluated,
    Flat,
    kept_avals,
    load_all,
    Loop,
    memory_type,
    out_like,
    pack,
    Ref,
    Shaped,
    size,
    spec_of,
    split,
    step_in_lanes,
    store_all,
    unpack,
)


def run_forward(loop: Loop, *args: Array, keep: bool) -> Flat:
    """The last carry, what was stored, and, with `keep`, the carries that begin a segment."""
    return _Forward(loop, keep).run(args)


class _Forward:
    """What goes into the kernel, and in which order."""

    def __init__(self, loop: Loop, keep: bool):
        self.loop, self.keep = loop, keep
        self.consts, self.carry, self.signals = loop.avals
        self.stored = loop.results[1]
        self.step = step_in_lanes(loop)

    def run(self, args: Sequence[Array]) -> Flat:
        loop = self.loop
        found = call(loop, self.kernel, self._packed(args), self._specs(), *self._outs())
        last, left, kept = split(found, len(self.carry), len(self.stored))
        out = [unpack(loop, *pair) for pair in zip(last, self.carry, strict=True)]
        out += [unpack(loop, *pair, timed=True) for pair in zip(left, self.stored, strict=True)]
        return [*out, *kept]

    def _packed(self, args: Sequence[Array]) -> Flat:
        loop = self.loop
        consts, carry, signals = split(args, len(self.consts), len(self.carry))
        out = [pack(loop, *pair) for pair in zip(consts, self.consts, strict=True)]
        out += [pack(loop, *pair, wide=True) for pair in zip(carry, self.carry, strict=True)]
        pairs = zip(signals, self.signals, strict=True)
        return [*out, *(pack(loop, *pair, timed=True) for pair in pairs)]

    def _specs(self) -> list[pl.BlockSpec]:
        specs = [spec_of(self.loop, x) for x in self.consts]
        specs += [spec_of(self.loop, x, wide=True) for x in self.carry]
        return [*specs, *(spec_of(self.loop, x, timed=True) for x in self.signals)]

    def _outs(self) -> tuple[list[Shaped], list[pl.BlockSpec]]:
        loop = self.loop
        rows = [((size(loop, x),), x) for x in self.carry]
        rows += [((loop.count, size(loop, x)), x) for x in self.stored]
        outs = [out_like(loop, *row, dtype=memory_type(x.dtype)) for row, x in rows]
        outs += kept_avals(loop) if self.keep else []
        return outs, [blocks_of(*x.shape[:-1]) for x in outs]

    def kernel(self, *refs: Ref) -> None:
        given, first, now, last, store, kept = split(
            refs, len(self.consts), len(self.carry), len(self.signals), len(self.carry),
            len(self.stored),
        )  # fmt: skip
        fixed = load_all(given, self.consts)

        def sample(t: Lane, state: list[Lane]) -> list[Lane]:
            out = evaluated(self.step, fixed, state, load_all(now, self.signals, t))
            state, left = split(out, len(state))
            store_all(store, left, t)
            return state

        def segment(k: Lane, state: list[Lane]) -> list[Lane]:
            store_all(kept, state, k)
            return jax.lax.fori_loop(*bounds(self.loop, k), sample, state)

        body, count = (segment, self.loop.segments) if self.keep else (sample, self.loop.count)
        state = load_all(first, self.carry)
        store_all(last, jax.lax.fori_loop(np.int32(0), np.int32(count), body, state))
