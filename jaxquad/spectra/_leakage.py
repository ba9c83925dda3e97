"""Leakage through windows, apart from noise.

Behind a window w, y = g * x has the transform sum_n j^n / n! G^(n) X_n, with X_n that of x behind
the n-th derivative of w: the part beyond G X_0 is leakage, of the slope and the curvature of G. It
is the same in each draw of the noise, so the noise is what no combination of X_0, X_1, X_2 explains
over the windows of one length. Y_1 is added to these: poles outlast any series in the slopes of G,
but with them w y' = (w y)' - w' y has a transform that is linear in Y_1.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float


_RIDGE = 1e-12  # of the columns' size, so that empty ones do no harm
_WITHIN = 1e-6  # of its size: an output's slope that inputs explain so well adds nothing


Rows = Complex[np.ndarray, "frequencies windows _"]


class Slopes(NamedTuple):
    """Transforms behind the derivatives of the windows of one length."""

    first: Complex[np.ndarray, "frequencies _ channels"]  # derivative: inputs, then outputs
    second: Complex[np.ndarray, "frequencies _ inputs"]


class Rest(NamedTuple):
    """What is left of the outputs' windows, with what noise does there, for each window length.

    `products` are the sums of `conj(a) b` of what is left, `trace` is the energy that unit noise
    leaves, `bias` what the leakage adds to the response, and `doubt` the mean square of its error
    under unit noise.
    """

    products: Complex[np.ndarray, "frequencies outputs outputs groups"]
    trace: Float[np.ndarray, "frequencies outputs groups"]
    freedom: Float[np.ndarray, "frequencies outputs groups"]  # complex
    bias: Complex[np.ndarray, "frequencies outputs inputs groups"]
    doubt: Float[np.ndarray, "frequencies outputs inputs groups"]


def shows_leakage(windows: int, inputs: int) -> bool:
    """Whether there are enough windows of one length to tell leakage from noise."""
    return windows >= 3 * inputs + 3


def without_leakage(
    windows: Sequence[
        tuple[
            Complex[np.ndarray, "frequencies _ inputs"],
            Complex[np.ndarray, "frequencies _ outputs"],
        ]
    ],
    response: Complex[np.ndarray, "frequencies outputs inputs"],
    slopes: Sequence[Slopes],
    overlap: Float[np.ndarray, "windows windows"],
) -> Rest:
    """Outputs less all that inputs and leakage explain, one window length after the other.

    `windows` are the inputs and the outputs of each length. A length with too few windows for its
    leakage keeps it, as noise; its slopes do not matter.
    """
    found, first, gains = [], 0, np.swapaxes(response, 1, 2)
    for (x, y), (once, twice) in zip(windows, slopes, strict=True):
        count, inputs = x.shape[1:]
        columns, own = x, np.zeros_like(y)
        if shows_leakage(count, inputs):
            columns = np.concatenate([x, once[:, :, :inputs], twice], axis=2)
            own = once[:, :, inputs:]
        mine = slice(first, first + count)
        found.append(_least_squares(y - x @ gains, columns, own, overlap[mine, mine], inputs))
        first += count
    return Rest(*(np.stack(each, axis=-1) for each in zip(*found, strict=True)))


def _least_squares(
    left: Complex[np.ndarray, "frequencies windows outputs"],
    columns: Complex[np.ndarray, "frequencies windows columns"],
    own: Complex[np.ndarray, "frequencies windows outputs"],
    overlap: Float[np.ndarray, "windows windows"],
    inputs: int,
) -> tuple[np.ndarray, ...]:
    """`Rest` of one length: each output on columns, the inputs first, and on its `own` column.

    With P = P0 - q q^H the projection, P0 that of the common columns A, and O the overlap: the
    trace of P O, the degrees of freedom tr(P O)^2 / tr(P O P O).
    """
    adjoint = np.conj(np.swapaxes(columns, 1, 2))
    solver = _solver(adjoint @ columns)
    both = np.concatenate([left, own], axis=2)
    fitted = solver @ (adjoint @ both)
    both -= columns @ fitted
    both -= columns @ (solver @ (adjoint @ both))  # for the rounding of nearly dependent columns
    rest, q = np.split(both, 2, axis=2)
    length, whole = (np.sqrt(_inner(part, part)) for part in (q, own))
    inverse = np.where(length > _WITHIN * whole, 1 / np.maximum(length, 1e-300), 0.0)
    q = q * inverse[:, None]
    along = np.einsum("fwo,fwo->fo", np.conj(q), left)
    # The response took too much of the inputs: the first coefficients of what is left, less
    # `through` times those to `own`.
    taken, through = np.split(np.swapaxes(fitted[:, :inputs], 1, 2), 2, axis=1)
    through = through * inverse[:, :, None]
    seen = _Seen.of(adjoint, columns, q, overlap)
    return (
        cross_products(rest - q * along[:, None]),
        *_noise_left(solver, seen, overlap),
        through * along[:, :, None] - taken,
        _noise_in_rows(solver[:, :inputs], through, seen),
    )


def _solver(
    gram: Complex[np.ndarray, "frequencies columns columns"],
) -> Complex[np.ndarray, "frequencies columns columns"]:
    """The inverse of `gram`, with a ridge relative to the size of the columns."""
    power = np.real(np.diagonal(gram, axis1=1, axis2=2))
    inverse = 1 / np.maximum(np.sqrt(power), 1e-100)
    units = inverse[:, :, None] * inverse[:, None, :]
    return np.linalg.inv(gram * units + _RIDGE * np.eye(gram.shape[1])) * units


class _Seen(NamedTuple):
    """Products with the overlap O of the windows between the columns A and the rests q."""

    aa: Complex[np.ndarray, "frequencies columns columns"]  # A^H O A
    aa_twice: Complex[np.ndarray, "frequencies columns columns"]  # A^H O O A
    aq: Complex[np.ndarray, "frequencies columns outputs"]  # A^H O q
    qq: Float[np.ndarray, "frequencies outputs"]  # q^H O q, of each output
    qq_twice: Float[np.ndarray, "frequencies outputs"]  # q^H O O q

    @classmethod
    def of(
        cls,
        adjoint: Complex[np.ndarray, "frequencies columns windows"],
        columns: Complex[np.ndarray, "frequencies windows columns"],
        q: Complex[np.ndarray, "frequencies windows outputs"],
        overlap: Float[np.ndarray, "windows windows"],
    ) -> "_Seen":
        a, rest = _weigh(overlap, columns), _weigh(overlap, q)
        return cls(
            adjoint @ a,
            np.conj(np.swapaxes(a, 1, 2)) @ a,
            adjoint @ rest,
            _inner(q, rest),
            _inner(rest, rest),
        )


_ROWS = 16  # windows taken at once: few others overlap them


def _weigh(
    overlap: Float[np.ndarray, "windows windows"],
    columns: Rows,
) -> Rows:
    """The overlap of the windows times columns, in real arithmetic and near the diagonal only."""
    parts = np.ascontiguousarray(columns).view(float)
    weighed = np.empty_like(parts)
    for first in range(0, len(overlap), _ROWS):
        rows = slice(first, first + _ROWS)
        near = np.flatnonzero(np.any(overlap[rows], axis=0))
        band = slice(near[0], near[-1] + 1)
        np.matmul(overlap[rows, band], parts[:, band], out=weighed[:, rows])
    return weighed.view(complex)


def _noise_in_rows(
    to_x: Complex[np.ndarray, "frequencies inputs columns"],
    through: Complex[np.ndarray, "frequencies outputs inputs"],
    seen: _Seen,
) -> Float[np.ndarray, "frequencies outputs inputs"]:
    """Mean square that unit noise makes in the inputs' coefficients less `through` times q's."""
    plain = np.real(np.sum((to_x @ seen.aa) * np.conj(to_x), axis=2))
    crossed = np.swapaxes(to_x @ seen.aq, 1, 2)
    mixed = 2 * np.real(np.conj(through) * crossed)
    own = power_of(through) * seen.qq[:, :, None]
    return np.maximum(plain[:, None] - mixed + own, 0.0)


def _noise_left(
    solver: Complex[np.ndarray, "frequencies columns columns"],
    seen: _Seen,
    overlap: Float[np.ndarray, "windows windows"],
) -> tuple[Float[np.ndarray, "frequencies outputs"], Float[np.ndarray, "frequencies outputs"]]:
    """Trace and degrees of freedom of unit noise behind the projection."""
    once = solver @ seen.aa
    left = np.trace(overlap) - np.trace(once, axis1=1, axis2=2).real
    square = np.sum(overlap**2) - 2 * _trace(solver, seen.aa_twice) + _trace(once, once)
    crossed = seen.qq_twice - np.sum(np.conj(seen.aq) * (solver @ seen.aq), axis=1).real
    trace = left[:, None] - seen.qq
    freedom = trace**2 / (square[:, None] - 2 * crossed + seen.qq**2)
    return trace, np.maximum(freedom, 0.5)


def cross_products(
    rows: Complex[np.ndarray, "frequencies windows channels"],
) -> Complex[np.ndarray, "frequencies channels channels"]:
    """Sums of `conj(a) b` over windows."""
    return np.conj(np.swapaxes(rows, 1, 2)) @ rows


def power_of(x: Complex[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The square of the absolute value, which itself takes a library as long as ten products."""
    return np.real(x) ** 2 + np.imag(x) ** 2


def _inner(a: Rows, b: Rows) -> Float[np.ndarray, "frequencies _"]:
    """The real part of `conj(a) b`, summed over the windows."""
    parts = np.einsum("fwp,fwp->fp", a.view(float), b.view(float))
    return parts[:, ::2] + parts[:, 1::2]


def _trace(
    a: Complex[np.ndarray, "frequencies n n"], b: Complex[np.ndarray, "frequencies n n"]
) -> Float[np.ndarray, " frequencies"]:
    """The real part of the trace of the product."""
    return np.einsum("fab,fba->f", a, b).real
