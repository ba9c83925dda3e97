from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad.models._parameters import align

from ._ladrc_gains import LADRCGains
from ._observers import Observer
from ._per_axis import fit, full_shape, matched
from ._setpoint import Setpoint


class LADRCState(NamedTuple):
    """What a LADRC remembers from the last sample."""

    estimate: Float[Array, "states axes *ensemble"]  # [y, y', f], order 1 [y, f]
    command: Float[Array, " axes *ensemble"]  # as applied
    b0: Float[Array, " axes *ensemble"]  # in force


class LADRCLaw(eqx.Module):
    """A `LADRC` with its gains computed: what a loop runs, sample by sample."""

    gains: LADRCGains
    b0: Float[Array, "..."]
    limit: Float[Array, "..."]
    ensemble: tuple[int, ...] = eqx.field(static=True)
    observer: Observer
    dt: float = eqx.field(static=True)

    def init(
        self,
        like: Float[Array, " axes *ensemble"],
        measurement: Float[Array, " axes *ensemble"] | None = None,
    ) -> LADRCState:
        zero = jnp.zeros(full_shape(like, self.ensemble), like.dtype)
        first = zero if measurement is None else zero + align(measurement, zero)
        estimate = jnp.stack([first] + [zero] * (len(self.gains.correction) - 1))
        return LADRCState(estimate, zero, zero + fit(self.b0, zero))

    def step(
        self, state: LADRCState, reference: Any, measurement: Float[Array, " axes *ensemble"]
    ) -> tuple[LADRCState, Float[Array, " axes *ensemble"]]:
        return self._advance(state, state.estimate[-1], reference, measurement, self.b0)

    def step_with(
        self,
        state: LADRCState,
        reference: Any,
        measurement: Float[Array, " axes *ensemble"],
        b0: Float[Array, "..."],
    ) -> tuple[LADRCState, Float[Array, " axes *ensemble"]]:
        # f = y'' - b0 u: another b0 moves the disturbance, so that y'' and u stay as they are.
        unknown = state.estimate[-1] + (state.b0 - fit(b0, measurement)) * state.command
        return self._advance(state, unknown, reference, measurement, b0)

    def applied(self, state: LADRCState, achieved: Float[Array, " axes *ensemble"]) -> LADRCState:
        return state._replace(command=achieved)

    def signals(self, state: LADRCState) -> dict[str, Array]:
        return {"disturbance": state.estimate[-1] / state.b0}

    def _advance(self, state, unknown, reference, measurement, b0):
        reference = matched(reference, measurement, state.command)
        # Row by row: stacks and slices of the estimate cost most of a reverse pass.
        b0 = jnp.broadcast_to(fit(b0, measurement), measurement.shape)
        estimate = [*state.estimate[:-1], unknown]
        predicted = self.observer.predict(estimate, b0 * state.command, self.dt)
        error = measurement - predicted[0]
        gains = [fit(row, measurement) for row in self.gains.correction]
        corrected = [x + l * error for x, l in zip(predicted, gains, strict=True)]
        command = self._feedback(corrected if self.observer.current else predicted, reference) / b0
        limit = fit(self.limit, command)
        command = jnp.clip(command, -limit, limit)
        return LADRCState(jnp.stack(corrected), command, b0), command

    def _feedback(self, estimate: Sequence[Array], reference: Any) -> Array:
        """What b0 u is to be, in rad/s^2; order 1 in rad/s."""
        ahead = isinstance(reference, Setpoint)
        angle = reference.angle if ahead else reference
        drive = fit(self.gains.proportional, angle) * (angle - estimate[0]) - estimate[-1]
        if self.gains.derivative is None:
            return drive + reference.rate if ahead else drive
        error = reference.rate - estimate[1] if ahead else -estimate[1]
        drive = drive + fit(self.gains.derivative, angle) * error
        return drive + reference.acceleration if ahead else drive
