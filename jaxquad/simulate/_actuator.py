import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad.models import Allocation, QUANSER_HOVER


class MotorDrive(eqx.Module):
    """From roll, pitch and yaw commands in V to four motor voltages within their limits.

    A command is the difference of voltages that Eq. (9) multiplies: V4 - V2 for roll, V1 - V3 for
    pitch, V1 - V2 + V3 - V4 for yaw, about a common `bias`.
    """

    allocation: Allocation
    bias: float = eqx.field(static=True, default=QUANSER_HOVER.bias_voltage)  # V
    limit: float = eqx.field(static=True, default=QUANSER_HOVER.voltage_limit)  # V, either sign

    def __check_init__(self):
        if not abs(self.bias) < self.limit:
            raise ValueError(f"bias {self.bias} V must lie within the limit of {self.limit} V")

    def inputs(self, command: Float[Array, " 3 *ensemble"]) -> Float[Array, " 4 *ensemble"]:
        """Motor voltages, clipped at the amplifier's limit."""
        volts = self.allocation.from_differences(command, self.bias)
        return jnp.clip(volts, -self.limit, self.limit)

    def achieved(self, inputs: Float[Array, " 4 *ensemble"]) -> Float[Array, " 3 *ensemble"]:
        """The command that these voltages amount to: less than was asked for where they clip."""
        return self.allocation.differences(inputs)
