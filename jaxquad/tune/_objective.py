import math
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad.models._parameters import as_float

from ._penalty import is_gated, Penalty
from ._quantities import level, per_member, QUANTITIES, require_quantity
from ._risk import Mean, Risk


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
