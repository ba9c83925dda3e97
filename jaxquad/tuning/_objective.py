"""What a tune minimises: quantities of each member, penalties, limits, and risks over members."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import (
    as_float,
    as_float_or_none,
    require_finite,
    require_nonnegative,
    require_positive,
)


Value = TypeVar("Value", bound=ArrayLike)  # NumPy's stay so: nothing is compiled for them
_DEGREE = float(np.degrees(1.0))


class Quantity(NamedTuple):
    """A number of a loop: how it is computed, how two of it compare, and how it is printed."""

    title: str  # in tables and figures
    unit: str  # as printed
    factor: float = 1.0  # from SI units to the printed one
    decibels: bool = False  # printed as 20 log10
    linear: bool = False  # of the linear loop, see `jq.loops.LoopAnalysis`; else of a flight
    si_unit: str = "1"
    logarithmic: bool = True  # it is compared by its logarithm; else in steps of `scale`
    scale: float = 1.0
    least: float = 1e-9  # value of which a logarithm is taken
    most: float = 1e9
    smaller_is_worse: bool = False
    summed: bool = False  # over the axes in an objective; else the worst axis counts

    @property
    def sign(self) -> float:
        """-1 where a smaller number is the worse one, else 1."""
        return -1.0 if self.smaller_is_worse else 1.0

    def level(self, value: Value) -> Value:
        """What weights and penalties act on: ln of the value, or the value over its `scale`."""
        xp: Any = jnp if isinstance(value, jax.Array) else np
        bounded = xp.minimum(value, self.most)
        if not self.logarithmic:
            return bounded / self.scale
        return xp.log(xp.maximum(bounded, self.least))

    def combine_axes(
        self, value: Float[Array, "axes members"], *, worst: bool = False
    ) -> Float[Array, " members"]:
        """One number for each member: the sum over its axes, or that of its worst axis."""
        if self.summed and not worst:
            return jnp.sum(value, axis=0)
        return jnp.min(value, axis=0) if self.smaller_is_worse else jnp.max(value, axis=0)

    def number(self, value: float) -> float:
        """The value in the printed unit."""
        if self.decibels:
            with np.errstate(divide="ignore", invalid="ignore"):
                return float(20 * np.log10(value))
        return float(value) * self.factor

    def text(self, value: float, *, unit: bool = True) -> str:
        """The value as printed; an infinite margin is "any"."""
        number = self.number(value)
        if np.isnan(number):
            return "n/a"
        if np.isinf(number):
            return "any" if "margin" in self.title else f"{'-' if number < 0 else ''}inf"
        return f"{number:.4g}{' ' + self.unit if unit and self.unit else ''}"


# To add one: an entry here, and a number of that name from what computes it. Of a flight: a sum in
# `_UPDATES` of simulation/_flight_metrics.py, with a field, row and unit in simulation/_metrics.py.
# Of a linear loop: in `numbers_of` and `NUMBERS` of loops/_analysis.py, with a field of
# `LoopAnalysis` and of `LoopNumbers`.
QUANTITIES = {
    "itae": Quantity("ITAE", "deg s^2", _DEGREE, si_unit="rad s^2", summed=True),
    "iae": Quantity("IAE", "deg s", _DEGREE, si_unit="rad s", summed=True),
    "ise": Quantity("ISE", "deg^2 s", _DEGREE**2, si_unit="rad^2 s", summed=True),
    "activity": Quantity("activity", "u^2", si_unit="unit^2", summed=True),
    "activity_rate": Quantity("activity", "u^2/s", si_unit="unit^2/s", summed=True),
    "energy": Quantity("energy", "u^2 s", si_unit="unit^2 s", summed=True),
    "overshoot": Quantity("overshoot", "%", si_unit="%", logarithmic=False, scale=10.0),
    "peak": Quantity("peak error", "deg", _DEGREE, si_unit="rad"),
    "rms": Quantity("rms error", "deg", _DEGREE, si_unit="rad"),
    "disturbance_rmse": Quantity("disturbance error", "N m", si_unit="N m"),
    "saturation_share": Quantity("saturated", "%", 100.0, logarithmic=False, scale=0.1),
    "abscissa": Quantity("slowest pole", "1/s", linear=True, si_unit="1/s", logarithmic=False),
    "sensitivity_peak": Quantity("Ms", "", linear=True),
    "gain_margin": Quantity(
        "gain margin up", "dB", decibels=True, linear=True, least=1.0, most=1e3,
        smaller_is_worse=True,
    ),
    "gain_reduction": Quantity("gain margin down", "dB", decibels=True, linear=True, least=1e-3),
    "phase_margin": Quantity(
        "phase margin", "deg", _DEGREE, linear=True, si_unit="rad", logarithmic=False, most=3.15,
        smaller_is_worse=True,
    ),
    "delay_margin": Quantity(
        "delay margin", "ms", 1e3, linear=True, si_unit="s", least=1e-5, most=10.0,
        smaller_is_worse=True,
    ),
    "noise_gain": Quantity("noise gain", "u/rad", linear=True, si_unit="unit/rad"),
}  # fmt: skip
LINEAR = tuple(name for name, quantity in QUANTITIES.items() if quantity.linear)


def split_quantities(wanted: Collection[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of flight quantities, and those of the linear loop."""
    names = sorted(wanted)
    flight = tuple(name for name in names if not QUANTITIES[name].linear)
    return flight, tuple(name for name in names if QUANTITIES[name].linear)


def require_quantity(name: str) -> None:
    if name not in QUANTITIES:
        raise ValueError(f"there is no quantity {name!r}: choose one of {', '.join(QUANTITIES)}")


@runtime_checkable
class Risk(Protocol):
    """Makes one number of those of all members; larger is worse."""

    def __call__(self, values: Float[Array, " members"], /) -> Float[Array, ""]: ...


def risk_text(risk: Risk) -> str:
    return getattr(risk, "text", type(risk).__name__.lower())


class Mean(eqx.Module):
    """The mean over the members."""

    text: str = eqx.field(static=True, default="mean", init=False)

    def __call__(self, values: Float[Array, " members"]) -> Float[Array, ""]:
        return jnp.mean(values)


class Worst(eqx.Module):
    """The worst member.

    Its gradient is that of one member alone, so a descent is steadier with `jq.tuning.CVaR`.
    """

    text: str = eqx.field(static=True, default="worst", init=False)

    def __call__(self, values: Float[Array, " members"]) -> Float[Array, ""]:
        return jnp.max(values)


class CVaR(eqx.Module):
    """The conditional value at risk: the mean of the worst `share` of the members.

    A share that is no whole number of members counts the last one in part.

    Source: Rockafellar and Uryasev, "Optimization of conditional value-at-risk" (2000).

    **Arguments:**

    - `share`: above 0 and at most 1.

    **Raises:**

    - `ValueError`: the share is outside of that.
    """

    share: float = eqx.field(static=True, default=0.2)

    def __check_init__(self):
        if not 0 < self.share <= 1:
            raise ValueError(f"share is {self.share}: give one above 0 and at most 1, as 0.2")

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
    """A weighted sum of risks, as `Mix(((0.5, Mean()), (0.5, CVaR(0.2))))`.

    **Arguments:**

    - `parts`: pairs of a weight above 0 and a risk.

    **Raises:**

    - `ValueError`: there are no parts, or a weight is not above 0.
    """

    parts: Sequence[tuple[float, Risk]]

    def __check_init__(self):
        if not self.parts or not all(w > 0 and math.isfinite(w) for w, _ in self.parts):
            raise ValueError(f"parts are {self.parts}: give (weight, risk), each weight above 0")

    @property
    def text(self) -> str:
        return " + ".join(f"{w:g} {risk_text(risk)}" for w, risk in self.parts)

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
    """A soft bound that is added to every member's cost: `weight` soft(ln(q / knee)).

    soft(x) = softplus(8 x) / 8. The abscissa, which can have either sign, counts as (q - knee) in
    1/s; overshoot and the share of saturation count as (q - knee) in steps of 10 %. For margins,
    of which less is worse, the sign is reversed. Penalties on the linear loop, except on the
    abscissa, act on stable members only. Source: docs/tuning.md.

    **Arguments:**

    - `quantity`: a name from `jq.tuning.QUANTITIES`.
    - `knee`: where the cost begins, in SI units (rad, s).
    - `weight`: the cost per neper beyond the knee.

    **Raises:**

    - `ValueError`: the quantity does not exist, the weight is negative, or the knee has no
        logarithm.
    """

    quantity: str = eqx.field(static=True)
    knee: Float[Array, "..."] = eqx.field(converter=as_float)
    weight: Float[Array, "..."] = eqx.field(converter=as_float, default=1.0)

    def __check_init__(self):
        require_quantity(self.quantity)
        require_bound(self.quantity, self.knee)
        require_nonnegative("weight", self.weight, "give the cost per neper beyond the knee")

    def __call__(
        self, values: Float[Array, " members"], gate: Float[Array, " members"]
    ) -> Float[Array, " members"]:
        """The cost of each member; `gate` is 1 where its loop is stable, 0 where it is not."""
        quantity = QUANTITIES[self.quantity]
        beyond = quantity.level(values) - quantity.level(self.knee)
        cost = self.weight * soft(quantity.sign * beyond)
        return gate * cost if is_gated(self.quantity) else cost


def is_gated(quantity: str) -> bool:
    """Whether the quantity is meaningless for an unstable loop."""
    return QUANTITIES[quantity].linear and quantity != "abscissa"


def require_bound(quantity: str, bound: Float[Array, "..."]) -> None:
    require_finite(f"the bound of {quantity}", bound)
    if QUANTITIES[quantity].logarithmic:
        name = f"the bound of {quantity}, which counts by its logarithm,"
        require_positive(name, bound, f"give it in {QUANTITIES[quantity].si_unit}")


class Limit(eqx.Module):
    """A hard bound on one quantity, as `Limit("sensitivity_peak", at_most=3.6)`.

    Of several axes each member counts by its worst one. The tuner enforces limits by an augmented
    Lagrangian on the members that it tunes on; the certificate checks them on fresh members.

    **Arguments:**

    - `quantity`: a name from `jq.tuning.QUANTITIES`.
    - `at_most`, `at_least`: the bound in SI units (rad, s, rad s^2); give one of the two.
    - `over`: the number over the members that is bounded, by default that of the worst.

    **Raises:**

    - `ValueError`: the quantity does not exist, or there is not exactly one bound.
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
        """The number that must not be passed."""
        bound = self.at_least if self.at_most is None else self.at_most
        assert bound is not None
        return bound

    @property
    def sign(self) -> float:
        """1 for `at_most`, -1 for `at_least`."""
        return -1.0 if self.at_most is None else 1.0

    def excess(self, values: Float[Array, " members"]) -> Float[Array, ""]:
        """How far the members are beyond the limit, in its unit; above 0 it is missed."""
        return self.over(self.sign * values) - self.sign * self.bound

    def beyond(self, values: Float[Array, " members"]) -> Float[Array, " members"]:
        """The excess as levels, one for each constraint that the limit makes; above 0, missed.

        The worst member is within the bound if every member is, and that is a smooth constraint.
        """
        level = QUANTITIES[self.quantity].level
        beyond = self.sign * (level(values) - level(self.bound))
        if isinstance(self.over, Worst):
            return beyond
        return jnp.broadcast_to(self.over(beyond), beyond.shape)

    def __str__(self) -> str:
        sense = "at most" if self.at_most is not None else "at least"
        bound = np.asarray(self.bound).item()
        return f"{self.quantity} {sense} {bound:.4g} ({risk_text(self.over)})"


_STANDARD = (
    ("activity_rate", 20.0, 2.0),
    ("sensitivity_peak", 2.0, 3.0),
    ("abscissa", -0.5, 5.0),
)
_RAMP = 0.25  # 1/s, the decay rate from which a member counts in full

Numbers = dict[str, Float[Array, "axes members"]]


def _weights(terms: Mapping[str, float]) -> dict[str, Array]:
    return {name: as_float(weight) for name, weight in terms.items()}


class Objective(eqx.Module):
    """What a tune minimises: the `risk` over the members of each one's terms and penalties.

    A term is its weight times the logarithm of a quantity (overshoot and saturation share, which
    may be 0, count in steps of 10 %). The default is ln(ITAE) + 2 soft(ln(activity rate / 20))
    + 3 gate soft(ln(Ms / 2)) + 5 soft(abscissa + 0.5), whose gate is 1 for a stable loop, 0 for an
    unstable one, and has no derivative. The activity rate is the sum of squared changes of the
    command per second, in V^2/s: give your own penalties where commands have another unit.
    Source: docs/tuning.md.

    **Arguments:**

    - `terms`: weights by the names of quantities, see `jq.tuning.QUANTITIES`.
    - `penalties`: soft bounds.
    - `risk`: what counts over the members: `jq.tuning.Mean`, `jq.tuning.CVaR`, `jq.tuning.Worst`,
        `jq.tuning.Mix`, or a function of your own.
    - `events`: times in s at which the clock of ITAE starts again, such as those of steps and
        gusts; without any it runs from `start`.
    - `start`, `stop`: only start <= t < stop counts, in s.
    - `load_start`: where overshoot ends, and where peak, rms and the error of the disturbance's
        estimate begin, in s.

    **Raises:**

    - `ValueError`: there are no terms, or a quantity or an event does not exist.
    """

    terms: dict[str, Array] = eqx.field(converter=_weights, default_factory=lambda: {"itae": 1.0})
    penalties: Sequence[Penalty] = eqx.field(
        default_factory=lambda: tuple(Penalty(n, knee=k, weight=w) for n, k, w in _STANDARD)
    )
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
            raise ValueError(f"events are {self.events}: give times in s, 0 or later")

    @property
    def quantities(self) -> frozenset[str]:
        """All quantities that have to be computed, the abscissa among them."""
        return frozenset(self.terms) | {p.quantity for p in self.penalties} | {"abscissa"}

    def costs(self, numbers: Numbers) -> Float[Array, " members"]:
        """The cost of each member from its quantities, `[axes, members]` each."""
        gate = stability_gate(numbers["abscissa"])
        total = jnp.zeros_like(gate)
        for name, weight in self.terms.items():
            quantity = QUANTITIES[name]
            signed = quantity.sign * (weight * quantity.level(quantity.combine_axes(numbers[name])))
            total = total + (gate * signed if is_gated(name) else signed)
        for penalty in self.penalties:
            values = QUANTITIES[penalty.quantity].combine_axes(numbers[penalty.quantity])
            total = total + penalty(values, gate)
        return total


def stability_gate(abscissa: Float[Array, "axes members"]) -> Float[Array, " members"]:
    """1 for a stable member, 0 for an unstable one, without a derivative.

    Beyond the boundary of stability |S| is small: its peak would pull members there.
    """
    slowest = jnp.max(abscissa, axis=0)
    return jax.lax.stop_gradient(jnp.clip(-slowest / _RAMP, 0, 1))
