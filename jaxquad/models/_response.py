"""What CPUs compute eight at a time: sines, arctangents, responses in real arithmetic."""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from jaxquad._compile import no_fuse


Numbers = Array | np.ndarray  # constants of a traced function are NumPy's
Angles = Float[Numbers, "*shape"]
Omega = Float[Array, " frequencies"]  # rad/s
ByState = Float[Array, "states frequencies"]

# sin x = x + x^3 (c0 + c1 x^2 + ...) on -pi/2 to pi/2, minimax in the relative error: 3e-19, and
# 6e-9 in single precision. pi as a sum of terms of so few bits that whole multiples are exact.
_DOUBLE = (
    -0.166666666666666656,
    8.33333333333319405e-3,
    -1.9841269841209131e-4,
    2.75573192111224691e-6,
    -2.50521068714565771e-8,
    1.60589396382709149e-10,
    -7.64298972232153102e-13,
    2.72115623198655615e-15,
)
_PI_DOUBLE = tuple(
    map(float.fromhex, ("0x1.921fb544p+1", "0x1.0b4611a6p-33", "0x1.3198a2e037073p-68"))
)
_SINGLE = (
    -0.166666595440576413,
    8.33306607232267338e-3,
    -1.98095894606002282e-4,
    2.60574945504259035e-6,
)
_PI_SINGLE = tuple(map(float.fromhex, ("0x1.92p+1", "0x1.fb4p-11", "0x1.4442d18469899p-23")))
_PER_PI = 0.3183098861837907


@jax.custom_jvp
def sincos(x: Angles) -> tuple[Angles, Angles]:
    """Sine and cosine of angles in rad, by short polynomials that a CPU computes 8 at a time.

    For loops of many small steps, where the library functions cost several times as much. Within
    1.4 units of rounding of 1, up to 1e9 rad (1e6 in single precision, where large angles need
    fused products and sums, as optimised code has them); nan beyond. Differentiable to any order.
    """
    x = checkpoint_name(x, "sincos")  # by which a kernel of a GPU knows it
    x = jnp.where(jnp.abs(x) <= (1e6 if x.dtype == jnp.float32 else 1e9), x, jnp.nan)
    near, below = jnp.round(x * _PER_PI), jnp.floor(x * _PER_PI)
    return _sign(near) * _near(x, near), -_sign(below) * _near(x, below + 0.5)


@sincos.defjvp
def _sincos_jvp(primals, tangents):
    (x,), (dx,) = primals, tangents
    sine, cosine = sincos(x)
    return (sine, cosine), (cosine * dx, -sine * dx)


def _near(x: Angles, turns: Angles) -> Angles:
    """The sine of x - turns pi, which is a quarter turn at most."""
    single = x.dtype == jnp.float32
    terms, coefficients = (_PI_SINGLE, _SINGLE) if single else (_PI_DOUBLE, _DOUBLE)
    for term in terms:
        x = x - turns * term
    square = x * x
    series = coefficients[-1] * square
    for coefficient in coefficients[-2::-1]:
        series = (series + coefficient) * square
    return x + x * series


def _sign(turns: Angles) -> Angles:
    """1 for even numbers, -1 for odd ones."""
    half = 0.5 * turns
    return 1 - 4 * (half - jnp.floor(half))


# arctan x = x + x^3 P(x^2) / Q(x^2) to tan(pi / 8); Moshier, Methods and Programs for Mathematical
# Functions (Cephes): 2e-16.
_ABOVE = (
    -0.8750608600031904122785,
    -16.15753718733365076637,
    -75.00855792314704667340,
    -122.8866684490136173410,
    -64.85021904942025371773,
)
_BELOW = (
    1.0,
    24.85846490142306297962,
    165.0270098316988542046,
    432.8810604912902668951,
    485.3903996359136964868,
    194.5506571482613964425,
)
_EIGHTH = 0.4142135623730951  # tan(pi / 8)


def arctan2(y: Angles, x: Angles) -> Angles:
    """The angle of (x, y) in rad, within 4e-16 of `jnp.arctan2` in double precision.

    0 at the origin and nan where both are infinite; the sign of a zero does not count.
    """
    high, wide = jnp.abs(y), jnp.abs(x)
    small, large = jnp.minimum(high, wide), jnp.maximum(high, wide)
    steep = small > _EIGHTH * large
    above = jnp.where(steep, small - large, small)
    below = jnp.where(steep, small + large, jnp.where(large == 0, 1.0, large))
    tangent = above / below
    square = tangent * tangent
    series = square * _polynomial(_ABOVE, square) / _polynomial(_BELOW, square)
    angle = tangent + tangent * series
    angle = jnp.where(steep, angle + np.pi / 4, angle)
    angle = jnp.where(high > wide, np.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, np.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)


def _polynomial(coefficients: tuple[float, ...], x: Angles) -> Angles:
    value = jnp.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        value = value * x + coefficient
    return value


class Split(NamedTuple):
    """A stack of complex matrices in two parts, (rows, columns, frequencies) each."""

    real: Float[Array, "rows columns frequencies"]
    imag: Float[Array, "rows columns frequencies"]


Scales = tuple[ByState, ByState]


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


def equilibrium(size: Float[Array, "states states frequencies"]) -> tuple[ByState, ByState]:
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
    unused, number = jnp.ones((states, frequencies), matrix.real.dtype), jnp.arange(states)
    tiny = float(jnp.finfo(matrix.real.dtype).eps) ** 2

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
        # Unknown k against the right side of the row, by the reciprocal of the pivot.
        diagonal = (number == k)[:, None]
        real, imag = (jax.lax.dynamic_index_in_dim(part, k) for part in pivots)
        power = real * real + imag * imag
        zero = power < tiny**2
        real, power = jnp.where(zero, tiny, real), jnp.where(zero, tiny**2, power)
        real, imag = real / power, -imag / power
        a, b = jnp.where(diagonal, 1, pivots.real), jnp.where(diagonal, 0, pivots.imag)
        scaled = Split((a * real - b * imag)[None], (a * imag + b * real)[None])
        left = Split(
            jnp.where(is_pivot, -1, column.real)[:, None],
            jnp.where(is_pivot, 0, column.imag)[:, None],
        )
        kept = jnp.where(is_pivot[:, None] | diagonal[None], 0, jnp.ones((), a.dtype))
        table = Split(
            kept * table.real - (left.real * scaled.real - left.imag * scaled.imag),
            kept * table.imag - (left.real * scaled.imag + left.imag * scaled.real),
        )
        return (table, jnp.where(is_pivot, 0, unused)), row

    (table, _), row = jax.lax.scan(step, (matrix, unused), jnp.arange(states))
    # Column k belongs to the right side row[k], and row[k] holds the unknown k.
    place = jnp.sum(jnp.where(row[:, None] == number[None, :, None], number[:, None, None], 0), 0)
    index = (row[:, None] * states + place[None]).reshape(-1, frequencies)
    order = lambda part: _take_along(part.reshape(-1, frequencies), index, 0).reshape(part.shape)
    return Split(order(table.real), order(table.imag))


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
def response(matrices: Matrices, omega: Omega) -> Split:
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


def _solve_states(matrices: Matrices, omega: Omega) -> Solved:
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


def _mark_rounding(matrices: Matrices, omega: Omega, solved: Solved) -> Split:
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
    push = [_multiply(d.F, states), _multiply(d.M, _derivative(states, -omega))]
    if d.G is not None:
        real = jnp.broadcast_to(d.G[:, :, None], states.real.shape)
        push.append(Split(real, jnp.zeros_like(states.imag)))
    change = [_multiply(d.H0, states), _multiply(d.H1, _derivative(states, omega))]
    if d_omega is not None:
        turned = _derivative(states, -d_omega)
        push.append(turned if matrices.M is None else _multiply(matrices.M, turned))
        change.append(_multiply(matrices.H1, _derivative(states, d_omega)))
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


def _apply_delay(parts: Split, late: Array | None, omega: Omega) -> Split:
    if late is None:
        return parts
    angle = late[:, :, None] * omega[None, None]
    (real, imag), (s, c) = parts, no_fuse(sincos, angle)
    return Split(real * c + imag * s, imag * c - real * s)


def _pencil(matrices: Matrices, omega: Omega) -> Split:
    F, M = matrices.F, matrices.M
    M = jnp.eye(len(F), dtype=F.dtype) if M is None else M
    shape = (*F.shape, omega.size)
    return Split(jnp.broadcast_to(-F[:, :, None], shape), M[:, :, None] * omega[None, None])


def _output_of(matrices: Matrices, omega: Omega, states: Split) -> Split:
    """(H0 + s H1) times `states`, or times the resolvent."""
    rates = _multiply(matrices.H1, _derivative(states, omega))
    return _add(_multiply_real(matrices.H0, states), rates)


def _is_rounding(
    matrices: Matrices, omega: Omega, solved: Solved
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


def _derivative(states: Split, omega: Omega) -> Split:
    factor = omega[None, None]
    return Split(-factor * states.imag, factor * states.real)


def _multiply(matrix: Array | None, states: Split) -> Split | None:
    return None if matrix is None else _multiply_real(matrix, states)


def _multiply_real(matrix: Array, states: Split) -> Split:
    """A real matrix times both parts, in one product."""
    both = jnp.concatenate(states, axis=1)
    product, inputs = _dot(matrix, both), states.real.shape[1]
    return Split(product[:, :inputs], product[:, inputs:])


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
