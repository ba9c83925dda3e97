import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Complex, Float

from jaxquad._core import as_float, is_zero, require_finite, require_nonnegative, require_positive

from ._protocols import Frequencies
from ._transfer_function import imaginary, TransferFunction


class AttitudeAxis(eqx.Module):
    """One axis near hover, from the difference of two opposite motor inputs to the angle in rad.

    Only the ratio L K_t / J_x enters the response: one record cannot separate J_x from K_t. That
    takes a second record with a known added inertia (`with_added_inertia`), a known static torque,
    or a prior.
    Source: Eq. (28) of the paper with the lag, delay and damping that it neglects.

    **Arguments:**

    - `L`: the arm in m; `K_t`: the thrust in N/V; `J_x`: the inertia in kg m^2.
    - `lag`: of motor and propeller in s; `delay`: in s; `K_af`: the damping in N m s/rad.

    **Raises:**

    - `ValueError`: a value is outside its physical range.
    """

    L: Float[Array, ""] = eqx.field(converter=as_float)  # arm, m
    K_t: Float[Array, ""] = eqx.field(converter=as_float)  # thrust, N/V
    J_x: Float[Array, ""] = eqx.field(converter=as_float)  # inertia, kg m^2
    lag: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)  # of motor and propeller, s
    delay: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)  # s
    K_af: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)  # damping, N m s/rad

    def __check_init__(self):
        for name, value in {"L": self.L, "K_t": self.K_t, "J_x": self.J_x}.items():
            require_positive(name, value, "give it in SI units")
        for name, value in {"lag": self.lag, "delay": self.delay}.items():
            require_nonnegative(name, value, "give seconds, and 0 for none")
        require_finite("K_af", self.K_af)

    @property
    def gain(self) -> Float[Array, ""]:
        """Angular acceleration per unit of input, L K_t / J_x, in rad/s^2/V."""
        return self.L * self.K_t / self.J_x

    def frequency_response(self, omega: Frequencies) -> Complex[Array, "frequencies 1 1"]:
        """Angle over input, rad/V, at `omega` in rad/s; infinite at 0."""
        s = imaginary(omega)
        lever, inertia, lag, delay, damping = (
            x.astype(s.dtype)
            for x in (self.L * self.K_t, self.J_x, self.lag, self.delay, self.K_af)
        )
        rigid = s * (inertia * s + damping)
        return (lever * jnp.exp(-delay * s) / (rigid * (lag * s + 1)))[:, None, None]

    def transfer_function(self) -> TransferFunction:
        """The same model as a ratio of polynomials.

        A lag of 0 has no pole and is left out. Under jit its value is unknown: it must not be 0.
        """
        zero = jnp.zeros_like(self.J_x)
        rigid = jnp.stack([self.J_x, self.K_af, zero])
        if is_zero(self.lag):
            denominator = rigid
        else:
            denominator = jnp.convolve(rigid, jnp.stack([self.lag, jnp.ones_like(self.lag)]))
        return TransferFunction((self.L * self.K_t)[None], denominator, self.delay)

    def with_added_inertia(self, inertia: ArrayLike) -> "AttitudeAxis":
        """The same axis carrying a known extra `inertia` in kg m^2."""
        return dataclasses.replace(self, J_x=self.J_x + as_float(inertia))
