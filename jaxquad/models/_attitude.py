"""Rotations; attitude dynamics of a rigid body about all axes, and of axes without coupling."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import (
    align,
    as_float,
    as_float_or_none,
    on_host,
    per_member,
    require_finite,
    require_nonnegative,
    require_positive,
    require_vector,
)

from ._response import arctan2, sincos


Vector = Float[Array, " 3 *ensemble"]  # of each member of an ensemble
PerAxis = Float[Array, "3 ..."]  # or `[3, *ensemble]`
Axes = Float[Array, "axes ..."]
AxisValues = Float[Array, " axes *ensemble"]
Four = Float[Array, " 4 *ensemble"]  # of a quaternion, or of four motors


def euler_rates_matrix(euler: Vector) -> Float[Array, " 3 3 *ensemble"]:
    """The W of `rate = W @ euler_rates`, for ZYX Euler angles in rad.

    Source: Eq. (1), where the matrix itself is not printed. W is no rotation: its determinant is
    cos(pitch), so it has no inverse at a pitch of 90 degrees.
    """
    (s_phi, s_theta, _), (c_phi, c_theta, _) = jnp.sin(euler), jnp.cos(euler)
    zero, one = jnp.zeros_like(s_phi), jnp.ones_like(s_phi)
    return jnp.stack(
        [
            jnp.stack([one, zero, -s_theta]),
            jnp.stack([zero, c_phi, s_phi * c_theta]),
            jnp.stack([zero, -s_phi, c_phi * c_theta]),
        ]
    )


def euler_rates(euler: Vector, rate: Vector) -> Vector:
    """Derivatives of the Euler angles, rad/s, at a body `rate` in rad/s: Eq. (1), solved."""
    phi, theta, _ = euler
    p, q, r = rate
    (s_phi, c_phi), (s_theta, c_theta) = sincos(phi), sincos(theta)
    heading = (s_phi * q + c_phi * r) / c_theta
    return jnp.stack([p + s_theta * heading, c_phi * q - s_phi * r, heading])


def euler_acceleration(euler: Vector, rate: Vector, rate_derivative: Vector) -> Vector:
    """Second derivatives of the Euler angles, rad/s^2.

    Source: Eq. (8), corrected: its right side is `rate_derivative`, and the left side follows as
    inv(W) (rate_derivative - dW/dt euler_rates), which is the time derivative of inv(W) rate.
    """
    tangent = (euler_rates(euler, rate), rate_derivative)
    return jax.jvp(euler_rates, (euler, rate), tangent)[1]


def quaternion_from_euler(euler: Vector) -> Four:
    """Unit quaternion, scalar first, that turns body into earth vectors; angles ZYX in rad."""
    (s_phi, s_theta, s_psi), (c_phi, c_theta, c_psi) = jnp.sin(euler / 2), jnp.cos(euler / 2)
    return jnp.stack(
        [
            c_phi * c_theta * c_psi + s_phi * s_theta * s_psi,
            s_phi * c_theta * c_psi - c_phi * s_theta * s_psi,
            c_phi * s_theta * c_psi + s_phi * c_theta * s_psi,
            c_phi * c_theta * s_psi - s_phi * s_theta * c_psi,
        ]
    )


def euler_from_quaternion(quaternion: Four) -> Vector:
    """ZYX Euler angles in rad of a unit `quaternion`, with a finite gradient at every attitude."""
    w, x, y, z = quaternion
    limit = 1 - jnp.finfo(quaternion.dtype).eps  # arcsin has an infinite slope at 1
    sine = jnp.clip(2 * (w * y - z * x), -limit, limit)
    ahead = [1 - 2 * (x * x + y * y), jnp.sqrt((1 - sine) * (1 + sine)), 1 - 2 * (y * y + z * z)]
    return _angles(jnp.stack([2 * (w * x + y * z), sine, 2 * (w * z + x * y)]), jnp.stack(ahead))


@jax.custom_jvp
def _angles(y: Float[Array, "*shape"], x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    return jnp.asarray(arctan2(y, x))


@_angles.defjvp
def _angles_jvp(primals, tangents):
    (y, x), (dy, dx) = primals, tangents
    return _angles(y, x), (x * dy - y * dx) / (x * x + y * y)


def quaternion_derivative(quaternion: Four, rate: Vector) -> Four:
    """Time derivative, 1/s, of a body-to-earth `quaternion` at a body `rate` in rad/s."""
    scalar, vector = quaternion[:1], quaternion[1:]
    along = -jnp.sum(vector * rate, axis=0, keepdims=True)
    across = scalar * rate + jnp.cross(vector, rate, axis=0)
    return jnp.concatenate([along, across]) / 2


_CREEP = 0.01  # rad/s, at which the torque reaches 76 % of its level


def _friction(coulomb: Float[Array, "..."], rate: AxisValues) -> AxisValues:
    """Dry-friction torque in N m at `rate` in rad/s, smoothed so that it has a gradient."""
    return -align(coulomb, rate) * jnp.tanh(rate / _CREEP)


class Attitude(eqx.Module):
    """A rigid multirotor turning about its centre of mass, in principal body axes.

    Source: Eq. (2) and (5)-(7) of the paper, corrected, with `damping` for K_af and `rotor_inertia`
    for J_M.

    **Arguments:** (one value per axis each, or `[3, *ensemble]`)

    - `inertia`: in kg m^2; `damping`: in N m s/rad.
    - `rotor_inertia`: of one rotor in kg m^2, one value or `[*ensemble]`; 0 leaves the spin out.
    - `stiffness`: in N m/rad, of a test stand whose centre of mass is below its pivot: a body
        torque per Euler angle, to first order in the angles. None leaves it out.
    - `coulomb`: the dry friction of the bearings in N m, coulomb * tanh(rate / 0.01 rad/s); None
        leaves it out.

    **Raises:** `ValueError`: an inertia is not positive, or a value is not finite.
    """

    inertia: PerAxis = per_member(rank=1, converter=as_float)
    damping: PerAxis = per_member(rank=1, converter=as_float, default=(0.0,) * 3)
    rotor_inertia: Float[Array, "..."] = per_member(rank=0, converter=as_float, default=0.0)
    stiffness: PerAxis | None = per_member(rank=1, converter=as_float_or_none, default=None)
    coulomb: PerAxis | None = per_member(rank=1, converter=as_float_or_none, default=None)

    def __check_init__(self):
        require_vector("inertia", self.inertia, 3)
        require_vector("damping", self.damping, 3)
        require_positive("inertia", self.inertia, "give kg m^2, about 0.005 to 0.1 on a quadrotor")
        require_finite("damping", self.damping)
        require_nonnegative("rotor_inertia", self.rotor_inertia, "0 leaves the rotors' spin out")
        if self.stiffness is not None:
            require_vector("stiffness", self.stiffness, 3)
            require_finite("stiffness", self.stiffness)
        if self.coulomb is not None:
            require_vector("coulomb", self.coulomb, 3)
            require_nonnegative("coulomb", self.coulomb, "friction acts against the motion")

    def acceleration(
        self, rate: Vector, torque: Vector, spin: Float[Array, "*ensemble"] | float = 0.0
    ) -> Vector:
        """Angular acceleration in rad/s^2 under a body `torque` in N m.

        `spin` is O1 - O2 + O3 - O4 in rad/s, front and back rotors anticlockwise seen from above;
        it changes slowly, so the reaction J_M d(spin)/dt on yaw is left out.
        Source: Eq. (5)-(7), corrected: the rotors' torque is J_M spin (q, -p, 0), not J_M spin.
        """
        inertia, damping = align(self.inertia, rate), align(self.damping, rate)
        rotors = align(jnp.asarray(self.rotor_inertia * spin)[None], rate)
        down = align(jnp.array([0, 0, 1], dtype=rate.dtype), rate)
        momentum = inertia * rate - rotors * down  # anticlockwise from above points up
        if self.coulomb is not None:
            torque = torque + _friction(self.coulomb, rate)
        return (torque - damping * rate - jnp.cross(rate, momentum, axis=0)) / inertia

    def restoring_torque(self, euler: Vector) -> Vector:
        """Body torque in N m of the stiffness at Euler angles in rad."""
        if self.stiffness is None:
            return jnp.zeros_like(euler)
        return -align(self.stiffness, euler) * euler


def _per_axis(x: ArrayLike | Sequence) -> Array:
    x = as_float(x)
    return x if x.ndim else as_float(on_host(x)[None])


def _per_axis_or_none(x: ArrayLike | Sequence | None) -> Array | None:
    return None if x is None else _per_axis(x)


class LinearAxis(eqx.Module):
    """One axis of a plant about rest: x' = A x + command u + torque d, angle = x[0].

    The states are the angle in rad, its rate in rad/s and, after these, those of the motors in
    units of the command u; d is a disturbance torque in N m. All may have an ensemble on trailing
    axes.
    """

    A: Float[Array, "states states *ensemble"] = per_member(rank=2)
    command: Float[Array, " states *ensemble"] = per_member(rank=1)
    torque: Float[Array, " states *ensemble"] = per_member(rank=1)
    gain: Float[Array, "*ensemble"] = per_member(rank=0)  # rad/s^2 per unit of a steady command


class AxesState(eqx.Module):
    """The state of `DecoupledAxes`, or its time derivative."""

    angle: AxisValues  # rad
    rate: AxisValues  # rad/s
    motor: AxisValues | None  # effective command; None without a lag


class DecoupledAxes(eqx.Module):
    """Axes without coupling: J angle'' = torque_gain u_m - friction + disturbance.

    Friction is damping * rate + coulomb * tanh(rate / 0.01 rad/s) + stiffness * angle, and the
    motors follow the command u by a first-order lag, u_m' = (u - u_m) / lag.
    Source: Eq. (28) of the paper, with the terms that it neglects.

    !!! example

        ```python
        plant = jq.DecoupledAxes(torque_gain=[0.0468], inertia=[0.0552], lag=0.02)
        ```

    **Arguments:** (one value for all axes, one per axis, or `[axes, *ensemble]`)

    - `torque_gain`: in N m per unit of command. On the Quanser Hover it is L K_f = 0.0234 N m/V for
        u = V4 - V2, and twice that for +u and -u on two motors.
    - `inertia`: in kg m^2.
    - `lag`: of the motors in s; None leaves it out.
    - `damping`: in N m s/rad; `stiffness`: in N m/rad; `coulomb`: in N m, None leaves it out.

    **Raises:** `ValueError`: an inertia, torque gain or lag is not positive, friction is not
    finite, or the shapes do not match.
    """

    torque_gain: Axes = per_member(rank=1, converter=_per_axis)
    inertia: Axes = per_member(rank=1, converter=_per_axis)
    lag: Axes | None = per_member(rank=1, converter=_per_axis_or_none, default=None)
    damping: Axes = per_member(rank=1, converter=_per_axis, default=0.0)
    stiffness: Axes = per_member(rank=1, converter=_per_axis, default=0.0)
    coulomb: Axes | None = per_member(rank=1, converter=_per_axis_or_none, default=None)

    def __check_init__(self):
        _ = self.shape
        remedy = "give N m per unit of command, with the command's sign chosen to make it positive"
        require_positive("torque_gain", self.torque_gain, remedy)
        require_positive("inertia", self.inertia, "give kg m^2, about 0.005 to 0.1 on a quadrotor")
        if self.lag is not None:
            require_positive("lag", self.lag, "give seconds; for motors without lag, lag=None")
        require_finite("damping", self.damping)
        require_finite("stiffness", self.stiffness)
        if self.coulomb is not None:
            require_nonnegative("coulomb", self.coulomb, "friction acts against the motion")

    @property
    def shape(self) -> tuple[int, ...]:
        """(axes, *ensemble), as the parameters ask for together."""
        shapes = {f"{name} {x.shape}": x.shape for name, x in vars(self).items() if x is not None}
        longest = max(len(shape) for shape in shapes.values())
        try:
            return np.broadcast_shapes(*(s + (1,) * (longest - len(s)) for s in shapes.values()))
        except ValueError:
            raise ValueError(
                f"the parameters have shapes that do not match, {', '.join(shapes)}: give each one "
                "value per axis, and per member of an ensemble along a last axis"
            ) from None

    @property
    def gain(self) -> AxisValues:
        """b, the acceleration that a unit of command causes: rad/s^2 per unit."""
        return _align_to(self.torque_gain, self.inertia) / _align_to(self.inertia, self.torque_gain)

    def init(
        self, euler: ArrayLike | Sequence | None = None, *, ensemble: tuple[int, ...] = ()
    ) -> AxesState:
        """At rest at the angles `euler` in rad, 0 if None, with the motors stopped.

        The state is as wide as `ensemble`, the parameters and `euler` ask for together.
        """
        dtype = self.inertia.dtype
        angle = jnp.zeros(1, dtype) if euler is None else jnp.asarray(euler, dtype)
        axes, *members = self.shape
        shape = jnp.broadcast_shapes(tuple(members), ensemble, angle.shape[1:])
        still = jnp.zeros((max(axes, angle.shape[0]), *shape), dtype)
        angle = jnp.broadcast_to(align(angle, still), still.shape)
        return AxesState(angle, still, None if self.lag is None else still)

    def derivative(
        self, state: AxesState, inputs: AxisValues, disturbance: AxisValues
    ) -> AxesState:
        """Time derivative of `state` under the command `inputs` and a `disturbance` in N m."""
        angle, rate = state.angle, state.rate
        motor = inputs if state.motor is None else state.motor
        torque = align(self.torque_gain, rate) * motor + disturbance
        torque = torque - align(self.damping, rate) * rate - align(self.stiffness, rate) * angle
        if self.coulomb is not None:
            torque = torque + _friction(self.coulomb, rate)
        lagging = None if self.lag is None else (inputs - motor) / align(self.lag, rate)
        return AxesState(rate, torque / align(self.inertia, rate), lagging)

    def measure(self, state: AxesState) -> AxisValues:
        """The angles in rad."""
        return state.angle

    def linearise(self, axis: int) -> LinearAxis:
        """One axis about rest, without its dry friction, which has no linear part.

        **Raises:** ValueError for an axis that the plant does not have.
        """
        axes, *ensemble = self.shape
        if not 0 <= axis < axes:
            has = f"axes 0 to {axes - 1}" if axes > 1 else "one axis only, number 0 (roll)"
            raise ValueError(f"axis is {axis}, but the plant has {has}")

        def of_axis(x: Array) -> Array:  # for each member; where all axes share a value, that one
            value = x[axis if x.shape[0] > 1 else 0]
            one_each = value.shape + (1,) * (len(ensemble) - value.ndim)
            return jnp.broadcast_to(value.reshape(one_each), tuple(ensemble))

        inertia, lag = of_axis(self.inertia), None if self.lag is None else of_axis(self.lag)
        one, zero = jnp.ones_like(inertia), jnp.zeros_like(inertia)
        gain = of_axis(self.torque_gain) / inertia
        pull, brake = -of_axis(self.stiffness) / inertia, -of_axis(self.damping) / inertia
        rows, command, torque = [[zero, one], [pull, brake]], [zero, gain], [zero, 1 / inertia]
        if lag is not None:
            rows = [[zero, one, zero], [pull, brake, gain], [zero, zero, -1 / lag]]
            command, torque = [zero, zero, 1 / lag], [*torque, zero]
        return LinearAxis(jnp.array(rows), jnp.array(command), jnp.array(torque), gain)

    def with_added_inertia(self, inertia: Float[ArrayLike, "..."]) -> "DecoupledAxes":
        """The same axes carrying a known extra `inertia` in kg m^2, such as a payload."""
        return eqx.tree_at(lambda p: p.inertia, self, add_inertia(self.inertia, inertia))


def add_inertia(inertia: Axes, extra: Float[ArrayLike, "..."]) -> Array:
    """The sum, in the precision of `inertia`, where either may have a trailing ensemble axis."""
    extra = jnp.atleast_1d(jnp.asarray(extra, inertia.dtype))
    total = _align_to(inertia, extra) + _align_to(extra, inertia)
    require_positive("the inertia with what was added", total, "add kg m^2 that leave it above 0")
    return total


def _align_to(x: Array, other: Array) -> Array:
    return x if x.ndim >= other.ndim else align(x, other)
