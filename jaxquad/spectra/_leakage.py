"""Leakage through windows, apart from noise.

Behind a window w, y = g * x has the transform sum_n j^n / n! G^(n) X_n, with X_n that of x behind
the n-th derivative of w: the part beyond G X_0 is leakage, of the slope and the curvature of G. It
is the same in each draw of the noise, so the noise is what no combination of X_0, X_1, X_2 explains
over the windows of one length. Y_1 is added to these: poles outlast any series in the slopes of G,
but with them w y' = (w y)' - w' y has a transform that is linear in Y_1.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxquad.models import invert_definite


_RIDGE = 1e-12  # of the columns' size, so that empty ones do no harm
_WITHIN = 1e-6  # of its size: an output's slope that inputs explain so well adds nothing


class Slopes(NamedTuple):
    """Transforms behind the derivatives of the windows of one length."""

    first: Complex[Array, "_ frequencies channels"]  # derivative: inputs, then outputs
    second: Complex[Array, "_ frequencies inputs"]


class Rest(NamedTuple):
    """What is left of the outputs' windows, with what noise does there, for each window length.

    `trace` is the energy that unit noise leaves, `bias` what the leakage adds to the response that
    the residuals are of, and `doubt` the mean square of its error under unit noise.
    """

    residuals: Complex[Array, "frequencies windows outputs"]
    trace: Float[Array, "frequencies outputs groups"]
    freedom: Float[Array, "frequencies outputs groups"]  # complex
    bias: Complex[Array, "frequencies outputs inputs groups"]
    doubt: Float[Array, "frequencies outputs inputs groups"]


def shows_leakage(windows: int, inputs: int) -> bool:
    """Whether there are enough windows of one length to tell leakage from noise."""
    return windows >= 3 * inputs + 3


def without_leakage(
    residuals: Complex[Array, "frequencies windows outputs"],
    x: Complex[Array, "frequencies windows inputs"],
    slopes: Sequence[Slopes],
    overlap: Float[Array, "windows windows"],
    counts: Sequence[int],
) -> Rest:
    """Residuals less all that inputs and leakage explain, one window length after the other.

    A length with too few windows for its leakage keeps it, as noise; its slopes do not matter.
    """
    ends, found = np.cumsum(counts)[:-1], []
    parts = jnp.split(residuals, ends, axis=1), jnp.split(x, ends, axis=1)
    for k, (left, inputs) in enumerate(zip(*parts, strict=True)):
        first = int(np.sum(counts[:k]))
        mine = overlap[first : first + counts[k], first : first + counts[k]]
        leaked, own = inputs[:, :, :0], jnp.zeros_like(left)
        if shows_leakage(counts[k], inputs.shape[2]):
            once, twice = (jnp.swapaxes(part, 0, 1) for part in slopes[k])
            steep, own = once[:, :, : twice.shape[2]], once[:, :, twice.shape[2] :]
            leaked = jnp.concatenate([steep, twice], axis=2)
        found.append(_least_squares(left, inputs, leaked, own, mine))
    rest, *others = zip(*found, strict=True)
    return Rest(jnp.concatenate(rest, axis=1), *(jnp.stack(x, axis=-1) for x in others))


def _least_squares(
    left: Complex[Array, "frequencies windows outputs"],
    x: Complex[Array, "frequencies windows inputs"],
    leaked: Complex[Array, "frequencies windows slopes"],
    own: Complex[Array, "frequencies windows outputs"],
    overlap: Float[Array, "windows windows"],
) -> Rest:
    """Each output on `x`, `leaked` and its `own` column.

    With P = P0 - q q^H the projection, P0 that of the common columns, and O the overlap: the trace
    of P O, the degrees of freedom tr(P O)^2 / tr(P O P O).
    """
    columns = jnp.concatenate([x, leaked], axis=2)
    size = jnp.maximum(jnp.sqrt(jnp.sum(power_of(columns), axis=1, keepdims=True)), 1e-300)
    unit = _times(columns, 1 / size)
    ridge = _RIDGE * jnp.eye(unit.shape[2], dtype=unit.dtype)[None]
    solver = invert_definite(_adjoint(unit) @ unit + ridge)
    pseudo, both = solver @ _adjoint(unit), jnp.concatenate([left, own], axis=2)
    for _ in range(2):  # the second time for the rounding of nearly dependent columns
        both = both - unit @ (pseudo @ both)
    rest, q = jnp.split(both, 2, axis=2)
    length, whole = (jnp.sqrt(jnp.sum(power_of(part), axis=1)) for part in (q, own))
    inverse = jnp.where(length > _WITHIN * whole, 1 / jnp.maximum(length, 1e-300), 0.0)
    q, pushed = (_times(part, inverse[:, None]) for part in (q, own))
    along = jnp.sum(jnp.conj(q) * left, axis=1)[:, None]
    # Rows from the windows to the inputs' coefficients, of which the response took too much: those
    # of x, less `through` times those to `own`.
    inputs = x.shape[2]
    to_x = _times(pseudo[:, :inputs], 1 / jnp.swapaxes(size[:, :, :inputs], 1, 2))
    through = jnp.swapaxes(to_x @ pushed, 1, 2)
    seen = _weigh(overlap, unit, q, _adjoint(to_x))
    return Rest(
        rest - q * along,
        *_noise_left(unit, solver, pseudo, q, overlap, seen),
        through * jnp.swapaxes(along, 1, 2) - jnp.swapaxes(to_x @ left, 1, 2),
        _noise_in_rows(to_x, through, q, seen),
    )


class _Seen(NamedTuple):
    """The overlap of the windows times columns."""

    unit: Complex[Array, "frequencies windows columns"]
    q: Complex[Array, "frequencies windows outputs"]
    rows: Complex[Array, "frequencies windows inputs"]


def _weigh(
    overlap: Float[Array, "windows windows"], *columns: Complex[Array, "frequencies windows _"]
) -> _Seen:
    """All columns of all frequencies in one product of real matrices."""
    joined = jnp.moveaxis(jnp.concatenate(columns, axis=2), 1, 0)
    flat = joined.reshape(len(joined), -1)
    real, imag = jnp.split(overlap @ jnp.concatenate([flat.real, flat.imag], axis=1), 2, axis=1)
    found = jnp.moveaxis(jax.lax.complex(real, imag).reshape(joined.shape), 0, 1)
    return _Seen(*jnp.split(found, np.cumsum([x.shape[2] for x in columns])[:-1], axis=2))


def _noise_in_rows(
    to_x: Complex[Array, "frequencies inputs windows"],
    through: Complex[Array, "frequencies outputs inputs"],
    q: Complex[Array, "frequencies windows outputs"],
    seen: _Seen,
) -> Float[Array, "frequencies outputs inputs"]:
    """Mean square that unit noise makes behind rows of `to_x` less `through` times those of q."""
    plain = jnp.real(jnp.sum(to_x * jnp.swapaxes(seen.rows, 1, 2), axis=2))
    crossed = jnp.swapaxes(to_x @ seen.q, 1, 2)
    own = jnp.real(jnp.sum(jnp.conj(q) * seen.q, axis=1))
    mixed = 2 * jnp.real(jnp.conj(through) * crossed)
    return jnp.maximum(plain[:, None] - mixed + power_of(through) * own[:, :, None], 0.0)


def _noise_left(
    unit: Complex[Array, "frequencies windows columns"],
    solver: Complex[Array, "frequencies columns columns"],
    pseudo: Complex[Array, "frequencies columns windows"],
    q: Complex[Array, "frequencies windows outputs"],
    overlap: Float[Array, "windows windows"],
    seen: _Seen,
) -> tuple[Float[Array, "frequencies outputs"], Float[Array, "frequencies outputs"]]:
    """Trace and degrees of freedom of unit noise behind the projection."""
    once = pseudo @ seen.unit
    twice = _trace(solver @ (_adjoint(seen.unit) @ seen.unit))
    common = jnp.trace(overlap) - _trace(once)
    square = jnp.sum(overlap**2) - 2 * twice + _trace(once @ once)
    own = jnp.real(jnp.sum(jnp.conj(q) * seen.q, axis=1))
    along = seen.q - unit @ (pseudo @ seen.q)
    crossed = jnp.real(jnp.sum(jnp.conj(seen.q) * along, axis=1))
    trace = common[:, None] - own
    freedom = trace**2 / (square[:, None] - 2 * crossed + own**2)
    return trace, jnp.maximum(freedom, 0.5)


def power_of(x: Complex[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The square of the absolute value, which itself takes a library as long as ten products."""
    return jnp.real(x) ** 2 + jnp.imag(x) ** 2


def _times(x: Complex[Array, "*shape"], factor: Float[Array, "..."]) -> Complex[Array, "*shape"]:
    return jax.lax.complex(jnp.real(x) * factor, jnp.imag(x) * factor)


def _adjoint(x: Complex[Array, "frequencies a b"]) -> Complex[Array, "frequencies b a"]:
    return jnp.conj(jnp.swapaxes(x, 1, 2))


def _trace(x: Complex[Array, "frequencies a a"]) -> Float[Array, " frequencies"]:
    return jnp.real(jnp.trace(x, axis1=1, axis2=2))
