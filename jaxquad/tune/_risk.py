import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


Risk = Callable[[Float[Array, " members"]], Float[Array, ""]]


class Mean(eqx.Module):
    """The mean over the members."""

    text: str = eqx.field(static=True, default="mean", init=False)

    def __call__(self, values: Float[Array, " members"]) -> Float[Array, ""]:
        return jnp.mean(values)


class Worst(eqx.Module):
    """The worst member. Its gradient is that of one member: CVaR moves more steadily."""

    text: str = eqx.field(static=True, default="worst", init=False)

    def __call__(self, values: Float[Array, " members"]) -> Float[Array, ""]:
        return jnp.max(values)


class CVaR(eqx.Module):
    """The mean of the worst `share` of the members, exactly also where that is no whole number.

    Source: Rockafellar and Uryasev (2000). Raises ValueError for a share not in 0 < share <= 1.
    """

    share: float = eqx.field(static=True, default=0.2)

    def __check_init__(self):
        if not 0 < self.share <= 1:
            raise ValueError(f"share is {self.share}: give that of the worst members, as 0.2")

    @property
    def text(self) -> str:
        return f"CVaR {100 * self.share:g} %"

    def __call__(self, values: Float[Array, " members"]) -> Float[Array, ""]:
        ordered = jnp.sort(values)[::-1]
        wanted = self.share * values.size
        places = jnp.arange(values.size, dtype=values.dtype)
        weight = jnp.clip(wanted - places, 0, 1) / wanted
        return jnp.dot(ordered, weight)


class Mix(eqx.Module):
    """A weighted sum of risks: `Mix(((0.5, Mean()), (0.5, CVaR(0.2))))`.

    Raises ValueError for weights that are not above 0.
    """

    parts: Sequence[tuple[float, Risk]]

    def __check_init__(self):
        if not self.parts or not all(w > 0 and math.isfinite(w) for w, _ in self.parts):
            raise ValueError(f"parts are {self.parts}: give (weight, risk), each weight above 0")

    @property
    def text(self) -> str:
        return " + ".join(f"{w:g} {getattr(risk, 'text', 'risk')}" for w, risk in self.parts)

    def __call__(self, values: Float[Array, " members"]) -> Float[Array, ""]:
        total = jnp.zeros((), values.dtype)
        for weight, risk in self.parts:
            total = total + weight * risk(values)
        return total
