"""The forward and the reverse pass of a time loop, one kernel each. See `_loop`."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import _kernel_memory as memory
from ._cuda_text import statements, type_of
from ._kernel_memory import assigned, InBlock, Lines, nested, Rows, variables
from ._loop import (
    bounds,
    Flat,
    is_float,
    is_wide,
    Loop,
    reverse_in_lanes,
    Shaped,
    size,
    split,
    step_in_lanes,
)


def run_forward(loop: Loop, *args: Array, keep: bool) -> Flat:
    """The last carry, what was stored, and, with `keep`, the carries that begin a segment."""
    (consts, carry, signals), stored = loop.avals, loop.results[1]
    fixed_rows = memory.rows_of(loop, "fixed", consts)
    begun_rows = memory.rows_of(loop, "begun", carry)
    now_rows = memory.rows_of(loop, "now", signals)
    last_rows = memory.rows_of(loop, "last", carry, all_wide=True)
    left_rows = memory.rows_of(loop, "left", stored, all_wide=True)
    kept_tiles = memory.tiles_of(loop, "kept", loop.segments.number) if keep else []
    # The text of the kernel.
    loads, fixed = memory.load_all(fixed_rows)
    begun, first = memory.load_all(begun_rows)
    begins, state = variables(loop, "state", carry, first)
    now, sample_signals = memory.load_all(now_rows, time="t")
    step, out = statements(step_in_lanes(loop), [*fixed, *state, *sample_signals], "v")
    after, left = split(out, len(state))
    sample = [*now, *step, *memory.store_all(left_rows, left, "t"), *assigned(state, after)]
    samples = nested(f"for (int t = 0; t < {loop.count}; ++t)", sample)
    if keep:
        samples = nested("for (int t = first; t < end; ++t)", sample)
        segment = [*bounds(loop), *memory.store_tiles(kept_tiles, state, "segment"), *samples]
        head = f"for (int segment = 0; segment < {loop.segments.number}; ++segment)"
        samples = nested(head, segment)
    lines = [*loads, *begun, *begins, *samples, *memory.store_all(last_rows, state)]
    # Its arguments and results.
    still, timed = split(args, len(consts) + len(carry))
    arrays = [memory.pack(loop, *pair) for pair in zip(still, [*consts, *carry], strict=True)]
    arrays += [memory.pack(loop, *pair, timed=True) for pair in zip(timed, signals, strict=True)]
    outs = [memory.out_like(loop, size(loop, x), dtype=x.dtype) for x in carry]
    outs += [memory.out_like(loop, loop.count, size(loop, x), dtype=x.dtype) for x in stored]
    outs += memory.kept_avals(loop) if keep else []
    inputs = [*fixed_rows, *begun_rows, *now_rows], arrays
    outputs = [*last_rows, *left_rows, *kept_tiles], outs
    last, left, kept = split(memory.run(loop, lines, inputs, outputs), len(carry), len(stored))
    results = [memory.unpack(loop, *pair) for pair in zip(last, carry, strict=True)]
    results += [memory.unpack(loop, *pair, timed=True) for pair in zip(left, stored, strict=True)]
    return [*results, *kept]


def holds_cotangents(loop: Loop, are_given: Sequence[bool]) -> bool:
    """Whether those of the float results that `are_given` differ between members: what all share
    would be felt by each, and the kernel has no place for it."""
    floats = [x for x in loop.out if is_float(x.dtype)]
    pairs = zip(floats, are_given, strict=True)
    return all(is_wide(loop, aval) for aval, is_given in pairs if is_given)


def run_reverse(loop: Loop, *args: Array, which: tuple[bool, ...]) -> Flat:
    """The cotangents of the arguments in `which`, from consts, carry, signals, the kept carries,
    and the cotangents of the float results."""
    return _Reverse(loop, which).run(args)


class _Reverse:
    """What goes into the kernel, and in which order."""

    def __init__(self, loop: Loop, which: tuple[bool, ...]):
        self.loop, self.which = loop, which
        self.consts, self.carry, self.signals = loop.avals
        self.stored = [x for x in loop.results[1] if is_float(x.dtype) and is_wide(loop, x)]
        self.moving = [x for x in self.carry if is_float(x.dtype)]
        wanted = split(which, len(self.consts), len(self.carry))
        self.wanted_carry = wanted[1]
        pick = lambda avals, flags: [x for x, flag in zip(avals, flags, strict=True) if flag]
        self.wanted_consts = pick(self.consts, wanted[0])
        self.wanted_signals = pick(self.signals, wanted[2])
        self.fixed = memory.rows_of(loop, "fixed", self.consts)
        self.now = memory.rows_of(loop, "now", self.signals)
        self.kept = memory.tiles_of(loop, "kept", loop.segments.number)
        self.felt = memory.rows_of(loop, "felt", self.moving)
        self.left = memory.rows_of(loop, "left", self.stored)
        self.to_fixed = memory.rows_of(loop, "to_fixed", self.wanted_consts, all_wide=True)
        self.to_carry = memory.rows_of(loop, "to_carry", self.moving, all_wide=True)
        self.to_now = memory.rows_of(loop, "to_now", self.wanted_signals)
        length, shared = loop.segments.length, loop.segments.are_shared
        self.again = memory.tiles_of(loop, "again", length, shared=shared)
        self.shelf = self.again if shared else []

    def run(self, args: Sequence[Array]) -> Flat:
        loop, shelf = self.loop, self.shelf
        consts, _, signals, kept, last, left = split(
            args, len(self.consts), len(self.carry), len(self.signals), len(self.kept),
            len(self.moving),
        )  # fmt: skip
        pairs = zip(signals, self.signals, strict=True)
        arrays = [memory.pack(loop, *pair) for pair in zip(consts, self.consts, strict=True)]
        arrays += [memory.pack(loop, *pair, timed=True) for pair in pairs]
        arrays += kept
        arrays += [memory.pack(loop, *pair) for pair in zip(last, self.moving, strict=True)]
        floats = [x for x in loop.results[1] if is_float(x.dtype)]
        pairs = (pair for pair in zip(left, floats, strict=True) if is_wide(loop, pair[1]))
        arrays += [memory.pack(loop, *pair, timed=True) for pair in pairs]
        still = [*self.wanted_consts, *self.moving]
        outs = [memory.out_like(loop, size(loop, x), dtype=x.dtype) for x in still]
        for x in self.wanted_signals:
            rows = loop.members if is_wide(loop, x) else -(-loop.members // memory.WARP)
            outs.append(jax.ShapeDtypeStruct((loop.count, size(loop, x), rows), x.dtype))
        outs += [] if shelf else [x.out(loop) for x in self.again]
        inputs = [*self.fixed, *self.now, *self.kept, *self.felt, *self.left], arrays
        into = [*self.to_fixed, *self.to_carry, *self.to_now, *(() if shelf else self.again)]
        in_block = InBlock(bool(loop.segments.shared))
        lines = self.lines(in_block)
        shared = in_block.size + sum(tile.size for tile in shelf)
        results = memory.run(loop, lines, inputs, (into, outs), shared=shared)
        consts, carry, signals, _ = split(
            results, len(self.wanted_consts), len(self.moving), len(self.wanted_signals)
        )
        out = [self._gathered(*pair) for pair in zip(consts, self.wanted_consts, strict=True)]
        moved = iter(zip(carry, self.moving, strict=True))
        for aval, wanted in zip(self.carry, self.wanted_carry, strict=True):
            if is_float(aval.dtype):
                pair = next(moved)
                out += [self._gathered(*pair)] if wanted else []
        pairs = zip(signals, self.wanted_signals, strict=True)
        return out + [self._gathered(*pair, timed=True) for pair in pairs]

    def _gathered(self, x: Array, aval: Shaped, timed: bool = False) -> Array:
        """The cotangent of an array; what members share gets the sum of their parts."""
        if is_wide(self.loop, aval):
            return memory.unpack(self.loop, x, aval, timed=timed)
        return jnp.sum(x, axis=-1).reshape(*x.shape[:timed], *aval.shape).astype(aval.dtype)

    def lines(self, in_block: InBlock) -> Lines:
        loop = self.loop
        loads, fixed = memory.load_all(self.fixed)
        fixed_begin, fixed = in_block.variables(loop, "still", self.consts, fixed)
        felt, last = memory.load_all(self.felt)
        begins, moved = in_block.variables(loop, "moved", self.moving, last)
        zeros = ["0"] * sum(size(loop, x) for x in self.wanted_consts)
        sums_begin, sums = in_block.variables(loop, "sum", self.wanted_consts, zeros)
        kept, first = memory.load_tiles(self.kept, "segment")
        kept += nested("if (segment > 0)", memory.fetch_before(self.kept)) if self.shelf else []
        state_begins, state = variables(loop, "state", self.carry, first)
        segment = [
            *bounds(loop), *kept, *state_begins,
            *nested("for (int t = first; t < end - 1; ++t)", self._once_more(fixed, state)),
            *memory.store_tiles(self.again, state, "end - 1 - first"),
            *nested("for (int t = end - 1; t >= first; --t)", self._back(fixed, moved, sums)),
        ]  # fmt: skip
        head = f"for (int segment = {loop.segments.number - 1}; segment >= 0; --segment)"
        ends = [*memory.store_all(self.to_carry, moved), *memory.store_all(self.to_fixed, sums)]
        shelf = memory.declared(in_block, self.shelf) if in_block.size or self.shelf else []
        begins = [*loads, *fixed_begin, *felt, *begins, *sums_begin]
        return [*shelf, *begins, *nested(head, segment), *ends]

    def _once_more(self, fixed: Lines, state: Lines) -> Lines:
        """A sample of the forward pass, whose carry is written to memory."""
        now, signals = memory.load_all(self.now, time="t")
        step, out = statements(step_in_lanes(self.loop), [*fixed, *state, *signals], "v")
        written = memory.store_tiles(self.again, state, "t - first")
        return [*written, *now, *step, *assigned(state, out[: len(state)])]

    def _back(self, fixed: Lines, moved: Lines, sums: Lines) -> Lines:
        """A sample of the reverse pass."""
        again, state = memory.load_tiles(self.again, "t - first")
        again += [] if self.shelf else nested("if (t > first)", memory.fetch_before(self.again))
        now, signals = memory.load_all(self.now, time="t")
        left, stored = self._stored_cotangents()
        inputs = [*fixed, *state, *signals, *moved, *stored]
        step, out = statements(reverse_in_lanes(self.loop, self.which), inputs, "v")
        to_fixed, before, to_now = split(out, len(sums), len(moved))
        added = [f"{total} += {part};" for total, part in zip(sums, to_fixed, strict=True)]
        return [*again, *now, *left, *step, *added, *assigned(moved, before), *self._to_now(to_now)]

    def _stored_cotangents(self) -> tuple[Lines, Lines]:
        rows, lines, names = iter(self.left), [], []
        for x in self.loop.results[1]:
            if is_float(x.dtype) and is_wide(self.loop, x):
                loads, numbers = memory.load_all([next(rows)], time="t")
                lines += loads
                names += numbers
            elif is_float(x.dtype):  # `holds_cotangents`: these are zero
                names += [f"({type_of(x.dtype)})0"] * size(self.loop, x)
        return lines, names

    def _to_now(self, names: Lines) -> Lines:
        parts = split(names, *(row.count for row in self.to_now))
        lines = []
        for row, part in zip(self.to_now, parts, strict=False):
            lines += row.store(part, "t") if row.wide else _shared(row, part)
        return lines


def _shared(row: Rows, names: Lines) -> Lines:
    """What all members share gets a sum of each warp."""
    warp = memory.WARP
    place = f"* ((members + {warp - 1}) / {warp}) + place / {warp}"
    lines = []
    for k, name in enumerate(names):
        total = f"total_{row.name}_{k}"
        halve = f"{total} += __shfl_down_sync(~0u, {total}, k);"
        lines += [
            f"auto {total} = is_member ? {name} : 0;",
            f"for (int k = {warp // 2}; k > 0; k /= 2) {halve}",
            f"if (is_member && place % {warp} == 0)",
            f"    {row.name}[(t * {row.count} + {k}) {place}] = {total};",
        ]
    return lines
