import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxquad._core import (
    as_float,
    broadcast_gain,
    ensemble_shape,
    is_concrete,
    multiply_gains,
    on_host,
    per_member,
    require_common_shape,
    require_finite,
    require_positive,
)

from .._protocols import Gain, Signal, Transform


class FuzzyMap(eqx.Module):
    """b0' = b0 + db0(delta) by fuzzy inference, delta = J / nominal.

    A triangular set stands on each of the `centres`, reaching to its neighbours, the outer ones
    level beyond; "if delta is P_i then db0 is P_j" gives each set one of the `increments`, and
    defuzzification is the weighted average. The memberships sum to 1, so that this is the straight
    line between (centre, increment) points, and nothing else.
    Source: Eq. (25) of the paper and its text; docs/equations.md.

    **Arguments:**

    - `nominal`: the inertia in kg m^2 at which delta is 1; `b0`: in rad/s^2 per unit of command.
        Both are scalars, one value per axis, or `[axes, *ensemble]`.
    - `centres`: of the sets, two or more values of delta that rise.
    - `increments`: of b0, one for each set.

    **Raises:**

    - `ValueError`: the centres do not rise, or an increment leaves no b0 above 0.
    """

    nominal: Gain = per_member(rank=1, converter=as_float)  # kg m^2
    b0: Gain = per_member(rank=1, converter=as_float)  # rad/s^2 per unit of command
    centres: Float[Array, " sets"] = eqx.field(converter=as_float)  # of delta
    increments: Float[Array, " sets"] = eqx.field(converter=as_float)  # of b0

    def __check_init__(self):
        require_positive("nominal", self.nominal, "give the inertia at which delta is 1")
        require_positive("b0", self.b0, "give that of the controller")
        require_finite("increments", self.increments)
        rises = not is_concrete(self.centres) or np.all(np.diff(np.asarray(self.centres)) > 0)
        if self.centres.ndim != 1 or self.centres.size < 2 or not rises:
            raise ValueError(f"centres are {self.centres}: give two or more that rise.")
        if self.increments.shape != self.centres.shape:
            raise ValueError(
                f"increments have the shape {self.increments.shape}: give one for each of the "
                f"{self.centres.size} sets."
            )
        if is_concrete(self.b0) and is_concrete(self.increments):
            least = np.min(self.b0) + np.min(self.increments)
            require_positive("b0 + increment", least, "raise b0 or the lowest increment")

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the map, () for one controller."""
        return ensemble_shape({"nominal": self.nominal, "b0": self.b0}, rank=1)

    def memberships(self, delta: Signal) -> Float[Array, " sets axes *ensemble"]:
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

    def __call__(self, inertia: Signal) -> Signal:
        """b0 in rad/s^2 per unit of command at an `inertia` in kg m^2."""
        require_common_shape({"inertia": inertia, "nominal": self.nominal, "b0": self.b0})
        delta = inertia / broadcast_gain(self.nominal, inertia)
        P = self.memberships(delta)
        increments = self.increments.astype(P.dtype).reshape((-1,) + (1,) * inertia.ndim)
        db0 = jnp.sum(P * increments, axis=0) / jnp.sum(P, axis=0)  # the average weight method
        return broadcast_gain(self.b0, inertia) + db0

    def tunable(self) -> dict[str, Transform | None]:
        """b0; the increments may cross 0, so they need `jq.identify.Real`."""
        return {"b0": None}


def printed_map(nominal: Gain | float, *, b0: float = 3.0) -> FuzzyMap:
    """The map with the ranges that the paper prints, to show what they do; not for use.

    Eight sets over 1 < delta < 22 and 0 <= db0 <= 24 can only raise b0, while the paper's own b0
    falls from 3 to 1.6, which is delta = 1.875. There this map says 4.0, past the stability limit
    of LADRC(10, 30) on the Hover: the ITAE of a step over 10 s grows from 1.4 to 21. At delta = 22
    it says 27, and the loop diverges.
    """
    return FuzzyMap(nominal, b0, np.linspace(1.0, 22.0, 8), np.linspace(0.0, 24.0, 8))


_SHARPNESS = 20.0
_FLATTEST = 0.05  # nepers from row to row at the start of a tune: a flat start has no gradient


class Falling(eqx.Module):
    """Coordinates for an array whose rows fall from one to the next: a `Transform`.

    The first row is its own coordinate; each further row is softplus(20 z) / 20 below the last.
    """

    def forward(self, z: Float[Array, "rows ..."]) -> Float[Array, "rows ..."]:
        drops = jax.nn.softplus(_SHARPNESS * z[1:]) / _SHARPNESS
        return z[:1] - jnp.concatenate([jnp.zeros_like(z[:1]), jnp.cumsum(drops, axis=0)])

    def inverse(self, values: Float[np.ndarray, "rows ..."]) -> Float[np.ndarray, "rows ..."]:
        """Coordinates of the falling rows nearest to `values`; rows fall by 0.05 at least."""
        drops = np.maximum(values[:-1] - values[1:], _FLATTEST)
        return np.concatenate([values[:1], np.log(np.expm1(_SHARPNESS * drops)) / _SHARPNESS])


class InertiaMap(eqx.Module):
    """From an inertia to the controller's gain b0: piecewise linear in ln J -> ln b0.

    Straight between `knots`, constant beyond the first and the last. Slope -1 is b0 = KT / J, which
    `certainty_equivalence` makes. Triangular fuzzy sets with averaged outputs are such a map, too:
    see `jq.control.FuzzyMap`. Source: Eq. (25) of the paper, docs/equations.md, with another map.

    **Arguments:**

    - `nominal`: the design's inertia in kg m^2, a scalar, one value per axis, or
        `[axes, *ensemble]`.
    - `knots`: ln(J / nominal), two or more values that rise.
    - `values`: ln b0 at each knot, `[knots]`, `[knots, axes]` or `[knots, axes, *ensemble]`.

    **Raises:**

    - `ValueError`: the knots do not rise, or the shapes do not fit.
    """

    nominal: Gain = per_member(rank=1, converter=as_float)  # kg m^2; axes *ensemble
    knots: Float[Array, " knots"] = eqx.field(converter=as_float)  # ln(J / nominal)
    values: Float[Array, " knots ..."] = per_member(
        rank=2, converter=as_float
    )  # ln b0; axes *ensemble

    def __check_init__(self):
        require_positive("nominal", self.nominal, "give the design's inertia in kg m^2")
        require_finite("knots", self.knots)
        require_finite("values", self.values)
        rises = not is_concrete(self.knots) or np.all(np.diff(np.asarray(self.knots)) > 0)
        if self.knots.ndim != 1 or self.knots.size < 2 or not rises:
            raise ValueError(f"knots are {self.knots}: give two or more that rise.")
        if self.values.ndim == 0 or self.values.shape[0] != self.knots.size:
            raise ValueError(
                f"values have the shape {self.values.shape}: give one for each of the "
                f"{self.knots.size} knots, (knots,), (knots, axes) or (knots, axes, members)."
            )

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the map, () for one controller."""
        return ensemble_shape({"nominal": self.nominal, "values": self.values[0]}, rank=1)

    def __call__(self, inertia: Signal) -> Signal:
        """b0 in rad/s^2 per unit of command at an `inertia` in kg m^2."""
        require_common_shape(
            {"inertia": inertia, "nominal": self.nominal, "values": self.values[0]}
        )
        nominal = broadcast_gain(self.nominal, inertia)
        x = jnp.log(jnp.maximum(inertia / nominal, 1e-6))
        return jnp.exp(interpolate(x, self.knots, self.values))

    def tunable(self) -> dict[str, Transform | None]:
        """The values, which keep falling."""
        return {"values": Falling()}

    @property
    def falls(self) -> Bool[Array, ""]:
        """Whether more inertia never raises b0, as for a plant of gain KT / J it should be."""
        return jnp.all(jnp.diff(self.values, axis=0) <= 0)


def interpolate(
    x: Signal, knots: Float[Array, " knots"], values: Float[Array, " knots ..."]
) -> Signal:
    """Straight between the knots and constant beyond, without a search: a sum of clipped ramps."""
    knots = knots.astype(x.dtype)
    rows = [broadcast_gain(row, x) for row in values]
    y = jnp.broadcast_to(rows[0], x.shape)
    for k in range(len(rows) - 1):
        share = jnp.clip((x - knots[k]) / (knots[k + 1] - knots[k]), 0, 1)
        y = y + (rows[k + 1] - rows[k]) * share
    return y


def certainty_equivalence(
    torque_gain: Float[ArrayLike, "..."],
    nominal: Float[ArrayLike, "..."],
    *,
    span: tuple[float, float] = (0.2, 5.0),
    knots: int = 6,
    factor: float = 1.0,
) -> InertiaMap:
    """The map b0 = `factor` KT / J: the estimate is used as if it were the true inertia.

    **Arguments:**

    - `torque_gain`: KT in N m per unit of command; `nominal`: in kg m^2. Both are scalars, one
        value per axis, or `[axes, *ensemble]`.
    - `span`: the lowest and the highest J / nominal; b0 is constant beyond.
    - `knots`: how many.
    - `factor`: with a lag in the loop a value above 1 is better, about 1.8 for 20 ms.

    **Returns:**

    An `InertiaMap`.

    **Raises:**

    - `ValueError`: a value is not positive, or the span is not one.
    """
    torque_gain, nominal = as_float(torque_gain), as_float(nominal)
    require_positive("torque_gain", torque_gain, "give N m per unit of command, L Kf of the Hover")
    require_positive("factor", as_float(factor), "1 is certainty equivalence")
    low, high = span
    if not 0 < low < high < float("inf") or knots < 2:
        raise ValueError(
            f"span is {span} times the nominal inertia in {knots} knots: give 0 < low < high and "
            "2 knots or more."
        )
    places = np.linspace(np.log(low), np.log(high), knots)
    top = on_host(_log_gain(torque_gain, nominal, as_float(factor)))
    return InertiaMap(nominal, places, top[None] - places.reshape((-1,) + (1,) * top.ndim))


@eqx.filter_jit  # as one program
def _log_gain(torque_gain: Gain, nominal: Gain, factor: Float[Array, ""]) -> Gain:
    """ln b0 at the nominal inertia."""
    return jnp.log(factor * multiply_gains(torque_gain, 1 / nominal))
