import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from jaxquad._compile import no_fuse

from ._vector_functions import sincos


class Split(NamedTuple):
    """A stack of complex matrices in two parts, (rows, columns, frequencies) each."""

    real: Float[Array, "rows columns frequencies"]
    imag: Float[Array, "rows columns frequencies"]


Scales = tuple[Float[Array, "states frequencies"], Float[Array, "states frequencies"]]


def _product(a: Split, b: Split) -> Split:
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
    result = _invert_in_place(Split(*(rows[:, None] * part * columns[None] for part in matrix)))
    return Split(*(columns[:, None] * part * rows[None] for part in result))


@inverse.defjvp
def _inverse_jvp(primals, tangents):
    result = inverse(*primals)  # whatever the scales
    change = _product(_product(result, tangents[0]), result)
    return result, Split(-change.real, -change.imag)


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


def _invert_in_place(matrix: Split) -> Split:
    # Each step exchanges one unknown with one right side, in place: what was the matrix from x to y
    # becomes that from y to x. Rows stay where they are and are put in order at the end.
    states, _, frequencies = matrix.real.shape
    unused = jnp.ones((states, frequencies), matrix.real.dtype)

    number = jnp.arange(states)

    def step(carry, k):
        table, unused = carry
        column = Split(
            *(jax.lax.dynamic_index_in_dim(part, k, 1, keepdims=False) for part in table)
        )
        size = (column.real * column.real + column.imag * column.imag) * unused - (1 - unused)
        best = size == jnp.max(size, axis=0, keepdims=True)
        # The last row as a fallback keeps the index valid where everything is NaN.
        row = jnp.min(jnp.where(best, number[:, None], states - 1), axis=0)
        pivots = Split(*(_take_along(part, row[None, None], 0)[0] for part in table))
        is_pivot = number[:, None] == row[None]
        table = _exchange(table, pivots, column, is_pivot, k)
        return (table, jnp.where(is_pivot, 0, unused)), row

    (table, _), row = jax.lax.scan(step, (matrix, unused), jnp.arange(states))
    # Column k belongs to the right side row[k], and row[k] holds the unknown k.
    place = jnp.sum(jnp.where(row[:, None] == number[None, :, None], number[:, None, None], 0), 0)
    index = (row[:, None] * states + place[None]).reshape(-1, frequencies)
    order = lambda part: _take_along(part.reshape(-1, frequencies), index, 0).reshape(part.shape)
    return Split(order(table.real), order(table.imag))


def _exchange(table: Split, row: Split, column: Split, is_pivot: Array, k: Int[Array, ""]) -> Split:
    """Unknown k against the right side of a `row`, which is where `is_pivot` says."""
    diagonal = (jnp.arange(len(table.real)) == k)[:, None]
    # The reciprocal of the pivot.
    real, imag = (jax.lax.dynamic_index_in_dim(part, k) for part in row)
    tiny = float(jnp.finfo(real.dtype).eps) ** 2
    power = real * real + imag * imag
    zero = power < tiny**2
    real, power = jnp.where(zero, tiny, real), jnp.where(zero, tiny**2, power)
    real, imag = real / power, -imag / power
    a, b = jnp.where(diagonal, 1, row.real), jnp.where(diagonal, 0, row.imag)
    scaled = Split((a * real - b * imag)[None], (a * imag + b * real)[None])
    column = Split(
        jnp.where(is_pivot, -1, column.real)[:, None], jnp.where(is_pivot, 0, column.imag)[:, None]
    )
    kept = jnp.where(is_pivot[:, None] | diagonal[None], 0, jnp.ones((), a.dtype))
    step = (
        column.real * scaled.real - column.imag * scaled.imag,
        column.real * scaled.imag + column.imag * scaled.real,
    )
    return Split(kept * table.real - step[0], kept * table.imag - step[1])


def _take_along(x: Array, index: Array, axis: int) -> Array:
    shape = list(x.shape)
    shape[axis] = index.shape[axis]
    index = jnp.broadcast_to(index, shape)
    return jnp.take_along_axis(x, index, axis=axis, mode="promise_in_bounds")


class Matrices(NamedTuple):
    """What a `StateSpace` holds; None stands for an M of ones, for no H1 and for no delay."""

    F: Float[Array, "states states"]
    G: Float[Array, "states inputs"]
    H0: Float[Array, "outputs states"]
    H1: Float[Array, "outputs states"] | None
    M: Float[Array, "states states"] | None
    late: Float[Array, "outputs inputs"] | None  # s, of input and output together


@jax.custom_jvp
def response(matrices: Matrices, omega: Float[Array, " frequencies"]) -> Split:
    """(H0 + s H1) (s M - F)^-1 G exp(-s late); rows are outputs and columns inputs.

    Infinite, with an undefined phase, where a pole lies so near that more than a hundredth of the
    states may be rounding. Source: Tischler & Remple, eq. 12.11 and 12.12.
    """
    return _mark_rounding(matrices, omega, _solve_states(matrices, omega))


class Solved(NamedTuple):
    """The response and what it is made of."""

    value: Split  # (outputs, inputs, frequencies), rounding or not
    resolvent: Split  # R = (s M - F)^-1
    states: Split  # X = R G
    scales: Scales


def _solve_states(matrices: Matrices, omega: Float[Array, " frequencies"]) -> Solved:
    """The response without a look at its rounding error."""
    # Scales from the geometric mean of the frequencies: units know no frequency.
    middle = jnp.exp(jnp.mean(jnp.log(jnp.where(omega > 0, omega, 1.0))))[None]
    shape = (len(matrices.F), omega.size)
    real, imag = _pencil(matrices, middle)
    rows, columns = equilibrium(jnp.maximum(jnp.abs(real), jnp.abs(imag)))
    scales = jax.lax.stop_gradient(
        (jnp.broadcast_to(rows, shape), jnp.broadcast_to(columns, shape))
    )
    resolvent = inverse(_pencil(matrices, omega), scales)
    states = Split(*(no_fuse(_multiply_columns, part, matrices.G) for part in resolvent))
    value = _apply_delay(_output_of(matrices, omega, states), matrices.late, omega)
    return Solved(value, resolvent, states, scales)


def _mark_rounding(
    matrices: Matrices, omega: Float[Array, " frequencies"], solved: Solved
) -> Split:
    lost = _is_rounding(*jax.lax.stop_gradient((matrices, omega, solved)))
    real, imag = solved.value
    return Split(jnp.where(lost, jnp.inf, real), jnp.where(lost, jnp.nan, imag))


@ft.partial(response.defjvp, symbolic_zeros=True)
def _response_jvp(primals, tangents):
    # With the states X = R G and L = (H0 + s H1) R, both small, instead of the products R dF R:
    # dT = L (dG + dF X - d(s M) X) + d(H0 + s H1) X, late, and -j d(omega late) T.
    matrices, omega = primals
    # None for tangents that are known to be zero.
    absent = lambda x: isinstance(x, SymbolicZero)
    d, d_omega = jax.tree.map(lambda x: None if absent(x) else x, tangents, is_leaf=absent)
    solved = _solve_states(matrices, omega)
    value, states = _mark_rounding(matrices, omega, solved), solved.states
    rate = _derivative(states, omega)
    push = [_multiply(d.F, states), _negative(_multiply(d.M, rate))]
    if d.G is not None:
        real = jnp.broadcast_to(d.G[:, :, None], states.real.shape)
        push.append(Split(real, jnp.zeros_like(states.imag)))
    change = [_multiply(d.H0, states), _multiply(d.H1, rate)]
    if d_omega is not None:
        turned = _derivative(states, d_omega)
        push.append(_negative(turned if matrices.M is None else _multiply(matrices.M, turned)))
        change.append(_multiply(matrices.H1, turned))
    pushed = _add_present(push)
    if pushed is not None:
        change.append(no_fuse(_product, _output_of(matrices, omega, solved.resolvent), pushed))
    changed = _add_present(change)
    moved = [None if changed is None else _apply_delay(changed, matrices.late, omega)]
    for late, frequency in ((d.late, omega), (matrices.late, d_omega)):
        if late is not None and frequency is not None:
            angle = late[:, :, None] * frequency[None, None]
            moved.append(Split(angle * value.imag, -angle * value.real))
    return value, _add(Split(*(jnp.zeros_like(part) for part in value)), *moved)


def _apply_delay(parts: Split, late: Array | None, omega: Float[Array, " frequencies"]) -> Split:
    if late is None:
        return parts
    angle = late[:, :, None] * omega[None, None]
    (real, imag), (s, c) = parts, no_fuse(sincos, angle)
    return Split(real * c + imag * s, imag * c - real * s)


def _pencil(matrices: Matrices, omega: Float[Array, " frequencies"]) -> Split:
    F, M = matrices.F, matrices.M
    M = jnp.eye(len(F), dtype=F.dtype) if M is None else M
    shape = (*F.shape, omega.size)
    return Split(jnp.broadcast_to(-F[:, :, None], shape), M[:, :, None] * omega[None, None])


def _output_of(matrices: Matrices, omega: Float[Array, " frequencies"], states: Split) -> Split:
    """(H0 + s H1) times `states`, or times the resolvent."""
    rates = _multiply(matrices.H1, _derivative(states, omega))
    return _add(_multiply_real(matrices.H0, states), rates)


def _is_rounding(
    matrices: Matrices, omega: Float[Array, " frequencies"], solved: Solved
) -> Bool[Array, "outputs inputs frequencies"]:
    # A first-order bound of the rounding error in the states, beside the largest state in the
    # units that make the equations alike; and what only a pivot of zero can make so large.
    row, unit = (scale[:, None] for scale in solved.scales)
    size, gain = (jnp.abs(x.real) + jnp.abs(x.imag) for x in (solved.states, solved.resolvent))
    mass = size if matrices.M is None else _dot(jnp.abs(matrices.M), size)
    terms = _dot(jnp.abs(matrices.F), size) + omega[None, None] * mass
    error = sum(gain[:, k, None] * terms[k][None] for k in range(len(gain)))
    limit = 0.01 / float(jnp.finfo(omega.dtype).eps)
    push = jnp.max(row * jnp.abs(matrices.G)[:, :, None], axis=0, keepdims=True)
    doubtful = ~(error / unit <= limit * jnp.max(size / unit, axis=0, keepdims=True))
    doubtful = doubtful | (size / unit > limit**1.5 * push)
    H = [jnp.abs(matrix) for matrix in (matrices.H0, matrices.H1) if matrix is not None]
    measured = sum(H[1:], H[0]) > 0
    by_state = [measured[:, k, None, None] & doubtful[k][None] for k in range(len(doubtful))]
    return ft.reduce(jnp.logical_or, by_state)


def _derivative(states: Split, omega: Float[Array, " frequencies"]) -> Split:
    factor = omega[None, None]
    return Split(-factor * states.imag, factor * states.real)


def _multiply(matrix: Array | None, states: Split) -> Split | None:
    return None if matrix is None else _multiply_real(matrix, states)


def _multiply_real(matrix: Array, states: Split) -> Split:
    """A real matrix times both parts, in one product."""
    both = jnp.concatenate(states, axis=1)
    product, inputs = _dot(matrix, both), states.real.shape[1]
    return Split(product[:, :inputs], product[:, inputs:])


def _negative(parts: Split | None) -> Split | None:
    return None if parts is None else Split(-parts.real, -parts.imag)


def _add_present(terms: Sequence[Split | None]) -> Split | None:
    present = [term for term in terms if term is not None]
    return _add(*present) if present else None


def _add(first: Split, *others: Split | None) -> Split:
    """The sum, without what is None."""
    present = [term for term in others if term is not None]
    return ft.reduce(lambda a, b: Split(a.real + b.real, a.imag + b.imag), present, first)


def _multiply_columns(array: Array, matrix: Array) -> Array:
    terms = [array[:, k, None] * matrix[k][None, :, None] for k in range(len(matrix))]
    return ft.reduce(jnp.add, terms)


def _dot(matrix: Array, array: Array) -> Array:
    return jnp.einsum("ij,jkf->ikf", matrix, array, precision="highest")
