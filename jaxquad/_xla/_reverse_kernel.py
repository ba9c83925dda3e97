"""The reverse pass of a time loop as one kernel. See `_loop_kernels`."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jaxtyping import Array

from ._lanes import Lane
from ._loop_kernels import (
    BLOCK,
    blocks_of,
    bounds,
    call,
    evaluated,
    Flat,
    is_float,
    is_wide,
    load_all,
    Loop,
    memory_type,
    out_like,
    pack,
    Ref,
    reverse_in_lanes,
    Shaped,
    size,
    spec_of,
    split,
    step_in_lanes,
    store_all,
    unpack,
)


def holds_cotangents(loop: Loop, given: Sequence[bool]) -> bool:
    """Whether those of the float results that are `given` differ between members.

    What all members share would be felt by each: the kernel has no place for it.
    """
    floats = [x for x in loop.out if is_float(x.dtype)]
    pairs = zip(floats, given, strict=True)
    return all(is_wide(loop, aval) for aval, is_given in pairs if is_given)


def run_reverse(loop: Loop, *args: Array, which: tuple[bool, ...]) -> Flat:
    """The cotangents of the arguments in `which`.

    The arguments are consts, carry, signals, the carries that were kept, and the cotangents of the
    float results.
    """
    return _Reverse(loop, which).run(args)


class _Reverse:
    """What goes into the kernel, and in which order."""

    def __init__(self, loop: Loop, which: tuple[bool, ...]):
        self.loop = loop
        self.consts, self.carry, self.signals = loop.avals
        self.stored = [x for x in loop.results[1] if is_float(x.dtype) and is_wide(loop, x)]
        self.moving = [x for x in self.carry if is_float(x.dtype)]
        wanted = split(which, len(self.consts), len(self.carry))
        self.wanted_carry = wanted[1]
        pick = lambda avals, flags: [x for x, flag in zip(avals, flags, strict=True) if flag]
        self.wanted_consts = pick(self.consts, wanted[0])
        self.wanted_signals = pick(self.signals, wanted[2])
        self.step, self.back = step_in_lanes(loop), reverse_in_lanes(loop, which)

    def run(self, args: Sequence[Array]) -> Flat:
        found = call(self.loop, self.kernel, self._packed(args), self._specs(), *self._outs())
        consts, carry, signals, _ = split(found, *self._counts())
        out = [self._gathered(*pair) for pair in zip(consts, self.wanted_consts, strict=True)]
        floats = iter(zip(carry, self.moving, strict=True))
        for aval, wanted in zip(self.carry, self.wanted_carry, strict=True):
            if is_float(aval.dtype):
                pair = next(floats)
                out += [self._gathered(*pair)] if wanted else []
        return out + [
            self._gathered(x, aval, timed=True)
            for x, aval in zip(signals, self.wanted_signals, strict=True)
        ]

    def _gathered(self, x: Array, aval: Shaped, timed: bool = False) -> Array:
        """The cotangent of an array; what members share gets the sum of their parts."""
        if is_wide(self.loop, aval):
            return unpack(self.loop, x, aval, timed=timed)
        return jnp.sum(x, axis=-1).reshape(*x.shape[:timed], *aval.shape).astype(aval.dtype)

    def _counts(self) -> tuple[int, int, int]:
        return len(self.wanted_consts), len(self.moving), len(self.wanted_signals)

    def _packed(self, args: Sequence[Array]) -> Flat:
        loop = self.loop
        consts, _, signals, kept, last, left = split(
            args, len(self.consts), len(self.carry), len(self.signals), len(self.carry),
            len(self.moving),
        )  # fmt: skip
        floats = [x for x in loop.results[1] if is_float(x.dtype)]
        out = [pack(loop, *pair) for pair in zip(consts, self.consts, strict=True)]
        out += [pack(loop, *pair, timed=True) for pair in zip(signals, self.signals, strict=True)]
        out += kept
        pairs = zip(last, self.moving, strict=True)
        out += [pack(loop, *pair, wide=True, fill=0.0) for pair in pairs]
        pairs = (pair for pair in zip(left, floats, strict=True) if is_wide(loop, pair[1]))
        return [*out, *(pack(loop, *pair, timed=True, fill=0.0) for pair in pairs)]

    def _specs(self) -> list[pl.BlockSpec]:
        loop = self.loop
        specs = [spec_of(loop, x) for x in self.consts]
        specs += [spec_of(loop, x, timed=True) for x in self.signals]
        specs += [blocks_of(loop.segments, size(loop, x)) for x in self.carry]
        specs += [blocks_of(size(loop, x)) for x in self.moving]
        return [*specs, *(spec_of(loop, x, timed=True) for x in self.stored)]

    def _outs(self) -> tuple[list[Shaped], list[pl.BlockSpec]]:
        loop = self.loop
        rows = [(size(loop, x),) for x in (*self.wanted_consts, *self.moving)]
        kinds = [x.dtype for x in (*self.wanted_consts, *self.moving)]
        outs = [out_like(loop, *row, dtype=kind) for row, kind in zip(rows, kinds, strict=True)]
        specs = [blocks_of(*row) for row in rows]
        for x in self.wanted_signals:
            row = (loop.count, size(loop, x))
            if is_wide(loop, x):
                outs.append(out_like(loop, *row, dtype=x.dtype))
                specs.append(blocks_of(*row))
            else:  # one sum of each program
                blocks = -(-loop.members // BLOCK)
                outs.append(jax.ShapeDtypeStruct((*row, blocks), x.dtype))
                specs.append(pl.BlockSpec((*row, 1), lambda i: (0, 0, i)))
        for x in self.carry:  # of the samples of a segment
            outs.append(out_like(loop, loop.segment, size(loop, x), dtype=memory_type(x.dtype)))
            specs.append(blocks_of(loop.segment, size(loop, x)))
        return outs, specs

    def kernel(self, *refs: Ref) -> None:
        loop = self.loop
        given, now, kept, last, left, *outs = split(
            refs, len(self.consts), len(self.signals), len(self.carry), len(self.moving),
            len(self.stored), *self._counts(),
        )  # fmt: skip
        to_consts, to_carry, to_signals, scratch = outs
        fixed = load_all(given, self.consts)
        samples = lambda t: load_all(now, self.signals, t)
        count = sum(size(loop, x) for x in self.moving)

        def forward(t: Lane, state: list[Lane]) -> list[Lane]:
            out = evaluated(self.step, fixed, state, samples(t))
            return out[: len(state)]

        def segment(i: Lane, sums: list[Lane]) -> list[Lane]:
            k = np.int32(loop.segments - 1) - i
            first, end = bounds(loop, k)

            def again(t: Lane, state: list[Lane]) -> list[Lane]:
                store_all(scratch, state, t - first)
                return forward(t, state)

            def back(j: Lane, sums: list[Lane]) -> list[Lane]:
                t = end - np.int32(1) - (j - first)
                given = fixed, load_all(scratch, self.carry, t - first), samples(t)
                parts = split(sums, count)
                out = evaluated(self.back, *given, parts[0], self._stored_cotangents(left, t))
                to_fixed, before, to_now = split(out, len(parts[1]), count)
                self._store_signals(to_signals, to_now, t)
                return [*before, *(a + b for a, b in zip(parts[1], to_fixed, strict=True))]

            state = load_all(kept, self.carry, k)
            state = jax.lax.fori_loop(first, end - np.int32(1), again, state)
            store_all(scratch, state, end - np.int32(1) - first)
            return jax.lax.fori_loop(first, end, back, sums)

        cotangents = load_all(last, self.moving)
        sums = [jnp.zeros(BLOCK, x.dtype) for x in self.wanted_consts for _ in range(size(loop, x))]
        sums = jax.lax.fori_loop(
            np.int32(0), np.int32(loop.segments), segment, [*cotangents, *sums]
        )
        store_all(to_carry, sums[: len(cotangents)])
        store_all(to_consts, sums[len(cotangents) :])

    def _stored_cotangents(self, left: Sequence[Ref], t: Lane) -> list[Lane]:
        refs, out = iter(left), []
        for x in self.loop.results[1]:
            if is_float(x.dtype) and is_wide(self.loop, x):
                out += load_all([next(refs)], [x], t)
            elif is_float(x.dtype):  # `holds_cotangents`: these are zero
                out += [jnp.zeros(BLOCK, x.dtype)] * size(self.loop, x)
        return out

    def _store_signals(self, refs: Sequence[Ref], lanes: list[Lane], t: Lane) -> None:
        parts = split(lanes, *(size(self.loop, x) for x in self.wanted_signals))
        for ref, x, part in zip(refs, self.wanted_signals, parts, strict=False):
            if is_wide(self.loop, x):
                store_all([ref], part, t)
                continue
            for k, lane in enumerate(part):
                ref[t, k, 0] = jnp.sum(lane)
