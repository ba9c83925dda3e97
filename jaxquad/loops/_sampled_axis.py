"""One axis of a plant from sample to sample, exactly."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxquad.models import LinearAxis, split_delay


_TERMS = 18  # of the series at a norm of 1: 1 / 19! is below the last bit
_SQUARINGS = 30


class SampledAxis(NamedTuple):
    """x+ = transition x + fresh u[k - shift] + stale u[k - shift - 1] + push d, angle = x[0].

    The states are those of a `LinearAxis`, its rate times dt. The command u and the disturbance
    torque d are held over a sample; the command acts late.
    """

    transition: Float[Array, "states states"]
    fresh: Float[Array, " states"]
    stale: Float[Array, " states"]
    push: Float[Array, " states"]
    shift: Int[Array, ""]  # whole samples of the delay


def sample_axis(axis: LinearAxis, delay: Float[Array, ""] | None, dt: float) -> SampledAxis:
    """The axis between samples `dt` seconds apart, its command `delay` seconds late."""
    flow, command, torque = _in_samples(axis, dt)
    whole = _propagate(flow, jnp.stack([command, torque], axis=1), jnp.ones((), flow.dtype))
    states = len(flow)
    transition, driven, push = whole[:, :states], whole[:, states], whole[:, states + 1]
    if delay is None:
        return SampledAxis(transition, driven, jnp.zeros_like(driven), push, jnp.zeros((), int))
    shift, late = split_delay(delay, dt)
    fresh = _propagate(flow, command[:, None], 1 - late)[:, states]
    return SampledAxis(transition, fresh, driven - fresh, push, shift)


def _in_samples(
    axis: LinearAxis, dt: float
) -> tuple[Float[Array, "states states"], Float[Array, " states"], Float[Array, " states"]]:
    # Time in samples, so that the entries have one size whatever the sample interval.
    unit = np.ones(len(axis.command))
    unit[1] = dt  # of the rate
    entries = jnp.asarray(dt * unit[:, None] / unit[None], axis.A.dtype)
    inputs = jnp.asarray(dt * unit, axis.A.dtype)
    return axis.A * entries, axis.command * inputs, axis.torque * inputs


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
