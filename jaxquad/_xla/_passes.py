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
    consts, carry, signals = loop.avals
    floats = [x for x in loop.results[1] if is_float(x.dtype)]
    moving = [x for x in carry if is_float(x.dtype)]
    wanted = split(which, len(consts), len(carry))
    pick = lambda avals, flags: [x for x, flag in zip(avals, flags, strict=True) if flag]
    wanted_consts, wanted_signals = pick(consts, wanted[0]), pick(signals, wanted[2])
    fixed_rows = memory.rows_of(loop, "fixed", consts)
    now_rows = memory.rows_of(loop, "now", signals)
    felt_rows = memory.rows_of(loop, "felt", moving)
    left_rows = memory.rows_of(loop, "left", [x for x in floats if is_wide(loop, x)])
    to_fixed = memory.rows_of(loop, "to_fixed", wanted_consts, all_wide=True)
    to_carry = memory.rows_of(loop, "to_carry", moving, all_wide=True)
    to_now = memory.rows_of(loop, "to_now", wanted_signals)
    kept_tiles = memory.tiles_of(loop, "kept", loop.segments.number)
    length, are_shared = loop.segments.length, loop.segments.are_shared
    again_tiles = memory.tiles_of(loop, "again", length, shared=are_shared)
    shelf, in_block = again_tiles if are_shared else [], InBlock(bool(loop.segments.shared))
    # The text of the kernel.
    loads, fixed = memory.load_all(fixed_rows)
    fixed_begin, fixed = in_block.variables(loop, "still", consts, fixed)
    felt, last = memory.load_all(felt_rows)
    begins, moved = in_block.variables(loop, "moved", moving, last)
    zeros = ["0"] * sum(size(loop, x) for x in wanted_consts)
    sums_begin, sums = in_block.variables(loop, "sum", wanted_consts, zeros)
    kept, first = memory.load_tiles(kept_tiles, "segment")
    kept += nested("if (segment > 0)", memory.fetch_before(kept_tiles)) if shelf else []
    state_begins, state = variables(loop, "state", carry, first)
    now, sample_signals = memory.load_all(now_rows, time="t")
    # A sample of the forward pass, whose carry is written to memory.
    step, out = statements(step_in_lanes(loop), [*fixed, *state, *sample_signals], "v")
    written = memory.store_tiles(again_tiles, state, "t - first")
    once_more = [*written, *now, *step, *assigned(state, out[: len(state)])]
    # A sample of the reverse pass.
    again, before = memory.load_tiles(again_tiles, "t - first")
    again += [] if shelf else nested("if (t > first)", memory.fetch_before(again_tiles))
    rows, left, stored = iter(left_rows), [], []
    for x in floats:
        if is_wide(loop, x):
            lines, names = memory.load_all([next(rows)], time="t")
            left += lines
            stored += names
        else:  # `holds_cotangents`: these are zero
            stored += [f"({type_of(x.dtype)})0"] * size(loop, x)
    inputs = [*fixed, *before, *sample_signals, *moved, *stored]
    step, out = statements(reverse_in_lanes(loop, which), inputs, "v")
    of_fixed, of_carry, of_now = split(out, len(sums), len(moved))
    back = [*again, *now, *left, *step]
    back += [f"{total} += {part};" for total, part in zip(sums, of_fixed, strict=True)]
    back += assigned(moved, of_carry)
    for row, part in zip(to_now, split(of_now, *(row.count for row in to_now)), strict=False):
        back += row.store(part, "t") if row.wide else _shared(row, part)
    segment = [
        *bounds(loop), *kept, *state_begins,
        *nested("for (int t = first; t < end - 1; ++t)", once_more),
        *memory.store_tiles(again_tiles, state, "end - 1 - first"),
        *nested("for (int t = end - 1; t >= first; --t)", back),
    ]  # fmt: skip
    head = f"for (int segment = {loop.segments.number - 1}; segment >= 0; --segment)"
    declared = memory.declared(in_block, shelf) if in_block.size or shelf else []
    text = [
        *declared, *loads, *fixed_begin, *felt, *begins, *sums_begin, *nested(head, segment),
        *memory.store_all(to_carry, moved), *memory.store_all(to_fixed, sums),
    ]  # fmt: skip
    # Its arguments and results.
    parts = split(args, len(consts), len(carry), len(signals), len(kept_tiles), len(moving))
    timed = lambda x, avals: [
        memory.pack(loop, *pair, timed=True) for pair in zip(x, avals, strict=True)
    ]
    arrays = [memory.pack(loop, *pair) for pair in zip(parts[0], consts, strict=True)]
    arrays += [*timed(parts[2], signals), *parts[3]]
    arrays += [memory.pack(loop, *pair) for pair in zip(parts[4], moving, strict=True)]
    wide = [pair for pair in zip(parts[5], floats, strict=True) if is_wide(loop, pair[1])]
    arrays += [memory.pack(loop, *pair, timed=True) for pair in wide]
    outs = [memory.out_like(loop, size(loop, x), dtype=x.dtype) for x in (*wanted_consts, *moving)]
    for x in wanted_signals:
        lanes = loop.members if is_wide(loop, x) else -(-loop.members // memory.WARP)
        outs.append(jax.ShapeDtypeStruct((loop.count, size(loop, x), lanes), x.dtype))
    outs += [] if shelf else [x.out(loop) for x in again_tiles]
    results = memory.run(
        loop, text, ([*fixed_rows, *now_rows, *kept_tiles, *felt_rows, *left_rows], arrays),
        ([*to_fixed, *to_carry, *to_now, *(() if shelf else again_tiles)], outs),
        shared=in_block.size + sum(tile.size for tile in shelf),
    )  # fmt: skip

    def gathered(x: Array, aval: Shaped, timed: bool = False) -> Array:
        """The cotangent of an array; what members share gets the sum of their parts."""
        if is_wide(loop, aval):
            return memory.unpack(loop, x, aval, timed=timed)
        return jnp.sum(x, axis=-1).reshape(*x.shape[:timed], *aval.shape).astype(aval.dtype)

    of_consts, of_carry, of_signals, _ = split(
        results, len(wanted_consts), len(moving), len(wanted_signals)
    )
    wanted_carry = [flag for x, flag in zip(carry, wanted[1], strict=True) if is_float(x.dtype)]
    pairs = [*zip(of_consts, wanted_consts, strict=True)]
    pairs += pick([*zip(of_carry, moving, strict=True)], wanted_carry)
    out = [gathered(*pair) for pair in pairs]
    return out + [gathered(*x, timed=True) for x in zip(of_signals, wanted_signals, strict=True)]


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
