"""One axis of a plant from sample to sample, exactly."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxquad.models import DecoupledAxes, split_delay


_TERMS = 18  # of the series at a norm of 1: 1 / 19! is below the last bit
_SQUARINGS = 30


class AxisParameters(NamedTuple):
    """One axis of `DecoupledAxes` without its dry friction, which has no linear part."""

    torque_gain: Float[Array, "*ensemble"]
    inertia: Float[Array, "*ensemble"]
    lag: Float[Array, "*ensemble"] | None
    damping: Float[Array, "*ensemble"]
    stiffness: Float[Array, "*ensemble"]


class SampledAxis(NamedTuple):
    """x+ = transition x + fresh u[k - shift] + stale u[k - shift - 1] + push d, angle = x[0].

    The states are the angle, the rate times dt and, with a lag, the effective command. The command
    u and the disturbance torque d are held over a sample; the command acts late.
    """

    transition: Float[Array, "states states"]
    fresh: Float[Array, " states"]
    stale: Float[Array, " states"]
    push: Float[Array, " states"]
    shift: Int[Array, ""]  # whole samples of the delay


def parameters_of(plant: DecoupledAxes, axis: int) -> AxisParameters:
    """The parameters of one axis; where all axes share a value, that one."""
    of_axis = lambda x: x[axis if x.shape[0] > 1 else 0]
    return AxisParameters(
        of_axis(plant.torque_gain),
        of_axis(plant.inertia),
        None if plant.lag is None else of_axis(plant.lag),
        of_axis(plant.damping),
        of_axis(plant.stiffness),
    )


def sampled(axis: AxisParameters, delay: Float[Array, ""] | None, dt: float) -> SampledAxis:
    """The axis between samples `dt` seconds apart, its command `delay` seconds late."""
    flow, command, torque = _normalised(axis, dt)
    whole = _propagate(flow, jnp.stack([command, torque], axis=1), jnp.ones((), flow.dtype))
    states = len(flow)
    transition, driven, push = whole[:, :states], whole[:, states], whole[:, states + 1]
    if delay is None:
        return SampledAxis(transition, driven, jnp.zeros_like(driven), push, jnp.zeros((), int))
    shift, late = split_delay(delay, dt)
    fresh = _propagate(flow, command[:, None], 1 - late)[:, states]
    return SampledAxis(transition, fresh, driven - fresh, push, shift)


def _normalised(
    axis: AxisParameters, dt: float
) -> tuple[Float[Array, "states states"], Float[Array, " states"], Float[Array, " states"]]:
    # Time in samples, so that the entries have one size whatever the sample interval.
    one = jnp.ones_like(axis.inertia)
    zero = jnp.zeros_like(one)
    pull, brake = -axis.stiffness * dt**2 / axis.inertia, -axis.damping * dt / axis.inertia
    gain = axis.torque_gain * dt**2 / axis.inertia
    rows = [[zero, one], [pull, brake]]
    command, torque = [zero, gain], [zero, dt**2 / axis.inertia]
    if axis.lag is not None:
        keep = -dt / axis.lag
        rows = [[zero, one, zero], [pull, brake, gain], [zero, zero, keep]]
        command, torque = [zero, zero, -keep], [*torque, zero]
    return jnp.array(rows), jnp.array(command), jnp.array(torque)


def _propagate(
    flow: Float[Array, "states states"],
    inputs: Float[Array, "states inputs"],
    time: Float[Array, ""],
) -> Float[Array, "states columns"]:
    """What held inputs and the state make of the state after `time`: Van Loan's augmentation."""
    states, columns = inputs.shape
    both = jnp.concatenate([flow, inputs], axis=1) * time
    return _exponential(jnp.pad(both, ((0, columns), (0, 0))))[:states]


def _exponential(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    # The series with scaling and squaring: a fraction of jax.scipy.linalg.expm's compile time, no
    # LAPACK under vmap.
    size = jnp.maximum(jnp.max(jnp.sum(jnp.abs(matrix), axis=0)), 1.0)
    halvings = jax.lax.stop_gradient(jnp.clip(jnp.ceil(jnp.log2(size)), 0, _SQUARINGS))
    small = matrix * jnp.exp2(-halvings)
    unit = jnp.eye(len(matrix), dtype=matrix.dtype)

    def nest(power: Array, k: Array) -> tuple[Array, None]:
        return unit + jnp.dot(small, power, precision="highest") / k, None

    def square(power: Array, k: Array) -> tuple[Array, None]:
        return jnp.where(k < halvings, jnp.dot(power, power, precision="highest"), power), None

    terms = jnp.arange(_TERMS, 0, -1, dtype=matrix.dtype)
    series = jax.lax.scan(nest, unit, terms)[0]
    return jax.lax.scan(square, series, jnp.arange(_SQUARINGS, dtype=matrix.dtype))[0]
