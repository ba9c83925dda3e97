from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad._core import ensemble_shape, fit, require_positive, require_shapes


PLAUSIBLE = 10.0  # times the nominal inertia, or a share of it


class InertiaEstimate(NamedTuple):
    """What an estimator holds of the inertia, and how sure of it it is."""

    inertia: Float[Array, " axes *ensemble"]  # kg m^2; the nominal one before any excitation
    deviation: Float[Array, " axes *ensemble"]  # kg m^2, standard deviation
    trusted: Float[Array, " axes *ensemble"]  # 1 where excited and precise enough, else 0


@runtime_checkable
class InertiaEstimator(Protocol):
    """What `jq.AdaptiveLADRC` asks of an estimator.

    `update` hears once a sample the command that the plant received since the last sample and the
    angle just measured. `probe` is the test signal to add to the next command; `excite`
    demands one.
    """

    def init(self, like: Any) -> Any: ...
    def update(self, state: Any, command: Any, measurement: Any) -> Any: ...
    def estimate(self, state: Any) -> InertiaEstimate: ...
    def probe(self, state: Any) -> Float[Array, " axes *ensemble"]: ...
    def excite(self, state: Any) -> Any: ...


class Held(NamedTuple):
    """An estimate between the samples or windows that renew it."""

    inertia: Float[Array, " axes *ensemble"]  # kg m^2
    variance: Float[Array, " axes *ensemble"]  # (kg m^2)^2, when it was made
    age: Float[Array, " axes *ensemble"]  # relative variance that has come with time
    informed: Float[Array, " axes *ensemble"]  # 1 once there was excitation


def nothing_held(nominal: Float[Array, "..."], like: Float[Array, " axes *ensemble"]) -> Held:
    zero = jnp.zeros_like(like)
    return Held(jnp.broadcast_to(fit(nominal, like), like.shape), zero, zero, zero)


def judged(held: Held, nominal: Float[Array, "..."], trust: float) -> InertiaEstimate:
    """The estimate with its deviation: 100 % before any excitation, growing while it is held.

    Trusted with a relative deviation of `trust` and within a factor of 10 of the `nominal`.
    """
    spread = held.variance + held.age * held.inertia**2
    some = spread > 0
    deviation = jnp.where(some, jnp.sqrt(jnp.where(some, spread, 1)), 0)
    informed = held.informed > 0
    deviation = jnp.where(informed, deviation, jnp.abs(held.inertia))
    ratio = held.inertia / fit(nominal, held.inertia)
    plausible = (ratio > 1 / PLAUSIBLE) & (ratio < PLAUSIBLE)
    sure = informed & plausible & (deviation <= trust * held.inertia)
    return InertiaEstimate(held.inertia, deviation, sure.astype(deviation.dtype))


def doubted(held: Held) -> Held:
    """As unsure as at the start, with the inertia kept."""
    return held._replace(age=jnp.ones_like(held.age))


def plant_ensemble(torque_gain: Array, nominal: Array) -> tuple[int, ...]:
    return ensemble_shape({"torque_gain": torque_gain, "nominal": nominal}, rank=1)


def require_plant(torque_gain: Array, nominal: Array) -> None:
    require_positive("torque_gain", torque_gain, "give N m per unit of command, on the rig L Kf")
    require_positive("nominal", nominal, "give the design's inertia in kg m^2")
    require_shapes({"torque_gain": torque_gain, "nominal": nominal})


def require_above_zero(unit: str, **values: float) -> None:
    for name, value in values.items():
        if not 0 < value < float("inf"):
            raise ValueError(f"{name} is {value} {unit}: give a positive, finite number")
