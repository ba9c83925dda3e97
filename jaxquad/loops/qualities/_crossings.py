"""Where a quantity passes through zero along frequency, and how that place moves."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


_HALVINGS = 60  # from a grid's interval to the last bit of a float64


def crossed(values: Float[Array, " frequencies"], direction: str) -> Bool[Array, " intervals"]:
    """Intervals in which `values` pass zero "falling", "rising" or in "both" directions.

    A curve that lies on zero but for rounding does not cross it.
    """
    above = values >= -1e4 * jnp.finfo(values.dtype).eps
    falls, rises = above[:-1] & ~above[1:], ~above[:-1] & above[1:]
    both = falls | rises
    finite = jnp.isfinite(values)
    return {"falling": falls, "rising": rises, "both": both}[direction] & finite[:-1] & finite[1:]


def crossings(
    residual: Callable[[Float[Array, " points"]], Float[Array, " points"]],
    omega: Float[Array, " frequencies"],
    where: Bool[Array, " intervals"],
    *,
    rank: Float[Array, " intervals"] | None = None,
    limit: int = 1,
) -> Float[Array, " crossings"]:
    """The roots of `residual` in the intervals `where`, rising in rad/s; `nan` where there is none.

    `residual` treats each frequency by itself. Of more than `limit` roots, those of lowest `rank`
    are kept, by default the lowest frequencies. Each is bisected to machine accuracy, and its
    derivatives of any order with respect to what `residual` closes over are those of the implicit
    function theorem.
    """
    rank = jnp.arange(where.size, dtype=omega.dtype) if rank is None else rank
    chosen = jax.lax.top_k(jnp.where(where, -rank, -jnp.inf), min(limit, where.size))[1]
    chosen = jnp.sort(jnp.where(where[chosen], chosen, where.size))
    exists, interval = chosen < where.size, jnp.minimum(chosen, where.size - 1)
    root = _root(residual, omega[interval], omega[interval + 1])
    return jnp.where(exists, root, jnp.nan)


def first(
    residual: Callable[[Float[Array, " points"]], Float[Array, " points"]],
    omega: Float[Array, " frequencies"],
    where: Bool[Array, " intervals"],
    rank: Float[Array, " intervals"] | None = None,
) -> Float[Array, ""]:
    """The one root of lowest rank, `nan` if there is none."""
    return crossings(residual, omega, where, rank=rank)[0]


def between(
    residual: Callable[[Float[Array, " points"]], Float[Array, " points"]],
    low: Float[Array, ""],
    high: Float[Array, ""],
) -> Float[Array, ""]:
    """A root between two frequencies where `residual` has opposite signs."""
    return _root(residual, low[None], high[None])[0]


def _root(
    residual: Callable[[Float[Array, " points"]], Float[Array, " points"]],
    low: Float[Array, " points"],
    high: Float[Array, " points"],
) -> Float[Array, " points"]:
    low, high = jax.lax.stop_gradient((low, high))

    def bisect(f, _):
        sign = f(low) >= 0

        def halve(_, ends):
            middle = jnp.sqrt(ends[0]) * jnp.sqrt(ends[1])
            left = (f(middle) >= 0) == sign
            return jnp.where(left, middle, ends[0]), jnp.where(left, ends[1], middle)

        return jax.lax.fori_loop(0, _HALVINGS, halve, (low, high))[1]

    def divide(slope, y):
        steep = slope(jnp.ones_like(y))
        # Where a curve only touches zero the derivative is infinite; unused rows stay 0.
        return y / jnp.where(steep == 0, jnp.finfo(y.dtype).tiny, steep)

    return jax.lax.custom_root(residual, low, bisect, divide)
