"""How a state-space response changes with single entries of its matrices, without a derivative.

With the resolvent R, the states X = R G and L = (H0 + s H1) R, the response L G changes with
F[p][q] by L[:, p] X[q, :], one column times one row; and so with all the others.
"""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxquad._compile import no_fuse

from ._response import inverse_by_diagonal, Matrices, output_of, solve_states, Split


class Entry(NamedTuple):
    """One number of a `StateSpace`: `F[0][1]` is ("F", 0, 1), `input_delay[2]` has column 0."""

    field: str
    row: int
    column: int


class _Places(NamedTuple):
    """Which column, row and inputs belong to each entry: hashed, to be known when compiling."""

    column: tuple[int, ...]
    row: tuple[int, ...]
    source: tuple[int | None, ...]  # the only input that an entry acts on; None for all


class FactoredSlopes(NamedTuple):
    """The slopes of ln T by entries, as products of a column and a row."""

    left: Split  # (columns, outputs, inputs, frequencies), relative to the response
    right: Split  # (rows, inputs, frequencies)
    scale: Float[Array, " entries"]
    places: _Places

    def multiply_out(self, weights: Split) -> Split:
        """The slopes, (entries, outputs, inputs, frequencies), with both parts weighted."""
        factors, places = (self.left, self.right, self.scale), self.places
        real = no_fuse(ft.partial(_real_slopes, places), *factors, weights.real)
        return Split(real, no_fuse(ft.partial(_imag_slopes, places), *factors, weights.imag))

    @property
    def multiplies_sooner(self) -> bool:
        """Whether `normal_products` takes less arithmetic than the products of the slopes."""
        (columns, outputs), rows = self.left.real.shape[:2], len(self.right.real)
        entries = len(self.places.column)
        pairs = columns * (columns + 1) // 2
        return pairs * (2 * rows**2 + 6 * outputs) < 2 * entries * outputs * (entries + 4)

    def normal_products(
        self, weight: Float[Array, "outputs inputs frequencies"], misfit: Split
    ) -> tuple[Float[Array, " entries"], Float[Array, "entries entries"]]:
        """J'r and J'J without the slopes, where one `weight` is that of both parts.

        Two slopes are multiplied as their columns, summed over outputs, times their rows.
        """
        square, columns = weight * weight, len(self.left.real)
        summed = _in_line(_column_products(_pairs(columns), self.left, square))
        found = _contract(summed, no_fuse(_row_products, self.right))
        hessian = _products_of_entries(self.places, columns, found)
        pulled = no_fuse(_pulls, self.left, Split(*(square * part for part in misfit)))
        gradient = _pulls_of_entries(self.places, _contract(pulled, _in_line(self.right)))
        return gradient * self.scale, hessian * self.scale[:, None] * self.scale[None]


def factor_slopes(
    matrices: Matrices,
    omega: Float[Array, " frequencies"],
    entries: Sequence[Entry],
    scale: Float[Array, " entries"],
) -> tuple[Split, FactoredSlopes]:
    """The response T, and the slopes of ln T by each entry times its `scale`.

    Both without a look at rounding near a pole; the slope of a response of 0 is not finite.
    """
    found = solve_states(matrices, omega, inverse_by_diagonal)
    seen, undelayed = (output_of(matrices, omega, x) for x in (found.resolvent, found.states))
    outputs, count, _ = seen.real.shape
    columns, rows, signs = np.array([_find_vectors(each, count, outputs) for each in entries]).T
    (used, column), (pushed, row) = (np.unique(x, return_inverse=True) for x in (columns, rows))
    places = _Places(tuple(column.tolist()), tuple(row.tolist()), tuple(map(_source, entries)))
    left, right = _columns(used, seen, undelayed, omega), _rows(pushed, found.states, omega)
    return found.value, FactoredSlopes(left, right, jnp.asarray(signs, scale.dtype) * scale, places)


def _find_vectors(entry: Entry, count: int, outputs: int) -> tuple[int, int, int]:
    """Which of all `_columns`, which of all `_rows`, and with which sign."""
    _, row, column = entry
    late, one = count + outputs, 2 * count
    places = {
        "F": (row, column, 1),
        "G": (row, one, 1),
        "H0": (count + row, column, 1),
        "H1": (count + row, count + column, 1),
        "M": (row, count + column, -1),
        "input_delay": (late, one, 1),
        "output_delay": (late + 1 + row, one, 1),
    }
    return places[entry.field]


def _source(entry: Entry) -> int | None:
    return {"G": entry.column, "input_delay": entry.row}.get(entry.field)


def _columns(
    used: np.ndarray, seen: Split, undelayed: Split, omega: Float[Array, " frequencies"]
) -> Split:
    """Those of L and unit vectors over the response; -s for delays, of all outputs and of each."""
    (outputs, inputs, _), late = undelayed.real.shape, sum(seen.real.shape[:2])
    left = _append_units(Split(*(jnp.moveaxis(part, 1, 0) for part in seen)))
    left = Split(*(part[used[used < late]] for part in left))
    relative = no_fuse(_divide, left, no_fuse(_reciprocal, undelayed))
    which = np.concatenate([np.ones((1, outputs)), np.eye(outputs)])[used[used >= late] - late]
    rate = -jnp.asarray(which, omega.dtype)[:, :, None, None] * omega[None, None, None]
    rate = jnp.broadcast_to(rate, (len(which), outputs, inputs, omega.size))
    return Split(
        jnp.concatenate([relative.real, jnp.zeros_like(rate)]),
        jnp.concatenate([relative.imag, rate]),
    )


def _rows(pushed: np.ndarray, states: Split, omega: Float[Array, " frequencies"]) -> Split:
    """Those of X, of s X, and one of ones."""
    rate = Split(-omega[None, None] * states.imag, omega[None, None] * states.real)
    one = jnp.ones_like(states.real[:1])
    rows = zip(states, rate, (one, jnp.zeros_like(one)), strict=True)
    return Split(*(jnp.concatenate(parts)[pushed] for parts in rows))


def _reciprocal(response: Split) -> Split:
    power = response.real * response.real + response.imag * response.imag
    return Split(response.real / power, -response.imag / power)


def _divide(left: Split, over: Split) -> Split:
    a, b = Split(*(x[:, :, None] for x in left)), Split(*(x[None] for x in over))
    return Split(a.real * b.real - a.imag * b.imag, a.real * b.imag + a.imag * b.real)


def _append_units(rows: Split) -> Split:
    """The unit vectors of the second axis below the rows."""
    _, width, frequencies = rows.real.shape
    unit = jnp.eye(width, dtype=rows.real.dtype)[:, :, None]
    unit = jnp.broadcast_to(unit, (width, width, frequencies))
    return Split(jnp.concatenate([rows.real, unit]), jnp.concatenate([rows.imag, 0 * unit]))


def _real_slopes(places: _Places, left: Split, right: Split, scale: Array, weights: Array) -> Array:
    a, b = _pick_factors(places, left, right)
    return (a.real * b.real - a.imag * b.imag) * _scale_inputs(places, scale, a) * weights[None]


def _imag_slopes(places: _Places, left: Split, right: Split, scale: Array, weights: Array) -> Array:
    a, b = _pick_factors(places, left, right)
    return (a.real * b.imag + a.imag * b.real) * _scale_inputs(places, scale, a) * weights[None]


def _pick_factors(places: _Places, left: Split, right: Split) -> tuple[Split, Split]:
    column, row = np.array(places.column), np.array(places.row)
    a, b = Split(*(part[column] for part in left)), Split(*(part[row] for part in right))
    return a, Split(*(part[:, None] for part in b))


def _scale_inputs(places: _Places, scale: Float[Array, " entries"], like: Split) -> Array:
    seen = _acts_on(places, like.real.shape[2]).T
    return jnp.where(seen, scale[:, None], 0.0)[:, None, :, None]


def _acts_on(places: _Places, inputs: int) -> Bool[np.ndarray, "inputs entries"]:
    return np.array([[each in (None, i) for each in places.source] for i in range(inputs)])


_Pairs = tuple[tuple[int, ...], tuple[int, ...]]


def _pairs(columns: int) -> _Pairs:
    """Each two columns once."""
    first, second = np.triu_indices(columns)
    return tuple(first.tolist()), tuple(second.tolist())


def _column_products(
    pairs: _Pairs, left: Split, square: Float[Array, "outputs inputs frequencies"]
) -> Split:
    """The sum of w^2 a b* over outputs, (pairs, inputs, frequencies); minus its imaginary part."""
    # Apart: XLA would share one large loop among threads that other fits keep busy.
    parts = (ft.partial(part, pairs) for part in (_real_products, _imag_products))
    return Split(*(no_fuse(part, left, square) for part in parts))


def _real_products(pairs: _Pairs, left: Split, square: Array) -> Array:
    real = jnp.zeros((), square.dtype)
    for o in range(len(square)):  # a plain sum is a fast loop, a reduction is not
        a, b = (Split(*(part[np.array(k), o] for part in left)) for k in pairs)
        real = real + square[o][None] * (a.real * b.real + a.imag * b.imag)
    return real


def _imag_products(pairs: _Pairs, left: Split, square: Array) -> Array:
    imag = jnp.zeros((), square.dtype)
    for o in range(len(square)):
        a, b = (Split(*(part[np.array(k), o] for part in left)) for k in pairs)
        imag = imag + square[o][None] * (a.real * b.imag - a.imag * b.real)
    return imag


def _row_products(right: Split) -> Float[Array, "inputs pairs parts"]:
    """a b* of each row with each other, as a matrix of rows."""
    a, b = Split(*(x[:, None] for x in right)), Split(*(x[None] for x in right))
    real = a.real * b.real + a.imag * b.imag
    imag = a.imag * b.real - a.real * b.imag
    return _in_line(Split(*(x.reshape(-1, *x.shape[2:]) for x in (real, imag))))


def _pulls(left: Split, pull: Split) -> Float[Array, "inputs columns parts"]:
    """The sum of a r* over outputs, its real part and minus its imaginary one."""
    real = imag = jnp.zeros((), pull.real.dtype)
    for o in range(len(pull.real)):
        a, r = Split(*(x[:, o] for x in left)), Split(*(x[o][None] for x in pull))
        real = real + (a.real * r.real + a.imag * r.imag)
        imag = imag + (a.real * r.imag - a.imag * r.real)
    return _in_line(Split(real, imag))


def _in_line(vectors: Split) -> Float[Array, "inputs vectors parts"]:
    return jnp.concatenate([jnp.moveaxis(part, 1, 0) for part in vectors], axis=-1)


def _contract(
    one: Float[Array, "inputs some parts"], other: Float[Array, "inputs others parts"]
) -> Float[Array, "inputs products"]:
    found = jnp.einsum("isp,iop->iso", one, other, precision="highest")
    return found.reshape(len(found), -1)


def _products_of_entries(
    places: _Places, columns: int, found: Float[Array, "inputs products"]
) -> Float[Array, "entries entries"]:
    """The sums over inputs of the products of each two entries, alike in either order."""
    number = np.zeros((columns, columns), int)
    number[_pairs(columns)] = np.arange(len(_pairs(columns)[0]))
    column, row, rows = np.array(places.column), np.array(places.row), max(places.row) + 1
    code = column * rows + row
    earlier, later = np.minimum(code[:, None], code), np.maximum(code[:, None], code)
    pair = number[earlier // rows, later // rows]
    index = (pair * rows + earlier % rows) * rows + later % rows
    both = [np.outer(mine, mine) for mine in _acts_on(places, len(found))]
    return _sum_inputs(found, index, both)


def _sum_inputs(
    found: Float[Array, "inputs products"],
    index: Int[np.ndarray, "*entries"],
    seen: Sequence[Bool[np.ndarray, "*entries"]],
) -> Float[Array, "*entries"]:
    terms = [jnp.where(mine, part[index], 0.0) for part, mine in zip(found, seen, strict=True)]
    return ft.reduce(jnp.add, terms)


def _pulls_of_entries(
    places: _Places, found: Float[Array, "inputs products"]
) -> Float[Array, " entries"]:
    """The sums over inputs of the products of each entry and the misfit."""
    index = np.array(places.column) * (max(places.row) + 1) + np.array(places.row)
    return _sum_inputs(found, index, list(_acts_on(places, len(found))))
