"""The inverse of many small complex matrices at once, frequency on the last axis.

Complex arrays are split into real and imaginary parts: compilers make them fast loops over the
frequencies. No LAPACK: its threads can wait for each other under `vmap` on a machine of two cores.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Split(NamedTuple):
    """A stack of complex matrices in two parts, (rows, columns, frequencies) each."""

    real: Float[Array, "rows columns frequencies"]
    imag: Float[Array, "rows columns frequencies"]


Scales = tuple[Float[Array, "states frequencies"], Float[Array, "states frequencies"]]


def product(a: Split, b: Split) -> Split:
    """The matrix product at each frequency."""
    real = imag = jnp.zeros((), a.real.dtype)
    for k in range(a.real.shape[1]):  # a plain sum is a fast loop, a reduction is not
        left, right = Split(*(x[:, k, None] for x in a)), Split(*(x[k][None] for x in b))
        real = real + (left.real * right.real - left.imag * right.imag)
        imag = imag + (left.real * right.imag + left.imag * right.real)
    return Split(real, imag)


@jax.custom_jvp
def inverse(matrix: Split, scales: Scales) -> Split:
    """The inverse at each frequency, by Gauss-Jordan elimination with partial pivoting.

    Rows and columns are first scaled alike by `scales`, see `equilibrium`, so that the unit of a
    state does not matter. A pivot of zero becomes a very small one: the inverse is then huge, not
    undefined.
    Source: Higham, Accuracy and Stability of Numerical Algorithms, section 14.4.
    """
    rows, columns = scales
    scaled = Split(*(rows[:, None] * part * columns[None] for part in matrix))
    return Split(*(columns[:, None] * part * rows[None] for part in _exchange(scaled)))


@inverse.defjvp
def _inverse_jvp(primals, tangents):
    found = inverse(*primals)  # whatever the scales
    change = product(product(found, tangents[0]), found)
    return found, Split(-change.real, -change.imag)


def equilibrium(
    size: Float[Array, "states states frequencies"],
) -> tuple[Float[Array, "states frequencies"], Float[Array, "states frequencies"]]:
    # Ruiz: divide rows and columns by the square root of their largest element, several times.
    log = jnp.log2(size)
    rows = columns = jnp.zeros_like(size[0])
    for _ in range(_ROUNDS):
        current = log + rows[:, None] + columns[None]
        largest = jnp.max(current, axis=1), jnp.max(current, axis=0)
        by_row, by_column = (jnp.where(jnp.isfinite(x), x, 0) / 2 for x in largest)
        rows, columns = rows - by_row, columns - by_column
    return jnp.exp2(jnp.round(rows)), jnp.exp2(jnp.round(columns))


_ROUNDS = 5  # units 12 decades apart end within a factor of 2.4


def _exchange(matrix: Split) -> Split:
    # Each step exchanges one unknown with one right side, in place: what was the matrix from x to y
    # becomes that from y to x. Rows stay where they are and are put in order at the end.
    states, _, frequencies = matrix.real.shape
    unused = jnp.ones((states, frequencies), matrix.real.dtype)

    def step(carry, k):
        table, unused = carry
        row = _pivot_row(table, unused, k)
        return (_exchanged(table, row, k), jnp.where(_is(row, states), 0, unused)), row

    (table, _), row = jax.lax.scan(step, (matrix, unused), jnp.arange(states))
    # Column k belongs to the right side row[k], and row[k] holds the unknown k.
    number = jnp.arange(states)
    place = jnp.sum(jnp.where(row[:, None] == number[None, :, None], number[:, None, None], 0), 0)
    index = (row[:, None] * states + place[None]).reshape(-1, frequencies)
    order = lambda part: _taken(part.reshape(-1, frequencies), index, 0).reshape(part.shape)
    return Split(order(table.real), order(table.imag))


def _pivot_row(
    table: Split, unused: Float[Array, "states frequencies"], k: Int[Array, ""]
) -> Int[Array, " frequencies"]:
    real, imag = _column(table, k)
    size = (real * real + imag * imag) * unused - (1 - unused)
    states = len(size)
    best = size == jnp.max(size, axis=0, keepdims=True)
    # The last row as a fallback keeps the index valid where everything is NaN.
    return jnp.min(jnp.where(best, jnp.arange(states)[:, None], states - 1), axis=0)


def _exchanged(table: Split, row: Int[Array, " frequencies"], k: Int[Array, ""]) -> Split:
    states = len(table.real)
    mine, diagonal = _is(row, states), (jnp.arange(states) == k)[:, None]
    pivots = [_taken(part, row[None, None], 0)[0] for part in table]
    here = [jax.lax.dynamic_index_in_dim(part, k) for part in pivots]
    real, imag = _reciprocal(*here)
    a, b = jnp.where(diagonal, 1, pivots[0]), jnp.where(diagonal, 0, pivots[1])
    scaled = Split((a * real - b * imag)[None], (a * imag + b * real)[None])
    column = _column(table, k)
    column = Split(
        jnp.where(mine, -1, column.real)[:, None], jnp.where(mine, 0, column.imag)[:, None]
    )
    kept = jnp.where(mine[:, None] | diagonal[None], 0, jnp.ones((), a.dtype))
    step = (
        column.real * scaled.real - column.imag * scaled.imag,
        column.real * scaled.imag + column.imag * scaled.real,
    )
    return Split(kept * table.real - step[0], kept * table.imag - step[1])


def _reciprocal(
    real: Float[Array, "1 frequencies"], imag: Float[Array, "1 frequencies"]
) -> tuple[Float[Array, "1 frequencies"], Float[Array, "1 frequencies"]]:
    tiny = float(jnp.finfo(real.dtype).eps) ** 2
    power = real * real + imag * imag
    zero = power < tiny**2
    real, power = jnp.where(zero, tiny, real), jnp.where(zero, tiny**2, power)
    return real / power, -imag / power


def _column(table: Split, k: Int[Array, ""]) -> Split:
    return Split(*(jax.lax.dynamic_index_in_dim(part, k, 1, keepdims=False) for part in table))


def _is(row: Int[Array, " frequencies"], states: int) -> Array:
    return jnp.arange(states)[:, None] == row[None]


def _taken(x: Array, index: Array, axis: int) -> Array:
    shape = list(x.shape)
    shape[axis] = index.shape[axis]
    index = jnp.broadcast_to(index, shape)
    return jnp.take_along_axis(x, index, axis=axis, mode="promise_in_bounds")
