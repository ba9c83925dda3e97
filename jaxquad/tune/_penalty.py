import equinox as eqx
import jax
from jaxtyping import Array, Float

from jaxquad.models._parameters import (
    as_float,
    require_finite,
    require_nonnegative,
    require_positive,
)

from ._quantities import level, OF_THE_LOOP, QUANTITIES, require_quantity


_SHARPNESS = 8.0


def soft(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """softplus(8 x) / 8: 0 far below 0, x far above, smooth between."""
    return jax.nn.softplus(_SHARPNESS * x) / _SHARPNESS


class Penalty(eqx.Module):
    """A soft bound, added to every member's cost: `weight` soft(ln(q / knee)).

    With soft(x) = softplus(8 x) / 8. The abscissa, which has either sign, counts as (q - knee) in
    1/s, overshoot and the share of saturation as (q - knee) in steps of 10 % of step or samples.
    For margins, of which less is worse, the sign is turned. Those of the linear loop, but for the
    abscissa, act on stable members only. Knees are SI (rad, s).
    Source: EQUATIONS.md, section 3. Raises ValueError for an unknown quantity, a negative weight
    and a knee that has no logarithm.
    """

    quantity: str = eqx.field(static=True)
    knee: Float[Array, "..."] = eqx.field(converter=as_float)
    weight: Float[Array, "..."] = eqx.field(converter=as_float, default=1.0)

    def __check_init__(self):
        require_quantity(self.quantity)
        require_bound(self.quantity, self.knee)
        require_nonnegative("weight", self.weight, "it says how much being beyond the knee costs")

    def __call__(
        self, values: Float[Array, " members"], gate: Float[Array, " members"]
    ) -> Float[Array, " members"]:
        """The cost of each member; `gate` is 1 where its loop is stable, 0 where it is not."""
        beyond = level(self.quantity, values) - level(self.quantity, self.knee)
        if QUANTITIES[self.quantity].smaller_is_worse:
            beyond = -beyond
        cost = self.weight * soft(beyond)
        return gate * cost if is_gated(self.quantity) else cost


def is_gated(quantity: str) -> bool:
    """Whether a number means nothing where the loop is unstable."""
    return quantity in OF_THE_LOOP and quantity != "abscissa"


def require_bound(quantity: str, bound: Float[Array, "..."]) -> None:
    """Raises ValueError for a bound that has no level."""
    require_finite(f"the bound of {quantity}", bound)
    if QUANTITIES[quantity].logarithmic:
        require = f"the bound of {quantity}, which counts by its logarithm,"
        require_positive(require, bound, f"give it in {QUANTITIES[quantity].unit}")
