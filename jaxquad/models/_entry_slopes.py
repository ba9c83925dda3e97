"""How a state-space response changes with single entries of its matrices, without a derivative.

With the resolvent R, the states X = R G and L = (H0 + s H1) R, the response L G changes with
F[p][q] by L[:, p] X[q, :], one column times one row; and so with all the others.
"""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._xla import no_fuse

from ._response import inverse_by_diagonal, Matrices, output_of, solve_states, Split


class Entry(NamedTuple):
    """One number of a `StateSpace`: `F[0][1]` is ("F", 0, 1), `input_delay[2]` has column 0."""

    field: str
    row: int
    column: int


class _Factors(NamedTuple):
    """What slopes are products of, each vector once."""

    left: Split  # (columns, outputs, inputs, frequencies), relative to the response
    right: Split  # (rows, inputs, frequencies)
    scale: Float[Array, " entries"]  # 0 for a delay
    late: Float[Array, "entries outputs inputs"]  # scale where the entry is a delay of the pair


class _Places(NamedTuple):
    """Which column and which row belong to each entry: hashed, to be known when compiling."""

    column: tuple[int, ...]
    row: tuple[int, ...]


def logarithmic_slopes(
    matrices: Matrices,
    omega: Float[Array, " frequencies"],
    entries: Sequence[Entry],
    scale: Float[Array, " entries"],
    weights: Split,
) -> tuple[Split, Split]:
    """The response T, and the slopes of ln T: (entries, outputs, inputs, frequencies).

    They are those by each entry times its `scale`, the real and the imaginary part times `weights`.
    Both without a look at rounding near a pole; the slope of a response of 0 is not finite.
    """
    found = solve_states(matrices, omega, inverse_by_diagonal)
    seen, undelayed = (output_of(matrices, omega, x) for x in (found.resolvent, found.states))
    factors, places = _make_factors(entries, scale, seen, found.states, undelayed, omega)
    real = no_fuse(ft.partial(_real_slopes, places), factors, weights.real)
    return found.value, Split(
        real, no_fuse(ft.partial(_imag_slopes, places), factors, omega, weights.imag)
    )


def _real_slopes(places: _Places, factors: _Factors, weights: Array) -> Array:
    a, b = _pick_factors(places, factors)
    scale = factors.scale[:, None, None, None]
    return (a.real * b.real - a.imag * b.imag) * scale * weights[None]


def _imag_slopes(places: _Places, factors: _Factors, omega: Array, weights: Array) -> Array:
    a, b = _pick_factors(places, factors)
    scale, delays = (
        factors.scale[:, None, None, None],
        factors.late[..., None] * omega[None, None, None],
    )
    return ((a.real * b.imag + a.imag * b.real) * scale - delays) * weights[None]


def _pick_factors(places: _Places, factors: _Factors) -> tuple[Split, Split]:
    column, row = np.array(places.column), np.array(places.row)
    left = Split(*(part[column] for part in factors.left))
    return left, Split(*(part[row][:, None] for part in factors.right))


def _make_factors(
    entries: Sequence[Entry],
    scale: Float[Array, " entries"],
    seen: Split,
    states: Split,
    undelayed: Split,
    omega: Float[Array, " frequencies"],
) -> tuple[_Factors, _Places]:
    """Columns from L and unit vectors, rows from X, s X and unit vectors."""
    (outputs, count, _), inputs = seen.real.shape, states.real.shape[1]
    rate = Split(-omega[None, None] * states.imag, omega[None, None] * states.real)
    left = _append_units(Split(*(jnp.moveaxis(part, 1, 0) for part in seen)))
    right = _append_units(Split(*map(jnp.concatenate, zip(states, rate, strict=True))))
    columns, rows, signs = np.array([_find_vectors(entry, count) for entry in entries]).T
    late = np.zeros((len(entries), outputs, inputs))
    for k, (field, which, _) in enumerate(entries):
        if field == "input_delay":
            late[k, :, which] = 1
        elif field == "output_delay":
            late[k, which] = 1
    (used, column), (pushed, row) = (np.unique(x, return_inverse=True) for x in (columns, rows))
    left, right = (Split(*(x[at] for x in y)) for at, y in ((used, left), (pushed, right)))
    relative = no_fuse(_divide, left, no_fuse(_reciprocal, undelayed))
    places = _Places(tuple(column.tolist()), tuple(row.tolist()))
    signs, delays = (jnp.asarray(x, scale.dtype) for x in (signs, late))
    return _Factors(relative, right, signs * scale, delays * scale[:, None, None]), places


def _reciprocal(response: Split) -> Split:
    power = response.real * response.real + response.imag * response.imag
    return Split(response.real / power, -response.imag / power)


def _divide(left: Split, over: Split) -> Split:
    a, b = Split(*(x[:, :, None] for x in left)), Split(*(x[None] for x in over))
    return Split(a.real * b.real - a.imag * b.imag, a.real * b.imag + a.imag * b.real)


def _find_vectors(entry: Entry, count: int) -> tuple[int, int, int]:
    """Which column, which row and with which sign; a delay has none of its own."""
    _, row, column = entry
    places = {
        "F": (row, column, 1),
        "G": (row, 2 * count + column, 1),
        "H0": (count + row, column, 1),
        "H1": (count + row, count + column, 1),
        "M": (row, count + column, -1),
    }
    return places.get(entry.field, (0, 0, 0))


def _append_units(rows: Split) -> Split:
    """The unit vectors of the second axis below the rows."""
    _, width, frequencies = rows.real.shape
    unit = jnp.eye(width, dtype=rows.real.dtype)[:, :, None]
    unit = jnp.broadcast_to(unit, (width, width, frequencies))
    return Split(jnp.concatenate([rows.real, unit]), jnp.concatenate([rows.imag, 0 * unit]))
