from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxquad._core import as_float, broadcast_gain, per_member, require_nonnegative

from .._protocols import InertiaEstimate


class ProbeState(NamedTuple):
    index: Int[Array, ""]  # samples
    exciting: Float[Array, " axes *ensemble"]  # 1 while the tones are on


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

    **Raises:**

    - `ValueError`: a frequency is not positive, or `below` is above `above`.
    """

    frequencies: tuple[float, ...] = eqx.field(static=True, default=(2.0,))  # Hz
    amplitude: Float[Array, "..."] = per_member(
        rank=1, converter=as_float, default=0.3
    )  # of each sine
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

    def init(self, like: Float[Array, " axes *ensemble"]) -> ProbeState:
        return ProbeState(jnp.zeros((), jnp.int32), jnp.ones_like(like))

    def step(self, state: ProbeState, estimate: InertiaEstimate) -> ProbeState:
        """The state one sample later, switched by the `estimate`."""
        return ProbeState(state.index + 1, self.switch(state.exciting, estimate))

    def switch(
        self, exciting: Float[Array, " axes *ensemble"], estimate: InertiaEstimate
    ) -> Float[Array, " axes *ensemble"]:
        """Whether the tones are on after this sample, 1 or 0."""
        if self.above == 0:
            return jnp.ones_like(exciting)
        doubt, known = jax.lax.stop_gradient((estimate.deviation, jnp.abs(estimate.inertia)))
        staying = jnp.where(doubt < self.below * known, 0, exciting)
        needed = (doubt > self.above * known) | (self._amplitude(exciting) == 0)
        return jnp.where(needed, 1, staying)

    def signal(self, state: ProbeState, dt: float) -> Float[Array, " axes *ensemble"]:
        """The sines, where they are on, in units of the command."""
        time = dt * state.index.astype(state.exciting.dtype)
        return self.wave(time * jnp.asarray(self.frequencies, time.dtype), state.exciting)

    def wave(
        self, phase: Float[Array, " tones"], exciting: Float[Array, " axes *ensemble"]
    ) -> Float[Array, " axes *ensemble"]:
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

    def init(self, like: Float[Array, " axes *ensemble"]) -> ProbeState:
        return ProbeState(jnp.zeros((), jnp.int32), jnp.ones_like(like))

    def step(self, state: ProbeState, estimate: InertiaEstimate) -> ProbeState:
        return state

    def signal(self, state: ProbeState, dt: float) -> Float[Array, " axes *ensemble"]:
        return jnp.zeros_like(state.exciting)
