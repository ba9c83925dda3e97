import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._transfer_function import TransferFunction


@eqx.filter_jit  # one compilation instead of one for each small operation
def realise(
    model: TransferFunction,
) -> tuple[
    Float[Array, "states states"],
    Float[Array, "states 1"],
    Float[Array, "1 states"],
    Float[Array, "1 1"],
]:
    """A, B, C, D of dx/dt = A x + B u, y = C x + D u: the model without its delay.

    The controllable canonical form, in a time measured in units of the fastest pole: written in
    seconds, its coefficients spread over many decades and its exponential loses digits.
    """
    states = model.denominator.size - 1
    missing = model.denominator.size - model.numerator.size
    a = (model.denominator / model.denominator[0])[1:]
    b = jnp.pad(model.numerator / model.denominator[0], (missing, 0))
    powers = jnp.arange(1, states + 1, dtype=a.dtype)
    speed = _fastest(a, powers)
    a, c = a / speed**powers, (b[1:] - b[0] * a) / speed**powers
    first = jnp.eye(states, 1, dtype=a.dtype)
    A = speed * (jnp.eye(states, k=-1, dtype=a.dtype) - first * a[None])
    return A, speed * first, c[None], b[:1, None]


def _fastest(a: Float[Array, " states"], powers: Float[Array, " states"]) -> Float[Array, ""]:
    # The input-output behaviour does not depend on this scale, hence neither does its gradient.
    speed = jnp.max(jax.lax.stop_gradient(jnp.abs(a)) ** (1 / powers), initial=0)
    return jnp.where(speed > 0, speed, 1)
