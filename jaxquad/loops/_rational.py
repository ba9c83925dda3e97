"""Responses of small sampled systems as ratios of polynomials in z - 1."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float


class Rational(NamedTuple):
    """numerators / denominator, highest power of z - 1 first.

    In z itself, slow poles would crowd about 1 and their coefficients cancel.
    """

    numerators: Float[Array, "inputs degrees"]
    denominator: Float[Array, " degrees"]

    def __call__(self, ahead: Complex[Array, " points"]) -> Complex[Array, "inputs points"]:
        """The values at `ahead`, which is z - 1."""
        rows = jnp.concatenate([self.numerators, self.denominator[None]]).astype(ahead.dtype)
        value = jnp.broadcast_to(rows[:, :1], (len(rows), *ahead.shape))
        for k in range(1, rows.shape[1]):
            value = value * ahead[None] + rows[:, k, None]
        return value[:-1] / value[-1:]


def rational(
    A: Float[Array, "states states"],
    B: Float[Array, "states inputs"],
    C: Float[Array, " states"],
    D: Float[Array, " inputs"],
) -> Rational:
    """C (z - A)^-1 B + D, by the Faddeev-LeVerrier recursion on A - 1.

    Source: Householder, The Theory of Matrices in Numerical Analysis, section 6.7. It loses digits
    as the number of states grows; sampled controllers have up to about eight.
    """
    unit = jnp.eye(len(A), dtype=A.dtype)
    change, adjugate = A - unit, unit
    above, below = [jnp.zeros_like(D)], [jnp.ones((), A.dtype)]
    for k in range(1, len(A) + 1):
        above.append(_dot(_dot(C, adjugate), B))
        advanced = _dot(change, adjugate)
        below.append(-jnp.trace(advanced) / k)
        adjugate = advanced + below[-1] * unit
    denominator = jnp.stack(below)
    return Rational(jnp.stack(above, axis=1) + D[:, None] * denominator[None], denominator)


def _dot(a: Array, b: Array) -> Array:
    return jnp.dot(a, b, precision="highest")
