import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad.models._parameters import as_float, is_concrete, require_finite, require_positive

from ._per_axis import ensemble_shape, fit


class FuzzyMap(eqx.Module):
    """b0' = b0 + db0(delta) by fuzzy inference, delta = J / nominal.

    A triangular set stands on each of the `centres`, reaching to its neighbours, the outer ones
    level beyond; "if delta is P_i then db0 is P_j" gives each set one of the `increments`, and
    defuzzification is the weighted average. The memberships sum to 1, so that this is the straight
    line between (centre, increment) points, and nothing else. Source: Eq. (25) and its text.
    Raises `ValueError` for centres that do not rise and for increments that leave no b0 above 0.
    """

    nominal: Float[Array, "..."] = eqx.field(converter=as_float)  # kg m^2
    b0: Float[Array, "..."] = eqx.field(converter=as_float)  # rad/s^2 per unit of command
    centres: Float[Array, " sets"] = eqx.field(converter=as_float)  # of delta
    increments: Float[Array, " sets"] = eqx.field(converter=as_float)  # of b0

    def __check_init__(self):
        require_positive("nominal", self.nominal, "give the inertia at which delta is 1")
        require_positive("b0", self.b0, "give that of the controller")
        require_finite("increments", self.increments)
        rises = not is_concrete(self.centres) or np.all(np.diff(np.asarray(self.centres)) > 0)
        if self.centres.ndim != 1 or self.centres.size < 2 or not rises:
            raise ValueError(f"centres are {self.centres}: give two or more, each above the last")
        if self.increments.shape != self.centres.shape:
            raise ValueError(
                f"increments have the shape {self.increments.shape}: give one for each of the "
                f"{self.centres.size} sets"
            )
        if is_concrete(self.b0) and is_concrete(self.increments):
            least = np.min(self.b0) + np.min(self.increments)
            require_positive("b0 + increment", least, "raise b0 or the lowest increment")

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the map, () for one controller."""
        return ensemble_shape({"nominal": self.nominal, "b0": self.b0})

    def memberships(
        self, delta: Float[Array, " axes *ensemble"]
    ) -> Float[Array, " sets axes *ensemble"]:
        """Of each set, from 0 to 1."""
        centres = self.centres.astype(delta.dtype)
        inside = jnp.clip(delta, centres[0], centres[-1])
        rise = [jnp.ones_like(delta)]
        for k in range(len(self.centres) - 1):
            rise.append((inside - centres[k]) / (centres[k + 1] - centres[k]))
        fall = [1 - up for up in rise[1:]] + [jnp.ones_like(delta)]
        return jnp.stack(
            [jnp.clip(jnp.minimum(a, b), 0, 1) for a, b in zip(rise, fall, strict=True)]
        )

    def __call__(self, inertia: Float[Array, " axes *ensemble"]) -> Float[Array, " axes *ensemble"]:
        """b0 in rad/s^2 per unit of command at an `inertia` in kg m^2."""
        weights = self.memberships(inertia / fit(self.nominal, inertia))
        increments = self.increments.astype(weights.dtype)
        increments = increments.reshape((-1,) + (1,) * inertia.ndim)
        average = jnp.sum(weights * increments, axis=0) / jnp.sum(weights, axis=0)
        return fit(self.b0, inertia) + average


def printed_map(nominal: Float[Array, "..."] | float, *, b0: float = 3.0) -> FuzzyMap:
    """The paper's map, to show what its printed ranges do; not for use.

    Eight sets over 1 < delta < 22 and 0 <= db0 <= 24 can only raise b0, while the paper's own b0
    falls from 3 to 1.6, which is delta = 1.875. There this map says 4.0, past the stability limit
    of LADRC(10, 30) on the rig: the ITAE of a step over 10 s grows from 1.4 to 21. At delta = 22 it
    says 27, and the loop diverges.
    """
    return FuzzyMap(nominal, b0, np.linspace(1.0, 22.0, 8), np.linspace(0.0, 24.0, 8))
