"""Plants that know nothing of the library but the methods that a loop calls."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxquad._core import as_float
from jaxquad.loops import align, per_member
from jaxquad.models import LinearAxis


class Spring(eqx.Module):
    """One axis on a spring that hardens: J y'' = K u_m - k (y + h y^3) + d, u_m' = (u - u_m) / lag.

    States are the rows of one array [3, axes, *ensemble].
    """

    torque_gain: Array = per_member(rank=1, converter=as_float)
    inertia: Array = per_member(rank=1, converter=as_float)
    lag: Array = per_member(rank=1, converter=as_float)
    stiffness: Array = per_member(rank=1, converter=as_float)
    hardening: Array = per_member(rank=1, converter=as_float)  # 1/rad^2

    def init(self, euler=None, *, ensemble=()):
        angle = jnp.zeros(1) if euler is None else jnp.asarray(euler)
        wide = jnp.broadcast_shapes(self.inertia.shape[1:], ensemble, angle.shape[1:])
        still = jnp.zeros((1, *wide))
        return jnp.stack([jnp.broadcast_to(align(angle, still), still.shape), still, still])

    def derivative(self, state, inputs, disturbance):
        angle, rate, motor = state
        gain, inertia, lag, stiffness, hardening = (align(x, rate) for x in vars(self).values())
        torque = gain * motor + disturbance - stiffness * (angle + hardening * angle**3)
        return jnp.stack([rate, torque / inertia, (inputs - motor) / lag])

    def measure(self, state):
        return state[0]

    def linearise(self, axis):
        gain, inertia, lag, stiffness, _ = jnp.broadcast_arrays(
            *(x[axis] for x in vars(self).values())
        )
        one, zero = jnp.ones_like(lag), jnp.zeros_like(lag)
        rows = [
            [zero, one, zero],
            [-stiffness / inertia, zero, gain / inertia],
            [zero, zero, -1 / lag],
        ]
        command, torque = [zero, zero, 1 / lag], [zero, 1 / inertia, zero]
        return LinearAxis(jnp.array(rows), jnp.array(command), jnp.array(torque), gain / inertia)


class TwoMotorPoles(eqx.Module):
    """One axis behind motors of two equal poles, J y'' = K u_2 + d, whose time has its own name."""

    torque_gain: Array = per_member(rank=1, converter=as_float)
    inertia: Array = per_member(rank=1, converter=as_float)
    time: Array = per_member(rank=1, converter=as_float)  # s, of each of the two poles

    def init(self, euler=None, *, ensemble=()):
        angle = jnp.zeros(1) if euler is None else jnp.asarray(euler)
        shapes = (x.shape[1:] for x in vars(self).values())
        wide = jnp.broadcast_shapes(*shapes, ensemble, angle.shape[1:])
        still = jnp.zeros((1, *wide))
        start = jnp.broadcast_to(align(angle, still), still.shape)
        return jnp.stack([start, still, still, still])

    def derivative(self, state, inputs, disturbance):
        _, rate, second, first = state
        gain, inertia, time = (align(x, rate) for x in vars(self).values())
        torque = gain * second + disturbance
        slopes = [rate, torque / inertia, (first - second) / time, (inputs - first) / time]
        return jnp.stack(slopes)

    def measure(self, state):
        return state[0]

    def linearise(self, axis):
        gain, inertia, time = jnp.broadcast_arrays(*(x[axis] for x in vars(self).values()))
        one, zero = jnp.ones_like(time), jnp.zeros_like(time)
        rows = [
            [zero, one, zero, zero],
            [zero, zero, gain / inertia, zero],
            [zero, zero, -1 / time, 1 / time],
            [zero, zero, zero, -1 / time],
        ]
        command, torque = [zero, zero, zero, 1 / time], [zero, 1 / inertia, zero, zero]
        return LinearAxis(jnp.array(rows), jnp.array(command), jnp.array(torque), gain / inertia)
