import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad._core import (
    align,
    as_float,
    as_float_or_none,
    per_member,
    require_finite,
    require_nonnegative,
    require_positive,
    require_vector,
)


_CREEP = 0.01  # rad/s, at which the torque reaches 76 % of its level


def friction(
    coulomb: Float[Array, "..."], rate: Float[Array, " axes *ensemble"]
) -> Float[Array, " axes *ensemble"]:
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

    **Raises:**

    - `ValueError`: an inertia is not positive, or a value is not finite.
    """

    inertia: Float[Array, "3 ..."] = per_member(rank=1, converter=as_float)
    damping: Float[Array, "3 ..."] = per_member(rank=1, converter=as_float, default=(0.0,) * 3)
    rotor_inertia: Float[Array, "..."] = per_member(rank=0, converter=as_float, default=0.0)
    stiffness: Float[Array, "3 ..."] | None = per_member(
        rank=1, converter=as_float_or_none, default=None
    )
    coulomb: Float[Array, "3 ..."] | None = per_member(
        rank=1, converter=as_float_or_none, default=None
    )

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
        self,
        rate: Float[Array, " 3 *ensemble"],
        torque: Float[Array, " 3 *ensemble"],
        spin: Float[Array, "*ensemble"] | float = 0.0,
    ) -> Float[Array, " 3 *ensemble"]:
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
            torque = torque + friction(self.coulomb, rate)
        return (torque - damping * rate - jnp.cross(rate, momentum, axis=0)) / inertia

    def restoring_torque(self, euler: Float[Array, " 3 *ensemble"]) -> Float[Array, " 3 *ensemble"]:
        """Body torque in N m of the stiffness at Euler angles in rad."""
        if self.stiffness is None:
            return jnp.zeros_like(euler)
        return -align(self.stiffness, euler) * euler
