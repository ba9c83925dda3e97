"""How a state-space response changes with single entries of its matrices, without a derivative.

With the resolvent R, the states X = R G and L = (H0 + s H1) R, the response L G changes with
F[p][q] by L[:, p] X[q, :], one column times one row; and so with all the others.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._xla import no_fuse

from ._response import Matrices, output_of, solve_states, Split


class Entry(NamedTuple):
    """One number of a `StateSpace`: `F[0][1]` is ("F", 0, 1), `input_delay[2]` has column 0."""

    field: str
    row: int
    column: int


class Slopes(NamedTuple):
    """One column, one row and one pattern of delays for each entry."""

    left: Split  # (entries, outputs, frequencies)
    right: Split  # (entries, inputs, frequencies)
    late: Float[np.ndarray, "entries outputs inputs"]  # 1 where the entry is a delay of the pair


def logarithmic_slopes(
    matrices: Matrices, omega: Float[Array, " frequencies"], entries: Sequence[Entry]
) -> tuple[Split, Split]:
    """The response T, and d ln T by each entry: (entries, outputs, inputs, frequencies).

    Both without a look at rounding near a pole; the slope of a response of 0 is not finite.
    """
    found = solve_states(matrices, omega)
    seen, undelayed = (output_of(matrices, omega, x) for x in (found.resolvent, found.states))
    picked = _pick_vectors(entries, seen, found.states, omega)
    delays = picked.late[..., None] * omega[None, None, None]
    over = no_fuse(_reciprocal, undelayed)
    return found.value, no_fuse(_relative_slopes, picked.left, picked.right, over, delays)


def _reciprocal(response: Split) -> Split:
    power = response.real * response.real + response.imag * response.imag
    return Split(response.real / power, -response.imag / power)


def _relative_slopes(left: Split, right: Split, over: Split, delays: Array) -> Split:
    a, b = Split(*(x[:, :, None] for x in left)), Split(*(x[:, None] for x in right))
    change = Split(a.real * b.real - a.imag * b.imag, a.real * b.imag + a.imag * b.real)
    over = Split(*(x[None] for x in over))
    return Split(
        change.real * over.real - change.imag * over.imag,
        change.real * over.imag + change.imag * over.real - delays,
    )


def _pick_vectors(
    entries: Sequence[Entry], seen: Split, states: Split, omega: Float[Array, " frequencies"]
) -> Slopes:
    """Columns from L and unit vectors, rows from X, s X and unit vectors."""
    (outputs, count, _), inputs = seen.real.shape, states.real.shape[1]
    rate = Split(-omega[None, None] * states.imag, omega[None, None] * states.real)
    left = _append_units(Split(*(jnp.moveaxis(part, 1, 0) for part in seen)))
    right = _append_units(Split(*map(jnp.concatenate, zip(states, rate, strict=True))))
    column, row, sign = np.array([_find_vectors(entry, count) for entry in entries]).T
    sign = jnp.asarray(sign, omega.dtype)[:, None, None]
    late = np.zeros((len(entries), outputs, inputs))
    for k, (field, which, _) in enumerate(entries):
        if field == "input_delay":
            late[k, :, which] = 1
        elif field == "output_delay":
            late[k, which] = 1
    columns, rows = (Split(*(x[at] for x in y)) for at, y in ((column, left), (row, right)))
    return Slopes(Split(*(sign * x for x in columns)), rows, late)


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
