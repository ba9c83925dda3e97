import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad.models._parameters import as_float_or_none

from ._penalty import require_bound
from ._quantities import level, require_quantity
from ._risk import Risk, Worst


class Limit(eqx.Module):
    """A hard bound on one quantity: `Limit("sensitivity_peak", at_most=3.6)`.

    `over` says of which number of the members, by default of the worst; of several axes each member
    counts by its worst one. Bounds are SI (rad, s, rad s^2). The tuner keeps limits by an augmented
    Lagrangian on the members that it tunes on, the certificate judges them on fresh ones.
    Raises ValueError for an unknown quantity and unless there is one bound.
    """

    quantity: str = eqx.field(static=True)
    at_most: Float[Array, "..."] | None = eqx.field(
        converter=as_float_or_none, default=None, kw_only=True
    )
    at_least: Float[Array, "..."] | None = eqx.field(
        converter=as_float_or_none, default=None, kw_only=True
    )
    over: Risk = eqx.field(default=Worst(), kw_only=True)

    def __check_init__(self):
        require_quantity(self.quantity)
        if (self.at_most is None) == (self.at_least is None):
            raise ValueError(
                f"the limit of {self.quantity} has at_most = {self.at_most} and at_least = "
                f"{self.at_least}: give one of the two"
            )
        require_bound(self.quantity, self.bound)

    @property
    def bound(self) -> Float[Array, "..."]:
        return self.at_least if self.at_most is None else self.at_most  # type: ignore[return-value]

    @property
    def sign(self) -> float:
        """1 where more is worse."""
        return -1.0 if self.at_most is None else 1.0

    def excess(self, values: Float[Array, " members"]) -> Float[Array, ""]:
        """How far the members are beyond the limit, in its unit; above 0 it is violated."""
        return self.over(self.sign * values) - self.sign * self.bound

    def beyond(self, values: Float[Array, " members"]) -> Float[Array, " members"]:
        """The same as levels, one for each constraint that the limit makes: above 0, violated.

        The worst member is within the bound if each of them is, which is a smooth constraint.
        """
        beyond = self.sign * (level(self.quantity, values) - level(self.quantity, self.bound))
        if isinstance(self.over, Worst):
            return beyond
        return jnp.broadcast_to(self.over(beyond), beyond.shape)

    def __str__(self) -> str:
        sense = "at most" if self.at_most is not None else "at least"
        over = getattr(self.over, "text", type(self.over).__name__.lower())
        return f"{self.quantity} {sense} {np.asarray(self.bound).item():.4g} ({over})"
