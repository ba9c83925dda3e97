"""Points of a response that share noise count together: neighbours partly repeat one another.

Under the inverse of their whole covariance the estimates would be the sharpest, but also trust
what the covariance says of the small differences between neighbours, which nobody knows: they
would follow any bias. So each point has a share of doubt, noise of its own, as large as that of
all the points that it shares noise with.
"""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from ._cost import Points, Weights


_DOUBT = 0.3  # of the variance of a point's share in the noise of all points

Square = Complex[np.ndarray, "outputs inputs frequencies frequencies"]


class Mixing(NamedTuple):
    """How the weighted points of one response are taken together, pair by pair.

    The weighted misfits, magnitude as the real part and phase as the imaginary one, are multiplied
    by `factor`, which is the identity where no noise is shared; `correlation` is that of the noise,
    relative to the response.
    """

    factor: Square
    correlation: Square
    idle: Bool[np.ndarray, ""] | None = None  # whether nothing is mixed, if programs are to ask


def mixings_of(points: Sequence[Points], weights: Sequence[Weights]) -> tuple[Mixing | None, ...]:
    """One for each response, `None` where the points share no noise."""
    return tuple(_mixing(*each) for each in zip(points, weights, strict=True))


def _mixing(points: Points, weights: Weights) -> Mixing | None:
    if not points.correlations:
        return None
    factor, correlation = (np.array(each) for each in unmixed(points.used.shape)[:2])
    for (o, i), shared in points.correlations.items():
        mine = np.flatnonzero(points.used[:, o, i])
        # A floor on the error is the points' own.
        own = np.minimum((weights[mine, o, i, 0] * points.floor[mine, o, i]) ** 2, 1.0)
        size = np.sqrt((1 - own) / points.shared[mine, o, i])
        whole = size[:, None] * shared * size + np.diag(own + _DOUBT)
        root = np.sqrt(1 + _DOUBT) * np.linalg.inv(np.linalg.cholesky(whole))
        factor[o, i][np.ix_(mine, mine)] = root
        correlation[o, i][np.ix_(mine, mine)] = shared
    return Mixing(factor, correlation, np.array(False))


@ft.lru_cache(maxsize=8)
def unmixed(shape: tuple[int, ...]) -> Mixing:
    """The mixing of (frequencies, outputs, inputs) that share no noise: identities."""
    count, outputs, inputs = shape
    identity = np.eye(count, dtype=complex)
    each = np.broadcast_to(identity, (outputs, inputs, count, count))
    return Mixing(each, each, np.array(True))


def mix(
    mixing: Mixing | None, weighted: Float[np.ndarray, "frequencies outputs inputs 2 *columns"]
) -> Float[np.ndarray, "frequencies outputs inputs 2 *columns"]:
    """Weighted misfits, or their slopes, taken together."""
    return weighted if mixing is None else _apply(mixing.factor, weighted)


def mix_twice(
    mixing: Mixing | None, weighted: Float[np.ndarray, "frequencies outputs inputs 2 *columns"]
) -> Float[np.ndarray, "frequencies outputs inputs 2 *columns"]:
    """The same by the factor and then by its adjoint."""
    if mixing is None:
        return weighted
    adjoint = np.conj(np.swapaxes(mixing.factor, 2, 3))
    return _apply(adjoint, _apply(mixing.factor, weighted))


def _apply(factor: Square, weighted: np.ndarray) -> np.ndarray:
    joined = np.moveaxis(weighted[:, :, :, 0] + 1j * weighted[:, :, :, 1], 0, 2)
    flat = factor @ joined.reshape(*joined.shape[:3], -1)
    turned = np.moveaxis(flat.reshape(joined.shape), 2, 0)
    return np.stack([np.real(turned), np.imag(turned)], axis=3)


def expected_cost(
    mixing: Mixing | None, sizes: Float[np.ndarray, "frequencies outputs inputs 2"]
) -> Float[np.ndarray, "outputs inputs"]:
    """What noise alone leaves of each pair's cost; `sizes` are weights times random errors."""
    if mixing is None:
        return np.sum(sizes**2, axis=(0, 3))
    size = np.moveaxis(sizes[..., 0], 0, -1)
    noise = size[..., :, None] * mixing.correlation * size[..., None, :]
    shaped = mixing.factor @ noise
    return 2 * np.real(np.einsum("oifg,oifg->oi", shaped, np.conj(mixing.factor)))


def mix_parts(
    mixing: Mixing | None,
    real: Float[Array, "*columns outputs inputs frequencies"],
    imag: Float[Array, "*columns outputs inputs frequencies"],
) -> tuple[Array, Array]:
    """As `mix`, in JAX, with frequencies last."""
    if mixing is None:
        return real, imag
    c, s = jnp.real(mixing.factor), jnp.imag(mixing.factor)
    turn = lambda matrix, part: jnp.einsum("oifg,...oig->...oif", matrix, part)

    def turned(real: Array, imag: Array) -> tuple[Array, Array]:
        return turn(c, real) - turn(s, imag), turn(s, real) + turn(c, imag)

    if mixing.idle is None:
        return turned(real, imag)
    return jax.lax.cond(mixing.idle, lambda *same: same, turned, real, imag)
