"""Arrays as the kernels of a time loop see them, and the text of such a kernel."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._cuda_text import PRELUDE, type_of
from ._loop import BLOCKS, Flat, is_wide, Loop, Shaped, size, split
from ._nvrtc import launch


BLOCK = 128  # threads that are started together
WARP = 32  # threads that can add up their numbers
Lines = list[str]


def pack(loop: Loop, x: Array, aval: Shaped, *, timed: bool = False) -> Array:
    """Members last, and the numbers of each member in one row."""
    wide = is_wide(loop, aval)
    if wide:
        x = jnp.moveaxis(x, timed + aval.shape.index(loop.members), -1)
    last = (loop.members,) if wide else ()
    x = x.reshape(*x.shape[:timed], size(loop, aval), *last)
    return x.astype(memory_type(x.dtype))


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
