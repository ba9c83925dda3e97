"""What all inertia estimators of this folder have in common."""

from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad._core import (
    as_float,
    broadcast_gain,
    ensemble_shape,
    per_member,
    require_all_positive,
    require_common_shape,
    require_positive,
)

from .._protocols import InertiaEstimate


PLAUSIBLE = 10.0  # times the nominal inertia, or a share of it


class LastEstimate(NamedTuple):
    """An estimate between the samples or windows that renew it."""

    inertia: Float[Array, " axes *ensemble"]  # kg m^2
    variance: Float[Array, " axes *ensemble"]  # (kg m^2)^2, when it was made
    age: Float[Array, " axes *ensemble"]  # relative variance that has come with time
    informed: Float[Array, " axes *ensemble"]  # 1 once there was excitation


State = TypeVar("State", bound=Any)  # a NamedTuple with the field `last`, a LastEstimate


class AbstractInertia(eqx.Module):
    """The plant and the rules of trust that all estimators share.

    A plant of the inertia J answers a command u with J angle'' = `torque_gain` u + disturbances.
    """

    torque_gain: Float[Array, "..."] = per_member(
        rank=1, converter=as_float
    )  # N m per unit of command
    nominal: Float[Array, "..."] = per_member(rank=1, converter=as_float)  # kg m^2
    trust: float = eqx.field(static=True, default=0.1, kw_only=True)
    drift: float = eqx.field(static=True, default=0.01, kw_only=True)  # 1/sqrt(s)
    dt: float = eqx.field(static=True, default=0.002, kw_only=True)  # s

    def __check_init__(self):
        remedy = "give N m per unit of command: L Kf of the Hover"
        require_positive("torque_gain", self.torque_gain, remedy)
        require_positive("nominal", self.nominal, "give the design's inertia in kg m^2")
        require_common_shape({"torque_gain": self.torque_gain, "nominal": self.nominal})
        require_all_positive(dt=self.dt)

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the parameters, () for one estimator."""
        return ensemble_shape(self)

    def estimate(self, state: Any) -> InertiaEstimate:
        """The last estimate, with the standard deviation that it has by this sample."""
        return self._assess(state.last)

    def excite(self, state: State) -> State:
        """Put the estimate in doubt, which starts the test signal; the inertia is kept."""
        last = state.last
        return state._replace(last=last._replace(age=jnp.ones_like(last.age)))

    def _start(self, like: Float[Array, " axes *ensemble"]) -> LastEstimate:
        """The nominal inertia, before any excitation."""
        zero = jnp.zeros_like(like)
        return LastEstimate(
            jnp.broadcast_to(broadcast_gain(self.nominal, like), like.shape), zero, zero, zero
        )

    def _assess(self, last: LastEstimate) -> InertiaEstimate:
        """100 % of deviation before any excitation; it grows while the estimate ages.

        Trusted with a relative deviation of `trust` and within a factor of 10 of the `nominal`.
        """
        variance = last.variance + last.age * last.inertia**2
        some = variance > 0
        deviation = jnp.where(some, jnp.sqrt(jnp.where(some, variance, 1)), 0)
        informed = last.informed > 0
        deviation = jnp.where(informed, deviation, jnp.abs(last.inertia))
        ratio = last.inertia / broadcast_gain(self.nominal, last.inertia)
        plausible = (ratio > 1 / PLAUSIBLE) & (ratio < PLAUSIBLE)
        sure = informed & plausible & (deviation <= self.trust * last.inertia)
        return InertiaEstimate(last.inertia, deviation, sure.astype(deviation.dtype))
