from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxquad._core import as_float, broadcast_gain, per_member, require_positive


class Past(NamedTuple):
    """What differences need of the samples before."""

    angle: Float[Array, " axes *ensemble"]
    change: Float[Array, " axes *ensemble"]  # of the angle over the last sample
    command: Float[Array, " axes *ensemble"]  # held during it
    seen: Int[Array, ""]  # samples, counted to 2


class Equation(NamedTuple):
    """Both sides of J acceleration = torque at one sample, each centred on the sample before."""

    acceleration: Float[Array, " axes *ensemble"]  # rad/s^2
    torque: Float[Array, " axes *ensemble"]  # N m
    rate: Float[Array, " axes *ensemble"]  # rad/s
    angle: Float[Array, " axes *ensemble"]  # rad
    valid: Float[Array, ""]  # 0 for the first two samples, whose differences have no past


def empty_past(like: Float[Array, " axes *ensemble"]) -> Past:
    zero = jnp.zeros_like(like)
    return Past(zero, zero, zero, jnp.zeros((), jnp.int32))


def motion(
    past: Past,
    torque_gain: Float[Array, "..."],
    command: Float[Array, " axes *ensemble"],
    measurement: Float[Array, " axes *ensemble"],
    dt: float,
) -> tuple[Past, Equation]:
    """The sampled equation of motion of an angle under held torques, without error:

    (phi_k - 2 phi_{k-1} + phi_{k-2}) / T^2 = (tau_{k-1} + tau_{k-2}) / (2 J).
    """
    change = measurement - past.angle
    equation = Equation(
        (change - past.change) / dt**2,
        broadcast_gain(torque_gain, measurement) * (command + past.command) / 2,
        (change + past.change) / (2 * dt),
        past.angle,
        (past.seen >= 2).astype(measurement.dtype),
    )
    return Past(measurement, change, command, jnp.minimum(past.seen + 1, 2)), equation


class FilterState(NamedTuple):
    past: Past
    stages: tuple[Float[Array, " signals axes *ensemble"], ...]


class MatchedFilters(eqx.Module):
    """The equation of motion, every term of it through the same discrete low-pass filter.

    `order` equal stages (1 - a) / (1 - a/z), a = exp(-bandwidth dt), so that the filtered equation
    is as exact as the sampled one. The terms are 1, rate, angle (if `angle`), acceleration and
    torque; the filtered 1 carries a constant disturbance through the start.
    Source: Eq. (19) of the paper, discretised exactly (docs/equations.md). A filter of the rate
    under zero-order hold, q0' = bandwidth (rate - q0), would bias the inertia by bandwidth dt / 2.
    """

    torque_gain: Float[Array, "..."] = per_member(
        rank=1, converter=as_float
    )  # N m per unit of command
    bandwidth: Float[Array, ""] = eqx.field(converter=as_float)  # rad/s
    order: int = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    angle: bool = eqx.field(static=True)

    def __check_init__(self):
        require_positive("bandwidth", self.bandwidth, "give rad/s, 10 for an encoder of 8192")
        if self.order not in (1, 2, 3):
            raise ValueError(
                f"order is {self.order}: filter by 1, 2 or 3 stages; behind an encoder take 3."
            )

    @property
    def signals(self) -> int:
        return 5 if self.angle else 4

    def init(self, like: Float[Array, " axes *ensemble"]) -> FilterState:
        stage = jnp.zeros((self.signals, *like.shape), like.dtype)
        return FilterState(empty_past(like), (stage,) * self.order)

    def __call__(
        self,
        state: FilterState,
        command: Float[Array, " axes *ensemble"],
        measurement: Float[Array, " axes *ensemble"],
    ) -> tuple[FilterState, Float[Array, " signals axes *ensemble"]]:
        """The filtered terms after one more sample."""
        past, now = motion(state.past, self.torque_gain, command, measurement, self.dt)
        middle = (now.rate, now.angle) if self.angle else (now.rate,)
        terms = (jnp.ones_like(measurement), *middle, now.acceleration, now.torque)
        out = now.valid * jnp.stack(terms)
        leak = -jnp.expm1(-self.bandwidth * self.dt).astype(out.dtype)
        stages = []
        for stage in state.stages:
            out = stage + leak * (out - stage)
            stages.append(out)
        return FilterState(past, tuple(stages)), out


def has_settled(
    terms: Float[Array, " signals axes *ensemble"],
) -> Float[Array, " axes *ensemble"]:
    """1 once the filter has forgotten its start, 0 before.

    The first difference of a counted angle is wrong by up to a count per sample interval, which
    the filter takes for a jump of the rate, 0.4 rad/s on the Hover.
    """
    return (terms[0] > 0.999).astype(terms.dtype)
