"""A PID behind a second-order filter of its measurement: noise rolls off as with a LADRC."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad.control import LinearController


class FilteredPID(eqx.Module):
    """u = ki int(r - v) - kp v - kd v', within +-limit; v is y through a Butterworth filter.

    Source: Astrom & Hagglund, Advanced PID Control, ch. 3. The filter is exact for a measurement
    that is held over the sample before it. While `told`, the integral stops where it would drive a
    saturated command further. Gains [axes, *ensemble], in units of the command.
    """

    kp: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    ki: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    kd: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    filter: Float[Array, "..."] = eqx.field(converter=jnp.asarray)  # rad/s
    limit: Float[Array, "..."] = eqx.field(converter=jnp.asarray)
    told: bool = eqx.field(static=True)
    dt: float = eqx.field(static=True)  # s

    @property
    def ensemble(self) -> tuple[int, ...]:
        return self.kp.shape[1:]

    def init(self, like: Float[Array, " axes *ensemble"]) -> Float[Array, "3 axes *ensemble"]:
        """Filtered angle in rad, its rate, and the integral of the error in rad s."""
        return jnp.zeros((3, *jnp.broadcast_shapes(like.shape, self.kp.shape)), like.dtype)

    def step(self, state: Any, reference: Any, measurement: Any) -> tuple[Any, Any]:
        angle, rate, integral = self._advanced(state, reference, measurement)
        wanted = self.ki * integral - self.kp * angle - self.kd * rate
        command = jnp.clip(wanted, -self.limit, self.limit)
        if self.told:
            further = (wanted - command) * (integral - state[2]) > 0
            integral = jnp.where(further, state[2], integral)
        return jnp.stack([angle, rate, integral]), command

    def linear(self, axis: int = 0, member: Any = ()) -> LinearController:
        """One axis without its limit, exactly."""
        one = jax.tree.map(lambda x: x[(axis, *member)], self)
        basis = jnp.eye(5, dtype=self.kp.dtype)  # the state, the set-point, the measurement
        columns = jax.vmap(lambda x: jnp.stack(one._advanced(x[:3], x[3], x[4])))(basis).T
        row = jnp.stack([-one.kp, -one.kd, one.ki])
        sent = row @ columns
        return LinearController(
            columns[:, :3], columns[:, 3], columns[:, 4], sent[:3], sent[3], sent[4], self.dt
        )

    def _advanced(self, state: Any, reference: Any, measurement: Any) -> tuple[Any, Any, Any]:
        away, rate = state[0] - measurement, state[1]
        slow = self.filter / jnp.sqrt(2.0)  # both parts of the poles
        decay, turn = jnp.exp(-slow * self.dt), slow * self.dt
        cosine, sine = decay * jnp.cos(turn), decay * jnp.sin(turn)
        angle = measurement + (cosine + sine) * away + sine / slow * rate
        rate = (cosine - sine) * rate - 2 * slow * sine * away
        return angle, rate, state[2] + self.dt * (reference - angle)
