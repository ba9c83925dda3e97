from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


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


def summarise(metrics: Any) -> Summary:
    """`Metrics.summary`. A time that a member never reaches counts as infinite."""
    spreads = {}
    for name in NUMBERS:
        values = getattr(metrics, name)
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
