"""How fast the phase falls beyond w180, as ADS-33 asks for it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._curve import Curve


_POINTS = 64  # of a model, even in frequency from w180 to 2 w180


def known_to(curve: Curve, clear: Bool[Array, " intervals"]) -> Float[Array, ""]:
    """Frequency in rad/s up to which the phase's branch is known: `clear` holds from the lowest."""
    return jnp.where(jnp.all(clear), curve.omega[-1], curve.omega[jnp.argmin(clear)])


def two_point_delay(
    curve: Curve, phase: Float[Array, " frequencies"], w180: Float[Array, ""], top: Float[Array, ""]
) -> Float[Array, ""]:
    """Phase lost from w180 to 2 w180, over 2 w180: in s, `nan` beyond `top`."""
    exists = 2 * w180 <= top
    start = jnp.where(exists, w180, curve.omega[0])
    ends = _phase_at(curve, phase, jnp.stack([start, 2 * start]))
    return jnp.where(exists, (ends[0] - ends[1]) / (2 * start), jnp.nan)


def fitted_delay(
    curve: Curve, phase: Float[Array, " frequencies"], w180: Float[Array, ""], top: Float[Array, ""]
) -> Float[Array, ""]:
    """Half the slope of the straight line through the phase from w180 to 2 w180: s, `nan` past top.

    A measured phase counts at its own frequencies with the coherence weight of Tischler & Remple,
    eq. (11.4); a model's at 64 even ones.
    """
    exists = 2 * w180 <= top
    start = jnp.where(exists, w180, curve.omega[0])
    if curve.coherence is None:
        points = start * jnp.linspace(1, 2, _POINTS, dtype=start.dtype)
        weights = jnp.ones_like(points)
    else:
        points = curve.omega
        inside = (points >= start) & (points <= 2 * start)
        weights = jnp.where(inside, (1.58 * (1 - jnp.exp(-curve.coherence))) ** 2, 0.0)
    slope = _slope(points / start, _phase_at(curve, phase, points), weights)
    return jnp.where(exists & (jnp.sum(weights > 0) >= 3), -slope / (2 * start), jnp.nan)


def _phase_at(
    curve: Curve, phase: Float[Array, " frequencies"], omega: Float[Array, " points"]
) -> Float[Array, " points"]:
    """Unwrapped phase at `omega`, on the branch that `phase` has on the grid."""
    branch = jnp.interp(jnp.log(omega), jnp.log(curve.omega), phase)
    branch = jax.lax.stop_gradient(branch)
    turned = curve(omega) * jnp.exp(jax.lax.complex(jnp.zeros_like(branch), -branch))
    return branch + jnp.angle(turned)


def _slope(
    x: Float[Array, " points"], y: Float[Array, " points"], weights: Float[Array, " points"]
) -> Float[Array, ""]:
    total = jnp.maximum(jnp.sum(weights), jnp.finfo(x.dtype).tiny)
    apart = x - jnp.sum(weights * x) / total
    spread = jnp.sum(weights * apart**2)
    return jnp.sum(weights * apart * y) / jnp.where(spread > 0, spread, 1.0)
