"""The flown loop again: what its law and the identified plant predict, beside what was measured."""

import dataclasses
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from .._protocols import LinearController
from ._ardupilot import ArduPilotRate
from ._betaflight import BetaflightADRC, BetaflightPID
from ._crazyflie import CrazyflieRate
from ._filters import FilterChain, PT1
from ._px4 import PX4Rate


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


class LoopCheck(NamedTuple):
    """Whether law and plant reproduce a flight.

    **Arguments:**

    - `omega`: rad/s.
    - `predicted`: the mean of the draws; `measured`: from set-point to rate.
    - `error`: one standard error of their difference, per component.
    - `inside`: the share of the frequencies where they differ by less than 95 % of chance.
    - `verdict`: in words.
    """

    omega: Float[np.ndarray, " frequencies"]
    predicted: Complex[np.ndarray, " frequencies"]
    measured: Complex[np.ndarray, " frequencies"]
    error: Float[np.ndarray, " frequencies"]
    inside: float
    verdict: str


_CHANCE = np.sqrt(-2 * np.log(0.05))  # radius of a circle that holds 95 % of a complex normal
_ENOUGH = 0.8  # of the frequencies: neighbours share their noise
_COARSEST = 0.5  # median error over |measured| beyond which nothing is told


def check_loop(
    omega: Float[Array | np.ndarray, " frequencies"],
    predictions: Complex[Array | np.ndarray, "draws frequencies"],
    measured: Complex[Array | np.ndarray, " frequencies"],
    random_error: Float[Array | np.ndarray, " frequencies"],
) -> LoopCheck:
    """Compare predicted closed loops with the measured one, before anything is proposed.

    **Arguments:**

    - `omega`: rad/s.
    - `predictions`: of `predict_loop`, for draws of the plant.
    - `measured`, `random_error`: as in a `jq.spectra.FrequencyResponse` from the set-point to the
        rate: the error is relative, 1 sigma of amplitude or phase.

    **Returns:** the `LoopCheck`.
    """
    omega, draws, seen = (np.asarray(x) for x in (omega, predictions, measured))
    mean = draws.mean(axis=0)
    spread = np.mean(np.abs(draws - mean) ** 2, axis=0) / 2
    error = np.sqrt(spread + (np.abs(seen) * np.asarray(random_error)) ** 2)
    away = np.abs(seen - mean) / error
    inside = float(np.mean(away < _CHANCE))
    return LoopCheck(omega, mean, seen, error, inside, _say(omega, mean, seen, error, inside))


def _say(omega, mean, seen, error, inside):
    coarse = float(np.median(error / np.abs(seen)))
    if coarse > _COARSEST:
        return (
            f"This log cannot tell: the measured response has an error of {100 * coarse:.0f} % in "
            "the median. Fly a sweep or doublets of the set-point on this axis."
        )
    worst = int(np.argmax(np.abs(seen - mean) / error))
    ratio, hertz = 20 * np.log10(abs(seen[worst] / mean[worst])), omega[worst] / (2 * np.pi)
    if inside >= _ENOUGH:
        return f"Law and plant reproduce the flight at {100 * inside:.0f} % of the frequencies."
    return (
        f"Law and plant do not reproduce the flight: only {100 * inside:.0f} % of the frequencies "
        f"agree, and at {hertz:.2g} Hz the measured response is {ratio:+.1f} dB from the predicted "
        "one. Check the parameters that flew, the units of the command, and what is unmodelled."
    )
