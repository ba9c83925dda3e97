"""Leakage through windows, apart from noise.

Behind a window w, y = g * x has the transform sum_n j^n / n! G^(n) X_n, with X_n that of x behind
the n-th derivative of w: the part beyond G X_0 is leakage, of the slope and the curvature of G. It
is the same in each draw of the noise, so the noise is what no combination of X_0, X_1, X_2 explains
over the windows of one length. Y_1 is added to these: poles outlast any series in the slopes of G,
but with them w y' = (w y)' - w' y has a transform that is linear in Y_1.
"""

from collections.abc import Sequence
from typing import NamedTuple

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


def without_leakage(
    residuals: Complex[Array, "frequencies windows outputs"],
    x: Complex[Array, "frequencies windows inputs"],
    slopes: Sequence[Slopes],
    overlap: Float[Array, "windows windows"],
    counts: Sequence[int],
) -> Rest:
    """Residuals less all that inputs and leakage explain, one window length after the other.

    A length with too few windows for its leakage keeps it, as noise.
    """
    ends, found = np.cumsum(counts)[:-1], []
    parts = jnp.split(residuals, ends, axis=1), jnp.split(x, ends, axis=1)
    for k, (left, inputs) in enumerate(zip(*parts, strict=True)):
        first = int(np.sum(counts[:k]))
        mine = overlap[first : first + counts[k], first : first + counts[k]]
        once, twice = (jnp.swapaxes(part, 0, 1) for part in slopes[k])
        steep, own = once[:, :, : twice.shape[2]], once[:, :, twice.shape[2] :]
        leaked = jnp.concatenate([steep, twice], axis=2)
        if counts[k] < inputs.shape[2] + leaked.shape[2] + 3:
            leaked, own = leaked[:, :, :0], jnp.zeros_like(own)
        found.append(_least_squares(left, inputs, leaked, own, mine.astype(left.dtype)))
    rest, *others = zip(*found, strict=True)
    return Rest(jnp.concatenate(rest, axis=1), *(jnp.stack(x, axis=-1) for x in others))


def _least_squares(
    left: Complex[Array, "frequencies windows outputs"],
    x: Complex[Array, "frequencies windows inputs"],
    leaked: Complex[Array, "frequencies windows slopes"],
    own: Complex[Array, "frequencies windows outputs"],
    overlap: Complex[Array, "windows windows"],
) -> Rest:
    """Each output on `x`, `leaked` and its `own` column.

    With P = P0 - q q^H the projection, P0 that of the common columns, and O the overlap: the trace
    of P O, the degrees of freedom tr(P O)^2 / tr(P O P O).
    """
    columns = jnp.concatenate([x, leaked], axis=2)
    size = jnp.maximum(jnp.sqrt(jnp.sum(jnp.abs(columns) ** 2, axis=1, keepdims=True)), 1e-300)
    unit = columns / size.astype(columns.dtype)
    ridge = _RIDGE * jnp.eye(unit.shape[2], dtype=unit.dtype)[None]
    pseudo = invert_definite(_adjoint(unit) @ unit + ridge) @ _adjoint(unit)
    rest, q = left, own
    for _ in range(2):  # the second time for the rounding of nearly dependent columns
        rest, q = rest - unit @ (pseudo @ rest), q - unit @ (pseudo @ q)
    length, whole = (jnp.sqrt(jnp.sum(jnp.abs(part) ** 2, axis=1)) for part in (q, own))
    inverse = jnp.where(length > _WITHIN * whole, 1 / jnp.maximum(length, 1e-300), 0.0)
    scale = inverse.astype(q.dtype)[:, None]
    q = q * scale
    along = jnp.sum(jnp.conj(q) * left, axis=1)[:, None]
    # Rows from the windows to the inputs' coefficients, of which the response took too much.
    inputs = x.shape[2]
    to_x = pseudo[:, :inputs] / jnp.swapaxes(size[:, :, :inputs], 1, 2).astype(unit.dtype)
    through = jnp.swapaxes(to_x @ (own * scale), 1, 2)[..., None]
    rows = to_x[:, None] - through * jnp.conj(jnp.swapaxes(q, 1, 2))[:, :, None]
    return Rest(
        rest - q * along,
        *_noise_left(unit, pseudo, q, overlap),
        -jnp.einsum("foiw,fwo->foi", rows, left),
        jnp.real(jnp.sum((rows @ overlap) * jnp.conj(rows), axis=3)),
    )


def _noise_left(
    unit: Complex[Array, "frequencies windows columns"],
    pseudo: Complex[Array, "frequencies columns windows"],
    q: Complex[Array, "frequencies windows outputs"],
    overlap: Complex[Array, "windows windows"],
) -> tuple[Float[Array, "frequencies outputs"], Float[Array, "frequencies outputs"]]:
    """Trace and degrees of freedom of unit noise behind the projection."""
    once = pseudo @ (overlap @ unit)
    twice = _trace(pseudo @ ((overlap @ overlap) @ unit))
    common = jnp.real(jnp.trace(overlap)) - _trace(once)
    square = jnp.sum(jnp.abs(overlap) ** 2) - 2 * twice + _trace(once @ once)
    seen = overlap @ q
    own = jnp.real(jnp.sum(jnp.conj(q) * seen, axis=1))
    crossed = jnp.real(jnp.sum(jnp.conj(seen) * (seen - unit @ (pseudo @ seen)), axis=1))
    trace = common[:, None] - own
    freedom = trace**2 / (square[:, None] - 2 * crossed + own**2)
    return trace, jnp.maximum(freedom, 0.5)


def _adjoint(x: Complex[Array, "frequencies a b"]) -> Complex[Array, "frequencies b a"]:
    return jnp.conj(jnp.swapaxes(x, 1, 2))


def _trace(x: Complex[Array, "frequencies a a"]) -> Float[Array, " frequencies"]:
    return jnp.real(jnp.trace(x, axis1=1, axis2=2))
