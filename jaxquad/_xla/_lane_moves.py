"""What moves numbers or adds them up, done on cells while tracing. See `_lanes`."""

import functools as ft
import math
from collections.abc import Callable, Sequence

import jax
import numpy as np
from jax.extend.core import JaxprEqn

from ._lanes import as_cells, Cells, cells_of, Lane, Lanes, NotInLanes, Rule, Shape


RULES: dict[str, Rule] = {}
_LONGEST = 64  # iterations of a loop within a sample


def _rule(*names: str) -> Callable:
    def register(rule: Callable) -> Callable:
        RULES.update(dict.fromkeys(names, rule))
        return rule

    return register


def _shape(equation: JaxprEqn, place: int = 0) -> Shape:
    return equation.invars[place].aval.shape  # pyright: ignore[reportAttributeAccessIssue]


def _result(equation: JaxprEqn) -> Shape:
    return equation.outvars[0].aval.shape  # pyright: ignore[reportAttributeAccessIssue]


@_rule("broadcast_in_dim")
def _broadcast(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    shape = lanes.small(_result(equation))
    places = [1] * len(shape)
    for axis, place in enumerate(equation.params["broadcast_dimensions"]):
        places[place] = x.shape[axis]
    return np.broadcast_to(x.reshape(places), shape)


@_rule("reshape", "squeeze", "expand_dims")
def _reshape(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    before, after = _shape(equation), _result(equation)
    ahead = [s.index(lanes.members) if lanes.members in s else None for s in (before, after)]
    if (ahead[0] is None) != (ahead[1] is None) or (
        ahead[0] is not None and math.prod(before[: ahead[0]]) != math.prod(after[: ahead[1]])
    ):
        raise NotInLanes(f"a reshape of {before} to {after}, across the members")
    return x.reshape(lanes.small(after))


@_rule("transpose")
def _transpose(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    return x.transpose(equation.params["permutation"])


@_rule("rev")
def _reverse(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    axes = equation.params["dimensions"]
    _keep_apart(lanes, equation, axes)
    return np.flip(x, axes)


@_rule("concatenate")
def _concatenate(lanes: Lanes, equation: JaxprEqn, *parts: Cells) -> Cells:
    axis = equation.params["dimension"]
    _keep_apart(lanes, equation, (axis,))
    lanes.small(_result(equation))
    return np.concatenate(parts, axis)


@_rule("stack")
def _stack(lanes: Lanes, equation: JaxprEqn, *parts: Cells) -> Cells:
    lanes.small(_result(equation))
    return np.stack(parts, equation.params["axis"])


@_rule("unstack")
def _unstack(lanes: Lanes, equation: JaxprEqn, x: Cells) -> list[Cells]:
    axis = equation.params["axis"]
    _keep_apart(lanes, equation, (axis,))
    return [as_cells(part) for part in np.moveaxis(x, axis, 0)]


@_rule("split")
def _split(lanes: Lanes, equation: JaxprEqn, x: Cells) -> list[Cells]:
    axis = equation.params["axis"]
    _keep_apart(lanes, equation, (axis,))
    return np.split(x, np.cumsum(equation.params["sizes"])[:-1], axis)


@_rule("slice")
def _slice(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    shape, params = _shape(equation), equation.params
    steps = params["strides"] or (1,) * len(shape)
    parts = []
    bounds = zip(params["start_indices"], params["limit_indices"], steps, strict=True)
    for axis, part in enumerate(bounds):
        if lanes.is_members(shape, axis):
            _require(part == (0, lanes.members, 1), "a slice of the members")
            part = (0, 1, 1)
        parts.append(slice(*part))
    return x[tuple(parts)]


@_rule("pad")
def _pad(lanes: Lanes, equation: JaxprEqn, x: Cells, value: Cells) -> Cells:
    shape = _shape(equation)
    for axis, (low, high, gap) in enumerate(equation.params["padding_config"]):
        if lanes.is_members(shape, axis):
            _require((low, high, gap) == (0, 0, 0), "members that are padded")
            continue
        row = np.take(x, [0], axis).shape
        rows = [cells_of([value.item()] * math.prod(row), row)]
        spaced = [y for k in range(x.shape[axis]) for y in [np.take(x, [k], axis), *rows * gap]]
        spaced = spaced[: len(spaced) - gap] if gap else spaced
        spaced = rows * max(low, 0) + spaced[max(-low, 0) :] + rows * max(high, 0)
        x = np.concatenate(spaced[: len(spaced) - max(-high, 0)], axis)
    return x


@_rule("dynamic_slice")
def _dynamic_slice(lanes: Lanes, equation: JaxprEqn, x: Cells, *starts: Cells) -> Cells:
    sizes = equation.params["slice_sizes"]
    return x[_window(lanes, _shape(equation), sizes, starts)]


@_rule("dynamic_update_slice")
def _update(lanes: Lanes, equation: JaxprEqn, x: Cells, new: Cells, *starts: Cells) -> Cells:
    out = x.copy()
    out[_window(lanes, _shape(equation), _shape(equation, 1), starts)] = new
    return out


def _window(lanes: Lanes, shape: Shape, sizes: Shape, starts: Sequence[Cells]) -> tuple:
    """Where a slice lies whose start is known while tracing."""
    parts = []
    for axis, (size, start) in enumerate(zip(sizes, starts, strict=True)):
        if lanes.is_members(shape, axis):
            _require(size == shape[axis], "a slice of the members")
            parts.append(slice(None))
            continue
        first = start.item()
        _require(isinstance(first, np.generic), "an index that is known only when it runs")
        first = min(max(int(first), 0), shape[axis] - size)
        parts.append(slice(first, first + size))
    return tuple(parts)


@_rule("iota")
def _iota(lanes: Lanes, equation: JaxprEqn) -> Cells:
    shape, axis = _result(equation), equation.params["dimension"]
    _require(not lanes.is_members(shape, axis), "the members' numbers")
    row = cells_of(list(np.arange(shape[axis], dtype=equation.params["dtype"])), (shape[axis],))
    return np.moveaxis(np.broadcast_to(row, _moved_last(lanes.small(shape), axis)), -1, axis)


@_rule("empty", "empty2")
def _empty(lanes: Lanes, equation: JaxprEqn) -> Cells:
    """What a loop fills."""
    zeros = np.zeros((), equation.outvars[0].aval.dtype)  # pyright: ignore
    return np.broadcast_to(cells_of([zeros[()]], ()), lanes.small(_result(equation)))


def _moved_last(shape: Shape, axis: int) -> Shape:
    return (*shape[:axis], *shape[axis + 1 :], shape[axis])


@_rule("reduce_sum", "reduce_prod", "reduce_max", "reduce_min", "reduce_and", "reduce_or")
def _reduce(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    name, axes = equation.primitive.name, equation.params["axes"]
    if not (lanes.leave_sums and name == "reduce_sum"):
        _keep_apart(lanes, equation, axes)
    kept = [axis for axis in range(x.ndim) if axis not in axes]
    shape = tuple(x.shape[axis] for axis in kept)
    rows = x.transpose(*kept, *axes).reshape(math.prod(shape), -1)
    return cells_of([lanes.fold(name, list(row)) for row in rows], shape)


@_rule("cumsum")
def _accumulate(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    axis, out = equation.params["axis"], np.empty_like(x)
    _keep_apart(lanes, equation, (axis,))
    turned = (lambda a: np.flip(a, axis)) if equation.params["reverse"] else (lambda a: a)
    rows, found = (np.moveaxis(turned(a), axis, 0) for a in (x, out))
    for k, row in enumerate(rows):
        total = row if k == 0 else _pairwise(lanes, "reduce_sum", total, row)  # noqa: F821
        found[k] = total
    return out


def _pairwise(lanes: Lanes, name: str, a: Cells, b: Cells) -> Cells:
    pairs = zip(np.ravel(as_cells(a)), np.ravel(as_cells(b)), strict=True)
    return cells_of([lanes.pair(name, *pair) for pair in pairs], np.shape(a))


@_rule("dot_general")
def _dot(lanes: Lanes, equation: JaxprEqn, a: Cells, b: Cells) -> Cells:
    (shared_a, shared_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    if not lanes.leave_sums:
        _keep_apart(lanes, equation, shared_a)
    kind = equation.outvars[0].aval.dtype  # pyright: ignore[reportAttributeAccessIssue]
    a, free_a = _matrices(a, batch_a, shared_a)
    b, free_b = _matrices(b, batch_b, shared_b)
    batch = tuple(a.shape[: len(batch_a)])
    a, b = (x.reshape(math.prod(batch), -1, math.prod(x.shape[-n:] or (1,)) if n else 1)
            for x, n in ((a, len(shared_a)), (b, len(shared_b))))  # fmt: skip
    product = lambda x, y: lanes.fold(
        "reduce_sum", [lanes.pair("reduce_prod", p, q) for p, q in zip(x, y, strict=True)]
    )
    found = [product(x, y).astype(kind) for m, n in zip(a, b, strict=True) for x in m for y in n]
    return cells_of(found, (*batch, *free_a, *free_b))


def _matrices(x: Cells, batch: Sequence[int], shared: Sequence[int]) -> tuple[Cells, Shape]:
    free = [axis for axis in range(x.ndim) if axis not in (*batch, *shared)]
    return x.transpose(*batch, *free, *shared), tuple(x.shape[axis] for axis in free)


@_rule("cond")
def _cond(lanes: Lanes, equation: JaxprEqn, index: Cells, *args: Cells) -> list[Cells]:
    """All branches, of which each member takes one: they are arithmetic."""
    branches = [lanes.call(branch, args) for branch in equation.params["branches"]]
    choice = index.item()
    if isinstance(choice, np.generic):
        return branches[min(max(int(choice), 0), len(branches) - 1)]
    found = branches[0]
    for k, branch in enumerate(branches[1:], 1):
        takes = choice if choice.dtype == bool else jax.lax.ge(choice, choice.dtype.type(k))
        pick = ft.partial(_choose, takes)
        found = [pick(new, old) for new, old in zip(branch, found, strict=True)]
    return found


def _choose(takes: Lane, new: Cells, old: Cells) -> Cells:
    pairs = zip(new.reshape(-1), old.reshape(-1), strict=True)
    return cells_of([jax.lax.select(takes, *pair) for pair in pairs], new.shape)


@_rule("scan")
def _scan(lanes: Lanes, equation: JaxprEqn, *args: Cells) -> list[Cells]:
    """A loop of a few iterations, one after the other."""
    params, length = equation.params, equation.params["length"]
    _require(length <= _LONGEST, f"a loop of {length} iterations within a sample")
    n, m = _counts(equation)
    consts, carry, xs = args[:n], list(args[n : n + m]), args[n + m :]
    stored: list[list[Cells]] = []
    order = range(length - 1, -1, -1) if params["reverse"] else range(length)
    for k in order:
        out = lanes.call(params["jaxpr"], [*consts, *carry, *(as_cells(x[k]) for x in xs)])
        carry = out[:m]
        stored.append(out[m:])
    rows = stored[::-1] if params["reverse"] else stored
    return [*carry, *(np.stack(column) for column in zip(*rows, strict=True))]


def _counts(equation: JaxprEqn) -> tuple[int, int]:
    """How many constants a scan has, and carries: its names for these differ between JAX versions.

    What is scanned has one axis less in the body.
    """
    rank, body = lambda v: len(v.aval.shape), equation.params["jaxpr"].jaxpr
    kept = lambda outer, inner: sum(rank(a) == rank(b) for a, b in zip(outer, inner, strict=True))
    carry = kept(equation.outvars, body.outvars)
    return kept(equation.invars, body.invars) - carry, carry


def _keep_apart(lanes: Lanes, equation: JaxprEqn, axes: Sequence[int | np.integer]) -> None:
    shape = _shape(equation)
    name = equation.primitive.name
    _require(not any(lanes.is_members(shape, axis) for axis in axes), f"{name} over the members")


def _require(condition: bool, otherwise: str) -> None:
    if not condition:
        raise NotInLanes(otherwise)
