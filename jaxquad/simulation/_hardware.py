"""Actuators within their limits, and a sensor that counts."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import align, as_float, is_concrete, per_member
from jaxquad.models import Allocation, QUANSER_HOVER


_MOTOR_DRIVE = "jq.simulation.MotorDrive(plant.allocation)"
_ROTOR_DRIVE = (
    "jq.simulation.RotorDrive(plant.allocation, jq.models.CRAZYFLIE.hover_input, "
    "jq.models.CRAZYFLIE.top_speed)"
)


class MotorDrive(eqx.Module):
    """From roll, pitch and yaw commands in V to four motor voltages within their limits.

    A command is the difference of voltages that Eq. (9) multiplies: V4 - V2 for roll, V1 - V3 for
    pitch, V1 - V2 + V3 - V4 for yaw, about a common `bias`.

    **Arguments:**

    - `allocation`: of the vehicle, `plant.allocation` of a `jq.models.Multirotor`.
    - `bias`: V, at which all motors turn in hover; the Quanser Hover's by default.
    - `limit`: V, of each motor to either side; the Quanser Hover's by default.

    **Raises:**

    - `ValueError`: the bias is beyond the limit, or the vehicle is driven by squared rotor speeds.
    """

    allocation: Allocation
    bias: float = eqx.field(static=True, default=QUANSER_HOVER.bias_voltage)  # V
    limit: float = eqx.field(static=True, default=QUANSER_HOVER.voltage_limit)  # V, either sign

    def __check_init__(self):
        if self.allocation.input != "voltage":
            raise ValueError(
                "the vehicle takes squared rotor speeds, and a MotorDrive clips voltages: give "
                f"drive={_ROTOR_DRIVE}, with the numbers of your vehicle"
            )
        if not abs(self.bias) < self.limit:
            raise ValueError(
                f"bias is {self.bias} V, but it must lie within the limit of {self.limit} V: lower "
                "it, or raise the limit"
            )

    def inputs(self, command: Float[Array, " 3 *ensemble"]) -> Float[Array, " 4 *ensemble"]:
        """Motor voltages, clipped at the amplifier's limit."""
        volts = self.allocation.from_differences(command, self.bias)
        return jnp.clip(volts, -self.limit, self.limit)

    def forward_limit(self, axes: int) -> Float[Array, " 3 *ensemble"]:
        """The command of each axis alone at which the first motor would have to turn backwards."""
        units = jnp.eye(axes, dtype=self.allocation.arm.dtype)
        steepest = jnp.max(jnp.abs(self.allocation.from_differences(units, 0.0)), axis=0)
        return abs(self.bias) / steepest

    def achieved(self, inputs: Float[Array, " 4 *ensemble"]) -> Float[Array, " 3 *ensemble"]:
        """The command that these voltages amount to: less than was asked for where they clip."""
        return self.allocation.differences(inputs)


class RotorDrive(eqx.Module):
    """From roll, pitch and yaw commands in rad^2/s^2 to four squared rotor speeds from 0 to a top.

    A command is the difference of squared speeds that Eq. (9) multiplies, as in `MotorDrive`, about
    the squared speed at which the vehicle hovers.

    **Arguments:**

    - `allocation`: of the vehicle, `plant.allocation` of a `jq.models.Multirotor`.
    - `hover`: squared speed in rad^2/s^2, as `jq.models.CRAZYFLIE.hover_input`.
    - `top_speed`: of a rotor in rad/s, as `jq.models.CRAZYFLIE.top_speed`.

    **Raises:**

    - `ValueError`: the hover is not between 0 and the top, or the vehicle is driven by voltages.
    """

    allocation: Allocation
    hover: float = eqx.field(static=True)  # rad^2/s^2
    top_speed: float = eqx.field(static=True)  # rad/s

    def __check_init__(self):
        if self.allocation.input != "omega2":
            raise ValueError(
                "the vehicle takes voltages, and a RotorDrive gives squared rotor speeds: give "
                f"drive={_MOTOR_DRIVE}"
            )
        if not 0 < self.hover < self.top_speed**2:
            raise ValueError(
                f"hover is {self.hover} rad^2/s^2, but it must lie between 0 and top_speed^2, "
                f"{self.top_speed**2}: give the squared speed that carries the vehicle"
            )

    def inputs(self, command: Float[Array, " 3 *ensemble"]) -> Float[Array, " 4 *ensemble"]:
        """Squared rotor speeds, clipped: a rotor does not turn backwards."""
        squares = self.allocation.from_differences(command, self.hover)
        return jnp.clip(squares, 0.0, self.top_speed**2)

    def achieved(self, inputs: Float[Array, " 4 *ensemble"]) -> Float[Array, " 3 *ensemble"]:
        """The command that these speeds amount to: less than was asked for where they clip."""
        return self.allocation.differences(inputs)


class Saturation(eqx.Module):
    """A drive that takes commands as they are, within a limit: for `jq.DecoupledAxes`.

    **Arguments:**

    - `limit`: of |command|, in its unit; one value, or one per axis.

    **Raises:**

    - `ValueError`: the limit is not above 0.
    """

    limit: Float[Array, "..."] = per_member(rank=1, converter=as_float)  # of |u|; [], [axes, ...]

    def __check_init__(self):
        if is_concrete(self.limit) and not np.all(np.asarray(self.limit) > 0):
            raise ValueError(
                f"limit is {self.limit}, but it must be above 0: it bounds the command on both "
                "sides, in the command's unit"
            )

    def inputs(self, command: Float[Array, " axes *ensemble"]) -> Float[Array, " axes *ensemble"]:
        """The command within the limit."""
        limit = align(self.limit, command).astype(command.dtype)
        return jnp.clip(command, -limit, limit)

    def achieved(self, inputs: Float[Array, " axes *ensemble"]) -> Float[Array, " axes *ensemble"]:
        """The command that these inputs amount to: themselves."""
        return inputs


class Encoder(eqx.Module):
    """An optical encoder: angles in steps of one count, with the gradient of the angle itself.

    **Arguments:**

    - `counts`: in a revolution.

    **Raises:**

    - `ValueError`: there is less than one count.
    """

    counts: int = eqx.field(static=True, default=8192)  # per revolution

    def __check_init__(self):
        if self.counts < 1:
            raise ValueError(f"counts is {self.counts}: an encoder has at least 1 per revolution")

    def __call__(self, angle: Float[Array, "..."]) -> Float[Array, "..."]:
        """The counted angle in rad."""
        step = 2 * jnp.pi / self.counts
        counted = step * jnp.round(angle / step)
        # Straight through: the derivative of the rounding itself is zero or infinite.
        return angle + jax.lax.stop_gradient(counted - angle)
