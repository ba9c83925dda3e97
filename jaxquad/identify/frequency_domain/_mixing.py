"""Points of a response that share noise count together: neighbours partly repeat one another.

So do pairs of output and input at one frequency: outputs share noise, and inputs that a narrow
window hardly tells apart share the outputs' noise. Whitened pair by pair along frequency, and then
at each frequency across pairs, estimates are nearly as sharp as under the whole covariance.

Under the inverse of their whole covariance the estimates would be the sharpest, but also trust
what the covariance says of the small differences between neighbours, which nobody knows: they
would follow any bias. So each point has a share of doubt, noise that it shares with none, as large
as that of all the points that it shares noise with.
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from ._cost import Points, Weights


_DOUBT = 0.3  # of the variance of a point's share in the noise of all points

Square = Complex[np.ndarray, "outputs inputs frequencies frequencies"]
Across = Complex[np.ndarray, "frequencies pairs pairs"]


class Mixing(NamedTuple):
    """How the weighted points of one response are taken together.

    The weighted misfits, magnitude as the real part and phase as the imaginary one, are multiplied
    by `factor` along frequency, and then by `across` at each frequency, output by output; both are
    triangular, and the identity where no noise is shared. `correlation` and `between` are those of
    the noise, relative to the response. A single pair has no `across`.
    """

    factor: Square
    correlation: Square
    across: Across | None = None
    between: Across | None = None
    idle: Bool[np.ndarray, ""] | None = None  # whether nothing is mixed, if programs are to ask


def mixings_of(points: Sequence[Points], weights: Sequence[Weights]) -> tuple[Mixing | None, ...]:
    """One for each response, `None` where the points share no noise."""
    return tuple(_mixing(*pair) for pair in zip(points, weights, strict=True))


def _mixing(points: Points, weights: Weights) -> Mixing | None:
    if not points.correlations and points.between is None:
        return None
    none = unmixed(points.used.shape)
    factor, correlation = np.array(none.factor), np.array(none.correlation)
    for (o, i), shared in points.correlations.items():
        mine = np.flatnonzero(points.used[:, o, i])
        # A floor on the error is shared with no other point.
        alone = np.minimum((weights[mine, o, i, 0] * points.floor[mine, o, i]) ** 2, 1.0)
        size = np.sqrt((1 - alone) / points.shared[mine, o, i])
        total = size[:, None] * shared * size + np.diag(alone + _DOUBT)
        root = np.sqrt(1 + _DOUBT) * np.linalg.inv(np.linalg.cholesky(total))
        factor[o, i][np.ix_(mine, mine)] = root
        correlation[o, i][np.ix_(mine, mine)] = shared
    across, between = none.across, none.between
    if points.between is not None:  # what whitens the pairs at each frequency
        alone = np.minimum((weights[..., 0] * points.floor) ** 2, 1.0).reshape(len(weights), -1)
        size, identity = np.sqrt(1 - alone), np.eye(alone.shape[1])
        total = size[:, :, None] * points.between * size[:, None, :]
        total = total + (alone + _DOUBT)[:, :, None] * identity
        across = np.sqrt(1 + _DOUBT) * np.linalg.inv(np.linalg.cholesky(total))
        between = points.between
    return Mixing(factor, correlation, across, between, np.array(False))


@ft.lru_cache(maxsize=8)
def unmixed(shape: tuple[int, ...]) -> Mixing:
    """The mixing of (frequencies, outputs, inputs) that share no noise: identities."""
    count, outputs, inputs = shape
    pairs, identity = outputs * inputs, np.eye(count, dtype=complex)
    along = np.broadcast_to(identity, (2, outputs, inputs, count, count))
    if pairs == 1:
        return Mixing(*along, idle=np.array(True))
    across = np.broadcast_to(np.eye(pairs, dtype=complex), (2, count, pairs, pairs))
    return Mixing(*along, *across, idle=np.array(True))


def mix(
    mixing: Mixing | None, weighted: Float[np.ndarray, "frequencies outputs inputs 2 *columns"]
) -> Float[np.ndarray, "frequencies outputs inputs 2 *columns"]:
    """Weighted misfits, or their slopes, taken together."""
    return weighted if mixing is None else _through(weighted, lambda x: mix_complex(mixing, x))


def mix_twice(
    mixing: Mixing | None, weighted: Float[np.ndarray, "frequencies outputs inputs 2 *columns"]
) -> Float[np.ndarray, "frequencies outputs inputs 2 *columns"]:
    """The same by the factors and then by their adjoints."""
    if mixing is None:
        return weighted

    def twice(x: Complex[np.ndarray, "outputs inputs frequencies columns"]) -> np.ndarray:
        mixed = mix_complex(mixing, x)
        if mixing.across is not None:
            mixed = _apply_across(np.conj(np.swapaxes(mixing.across, 1, 2)), mixed)
        return np.conj(np.swapaxes(mixing.factor, 2, 3)) @ mixed

    return _through(weighted, twice)


def mix_complex(
    mixing: Mixing, x: Complex[np.ndarray, "outputs inputs frequencies columns"]
) -> Complex[np.ndarray, "outputs inputs frequencies columns"]:
    """As `mix`, of magnitude and phase in one number."""
    mixed = mixing.factor @ x
    return mixed if mixing.across is None else _apply_across(mixing.across, mixed)


def _apply_across(across: Across, x: np.ndarray) -> np.ndarray:
    outputs, inputs, count, columns = x.shape
    pairs = np.moveaxis(x.reshape(outputs * inputs, count, columns), 0, 1)
    return np.moveaxis(across @ pairs, 1, 0).reshape(x.shape)


def _through(weighted: np.ndarray, apply: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    joined = np.moveaxis(weighted[:, :, :, 0] + 1j * weighted[:, :, :, 1], 0, 2)
    flat = apply(joined.reshape(*joined.shape[:3], -1))
    turned = np.moveaxis(flat.reshape(joined.shape), 2, 0)
    return np.stack([np.real(turned), np.imag(turned)], axis=3)


def expected_cost(
    mixing: Mixing | None, sizes: Float[np.ndarray, "frequencies outputs inputs 2"]
) -> Float[np.ndarray, "outputs inputs"]:
    """What noise alone leaves of each pair's cost; `sizes` are weights times random errors.

    Whitened along frequency, pairs count as correlated at each frequency as before.
    """
    if mixing is None:
        return np.sum(sizes**2, axis=(0, 3))
    size = np.moveaxis(sizes[..., 0], 0, -1)
    noise = size[..., :, None] * mixing.correlation * size[..., None, :]
    shaped = mixing.factor @ noise
    if mixing.across is None or mixing.between is None:
        return 2 * np.real(np.einsum("oifg,oifg->oi", shaped, np.conj(mixing.factor)))
    power = np.real(np.einsum("oifg,oifg->foi", shaped, np.conj(mixing.factor)))
    deviation = np.sqrt(np.maximum(power, 0.0)).reshape(len(power), -1)
    noise = deviation[:, :, None] * mixing.between * deviation[:, None, :]
    left = np.sum(np.real(mixing.across @ noise * np.conj(mixing.across)), axis=(0, 2))
    return 2 * left.reshape(power.shape[1:])


def mix_parts(
    mixing: Mixing | None,
    real: Float[Array, "*columns outputs inputs frequencies"],
    imag: Float[Array, "*columns outputs inputs frequencies"],
) -> tuple[Array, Array]:
    """As `mix`, in JAX, with frequencies last."""
    if mixing is None:
        return real, imag

    def turned(real: Array, imag: Array) -> tuple[Array, Array]:
        turn = lambda matrix, part: jnp.einsum("oifg,...oig->...oif", matrix, part)
        along = _turn_parts(turn, mixing.factor, real, imag)
        if mixing.across is None:
            return along
        shape = real.shape
        flat = (part.reshape(*shape[:-3], -1, shape[-1]) for part in along)
        turn = lambda matrix, part: jnp.einsum("fpq,...qf->...pf", matrix, part)
        real, imag = _turn_parts(turn, mixing.across, *flat)
        return real.reshape(shape), imag.reshape(shape)

    if mixing.idle is None:
        return turned(real, imag)
    return jax.lax.cond(mixing.idle, lambda *same: same, turned, real, imag)


def _turn_parts(
    turn: Callable[[Array, Array], Array], matrix: np.ndarray | Array, real: Array, imag: Array
) -> tuple[Array, Array]:
    c, s = jnp.real(matrix), jnp.imag(matrix)
    return turn(c, real) - turn(s, imag), turn(s, real) + turn(c, imag)
