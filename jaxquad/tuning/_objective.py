import math
from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import (
    as_float,
    as_float_or_none,
    require_finite,
    require_nonnegative,
    require_positive,
)

from ._quantities import level, OF_THE_LOOP, per_member, QUANTITIES, require_quantity


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


_STANDARD = (
    ("activity_rate", 20.0, 2.0),
    ("sensitivity_peak", 2.0, 3.0),
    ("abscissa", -0.5, 5.0),
)
_RAMP = 0.25  # 1/s, the decay at which a member counts as stable in full

Numbers = dict[str, Float[Array, "axes members"]]


def _weights(terms: Mapping[str, float]) -> dict[str, Array]:
    return {name: as_float(weight) for name, weight in terms.items()}


def _penalties() -> tuple[Penalty, ...]:
    return tuple(Penalty(name, knee=knee, weight=weight) for name, knee, weight in _STANDARD)


class Objective(eqx.Module):
    """What tuning minimises: `risk` over the members of the sum of terms and penalties of each.

    A term is its weight times the logarithm of a quantity (overshoot and saturation share, which
    may be 0, count in steps of 10 %). The default is ln(ITAE) + 2 soft(ln(activity rate / 20))
    + 3 gate soft(ln(Ms / 2)) + 5 soft(abscissa + 0.5), whose gate is 1 where the loop is stable and
    has no derivative. The activity rate is the sum of squared changes of the command per second, in
    V^2/s: give your own penalties where commands have another unit.

    `events` are the times in s at which the clock of ITAE starts again, such as those of steps and
    gusts; without any it runs from `start`. Only start <= t < stop (s) counts; overshoot ends and
    peak, rms and the error of the disturbance's estimate begin at `load_start`.
    Source: EQUATIONS.md, section 3. Raises ValueError for unknown quantities and weights.
    """

    terms: dict[str, Array] = eqx.field(converter=_weights, default_factory=lambda: {"itae": 1.0})
    penalties: Sequence[Penalty] = eqx.field(default_factory=_penalties)
    risk: Risk = Mean()
    events: tuple[float, ...] = eqx.field(static=True, default=(), kw_only=True)  # s
    start: float = eqx.field(static=True, default=0.0, kw_only=True)  # s
    stop: float | None = eqx.field(static=True, default=None, kw_only=True)  # s
    load_start: float | None = eqx.field(static=True, default=None, kw_only=True)  # s

    def __check_init__(self):
        if not self.terms:
            raise ValueError('terms is empty: say what to minimise, as {"itae": 1.0}')
        for name in self.terms:
            require_quantity(name)
        if not all(math.isfinite(t) and t >= 0 for t in self.events):
            raise ValueError(f"events are {self.events}: give times in s from 0 on")

    @property
    def quantities(self) -> frozenset[str]:
        """Whatever has to be measured, the abscissa included."""
        return frozenset(self.terms) | {p.quantity for p in self.penalties} | {"abscissa"}

    def costs(self, numbers: Numbers) -> Float[Array, " members"]:
        """The cost of each member from its quantities, `[axes, members]` each."""
        gate = stability_gate(numbers["abscissa"])
        total = jnp.zeros_like(gate)
        for name, weight in self.terms.items():
            term = weight * level(name, per_member(name, numbers[name]))
            term = -term if QUANTITIES[name].smaller_is_worse else term
            total = total + (gate * term if is_gated(name) else term)
        for penalty in self.penalties:
            values = per_member(penalty.quantity, numbers[penalty.quantity])
            total = total + penalty(values, gate)
        return total


def stability_gate(abscissa: Float[Array, "axes members"]) -> Float[Array, " members"]:
    """1 for a stable member, 0 for an unstable one, without a derivative.

    |S| is small beyond the boundary of stability, so that a peak of it would pull members there.
    """
    slowest = jnp.max(abscissa, axis=0)
    return jax.lax.stop_gradient(jnp.clip(-slowest / _RAMP, 0, 1))
