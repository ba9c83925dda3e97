from collections.abc import Mapping

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._linear import LinearController
from ._measurement_filter import butterworth


def linear_pid(gains: Mapping[str, Float[Array, ""]], dt: float) -> LinearController:
    """A PID of one axis without its limit.

    The states are the integral, the filtered rate and, of a filtered measurement, the filter's.
    """
    if "measurement_filter" in gains:
        return _behind_a_filter(gains, dt)
    kp, ki, kd = gains["kp"], gains["ki"], gains["kd"]
    keep = jnp.exp(-dt * gains["filter"])
    sharp = (1 - keep) / dt
    weight = gains["derivative_weight"]
    one, zero = jnp.ones_like(kp), jnp.zeros_like(kp)
    half = 0.5 * dt * ki
    back = (keep - 1) * sharp  # what a sample of the angle leaves in the filter
    return LinearController(
        A=jnp.stack([jnp.stack([one, zero]), jnp.stack([zero, keep])]),
        reference_in=jnp.stack([2 * half, back * weight]),
        measurement_in=jnp.stack([-2 * half, -back]),
        C=jnp.stack([one, kd]),
        reference_through=kp * gains["proportional_weight"] + half + kd * sharp * weight,
        measurement_through=-kp - half - kd * sharp,
        dt=dt,
    )


def _behind_a_filter(gains: Mapping[str, Float[Array, ""]], dt: float) -> LinearController:
    kp, ki, kd = gains["kp"], gains["ki"], gains["kd"]
    transition = butterworth(gains["measurement_filter"], dt)
    entry = jnp.array([1.0, 0.0], kp.dtype) - transition[:, 0]  # of the measurement
    bare = linear_pid({k: x for k, x in gains.items() if k != "measurement_filter"}, dt)
    heard = jnp.stack([kp + dt * ki, kd])  # u = ... - heard (v, v')
    none, zeros = jnp.zeros((2, 2), kp.dtype), jnp.zeros(2, kp.dtype)
    grown = none.at[0, 0].set(-dt * ki)  # of the integral, by v
    dot = lambda a, b: jnp.dot(a, b, precision="highest")
    return LinearController(
        A=jnp.block([[bare.A, dot(grown, transition)], [none, transition]]),
        reference_in=jnp.concatenate([bare.reference_in, zeros]),
        measurement_in=jnp.concatenate([dot(grown, entry), entry]),
        C=jnp.concatenate([bare.C, -dot(heard, transition)]),
        reference_through=bare.reference_through + 0.5 * dt * ki,
        measurement_through=-dot(heard, entry),
        dt=dt,
    )
