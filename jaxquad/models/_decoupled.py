from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import (
    align,
    as_float,
    per_member,
    require_finite,
    require_nonnegative,
    require_positive,
)

from ._attitude import friction


def _per_axis(x: ArrayLike | Sequence) -> Array:
    return jnp.atleast_1d(as_float(x))


def _per_axis_or_none(x: ArrayLike | Sequence | None) -> Array | None:
    return None if x is None else _per_axis(x)


class AxesState(eqx.Module):
    """What `DecoupledAxes` remember, or the time derivative of it."""

    angle: Float[Array, " axes *ensemble"]  # rad
    rate: Float[Array, " axes *ensemble"]  # rad/s
    motor: Float[Array, " axes *ensemble"] | None  # effective command; None without a lag


class DecoupledAxes(eqx.Module):
    """Axes that do not feel each other: J angle'' = torque_gain u_m - friction + disturbance.

    Friction is damping * rate + coulomb * tanh(rate / 0.01 rad/s) + stiffness * angle, and the
    motors follow the command u by a first-order lag, u_m' = (u - u_m) / lag. Every parameter is one
    value for all axes or one per axis, with an optional trailing ensemble axis; None leaves a term
    out. On the Quanser Hover `torque_gain` is L K_f = 0.0234 N m/V for u = V4 - V2, and twice that
    where +u and -u go to two motors.
    Source: Eq. (28), with the terms that it neglects. Raises ValueError for an inertia, torque gain
    or lag that is not positive, for friction that is not finite, and for shapes that do not match.
    """

    torque_gain: Float[Array, "axes ..."] = per_member(1, converter=_per_axis)  # N m per unit of u
    inertia: Float[Array, "axes ..."] = per_member(1, converter=_per_axis)  # kg m^2
    lag: Float[Array, "axes ..."] | None = per_member(
        1, converter=_per_axis_or_none, default=None
    )  # s
    damping: Float[Array, "axes ..."] = per_member(1, converter=_per_axis, default=0.0)  # N m s/rad
    stiffness: Float[Array, "axes ..."] = per_member(1, converter=_per_axis, default=0.0)  # N m/rad
    coulomb: Float[Array, "axes ..."] | None = per_member(
        1, converter=_per_axis_or_none, default=None
    )  # N m

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
    def gain(self) -> Float[Array, " axes *ensemble"]:
        """b, the acceleration that a unit of command causes: rad/s^2 per unit."""
        return _widest(self.torque_gain, self.inertia) / _widest(self.inertia, self.torque_gain)

    def init(
        self, euler: ArrayLike | Sequence | None = None, *, ensemble: tuple[int, ...] = ()
    ) -> AxesState:
        """At rest at the angles `euler` in rad, 0 if None, with the motors stopped.

        The state is as wide as `ensemble`, the parameters and `euler` ask for together.
        """
        dtype = self.inertia.dtype
        angle = jnp.zeros(1, dtype) if euler is None else jnp.asarray(euler, dtype)
        axes, *own = self.shape
        shape = jnp.broadcast_shapes(tuple(own), ensemble, angle.shape[1:])
        still = jnp.zeros((max(axes, angle.shape[0]), *shape), dtype)
        angle = jnp.broadcast_to(align(angle, still), still.shape)
        return AxesState(angle, still, None if self.lag is None else still)

    def derivative(
        self,
        state: AxesState,
        inputs: Float[Array, " axes *ensemble"],
        disturbance: Float[Array, " axes *ensemble"],
    ) -> AxesState:
        """Time derivative of `state` under the command `inputs` and a `disturbance` in N m."""
        angle, rate = state.angle, state.rate
        motor = inputs if state.motor is None else state.motor
        torque = align(self.torque_gain, rate) * motor + disturbance
        torque = torque - align(self.damping, rate) * rate - align(self.stiffness, rate) * angle
        if self.coulomb is not None:
            torque = torque + friction(self.coulomb, rate)
        lagging = None if self.lag is None else (inputs - motor) / align(self.lag, rate)
        return AxesState(rate, torque / align(self.inertia, rate), lagging)

    def measure(self, state: AxesState) -> Float[Array, " axes *ensemble"]:
        """The angles in rad."""
        return state.angle

    def with_added_inertia(self, inertia: Float[ArrayLike, "..."]) -> "DecoupledAxes":
        """The same axes carrying a known extra `inertia` in kg m^2, such as a payload."""
        return eqx.tree_at(lambda p: p.inertia, self, added(self.inertia, inertia))


def added(inertia: Float[Array, "axes ..."], extra: Float[ArrayLike, "..."]) -> Array:
    """The sum, in the precision of `inertia`, where either may have a trailing ensemble axis."""
    extra = jnp.atleast_1d(jnp.asarray(extra, inertia.dtype))
    total = _widest(inertia, extra) + _widest(extra, inertia)
    require_positive("inertia with what was added", total, "add kg m^2 that leave it above 0")
    return total


def _widest(x: Array, other: Array) -> Array:
    return x if x.ndim >= other.ndim else align(x, other)
