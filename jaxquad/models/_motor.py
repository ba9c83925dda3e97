import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._parameters import align, as_float, require_positive


class MotorLag(eqx.Module):
    """Motor and propeller as a first-order lag from the commanded to the effective input.

    Raises ValueError for a time constant that is not positive: a motor without lag has no state.
    """

    time_constant: Float[Array, "..."] = eqx.field(converter=as_float)  # s

    def __check_init__(self):
        remedy = "to model a motor without lag, leave the lag out (motor=None, lag=None)"
        require_positive("time_constant", self.time_constant, remedy)

    def derivative(
        self, state: Float[Array, " motors *ensemble"], command: Float[Array, " motors *ensemble"]
    ) -> Float[Array, " motors *ensemble"]:
        """Rate of change of the effective input, in units of `command` per s."""
        return (command - state) / align(self.time_constant[None], state)

    def step(
        self,
        state: Float[Array, " motors *ensemble"],
        command: Float[Array, " motors *ensemble"],
        dt: float | Float[Array, ""],
    ) -> Float[Array, " motors *ensemble"]:
        """The effective input after `dt` seconds of a held `command`, exactly."""
        return command + (state - command) * jnp.exp(-dt / align(self.time_constant[None], state))
