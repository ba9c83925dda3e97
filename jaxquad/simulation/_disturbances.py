import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from jaxquad._core import (
    as_float,
    require_all_positive,
    require_finite,
    require_nonnegative,
)

from ._signal import Clock, Motion, Signal, spread


def gauss_markov(
    key: Key[Array, ""],
    shape: tuple[int, ...],
    *,
    deviation: float | Float[Array, ""],
    corner: float | Float[Array, ""],
    dt: float,
) -> Float[Array, "samples ..."]:
    """Stationary first-order Gauss-Markov noise along the first axis, such as gusts of torque.

    `deviation` is its standard deviation, `corner` its bandwidth in rad/s.
    """
    white = jax.random.normal(key, shape, dtype=float)
    return gauss_markov_of(white, deviation=deviation, corner=corner, dt=dt)


def gauss_markov_of(
    white: Float[Array, "samples ..."],
    *,
    deviation: float | Float[Array, ""],
    corner: float | Float[Array, ""],
    dt: float,
) -> Float[Array, "samples ..."]:
    """`gauss_markov` that white noise of unit variance drives."""
    keep = jnp.exp(jnp.asarray(-corner * dt))
    drive = deviation * jnp.sqrt(1 - keep**2)

    def advance(level, kick):
        return keep * level + drive * kick, level

    return jax.lax.scan(advance, deviation * white[0], jnp.roll(white, -1, axis=0))[1]


class Pulse(Signal):
    """A pulse, or a train of pulses: `amplitude` for `width` s from the time `at` on.

    As a payload it is picked up and set down.

    **Arguments:**

    - `amplitude`: in the unit of what it is given for (a disturbance: N m, a payload: kg m^2); one
        value, or one per member.
    - `width`: s.
    - `period`: s; the pulse is repeated in every period, by default it is not.
    - `share`: the part of the period that a pulse lasts, instead of `width`; rounded to samples.
    - `at`: s from the start.

    **Raises:** ValueError for a pulse longer than its period, and for both or none of `width` and
    `share`.
    """

    amplitude: Float[Array, "..."] = eqx.field(converter=as_float)
    width: float | None = eqx.field(static=True, default=None, kw_only=True)  # s
    share: float | None = eqx.field(static=True, default=None, kw_only=True)
    period: float | None = eqx.field(static=True, default=None, kw_only=True)  # s
    at: float = eqx.field(static=True, default=0.0, kw_only=True)  # s

    def __check_init__(self):
        require_finite("amplitude", self.amplitude)
        if (self.width is None) == (self.share is None):
            raise ValueError("a pulse has either a width in s or a share of its period: give one")
        if self.period is not None:
            require_all_positive(period=self.period)
        share, width, period = self.share, self.width, self.period
        if share is not None and period is None:
            raise ValueError(f"share is {share} of a period: give the period in s, or a width")
        if share is not None and not 0 < share <= 1:
            raise ValueError(f"share is {share}: a pulse lasts between 0 and 1 of its period")
        if width is not None:
            require_all_positive(width=width)
            if period is not None and width > period:
                raise ValueError(f"a pulse of {width} s is longer than its period of {period} s")

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        since = clock.since(self.at)
        place = since
        if self.period is not None:
            place = since % clock.count("period", self.period, fewest=1)
        lasting = (since >= 0) & (place < self._samples(clock))
        return Motion(spread(lasting.astype(np.float64), self.amplitude))

    def _samples(self, clock: Clock) -> int:
        if self.width is not None:
            return clock.count("width", self.width, fewest=1)
        assert self.share is not None and self.period is not None
        return round(self.share * clock.count("period", self.period, fewest=1))


class Gust(Signal):
    """First-order Gauss-Markov noise: stationary from the first sample, exact at the samples.

    The spectrum is that of white noise through K / (s + corner), with K = deviation sqrt(2 corner).
    Each axis and member draws its own.

    **Arguments:**

    - `deviation`: standard deviation in the unit of the signal, N m for a torque.
    - `corner`: bandwidth in rad/s.

    **Raises:**

    - `ValueError`: the deviation is below 0, or the corner is not above 0.
    """

    deviation: Float[Array, "..."] = eqx.field(converter=as_float)
    corner: float = eqx.field(static=True, default=2.0, kw_only=True)  # rad/s

    def __check_init__(self):
        require_nonnegative("deviation", self.deviation, "it is a standard deviation")
        require_all_positive(corner=self.corner)

    @property
    def random(self) -> bool:
        return True

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        members = jnp.broadcast_shapes(self.deviation.shape, clock.ensemble)
        unit = _unit_gust(_needed(key), (clock.samples, *members), self.corner, clock.dt)
        return Motion(unit * jnp.broadcast_to(self.deviation, members)[None])


class WhiteNoise(Signal):
    """Independent normal values, each axis and member with its own.

    **Arguments:**

    - `deviation`: standard deviation in the unit of the signal, rad for a measurement.

    **Raises:**

    - `ValueError`: the deviation is below 0.
    """

    deviation: Float[Array, "..."] = eqx.field(converter=as_float)

    def __check_init__(self):
        require_nonnegative("deviation", self.deviation, "it is a standard deviation")

    @property
    def random(self) -> bool:
        return True

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        members = jnp.broadcast_shapes(self.deviation.shape, clock.ensemble)
        unit = jax.random.normal(_needed(key), (clock.samples, *members), self.deviation.dtype)
        return Motion(unit * jnp.broadcast_to(self.deviation, members)[None])


def ceti_gust(gain: ArrayLike, pole: float, *, torque_gain: ArrayLike = 1.0) -> Gust:
    """Control-equivalent turbulence input: white noise through gain / (s + pole).

    The white noise has unit intensity, E[w(t) w(s)] = delta(t - s), so the input has a standard
    deviation of gain / sqrt(2 pole) and the two-sided spectrum gain^2 / (omega^2 + pole^2) per Hz.
    `pole` is in rad/s. With the plant's `torque_gain` (N m per unit of command) `gain` is in units
    of command per sqrt(s), without it in N m per sqrt(s).
    Source: Lusardi et al., J. American Helicopter Society 49 (2004), for a helicopter in hover.
    """
    require_all_positive(pole=pole)
    return Gust(as_float(gain) * as_float(torque_gain) / np.sqrt(2 * pole), corner=pole)


@eqx.filter_jit
def _unit_gust(
    key: Key[Array, ""], shape: tuple[int, ...], corner: float, dt: float
) -> Float[Array, " samples *ensemble"]:
    return gauss_markov(key, shape, deviation=1.0, corner=corner, dt=dt)


def _needed(key: Key[Array, ""] | None) -> Key[Array, ""]:
    if key is None:
        raise ValueError("a gust or noise is drawn at random: give a key=jax.random.key(0)")
    return key
