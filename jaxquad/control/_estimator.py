"""What inertia estimators share: plant, trust, filtered equation of motion, test tones."""

from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxquad._core import (
    as_float,
    broadcast_gain,
    ensemble_shape,
    per_member,
    require_all_positive,
    require_common_shape,
    require_nonnegative,
    require_positive,
)

from ._protocols import Gain, InertiaEstimate, Signal


PLAUSIBLE = 10.0  # times the nominal inertia, or a share of it


class LastEstimate(NamedTuple):
    """An estimate between the samples or windows that renew it."""

    inertia: Signal  # kg m^2
    variance: Signal  # (kg m^2)^2, when it was made
    age: Signal  # relative variance that has come with time
    informed: Signal  # 1 once there was excitation


State = TypeVar("State", bound=Any)  # a NamedTuple with the field `last`, a LastEstimate


class AbstractInertia(eqx.Module):
    """The plant and the rules of trust that all estimators share.

    A plant of the inertia J answers a command u with J angle'' = `torque_gain` u + disturbances.
    """

    torque_gain: Gain = per_member(rank=1, converter=as_float)  # N m per unit of command
    nominal: Gain = per_member(rank=1, converter=as_float)  # kg m^2
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

    def _start(self, like: Signal) -> LastEstimate:
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


class Past(NamedTuple):
    """What differences need of the samples before."""

    angle: Signal
    change: Signal  # of the angle over the last sample
    command: Signal  # held during it
    samples: Int[Array, ""]  # samples, counted to 2


class Equation(NamedTuple):
    """Both sides of J acceleration = torque at one sample, each centred on the sample before."""

    acceleration: Signal  # rad/s^2
    torque: Signal  # N m
    rate: Signal  # rad/s
    angle: Signal  # rad
    valid: Float[Array, ""]  # 0 for the first two samples, whose differences have no past


def empty_past(like: Signal) -> Past:
    zero = jnp.zeros_like(like)
    return Past(zero, zero, zero, jnp.zeros((), jnp.int32))


def motion(
    past: Past, torque_gain: Gain, command: Signal, measurement: Signal, dt: float
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
        (past.samples >= 2).astype(measurement.dtype),
    )
    return Past(measurement, change, command, jnp.minimum(past.samples + 1, 2)), equation


class ProbeState(NamedTuple):
    index: Int[Array, ""]  # samples
    exciting: Signal  # 1 while the tones are on


class ProbeTones(eqx.Module):
    """Sines to add to the command while the inertia is in doubt.

    They start when the estimate's relative standard deviation is above `above` and stop when it is
    below `below`: permanent tones of 0.3 V at 2 Hz add two thirds to the ITAE of a step of the
    Hover. An estimator learns only while its tones are on, because without them a closed loop shows
    the controller, not the plant.

    **Arguments:**

    - `frequencies`: in Hz.
    - `amplitude`: of each sine in units of the command, a scalar or one value per axis. 0 says that
        other signals excite the loop all the time.
    - `above`, `below`: relative standard deviations; `above=0` keeps the tones on.

    **Raises:** `ValueError`: a frequency is not positive, or `below` is above `above`.
    """

    frequencies: tuple[float, ...] = eqx.field(static=True, default=(2.0,))  # Hz
    amplitude: Gain = per_member(rank=1, converter=as_float, default=0.3)  # of each sine
    above: float = eqx.field(static=True, default=0.08)
    below: float = eqx.field(static=True, default=0.04)

    def __check_init__(self):
        if not self.frequencies or not all(f > 0 for f in self.frequencies):
            raise ValueError(f"frequencies are {self.frequencies} Hz: give at least one, above 0.")
        if self.above != 0 and not 0 <= self.below <= self.above:
            raise ValueError(
                f"Tones start above {self.above} and stop below {self.below}: give 0 <= below <= "
                "above, or above=0 for permanent tones."
            )
        require_nonnegative("amplitude", self.amplitude, "give units of the command")

    def init(self, like: Signal) -> ProbeState:
        return ProbeState(jnp.zeros((), jnp.int32), jnp.ones_like(like))

    def step(self, state: ProbeState, estimate: InertiaEstimate) -> ProbeState:
        """The state one sample later, switched by the `estimate`."""
        return ProbeState(state.index + 1, self.switch(state.exciting, estimate))

    def switch(self, exciting: Signal, estimate: InertiaEstimate) -> Signal:
        """Whether the tones are on after this sample, 1 or 0."""
        if self.above == 0:
            return jnp.ones_like(exciting)
        deviation, inertia = jax.lax.stop_gradient((estimate.deviation, jnp.abs(estimate.inertia)))
        staying = jnp.where(deviation < self.below * inertia, 0, exciting)
        needed = (deviation > self.above * inertia) | (self._amplitude(exciting) == 0)
        return jnp.where(needed, 1, staying)

    def signal(self, state: ProbeState, dt: float) -> Signal:
        """The sines, where they are on, in units of the command."""
        time = dt * state.index.astype(state.exciting.dtype)
        return self.wave(time * jnp.asarray(self.frequencies, time.dtype), state.exciting)

    def wave(self, phase: Float[Array, " tones"], exciting: Signal) -> Signal:
        """The sines at these phases in cycles."""
        wave = jnp.sum(jnp.sin(2 * jnp.pi * (phase % 1)))
        return self._amplitude(exciting) * wave * exciting

    def _amplitude(self, like):
        amplitude = self.amplitude[None] if self.amplitude.ndim == 0 else self.amplitude
        return broadcast_gain(amplitude, like)


class NoProbe(eqx.Module):
    """No test signal: the estimator uses every sample.

    Only for loops that are excited by other means, an injected signal or a busy reference. Where
    only gusts move the Hover, least squares finds the controller instead of the plant: of 64 loops
    with b0 = 1.6 one in seven trusted an inertia that was up to 40 % off.
    """

    def init(self, like: Signal) -> ProbeState:
        return ProbeState(jnp.zeros((), jnp.int32), jnp.ones_like(like))

    def step(self, state: ProbeState, estimate: InertiaEstimate) -> ProbeState:
        return state

    def signal(self, state: ProbeState, dt: float) -> Signal:
        return jnp.zeros_like(state.exciting)
