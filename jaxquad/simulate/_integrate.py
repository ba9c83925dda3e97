from collections.abc import Callable

import jax
from jaxtyping import PyTree


def runge_kutta(derivative: Callable[[PyTree], PyTree], state: PyTree, dt: float) -> PyTree:
    """One classical fourth-order step of an autonomous system: the inputs are held in it."""

    def ahead(slope: PyTree, share: float) -> PyTree:
        return jax.tree.map(lambda x, k: x + share * dt * k, state, slope)

    k1 = derivative(state)
    k2 = derivative(ahead(k1, 0.5))
    k3 = derivative(ahead(k2, 0.5))
    k4 = derivative(ahead(k3, 1.0))
    return jax.tree.map(
        lambda x, a, b, c, d: x + dt / 6 * (a + 2 * b + 2 * c + d), state, k1, k2, k3, k4
    )
