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
from jaxtyping import Bool, Complex, Float


_RIDGE = 1e-12  # of the columns' size, so that empty ones do no harm
_SEEN = 1e-7  # of a residual: the square is below rounding
_WITHIN = 1e-6  # of its size: an output's slope that inputs explain so well adds nothing


Rows = Complex[np.ndarray, "frequencies _ windows"]
Gram = Complex[np.ndarray, "frequencies columns columns"]
Sizes = Float[np.ndarray, "frequencies _"]


class Slopes(NamedTuple):
    """Transforms behind the derivatives of the windows of one length."""

    first: Complex[np.ndarray, "frequencies _ channels"]  # derivative: inputs, then outputs
    second: Complex[np.ndarray, "frequencies _ inputs"]


class Rest(NamedTuple):
    """What is left of the outputs' windows, with what noise does there, for each window length.

    `products` are the sums of `conj(a) b` of what is left, `trace` is the energy that unit noise
    leaves, and `fits` are those of leakage.
    """

    products: Complex[np.ndarray, "frequencies outputs outputs groups"]
    trace: Float[np.ndarray, "frequencies outputs groups"]
    freedom: Float[np.ndarray, "frequencies outputs groups"]  # complex
    fits: "tuple[Fit, ...]"


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
    resolved: Bool[np.ndarray, "groups frequencies"],
) -> Rest:
    """Outputs less all that inputs and leakage explain, one window length after the other.

    `windows` are the inputs and the outputs of each length, which is looked at where it is
    `resolved`: from a frequency on, and the first everywhere. A length with too few windows for its
    leakage keeps it, as noise; its slopes do not matter.
    """
    found, first = [], 0
    for given, derived, known in zip(windows, slopes, resolved, strict=True):
        # What a window does not resolve lies below what it does, and has no weight.
        few = slice(int(np.argmax(known)), None)
        x, y, once, twice = (np.swapaxes(each[few], 1, 2) for each in (*given, *derived))
        inputs, count = x.shape[1:]
        columns, both = x, y - response[few] @ x
        if shows_leakage(count, inputs):
            columns = np.concatenate([x, once[:, :inputs], twice], axis=1)
            both = np.concatenate([both, once[:, inputs:]], axis=1)
        mine = slice(first, first + count)
        columns = np.ascontiguousarray(columns)
        found.append(_least_squares(both, columns, y.shape[1], overlap[mine, mine]))
        first += count
    *parts, fits = zip(*found, strict=True)
    products, trace, freedom = (_padded(each, len(response)) for each in parts)
    return Rest(products, np.where(trace > 0, trace, 1.0), np.maximum(freedom, 0.5), fits)


def _padded(parts: Sequence[np.ndarray], frequencies: int) -> np.ndarray:
    """Side by side, with zeros at the lowest frequencies that some lack."""
    whole = np.zeros((frequencies, *parts[0].shape[1:], len(parts)), parts[0].dtype)
    for k, part in enumerate(parts):
        whole[frequencies - len(part) :, ..., k] = part
    return whole


def _least_squares(
    both: Rows,
    columns: Complex[np.ndarray, "frequencies columns windows"],
    outputs: int,
    overlap: Float[np.ndarray, "windows windows"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, "Fit"]:
    """`Rest` of one length: each output on the columns, and on its own one behind it in `both`.

    With P = P0 - q q^H the projection, P0 that of the common columns A, and O the overlap: the
    trace of P O, the degrees of freedom tr(P O)^2 / tr(P O P O).
    """
    count, near, adjoint = columns.shape[1], _near(overlap), np.conj(columns)
    weighed = _weigh(near, columns)
    # One product of all: many small ones take as long to begin as to make.
    stacked = adjoint @ np.swapaxes(np.concatenate([columns, weighed, both], axis=1), 1, 2)
    gram, solver = stacked[:, :, :count], _solver(stacked[:, :, :count])
    fitted = solver @ stacked[:, :, 2 * count :]
    rest = both - np.swapaxes(fitted, 1, 2) @ columns
    whole, left = _size(both), _size(rest)
    if _shows_rounding(gram, solver, whole, left):
        rest -= np.swapaxes(solver @ (adjoint @ np.swapaxes(rest, 1, 2)), 1, 2) @ columns
        left = _size(rest)
    rest, q, length = rest[:, :outputs], rest[:, outputs:], left[:, outputs:]
    inverse = np.where(length > _WITHIN * whole[:, outputs:], 1 / np.maximum(length, 1e-300), 0.0)
    q = q * inverse[:, :, None]
    along = np.vecdot(q, rest[:, : q.shape[1]])
    if q.shape[1]:
        rest = rest - q * along[:, :, None]
    seen = _Seen.of(stacked[:, :, count : 2 * count], weighed, q, near)
    trace, freedom = _noise_left(solver, seen, overlap)
    if not q.shape[1]:
        trace, freedom = (np.repeat(each, outputs, axis=1) for each in (trace, freedom))
    products = np.conj(rest) @ np.swapaxes(rest, 1, 2)
    return products, trace, freedom, Fit(solver, fitted, inverse, along, seen)


def _solver(gram: Gram) -> Gram:
    """The inverse of `gram`, with a ridge relative to the size of the columns."""
    power = np.real(np.diagonal(gram, axis1=1, axis2=2))
    inverse = 1 / np.maximum(np.sqrt(power), 1e-100)
    units = inverse[:, :, None] * inverse[:, None, :]
    return np.linalg.inv(gram * units + _RIDGE * np.eye(gram.shape[1])) * units


def _shows_rounding(gram: Gram, solver: Gram, whole: Sizes, left: Sizes) -> bool:
    """Whether nearly dependent columns leave a part of themselves in what is left.

    It is orthogonal to all else, so its square counts.
    """
    least = np.real(np.diagonal(solver, axis1=1, axis2=2) * np.diagonal(gram, axis1=1, axis2=2))
    part = 2e-16 * np.max(least, axis=1, keepdims=True) * whole
    return bool(np.any(part > _SEEN * left))


class _Seen(NamedTuple):
    """Products with the overlap O of the windows between the columns A and the rests q."""

    aa: Gram  # A^H O A
    aa_twice: Gram  # A^H O O A
    aq: Complex[np.ndarray, "frequencies columns own"]  # A^H O q
    qq: Float[np.ndarray, "frequencies own"]  # q^H O q, of each output
    qq_twice: Float[np.ndarray, "frequencies own"]  # q^H O O q

    @classmethod
    def of(
        cls,
        aa: Gram,
        weighed: Complex[np.ndarray, "frequencies columns windows"],  # O A
        q: Complex[np.ndarray, "frequencies own windows"],
        near: "Sequence[_Near]",
    ) -> "_Seen":
        rest, count = _weigh(near, q), weighed.shape[1]
        found = np.conj(weighed) @ np.swapaxes(np.concatenate([weighed, q], axis=1), 1, 2)
        return cls(
            aa, found[:, :, :count], found[:, :, count:], _inner(q, rest), _inner(rest, rest)
        )


_FEW = 16  # windows taken at once: few others overlap them


class _Near(NamedTuple):
    """The overlap of a few windows with those that overlap them."""

    few: slice
    others: slice
    overlap: Complex[np.ndarray, "others few"]


def _near(overlap: Float[np.ndarray, "windows windows"]) -> list[_Near]:
    found = []
    for first in range(0, len(overlap), _FEW):
        few = slice(first, first + _FEW)
        places = np.flatnonzero(np.any(overlap[few], axis=0))
        others = slice(places[0], places[-1] + 1)
        found.append(_Near(few, others, overlap[others, few].astype(complex)))
    return found


def _weigh(near: Sequence[_Near], rows: Rows) -> Rows:
    """Rows times the overlap of the windows."""
    flat = rows.reshape(-1, rows.shape[2])
    weighed = np.empty_like(flat)
    for few, others, overlap in near:
        weighed[:, few] = flat[:, others] @ overlap
    return weighed.reshape(rows.shape)


def _noise_left(
    solver: Gram, seen: _Seen, overlap: Float[np.ndarray, "windows windows"]
) -> tuple[Float[np.ndarray, "frequencies _"], Float[np.ndarray, "frequencies _"]]:
    """Trace and degrees of freedom of unit noise behind the projection."""
    once = solver @ seen.aa
    left = (np.trace(overlap) - _trace(solver, seen.aa))[:, None]
    across = np.conj(np.swapaxes(once, 1, 2))
    square = np.sum(overlap**2) - 2 * _trace(solver, seen.aa_twice) + _trace(once, across)
    square = square[:, None]
    if seen.qq.shape[1]:
        crossed = seen.qq_twice - np.sum(np.conj(seen.aq) * (solver @ seen.aq), axis=1).real
        left = left - seen.qq
        square = square - 2 * crossed + seen.qq**2
    return left, np.maximum(left**2 / square, 0.5)


class Fit(NamedTuple):
    """Least squares of the outputs on inputs and leakage in windows of one length."""

    solver: Gram
    fitted: Complex[np.ndarray, "frequencies columns both"]  # of the outputs, then of their slopes
    inverse: Float[np.ndarray, "frequencies own"]  # of the size of q
    along: Complex[np.ndarray, "frequencies own"]  # coefficients of q
    seen: _Seen


Biases = Complex[np.ndarray, "frequencies outputs inputs groups"]


def find_bias(
    fits: Sequence[Fit], outputs: int, inputs: int
) -> tuple[Biases, Float[np.ndarray, "frequencies outputs inputs groups"]]:
    """What leakage adds to the response of each length, and its mean square under unit noise."""
    found = [_bias(fit, outputs, inputs) for fit in fits]
    frequencies = max(len(fit.solver) for fit in fits)
    bias, doubt = (_padded(each, frequencies) for each in zip(*found, strict=True))
    return bias, doubt


def _bias(fit: Fit, outputs: int, inputs: int) -> tuple[np.ndarray, np.ndarray]:
    # The response took too much of the inputs: the first coefficients of what is left, less
    # `through` times those to its own column.
    taken, through = np.split(np.swapaxes(fit.fitted[:, :inputs], 1, 2), [outputs], axis=1)
    through, to_x, seen = through * fit.inverse[:, :, None], fit.solver[:, :inputs], fit.seen
    plain = np.real(np.sum((to_x @ seen.aa) * np.conj(to_x), axis=2))[:, None]
    if not through.shape[1]:
        return -taken, np.repeat(np.maximum(plain, 0.0), outputs, axis=1)
    crossed = np.swapaxes(to_x @ seen.aq, 1, 2)
    mixed = 2 * np.real(np.conj(through) * crossed)
    own = power_of(through) * seen.qq[:, :, None]
    return through * fit.along[:, :, None] - taken, np.maximum(plain - mixed + own, 0.0)


def cross_products(
    rows: Complex[np.ndarray, "frequencies windows channels"],
) -> Complex[np.ndarray, "frequencies channels channels"]:
    """Sums of `conj(a) b` over windows."""
    return np.conj(np.swapaxes(rows, 1, 2)) @ rows


def power_of(x: Complex[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The square of the absolute value, which itself takes a library as long as ten products."""
    return np.real(x) ** 2 + np.imag(x) ** 2


def _inner(
    a: Complex[np.ndarray, "*rows terms"], b: Complex[np.ndarray, "*rows terms"]
) -> Float[np.ndarray, "*rows"]:
    """The real part of `conj(a) b`, summed over the last axis."""
    return np.vecdot(a.view(float), b.view(float))


def _size(rows: Rows) -> Sizes:
    return np.sqrt(_inner(rows, rows))


def _trace(
    a: Complex[np.ndarray, "frequencies n n"], b: Complex[np.ndarray, "frequencies n n"]
) -> Float[np.ndarray, " frequencies"]:
    """The real part of the trace of the product of `a` with the adjoint of `b`."""
    a, b = (np.ascontiguousarray(each).reshape(len(each), -1) for each in (a, b))
    return _inner(a, b)
