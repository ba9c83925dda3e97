from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import as_float, fit, is_concrete


@runtime_checkable
class AntiWindup(Protocol):
    """Decides what a sample adds to the integral of a bounded controller, in units of the command.

    `growth` is what the error asks for, `wanted` the command before its limit, `given` after it.
    """

    def __call__(
        self,
        growth: Float[Array, " axes *ensemble"],
        wanted: Float[Array, " axes *ensemble"],
        given: Float[Array, " axes *ensemble"],
        dt: float,
    ) -> Float[Array, " axes *ensemble"]: ...


class Clamping(eqx.Module):
    """Stops the integral while it would drive a saturated command further into its limit."""

    def __call__(
        self,
        growth: Float[Array, " axes *ensemble"],
        wanted: Float[Array, " axes *ensemble"],
        given: Float[Array, " axes *ensemble"],
        dt: float,
    ) -> Float[Array, " axes *ensemble"]:
        return jnp.where((wanted - given) * growth > 0, jnp.zeros_like(growth), growth)


class BackCalculation(eqx.Module):
    """Lets the integral follow the bounded command with the tracking time `time` in s.

    Source: Åström & Hägglund, Advanced PID Control, section 3.5. Raises ValueError for a time that
    is not above 0.
    """

    time: Float[Array, "..."] = eqx.field(converter=as_float)  # s; usually between kd/kp and kp/ki

    def __check_init__(self):
        if is_concrete(self.time) and not np.all(np.asarray(self.time) > 0):
            raise ValueError(
                f"The tracking time is {self.time} s, but it must be above 0: a value between "
                "kd/kp and kp/ki is usual."
            )

    def __call__(
        self,
        growth: Float[Array, " axes *ensemble"],
        wanted: Float[Array, " axes *ensemble"],
        given: Float[Array, " axes *ensemble"],
        dt: float,
    ) -> Float[Array, " axes *ensemble"]:
        follow = -jnp.expm1(-dt / fit(self.time, given))  # a sample's part, whatever the time
        return growth + follow * (given - wanted)
