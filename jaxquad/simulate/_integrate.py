from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PyTree


def runge_kutta(
    derivative: Callable[[PyTree], PyTree], state: PyTree, dt: Float[ArrayLike, "*ensemble"]
) -> PyTree:
    """One classical fourth-order step of an autonomous system: the inputs are held in it.

    `dt` in s may differ between the members of an ensemble, the trailing axes of the state.
    """
    spans = jax.tree.map(lambda x: _over(dt, x), state)

    def ahead(slope: PyTree, share: float) -> PyTree:
        return jax.tree.map(lambda x, h, k: x + share * h * k, state, spans, slope)

    k1 = derivative(state)
    k2 = derivative(ahead(k1, 0.5))
    k3 = derivative(ahead(k2, 0.5))
    k4 = derivative(ahead(k3, 1.0))
    return jax.tree.map(
        lambda x, h, a, b, c, d: x + h / 6 * (a + 2 * b + 2 * c + d), state, spans, k1, k2, k3, k4
    )


def integrate(
    derivative: Callable[[PyTree], PyTree],
    state: PyTree,
    duration: Float[ArrayLike, "*ensemble"],
    substeps: int,
) -> PyTree:
    """`duration` seconds in `substeps` equal Runge-Kutta steps."""
    if substeps == 1:
        return runge_kutta(derivative, state, duration)

    @jax.checkpoint
    def substep(state: PyTree, _: None) -> tuple[PyTree, None]:
        return runge_kutta(derivative, state, duration / substeps), None

    return jax.lax.scan(substep, state, None, length=substeps)[0]


def _over(dt: Float[ArrayLike, "*ensemble"], leaf: Array) -> Float[ArrayLike, "..."]:
    rank = jnp.ndim(dt)
    return dt if rank == 0 else jnp.reshape(dt, (1,) * (leaf.ndim - rank) + jnp.shape(dt))
