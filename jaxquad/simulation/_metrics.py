import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._metrics_text import described, remarks


NUMBERS = (
    "itae", "iae", "ise", "overshoot", "rise_time", "settling_time", "settling_time_5", "peak",
    "rms", "disturbance_rmse", "activity", "energy", "saturation_share",
)  # fmt: skip
_TIMES = ("rise_time", "settling_time", "settling_time_5")


class Spread(NamedTuple):
    """One number over an ensemble; inf where it rests on members that never get there."""

    mean: Float[Array, " axes"]
    p95: Float[Array, " axes"]
    worst: Float[Array, " axes"]
    cvar20: Float[Array, " axes"]  # mean of the worst fifth


class Summary(eqx.Module):
    """The numbers of `Metrics` over all members, those that diverged among them.

    `summary.itae.mean` and so on, each with one value per axis.
    """

    itae: Spread
    iae: Spread
    ise: Spread
    overshoot: Spread
    rise_time: Spread
    settling_time: Spread
    settling_time_5: Spread
    peak: Spread
    rms: Spread
    disturbance_rmse: Spread
    activity: Spread
    energy: Spread
    saturation_share: Spread
    diverged_share: Float[Array, ""]
    members: int = eqx.field(static=True)


def summarise(metrics: "Metrics") -> Summary:
    """`Metrics.summary`. A time that a member never reaches counts as infinite."""
    spreads = {}
    for name in NUMBERS:
        values = vars(metrics)[name]
        if name in _TIMES:
            never = metrics.stepped & jnp.isnan(values)
            values = jnp.where(never, jnp.inf, values)
        spreads[name] = spread_of(values)
    share = jnp.mean(metrics.diverged.astype(metrics.itae.dtype))
    return Summary(**spreads, diverged_share=share, members=metrics.diverged.size)


def spread_of(values: Float[Array, " axes *ensemble"]) -> Spread:
    """Mean, 95 % quantile, maximum and CVaR20 of each axis. nan members make the result nan."""
    members = jnp.sort(values.reshape(values.shape[0], -1), axis=1)
    spread = (quantile(members, 0.95), members[:, -1], cvar(members, 0.2))
    unknown = jnp.isnan(members[:, -1])  # sorted to the end
    return Spread(jnp.mean(members, axis=1), *(jnp.where(unknown, jnp.nan, x) for x in spread))


def quantile(ordered: Float[Array, " axes members"], share: float) -> Float[Array, " axes"]:
    """Of rising values, interpolated as numpy does; inf as soon as it rests on one."""
    place = share * (ordered.shape[1] - 1)
    below, part = int(place), place - int(place)
    low, high = ordered[:, below], ordered[:, min(below + 1, ordered.shape[1] - 1)]
    finite = jnp.isfinite(high) | (part == 0)
    step = jnp.where(finite, high, 0) - jnp.where(finite, low, 0)
    return jnp.where(finite, low + part * step, high)


def cvar(ordered: Float[Array, " axes members"], share: float) -> Float[Array, " axes"]:
    """Mean of the worst `share` of rising values: the next one counts in part, so none is lost."""
    members = ordered.shape[1]
    count = share * members
    parts = jnp.clip(count - jnp.arange(members, dtype=ordered.dtype), 0, 1)[::-1] / count
    counted: Bool[Array, " members"] = parts > 0
    weighed = jnp.where(counted[None], parts[None] * jnp.where(counted[None], ordered, 0), 0)
    return jnp.sum(weighed, axis=1)


class Metrics(eqx.Module):
    """How well a loop did in a window of time, for each axis and each member of an ensemble.

    The error is the reference less the true angle. `str()` shows one loop as it is, and an ensemble
    by mean, 95 % quantile, worst and CVaR20. A member that has diverged, in the window or not, is
    evaluated with its angle held where it left the bound: `diverged` says so, its integrals are
    finite, and it never settles.
    The step goes from where the reference stands before the window (with a window from 0 s, from
    the first angle) to where it is when the window ends or the load begins. Overshoot, rise and
    settling are nan on an axis whose reference does not go from one value to another and stay
    there; the rise time also if 90 % is never reached, a settling time if the angle is outside
    the band at the end. Times are interpolated between samples, so that they have gradients.
    """

    itae: Float[Array, " axes *ensemble"]  # integral of (t - start) |error|, rad s^2
    iae: Float[Array, " axes *ensemble"]  # integral of |error|, rad s
    ise: Float[Array, " axes *ensemble"]  # integral of error^2, rad^2 s
    overshoot: Float[Array, " axes *ensemble"]  # % of the step, 0 if there is none
    rise_time: Float[Array, " axes *ensemble"]  # s, from 10 to 90 % of the step
    settling_time: Float[Array, " axes *ensemble"]  # s, to within 2 % of the step for good
    settling_time_5: Float[Array, " axes *ensemble"]  # s, to within 5 %
    peak: Float[Array, " axes *ensemble"]  # greatest |error| under load, rad
    rms: Float[Array, " axes *ensemble"]  # of the error under load, rad
    disturbance_rmse: Float[Array, " axes *ensemble"]  # of its estimate under load, N m; or nan
    activity: Float[Array, " axes *ensemble"]  # sum of squared changes of the command
    energy: Float[Array, " axes *ensemble"]  # integral of the squared command, unit^2 s
    saturation_share: Float[Array, " axes *ensemble"]  # of the samples
    step: Float[Array, " axes *ensemble"]  # rad, from first to last; 0 without one
    stepped: Bool[Array, " axes *ensemble"]  # whether the reference makes a step
    diverged: Bool[Array, "*ensemble"]
    beyond_authority: Float[Array, " axes *ensemble"]  # share of samples; nan if not known
    reversing: Float[Array, " axes *ensemble"]  # share of samples that turn motors backwards
    start: float = eqx.field(static=True)  # s
    stop: float = eqx.field(static=True)  # s
    load_start: float = eqx.field(static=True)  # s
    per_step: bool = eqx.field(static=True, default=False)  # integrals divided by the step

    def normalised(self) -> "Metrics":
        """The same with ITAE, IAE and ISE of a unit step; nan on axes without a step."""
        if self.per_step:
            return self
        size = jnp.where(self.stepped, jnp.abs(self.step), jnp.nan)
        integrals = {"itae": self.itae / size, "iae": self.iae / size, "ise": self.ise / size**2}
        return dataclasses.replace(self, **integrals, per_step=True)

    def summary(self) -> Summary:
        """Mean, 95 % quantile, worst and CVaR20 of every number over the ensemble."""
        return summarise(self)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader has to know before using the numbers."""
        return tuple(remarks(self))

    def __str__(self) -> str:
        return described(self)
