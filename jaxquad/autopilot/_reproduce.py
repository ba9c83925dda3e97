"""The flown loop again: what its law and the identified plant predict, beside what was measured."""

import dataclasses
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxquad.control import LinearController

from ._filters import FilterChain, PT1
from .ardupilot._law import ArduPilotRate
from .betaflight._law import BetaflightADRC, BetaflightPID
from .crazyflie._firmware import CrazyflieRate
from .px4._firmware import PX4Rate


Rate = TypeVar(
    "Rate", bound=BetaflightPID | BetaflightADRC | PX4Rate | ArduPilotRate | CrazyflieRate
)


def without_gyro_filters(law: Rate) -> Rate:
    """The law as it acts on the logged rate, which is behind the gyro's filters in all firmwares.

    A plant that was identified up to that rate contains the filters.
    """
    if isinstance(law, BetaflightPID | BetaflightADRC):
        return dataclasses.replace(law, gyro=FilterChain(), filters=())
    if isinstance(law, PX4Rate) and law.gyro.filters:
        open = FilterChain((PT1(0.0),), law.gyro.rate_hz)  # the derivative is at the gyro's rate
        return dataclasses.replace(law, gyro=open)
    return dataclasses.replace(law, gyro=FilterChain())


@eqx.filter_jit
def predict_loop(
    law: LinearController,
    plant: Complex[Array | np.ndarray, "... frequencies"],
    omega: Float[Array | np.ndarray, " frequencies"],
) -> Complex[Array, "... frequencies"]:
    """The closed loop's response from set-point to measurement.

    **Arguments:**

    - `law`: of one axis, `law.linear(axis)`; of the rate, for a plant up to the rate.
    - `plant`: its response from the command to the measurement in rad or rad/s, the hold of the
        command included (`hold_response`); draws of it on leading axes.
    - `omega`: rad/s, below pi/dt.
    """
    turn = omega * law.dt
    z = jax.lax.complex(jnp.cos(turn), jnp.sin(turn))
    inputs = jnp.stack([law.reference_in, law.measurement_in], axis=1)
    through = jnp.stack([law.reference_through, law.measurement_through])
    states = len(law.A)

    def at(z: Array) -> Array:
        resolvent = z * jnp.eye(states, dtype=z.dtype) - law.A.astype(z.dtype)
        return law.C.astype(z.dtype) @ jnp.linalg.solve(resolvent, inputs.astype(z.dtype))

    ahead, back = (jax.vmap(at)(z) + through.astype(z.dtype)[None]).T
    plant = jnp.asarray(plant, z.dtype)
    wide = (1,) * (plant.ndim - 1) + (-1,)
    return plant * ahead.reshape(wide) / (1 - plant * back.reshape(wide))


def hold_response(
    omega: Float[Array | np.ndarray, " frequencies"], dt: float
) -> Complex[np.ndarray, " frequencies"]:
    """Of a command that is held over samples of `dt` seconds, at `omega` in rad/s."""
    half = np.asarray(omega) * dt / 2
    return np.sinc(half / np.pi) * np.exp(-1j * half)
