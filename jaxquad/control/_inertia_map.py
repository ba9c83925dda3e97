import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxquad.models._parameters import as_float, is_concrete, require_finite, require_positive

from ._per_axis import ensemble_shape, fit, times


class InertiaMap(eqx.Module):
    """From an inertia to the controller's gain b0: piecewise linear in ln J -> ln b0.

    Straight between `knots`, constant beyond the first and the last. Slope -1 is certainty
    equivalence, b0 = KT / J, which `certainty_equivalence` makes; knots and values are arrays, to
    be tuned by gradient. Triangular fuzzy sets with averaged outputs are such a map, too: see
    `jq.FuzzyMap`. Source: Eq. (25), with the map that replaces the printed one, docs/equations.md.
    Raises `ValueError` for knots that do not rise and for shapes that do not fit.
    """

    nominal: Float[Array, "..."] = eqx.field(converter=as_float)  # kg m^2; axes *ensemble
    knots: Float[Array, " knots"] = eqx.field(converter=as_float)  # ln(J / nominal)
    values: Float[Array, " knots ..."] = eqx.field(converter=as_float)  # ln b0; axes *ensemble

    def __check_init__(self):
        require_positive("nominal", self.nominal, "give the design's inertia in kg m^2")
        require_finite("knots", self.knots)
        require_finite("values", self.values)
        rises = not is_concrete(self.knots) or np.all(np.diff(np.asarray(self.knots)) > 0)
        if self.knots.ndim != 1 or self.knots.size < 2 or not rises:
            raise ValueError(f"knots are {self.knots}: give two or more, each above the last")
        if self.values.ndim == 0 or self.values.shape[0] != self.knots.size:
            raise ValueError(
                f"values have the shape {self.values.shape}: give one for each of the "
                f"{self.knots.size} knots, (knots,), (knots, axes) or (knots, axes, members)"
            )

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the map, () for one controller."""
        return ensemble_shape({"nominal": self.nominal, "values": self.values[0]})

    def __call__(self, inertia: Float[Array, " axes *ensemble"]) -> Float[Array, " axes *ensemble"]:
        """b0 in rad/s^2 per unit of command at an `inertia` in kg m^2."""
        nominal = fit(self.nominal, inertia)
        x = jnp.log(jnp.maximum(inertia / nominal, 1e-6))
        return jnp.exp(interpolate(x, self.knots, self.values))

    @property
    def falls(self) -> Bool[Array, ""]:
        """Whether more inertia never raises b0, as for a plant of gain KT / J it should be."""
        return jnp.all(jnp.diff(self.values, axis=0) <= 0)


def interpolate(
    x: Float[Array, " axes *ensemble"],
    knots: Float[Array, " knots"],
    values: Float[Array, " knots ..."],
) -> Float[Array, " axes *ensemble"]:
    """Straight between the knots and constant beyond, without a search: a sum of clipped ramps."""
    knots = knots.astype(x.dtype)
    rows = [fit(row, x) for row in values]
    y = jnp.broadcast_to(rows[0], x.shape)
    for k in range(len(rows) - 1):
        share = jnp.clip((x - knots[k]) / (knots[k + 1] - knots[k]), 0, 1)
        y = y + (rows[k + 1] - rows[k]) * share
    return y


def certainty_equivalence(
    torque_gain: Float[Array, "..."] | float,
    nominal: Float[Array, "..."] | float,
    *,
    span: tuple[float, float] = (0.2, 5.0),
    knots: int = 6,
    factor: float = 1.0,
) -> InertiaMap:
    """b0 = `factor` KT / J for J from `span[0]` to `span[1]` times the `nominal`, held beyond.

    `torque_gain` KT in N m per unit of command and `nominal` in kg m^2 are scalars, `[axes]` or
    `[axes, *ensemble]`. With lag in the loop a `factor` above 1 is better: about 1.8 for 20 ms.
    """
    torque_gain, nominal = as_float(torque_gain), as_float(nominal)
    require_positive("torque_gain", torque_gain, "give N m per unit of command, on the rig L Kf")
    require_positive("factor", as_float(factor), "1 is certainty equivalence")
    low, high = span
    if not 0 < low < high < float("inf") or knots < 2:
        raise ValueError(
            f"span is {span} times the nominal inertia in {knots} knots: give 0 < low < high and "
            "2 knots or more"
        )
    places = np.linspace(np.log(low), np.log(high), knots)
    top = jnp.log(factor * times(torque_gain, 1 / nominal))
    return InertiaMap(nominal, places, top[None] - places.reshape((-1,) + (1,) * top.ndim))
