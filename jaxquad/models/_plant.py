from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._allocation import Allocation
from ._attitude import Attitude
from ._motor import MotorLag
from ._parameters import align, as_float, is_concrete, is_zero
from ._rotation import euler_from_quaternion, quaternion_derivative, quaternion_from_euler


class MultirotorState(eqx.Module):
    """What a `Multirotor` remembers, or the time derivative of it."""

    quaternion: Float[Array, " 4 *ensemble"]  # body to earth, scalar first; any length but 0
    rate: Float[Array, " 3 *ensemble"]  # body axes, rad/s
    motor: Float[Array, " 4 *ensemble"] | None  # effective motor inputs; None without a lag


class Multirotor(eqx.Module):
    """A multirotor's attitude from motor inputs to Euler angles: Eq. (1)-(10), as corrected.

    Every parameter may have a trailing ensemble axis; then states, inputs and outputs have it too.
    Raises ValueError for spinning rotors driven by voltages, which do not tell the rotor speeds.
    """

    attitude: Attitude
    allocation: Allocation
    motor: MotorLag | None = None

    def __check_init__(self):
        rotor_inertia = self.attitude.rotor_inertia
        known = is_concrete(rotor_inertia) and not is_zero(rotor_inertia)
        if known and self.allocation.input == "voltage":
            raise ValueError(
                f"rotor_inertia is {rotor_inertia}, but voltages do not tell the rotor speeds: "
                'set it to 0, or use an Allocation with input="omega2".'
            )

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the parameters, () for one vehicle."""
        attitude, allocation = self.attitude, self.allocation
        vectors = [attitude.inertia, attitude.damping]
        scalars = [attitude.rotor_inertia, allocation.arm]
        scalars += [allocation.thrust_coefficient, allocation.torque_coefficient]
        if attitude.stiffness is not None:
            vectors.append(attitude.stiffness)
        if self.motor is not None:
            scalars.append(self.motor.time_constant)
        return jnp.broadcast_shapes(*(v.shape[1:] for v in vectors), *(s.shape for s in scalars))

    def init(
        self, euler: ArrayLike | Sequence[Any] | None = None, *, ensemble: tuple[int, ...] = ()
    ) -> MultirotorState:
        """At rest at the Euler angles `euler` in rad (level if None), with the motors stopped.

        The state is as wide as `ensemble`, the parameters and `euler` ask for together.
        """
        euler = as_float((0.0, 0.0, 0.0) if euler is None else euler)
        shape = jnp.broadcast_shapes(self.ensemble, ensemble, euler.shape[1:])
        rate = jnp.zeros((3, *shape), euler.dtype)
        quaternion = quaternion_from_euler(jnp.broadcast_to(align(euler, rate), rate.shape))
        motor = None if self.motor is None else jnp.zeros((4, *shape), euler.dtype)
        return MultirotorState(quaternion, rate, motor)

    def derivative(
        self,
        state: MultirotorState,
        inputs: Float[Array, " 4 *ensemble"],
        disturbance: Float[Array, " 3 *ensemble"],
    ) -> MultirotorState:
        """Time derivative of `state` under motor `inputs` and a `disturbance` torque in N m."""
        motor = inputs if state.motor is None else state.motor
        torque = self.allocation.torque(motor) + disturbance
        if self.attitude.stiffness is not None:
            torque = torque + self.attitude.restoring_torque(self.measure(state))
        return MultirotorState(
            quaternion_derivative(state.quaternion, state.rate),
            self.attitude.acceleration(state.rate, torque, self.allocation.spin(motor)),
            None if self.motor is None else self.motor.derivative(motor, inputs),
        )

    def measure(self, state: MultirotorState) -> Float[Array, " 3 *ensemble"]:
        """Euler angles in rad: what the encoders of a rig, or an attitude filter, report."""
        length = jnp.linalg.norm(state.quaternion, axis=0, keepdims=True)
        return euler_from_quaternion(state.quaternion / length)
