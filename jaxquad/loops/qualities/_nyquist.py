"""Whether a loop closes stably, counted from its response (Nyquist)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ._curve import ambiguous


_SLACK = 0.3  # of the slope at the lowest frequency, for a number of integrators
_TILT = jnp.pi / 3  # rad, of 1 + L at the lowest frequency from its limit at 0


def unstable_roots(
    omega: Float[Array, " frequencies"],
    loop: Complex[Array, " frequencies"],
    unstable_poles: Float[Array, ""],
) -> Float[Array, ""]:
    """Roots of 1 + L in the right half plane, `nan` where the frequencies do not tell.

    They tell if below the lowest the loop goes on as k / s^q, with a large magnitude if q > 0, and
    the highest is beyond the last crossover. The argument of 1 + L then grows by
    pi (P + q / 2 - Z) from 0 to infinity, with P `unstable_poles` of the loop and Z the answer.
    """
    values = 1 + loop
    argument = jnp.unwrap(jnp.angle(values))
    slope = jnp.log(jnp.abs(loop[1] / loop[0])) / jnp.log(omega[1] / omega[0])
    integrators = jnp.maximum(jnp.round(-slope), 0.0)
    whole = (jnp.abs(slope + integrators) < _SLACK) | (slope > 0)
    known = (integrators == 0) | (jnp.abs(loop[0]) > 2)
    limit = jnp.exp(jax.lax.complex(jnp.zeros_like(slope), -integrators * jnp.pi / 2))
    tilt = jnp.angle(values[0] / limit)
    tilt = tilt - jnp.pi * jnp.round(tilt / jnp.pi)
    growth = argument[-1] - argument[0] + tilt - jnp.angle(values[-1])
    roots = jnp.round(unstable_poles + integrators / 2 - growth / jnp.pi)
    clear = ~jnp.any(ambiguous(argument)) & (jnp.abs(loop[-1]) < 1) & (jnp.abs(tilt) < _TILT)
    return jax.lax.stop_gradient(jnp.where(clear & known & whole, roots, jnp.nan))


def remarks_on_roots(roots: float, unstable_poles: int) -> list[str]:
    """What a count of unstable roots means for the numbers of a loop."""
    if roots > 0:
        return [
            f"the closed loop is unstable: with {unstable_poles} unstable poles in the loop, "
            f"Nyquist counts {int(roots)} unstable roots; the numbers describe a loop "
            "that does not run, unless unstable_poles= or the sign of L is wrong"
        ]
    if roots < 0:
        return [
            f"the loop has {int(-roots)} more unstable poles than unstable_poles={unstable_poles}, "
            "or its sign is wrong"
        ]
    if roots != roots:
        return ["these frequencies do not tell whether the closed loop is stable: check it"]
    return []
