"""Actuators within their limits and the torque they have, a sensor that counts, and delays."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import (
    align,
    as_float,
    ensemble_shape,
    is_concrete,
    multiply_gains,
    of_one_rank,
    per_member,
    require_limit,
)
from jaxquad.loops import Drive, Loop, Plant
from jaxquad.models import Allocation, QUANSER_HOVER

from ._scenario import axis_names, Scenario


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
        require_limit(self.limit)

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


class DelayLine(eqx.Module):
    """The inputs on their way to the plant, for a delay of any number of samples, whole or not.

    During a sample interval the plant first feels an `early` input, for the share of the interval
    by which the delay exceeds whole samples, then a `late` one. All inputs first wait in a queue
    for the samples that every member waits at least; only the further ones differ by member.
    """

    samples: Float[Array, "*members"] = per_member(rank=0)  # the delay, in sample intervals
    fewest: int = eqx.field(static=True)  # whole samples that every member waits
    further: int = eqx.field(static=True)  # how many inputs are kept beyond the queue
    splits: bool = eqx.field(static=True)  # whether there are early inputs at all

    def step(
        self, past: Float[Array, "past ..."] | None, inputs: Float[Array, " inputs *ensemble"]
    ) -> tuple[Array | None, Array, Array]:
        """The past of the next sample, and the early and late inputs of this one.

        `inputs` are those that leave the queue; without a queue, the newest.
        """
        if past is None:
            return None, inputs, inputs
        waiting = jnp.concatenate([inputs[None], past])
        if self.further == 1 and self.splits:  # all members' delays have the same whole samples
            return waiting[:-1], waiting[1], waiting[0]
        samples = jnp.floor(self.samples).astype(int) - self.fewest
        late = _of_age(waiting, samples)
        return waiting[:-1], _of_age(waiting, samples + 1) if self.splits else late, late


def _of_age(queue: Float[Array, "ages ..."], age: Array) -> Array:
    # A mask, not a gather, whose reverse would be a scatter.
    ages = jnp.arange(len(queue)).reshape((-1,) + (1,) * (queue.ndim - 1))
    age = age.reshape((1,) * (queue.ndim - age.ndim) + age.shape)
    rows = jnp.where(ages == age, queue, 0)
    while len(rows) > 1:  # a sum by halves: a kernel cannot hold a reduction of many numbers
        half = len(rows) // 2
        total, odd = rows[:half] + rows[half : 2 * half], rows[2 * half :]
        rows = jnp.concatenate([total, odd]) if len(odd) else total
    return rows[0]


def delay_line(loop: Loop) -> DelayLine | None:
    """That of a loop; None without a delay."""
    length, splits, traced, fewest = loop.queue
    if length == 0:
        return None
    delay, longest = loop.delay, loop.longest_delay or 0.0
    if traced:
        wrong = (delay < 0) | (delay > longest * (1 + 1e-9)) | ~jnp.isfinite(delay)
        message = f"delay is outside 0 to longest_delay = {longest} s: raise longest_delay"
        delay = eqx.error_if(delay, wrong, message)
    samples = delay / loop.dt
    samples = samples if splits else jnp.round(samples)
    return DelayLine(samples, fewest, length - fewest, splits)


_ALL = 1e12  # units of command, more than any drive gives


class AuthorityWarning(UserWarning):
    """A scenario asks for more torque than the drive has."""


class Authority(eqx.Module):
    """The torque that a drive can hold against a disturbance, one axis at a time.

    **Arguments:**

    - `torque_gain`: N m per unit of command.
    - `command`: greatest command, of the drive and the controller; or inf.
    - `torque`: N m, at the limit of the command; inf without one.
    - `forward`: N m, until a motor turns backwards; inf if none can.
    """

    torque_gain: Float[Array, " axes *ensemble"] = per_member(rank=1)
    command: Float[Array, "axes ..."] = per_member(rank=1)
    torque: Float[Array, "axes ..."] = per_member(rank=1)
    forward: Float[Array, "axes ..."] = per_member(rank=1)

    def __str__(self) -> str:
        rows = []
        for k, name in enumerate(axis_names(self.torque.shape[0])):
            row = f"  {name}: {_span(self.torque[k])} N m"
            if np.isfinite(self.forward[k]).all():
                row += f", {_span(self.forward[k])} N m without a motor turning backwards"
            rows.append(row)
        return "\n".join(["torque authority", *rows])


def authority(
    plant: Plant, drive: Drive | None = None, controller: object | None = None
) -> Authority:
    """The torque in N m that `drive` gives on each axis of `plant` alone.

    **Arguments:**

    - `plant`: with a `torque_gain` in N m per unit of command, as `jq.DecoupledAxes` has.
    - `drive`: its saturation limits the command. With motors about a bias, such as
        `jq.simulation.MotorDrive`, `forward` is the torque at which the first of them would have to
        turn backwards: 0.0936 N m in roll on the Quanser Hover at its bias of 2 V.
    - `controller`: its `limit` counts, if it has one.

    **Raises:** ValueError for a plant whose torque per unit of command is not known.
    """
    result = eqx.filter_jit(find_authority)(plant, drive, controller)
    if result is None:
        raise ValueError(
            f"a {type(plant).__name__} has no torque_gain [axes] in N m per unit of command: add "
            "one, as jq.DecoupledAxes has"
        )
    return result


def find_authority(
    plant: Plant, drive: Drive | None, controller: object | None
) -> Authority | None:
    """`authority`, or None for a plant whose torque per unit of command is not known.

    What a drive has is asked for by name: a `limit` [axes, *ensemble], as controllers have, and
    `forward_limit(axes)` where its motors have a direction.
    """
    torque_gain = getattr(plant, "torque_gain", None)
    if torque_gain is None:
        return None
    gain = jnp.atleast_1d(as_float(torque_gain))
    limits = [getattr(part, "limit", jnp.inf) for part in (controller, drive)]
    limits = [jnp.atleast_1d(as_float(x)) for x in limits]
    axes = max(len(x) for x in (gain, *limits))
    gain = jnp.broadcast_to(gain, (axes, *gain.shape[1:]))
    most = jnp.full_like(gain, jnp.inf)
    if drive is not None:  # of the command of each axis alone: it is asked for all
        members = jnp.broadcast_shapes(gain.shape[1:], ensemble_shape(drive))
        wide, rows = jnp.zeros((axes, *members), gain.dtype), []
        for k, unit in enumerate(jnp.eye(axes, dtype=gain.dtype)):
            asked_for = _ALL * jnp.broadcast_to(align(unit, wide), wide.shape)
            both = [drive.achieved(drive.inputs(sign * asked_for))[k] for sign in (1.0, -1.0)]
            rows.append(jnp.minimum(*(jnp.abs(x) for x in both)))
        most = jnp.stack(rows)
        most = jnp.where(most < 0.99 * _ALL, most, jnp.inf)
    command = jnp.minimum(*of_one_rank(most, limits[0]))
    forward = jnp.full_like(gain, jnp.inf)  # the command at which the first motor stops
    if (forward_limit := getattr(drive, "forward_limit", None)) is not None:
        forward = forward_limit(axes).astype(gain.dtype)
    return Authority(gain, command, *(multiply_gains(gain, x) for x in (command, forward)))


def warn_beyond_authority(drive_authority: Authority | None, scenario: Scenario) -> None:
    """Warn of disturbances that no controller can hold. Silent for traced values."""
    for message in beyond_authority(drive_authority, scenario):
        warnings.warn(message, AuthorityWarning, stacklevel=3)


def beyond_authority(drive_authority: Authority | None, scenario: Scenario) -> list[str]:
    """What to say of disturbances that no controller can hold; nothing for traced values."""
    if drive_authority is None or not (
        is_concrete(scenario.disturbance) and is_concrete(drive_authority.torque)
    ):
        return []
    torque = np.abs(np.asarray(scenario.disturbance))
    most, forward = np.asarray(drive_authority.torque), np.asarray(drive_authority.forward)
    limits = (
        (most, "that the drive has: no controller holds the angle there"),
        (forward, "that the motors give without turning backwards"),
    )
    if all(torque.max(initial=0.0) <= limit.min(initial=np.inf) for limit, _ in limits):
        return []
    messages = []
    for k, name in enumerate(axis_names(torque.shape[1])):
        for limit, what in limits:
            least, demanded = limit[min(k, len(limit) - 1)], torque[:, k]
            demanded = demanded.reshape(demanded.shape + (1,) * (least.ndim + 1 - demanded.ndim))
            share = np.mean(demanded > (1 + 1e-6) * least)
            if share:
                messages.append(
                    f"the disturbance of {name} reaches {torque[:, k].max():.4g} N m: "
                    f"{share:.1%} of the samples exceed the {_span(least)} N m {what}. Lower it, "
                    "or raise the limit or the bias"
                )
                break
    return messages


def _span(values: ArrayLike) -> str:
    low, high = np.min(values), np.max(values)
    return f"{low:.4g}" if low == high else f"{low:.4g} .. {high:.4g}"
