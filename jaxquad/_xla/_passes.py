"""The forward and the reverse pass of a time loop, one kernel each, and arrays as these see them.

See `_loop`.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._cuda import launch, PRELUDE, statements, type_of
from ._loop import (
    BLOCKS,
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


BLOCK = 128  # threads that are started together
WARP = 32  # threads that can add up their numbers
Lines = list[str]


def pack(loop: Loop, arrays: Flat, avals: Sequence[Shaped], *, timed: bool = False) -> Flat:
    """Members last, and the numbers of each member in one row."""
    packed = []
    for x, aval in zip(arrays, avals, strict=True):
        last = (loop.members,) if is_wide(loop, aval) else ()
        if last:
            x = jnp.moveaxis(x, timed + aval.shape.index(loop.members), -1)
        x = x.reshape(*x.shape[:timed], size(loop, aval), *last)
        packed.append(x.astype(memory_type(x.dtype)))
    return packed


def unpack(loop: Loop, x: Array, aval: Shaped, *, timed: bool = False) -> Array:
    """The array itself. What has no members' axis is that of the first member."""
    shape = tuple(n for n in aval.shape if n != loop.members)
    x = x.reshape(*x.shape[:timed], *shape, loop.members).astype(aval.dtype)
    if not is_wide(loop, aval):
        return x[..., 0]
    return jnp.moveaxis(x, -1, timed + aval.shape.index(loop.members))


def memory_type(kind: np.dtype) -> np.dtype:
    return np.dtype(np.int32) if kind.kind == "b" else kind


def out_like(loop: Loop, *lengths: int, dtype: np.dtype) -> Shaped:
    return jax.ShapeDtypeStruct((*lengths, loop.members), memory_type(dtype))


class Rows(NamedTuple):
    """An array in memory: its name in a kernel, and how many numbers it has for each member."""

    name: str
    count: int
    kind: np.dtype
    wide: bool  # with a number for each member

    def at(self, k: int, time: str | None = None) -> str:
        """Its number `k` at a time, in C."""
        row = f"{k}" if time is None else f"({time}) * {self.count} + {k}"
        return f"{self.name}[{f'({row}) * members + member' if self.wide else row}]"

    def load(self, time: str | None = None) -> tuple[Lines, Lines]:
        """The lines that read it, and what its numbers are called."""
        names = [f"{self.name}_{k}" for k in range(self.count)]
        kind, test = type_of(self.kind), " != 0" if self.kind.kind == "b" else ""
        lines = [f"const {kind} {name} = {self.at(k, time)}{test};" for k, name in enumerate(names)]
        return lines, names

    def store(self, names: Sequence[str], time: str | None = None) -> Lines:
        pairs = enumerate(names)
        return [f"if (is_member) {self.at(k, time)} = {name};" for k, name in pairs]


def rows_of(
    loop: Loop, prefix: str, avals: Sequence[Shaped], *, all_wide: bool = False
) -> list[Rows]:
    pairs = enumerate(avals)
    wide = lambda x: all_wide or is_wide(loop, x)
    return [Rows(f"{prefix}{k}", size(loop, x), np.dtype(x.dtype), wide(x)) for k, x in pairs]


class Tile(NamedTuple):
    """Numbers of one type of each carry of a loop at several times, for a kernel's own use: a
    block's threads, then a time's numbers. What is `shared` is a block's own, and goes with it."""

    name: str
    kind: np.dtype
    places: tuple[int, ...]  # of these numbers among all of the carry
    times: int
    shared: bool

    @property
    def size(self) -> int:
        """Bytes of a block."""
        return self.times * len(self.places) * BLOCK * memory_type(self.kind).itemsize

    def out(self, loop: Loop) -> Shaped:
        blocks = -(-loop.members // BLOCK)
        shape = (blocks, self.times, len(self.places), BLOCK)
        return jax.ShapeDtypeStruct(shape, memory_type(self.kind))

    def load(self, time: str) -> tuple[Lines, dict[int, str]]:
        """The lines that read it, and what the number at a place of the carry is called."""
        names = {place: f"{self.name}_{place}" for place in self.places}
        kind, test = type_of(self.kind), " != 0" if self.kind.kind == "b" else ""
        read, lines = "*" if self.shared else "__ldcs", [self._now("const ", time)]
        for k, name in enumerate(names.values()):
            lines.append(f"const {kind} {name} = {read}({self.name}_now + {k * BLOCK}){test};")
        return lines, names

    def fetch_before(self) -> Lines:
        """Of the time before the one that was read, while that one is worked on."""
        rows = len(self.places)
        first = f"{self.name}_now - threadIdx.x % {WARP} - {rows * BLOCK}"
        return [f"fetch({first}, {rows}, {BLOCK});"]

    def store(self, names: Sequence[str], time: str) -> Lines:
        places = enumerate(self.places)
        lines = [f"{self.name}_now[{k * BLOCK}] = {names[place]};" for k, place in places]
        return [self._now("", time), *lines]

    def _now(self, access: str, time: str) -> str:
        kind = type_of(memory_type(self.kind))
        place = time if self.shared else f"blockIdx.x * {self.times}LL + {time}"
        first = f"({place}) * {len(self.places) * BLOCK} + threadIdx.x"
        return f"{access}{kind} *const {self.name}_now = {self.name} + {first};"


def tiles_of(loop: Loop, prefix: str, times: int, *, shared: bool = False) -> list[Tile]:
    kinds = [np.dtype(x.dtype) for x in loop.avals[1] for _ in range(size(loop, x))]
    places = {kind: [k for k, one in enumerate(kinds) if one == kind] for kind in kinds}
    tiles = [Tile(f"{prefix}_{kind}", kind, tuple(k), times, shared) for kind, k in places.items()]
    return sorted(tiles, key=lambda tile: -memory_type(tile.kind).itemsize)


class InBlock:
    """Numbers in double precision that a thread holds in its block's memory, if it is to do so."""

    def __init__(self, is_used: bool):
        self.is_used, self._count = is_used, 0

    @property
    def size(self) -> int:
        """Bytes of a block."""
        return self._count * BLOCK * 8

    def variables(
        self, loop: Loop, prefix: str, avals: Sequence[Shaped], values: Sequence[str]
    ) -> tuple[Lines, Lines]:
        """As the function of this name, of which these numbers are not."""
        lines, names = variables(loop, prefix, avals, values)
        kinds = [x.dtype for x in avals for _ in range(size(loop, x))]
        for k in [k for k, kind in enumerate(kinds) if self.is_used and kind == np.float64]:
            names[k] = f"held[{self._count * BLOCK}]"
            lines[k] = f"{names[k]} = {values[k]};"
            self._count += 1
        return lines, names


def declared(in_block: InBlock, tiles: Sequence[Tile]) -> Lines:
    """Where what a block shares lies, the largest numbers first, so that all are aligned."""
    lines, first = ["extern __shared__ long long shelf[];"], in_block.size
    if in_block.size:
        lines.append("volatile double *const held = (double *)shelf + threadIdx.x;")
    for tile in tiles:
        kind = type_of(memory_type(tile.kind))
        lines.append(f"{kind} *const {tile.name} = ({kind} *)((char *)shelf + {first});")
        first += tile.size
    return lines


def kept_avals(loop: Loop) -> list[Shaped]:
    """The carries at the first sample of every segment."""
    return [x.out(loop) for x in tiles_of(loop, "kept", loop.segments.number)]


def load_tiles(tiles: Sequence[Tile], time: str) -> tuple[Lines, Lines]:
    """The lines that read a carry, and what its numbers are called."""
    loads = [tile.load(time) for tile in tiles]
    names = {place: name for _, part in loads for place, name in part.items()}
    return [x for lines, _ in loads for x in lines], [names[k] for k in sorted(names)]


def fetch_before(tiles: Sequence[Tile]) -> Lines:
    return [x for tile in tiles for x in tile.fetch_before()]


def store_tiles(tiles: Sequence[Tile], names: Sequence[str], time: str) -> Lines:
    return [x for tile in tiles for x in tile.store(names, time)]


def load_all(rows: Iterable[Rows], time: str | None = None) -> tuple[Lines, Lines]:
    """The lines that read arrays, and what their numbers are called."""
    loads = [row.load(time) for row in rows]
    return [x for lines, _ in loads for x in lines], [x for _, names in loads for x in names]


def store_all(rows: Sequence[Rows], names: Sequence[str], time: str | None = None) -> Lines:
    parts = split(names, *(row.count for row in rows))
    return [x for row, part in zip(rows, parts, strict=False) for x in row.store(part, time)]


def variables(
    loop: Loop, prefix: str, avals: Sequence[Shaped], values: Sequence[str]
) -> tuple[Lines, Lines]:
    """Lines that make variables with these values, and what they are called."""
    kinds = [type_of(x.dtype) for x in avals for _ in range(size(loop, x))]
    names = [f"{prefix}{k}" for k in range(len(values))]
    return [f"{c} {x} = {y};" for c, x, y in zip(kinds, names, values, strict=True)], names


def assigned(names: Sequence[str], values: Sequence[str]) -> Lines:
    """Of variables whose new values may be each other's old ones."""
    first = [f"const auto next{k} = {y};" for k, y in enumerate(values)]
    return [*first, *(f"{x} = next{k};" for k, x in enumerate(names))]


def nested(head: str, lines: Iterable[str]) -> Lines:
    return [f"{head} {{", *(f"    {x}" for x in lines), "}"]


def run(
    loop: Loop, lines: Lines, inputs: tuple[Sequence[Rows | Tile], Flat],
    outputs: tuple[Sequence[Rows | Tile], Sequence[Shaped]], shared: int = 0,
) -> Flat:  # fmt: skip
    """What a kernel of these lines makes of arguments and writes to results."""
    pairs = [("const ", x) for x in inputs[0]] + [("", x) for x in outputs[0]]
    kind_of = lambda x: type_of(memory_type(x.kind))
    parameters = [f"{access}{kind_of(x)} *__restrict__ {x.name}" for access, x in pairs]
    bounds = f"__launch_bounds__({BLOCK}, {BLOCKS})"
    head = f'extern "C" __global__ void {bounds} kernel({", ".join(parameters)})'
    begin = [
        f"const long long members = {loop.members};",
        f"const long long place = (long long)blockIdx.x * {BLOCK} + threadIdx.x;",
        "const bool is_member = place < members;",
        "const long long member = is_member ? place : members - 1;",
    ]
    text = "\n".join([PRELUDE, *nested(head, [*begin, *lines]), ""])
    return launch(text, "kernel", inputs[1], outputs[1], loop.members, BLOCK, shared)


def run_forward(loop: Loop, *args: Array, keep: bool) -> Flat:
    """The last carry, what was stored, and, with `keep`, the carries that begin a segment."""
    (consts, carry, signals), stored = loop.avals, loop.results[1]
    fixed_rows = rows_of(loop, "fixed", consts)
    begun_rows = rows_of(loop, "begun", carry)
    now_rows = rows_of(loop, "now", signals)
    last_rows = rows_of(loop, "last", carry, all_wide=True)
    left_rows = rows_of(loop, "left", stored, all_wide=True)
    kept_tiles = tiles_of(loop, "kept", loop.segments.number) if keep else []
    # The text of the kernel.
    loads, fixed = load_all(fixed_rows)
    begun, first = load_all(begun_rows)
    begins, state = variables(loop, "state", carry, first)
    now, sample_signals = load_all(now_rows, time="t")
    step, out = statements(step_in_lanes(loop), [*fixed, *state, *sample_signals], "v")
    after, left = split(out, len(state))
    sample = [*now, *step, *store_all(left_rows, left, "t"), *assigned(state, after)]
    samples = nested(f"for (int t = 0; t < {loop.count}; ++t)", sample)
    if keep:
        samples = nested("for (int t = first; t < end; ++t)", sample)
        segment = [*bounds(loop), *store_tiles(kept_tiles, state, "segment"), *samples]
        head = f"for (int segment = 0; segment < {loop.segments.number}; ++segment)"
        samples = nested(head, segment)
    lines = [*loads, *begun, *begins, *samples, *store_all(last_rows, state)]
    # Its arguments and results.
    still, timed = split(args, len(consts) + len(carry))
    arrays = pack(loop, still, [*consts, *carry]) + pack(loop, timed, signals, timed=True)
    outs = [out_like(loop, size(loop, x), dtype=x.dtype) for x in carry]
    outs += [out_like(loop, loop.count, size(loop, x), dtype=x.dtype) for x in stored]
    outs += kept_avals(loop) if keep else []
    inputs = [*fixed_rows, *begun_rows, *now_rows], arrays
    outputs = [*last_rows, *left_rows, *kept_tiles], outs
    last, left, kept = split(run(loop, lines, inputs, outputs), len(carry), len(stored))
    results = [unpack(loop, *pair) for pair in zip(last, carry, strict=True)]
    results += [unpack(loop, *pair, timed=True) for pair in zip(left, stored, strict=True)]
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
    fixed_rows = rows_of(loop, "fixed", consts)
    now_rows = rows_of(loop, "now", signals)
    felt_rows = rows_of(loop, "felt", moving)
    left_rows = rows_of(loop, "left", [x for x in floats if is_wide(loop, x)])
    to_fixed = rows_of(loop, "to_fixed", wanted_consts, all_wide=True)
    to_carry = rows_of(loop, "to_carry", moving, all_wide=True)
    to_now = rows_of(loop, "to_now", wanted_signals)
    kept_tiles = tiles_of(loop, "kept", loop.segments.number)
    length, are_shared = loop.segments.length, loop.segments.are_shared
    again_tiles = tiles_of(loop, "again", length, shared=are_shared)
    shelf, in_block = again_tiles if are_shared else [], InBlock(bool(loop.segments.shared))
    # The text of the kernel.
    loads, fixed = load_all(fixed_rows)
    fixed_begin, fixed = in_block.variables(loop, "still", consts, fixed)
    felt, last = load_all(felt_rows)
    begins, moved = in_block.variables(loop, "moved", moving, last)
    zeros = ["0"] * sum(size(loop, x) for x in wanted_consts)
    sums_begin, sums = in_block.variables(loop, "sum", wanted_consts, zeros)
    kept, first = load_tiles(kept_tiles, "segment")
    kept += nested("if (segment > 0)", fetch_before(kept_tiles)) if shelf else []
    state_begins, state = variables(loop, "state", carry, first)
    now, sample_signals = load_all(now_rows, time="t")
    # A sample of the forward pass, whose carry is written to
    step, out = statements(step_in_lanes(loop), [*fixed, *state, *sample_signals], "v")
    written = store_tiles(again_tiles, state, "t - first")
    once_more = [*written, *now, *step, *assigned(state, out[: len(state)])]
    # A sample of the reverse pass.
    again, before = load_tiles(again_tiles, "t - first")
    again += [] if shelf else nested("if (t > first)", fetch_before(again_tiles))
    rows, left, stored = iter(left_rows), [], []
    for x in floats:
        if is_wide(loop, x):
            lines, names = load_all([next(rows)], time="t")
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
        *store_tiles(again_tiles, state, "end - 1 - first"),
        *nested("for (int t = end - 1; t >= first; --t)", back),
    ]  # fmt: skip
    head = f"for (int segment = {loop.segments.number - 1}; segment >= 0; --segment)"
    shelves = declared(in_block, shelf) if in_block.size or shelf else []
    text = [
        *shelves, *loads, *fixed_begin, *felt, *begins, *sums_begin, *nested(head, segment),
        *store_all(to_carry, moved), *store_all(to_fixed, sums),
    ]  # fmt: skip
    # Its arguments and results.
    parts = split(args, len(consts), len(carry), len(signals), len(kept_tiles), len(moving))
    wide = [k for k, x in enumerate(floats) if is_wide(loop, x)]
    cotangents, avals = [parts[5][k] for k in wide], [floats[k] for k in wide]
    arrays = pack(loop, parts[0], consts) + pack(loop, parts[2], signals, timed=True) + parts[3]
    arrays += pack(loop, parts[4], moving) + pack(loop, cotangents, avals, timed=True)
    outs = [out_like(loop, size(loop, x), dtype=x.dtype) for x in (*wanted_consts, *moving)]
    for x in wanted_signals:
        lanes = loop.members if is_wide(loop, x) else -(-loop.members // WARP)
        outs.append(jax.ShapeDtypeStruct((loop.count, size(loop, x), lanes), x.dtype))
    outs += [] if shelf else [x.out(loop) for x in again_tiles]
    results = run(
        loop, text, ([*fixed_rows, *now_rows, *kept_tiles, *felt_rows, *left_rows], arrays),
        ([*to_fixed, *to_carry, *to_now, *(() if shelf else again_tiles)], outs),
        shared=in_block.size + sum(tile.size for tile in shelf),
    )  # fmt: skip

    def gathered(x: Array, aval: Shaped, timed: bool = False) -> Array:
        """The cotangent of an array; what members share gets the sum of their parts."""
        if is_wide(loop, aval):
            return unpack(loop, x, aval, timed=timed)
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
    warp = WARP
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
