"""A time loop as one kernel. See `_loop_kernels`."""

from collections.abc import Sequence

from jaxtyping import Array

from ._cuda_text import statements
from ._kernel_memory import (
    assigned,
    kept_avals,
    Lines,
    load_all,
    nested,
    out_like,
    pack,
    rows_of,
    run,
    store_all,
    store_tiles,
    tiles_of,
    unpack,
    variables,
)
from ._loop_kernels import bounds, Flat, Loop, Shaped, size, split, step_in_lanes


def run_forward(loop: Loop, *args: Array, keep: bool) -> Flat:
    """The last carry, what was stored, and, with `keep`, the carries that begin a segment."""
    return _Forward(loop, keep).run(args)


class _Forward:
    """What goes into the kernel, and in which order."""

    def __init__(self, loop: Loop, keep: bool):
        self.loop, self.keep = loop, keep
        self.consts, self.carry, self.signals = loop.avals
        self.stored = loop.results[1]
        self.fixed = rows_of(loop, "fixed", self.consts)
        self.begun = rows_of(loop, "begun", self.carry)
        self.now = rows_of(loop, "now", self.signals)
        self.last = rows_of(loop, "last", self.carry, all_wide=True)
        self.left = rows_of(loop, "left", self.stored, all_wide=True)
        self.kept = tiles_of(loop, "kept", loop.segments.number) if keep else []

    def run(self, args: Sequence[Array]) -> Flat:
        loop = self.loop
        given, made = [*self.fixed, *self.begun, *self.now], [*self.last, *self.left, *self.kept]
        found = run(loop, self.lines(), (given, self._packed(args)), (made, self._outs()))
        last, left, kept = split(found, len(self.carry), len(self.stored))
        out = [unpack(loop, *pair) for pair in zip(last, self.carry, strict=True)]
        out += [unpack(loop, *pair, timed=True) for pair in zip(left, self.stored, strict=True)]
        return [*out, *kept]

    def _packed(self, args: Sequence[Array]) -> Flat:
        loop = self.loop
        still, signals = split(args, len(self.consts) + len(self.carry))
        avals = [*self.consts, *self.carry]
        out = [pack(loop, *pair) for pair in zip(still, avals, strict=True)]
        pairs = zip(signals, self.signals, strict=True)
        return [*out, *(pack(loop, *pair, timed=True) for pair in pairs)]

    def _outs(self) -> list[Shaped]:
        loop = self.loop
        outs = [out_like(loop, size(loop, x), dtype=x.dtype) for x in self.carry]
        outs += [out_like(loop, loop.count, size(loop, x), dtype=x.dtype) for x in self.stored]
        return outs + (kept_avals(loop) if self.keep else [])

    def lines(self) -> Lines:
        loop = self.loop
        loads, fixed = load_all(self.fixed)
        begun, first = load_all(self.begun)
        begins, state = variables(loop, "state", self.carry, first)
        now, signals = load_all(self.now, time="t")
        step, out = statements(step_in_lanes(loop), [*fixed, *state, *signals], "v")
        after, left = split(out, len(state))
        sample = [*now, *step, *store_all(self.left, left, "t"), *assigned(state, after)]
        if self.keep:
            each = nested("for (int t = first; t < end; ++t)", sample)
            segment = [*bounds(loop), *store_tiles(self.kept, state, "segment"), *each]
            samples = nested(
                f"for (int segment = 0; segment < {loop.segments.number}; ++segment)", segment
            )
        else:
            samples = nested(f"for (int t = 0; t < {loop.count}; ++t)", sample)
        return [*loads, *begun, *begins, *samples, *store_all(self.last, state)]
