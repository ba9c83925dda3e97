"""Maps from an inertia to b0, and controllers whose gains follow one: given, or as estimated."""

import dataclasses
import functools as ft
import math
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from jaxquad._compile import hasty_options, Jit
from jaxquad._core import (
    as_float,
    broadcast_gain,
    ensemble_shape,
    is_concrete,
    multiply_gains,
    on_host,
    per_member,
    require_all_positive,
    require_common_shape,
    require_finite,
    require_positive,
    require_signature,
    signal_shape,
)

from ._ladrc import LADRC, LADRCLaw, LADRCState
from ._pid import PID
from ._protocols import (
    Gain,
    InertiaEstimator,
    ProbingEstimator,
    Reference,
    Signal,
    Transform,
    Tunable,
)


InertiaToGain = Callable[[Array], Array]  # kg m^2 to b0 in rad/s^2 per unit of command


def _require_rising(name: str, values: Array) -> None:
    rises = not is_concrete(values) or np.all(np.diff(np.asarray(values)) > 0)
    if values.ndim != 1 or values.size < 2 or not rises:
        raise ValueError(f"{name} are {values}: give two or more that rise.")


def _interpolate(x: Signal, knots: Float[Array, " knots"], rows: Sequence[Gain] | Gain) -> Signal:
    """Straight between knots and constant beyond them, without a search: a sum of clipped ramps."""
    knots, y = knots.astype(x.dtype), jnp.broadcast_to(rows[0], x.shape)
    for k in range(len(rows) - 1):
        share = jnp.clip((x - knots[k]) / (knots[k + 1] - knots[k]), 0, 1)
        y = y + (rows[k + 1] - rows[k]) * share
    return y


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

    **Raises:** `ValueError`: the centres do not rise, or an increment leaves no b0 above 0.
    """

    nominal: Gain = per_member(rank=1, converter=as_float)  # kg m^2
    b0: Gain = per_member(rank=1, converter=as_float)  # rad/s^2 per unit of command
    centres: Float[Array, " sets"] = eqx.field(converter=as_float)  # of delta
    increments: Float[Array, " sets"] = eqx.field(converter=as_float)  # of b0

    def __check_init__(self):
        require_positive("nominal", self.nominal, "give the inertia at which delta is 1")
        require_positive("b0", self.b0, "give that of the controller")
        require_finite("increments", self.increments)
        _require_rising("centres", self.centres)
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

    def __call__(self, inertia: Signal) -> Signal:
        """b0 in rad/s^2 per unit of command at an `inertia` in kg m^2."""
        require_common_shape({"inertia": inertia, "nominal": self.nominal, "b0": self.b0})
        delta = inertia / broadcast_gain(self.nominal, inertia)
        db0 = _interpolate(delta, self.centres, self.increments.astype(delta.dtype))
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

    **Raises:** `ValueError`: the knots do not rise, or the shapes do not fit.
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
        _require_rising("knots", self.knots)
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
        return jnp.exp(_interpolate(x, self.knots, [broadcast_gain(row, x) for row in self.values]))

    def tunable(self) -> dict[str, Transform | None]:
        """The values, which keep falling."""
        return {"values": Falling()}

    @property
    def falls(self) -> Bool[Array, ""]:
        """Whether more inertia never raises b0, as for a plant of gain KT / J it should be."""
        return jnp.all(jnp.diff(self.values, axis=0) <= 0)


def certainty_equivalence(
    torque_gain: Float[ArrayLike, "..."], nominal: Float[ArrayLike, "..."], *,
    span: tuple[float, float] = (0.2, 5.0), knots: int = 6, factor: float = 1.0,
) -> InertiaMap:  # fmt: skip
    """The map b0 = `factor` KT / J: the estimate is used as if it were the true inertia.

    **Arguments:**

    - `torque_gain`: KT in N m per unit of command; `nominal`: in kg m^2. Both are scalars, one
        value per axis, or `[axes, *ensemble]`.
    - `span`: the lowest and the highest J / nominal; b0 is constant beyond.
    - `knots`: how many.
    - `factor`: with a lag in the loop a value above 1 is better, about 1.8 for 20 ms.

    **Raises:** `ValueError`: a value is not positive, or the span is not one.
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


class _ScheduledByMap:
    ladrc: LADRC | LADRCLaw
    map: InertiaToGain

    @property
    def dt(self) -> float:
        return self.ladrc.dt

    @property
    def ensemble(self) -> tuple[int, ...]:
        return ensemble_shape(self)

    def scheduled_at(self, inertia: Float[ArrayLike, "..."]) -> LADRC:
        """As `jq.control.ScheduledController`; one value per axis, or `[axes, *ensemble]`.

        **Raises:** ValueError for an inertia that is not above 0 or does not fit the axes of the
        map, and for a controller that has been prepared.
        """
        if isinstance(self.ladrc, LADRCLaw):
            raise ValueError(
                "A prepared controller has no wc and wo: schedule the one that it was made of."
            )
        return dataclasses.replace(self.ladrc, b0=gain_at(self.map, inertia))

    def tunable(self) -> dict[str, Transform | None]:
        """The bandwidths of the `ladrc`, whose b0 the map gives, and what the map says."""
        of_ladrc = {k: x for k, x in tunable_of("ladrc", self.ladrc).items() if k != "ladrc.b0"}
        return of_ladrc | tunable_of("map", self.map)

    # Of a prepared controller nothing is said of its observer.

    def observer_instability(self) -> str:
        return "" if isinstance(self.ladrc, LADRCLaw) else self.ladrc.observer_instability()

    def observer_slowness(self) -> str:
        return "" if isinstance(self.ladrc, LADRCLaw) else self.ladrc.observer_slowness()

    def observer_barrier(self, free: Collection[str]) -> Float[Array, ""]:
        if isinstance(self.ladrc, LADRCLaw):
            return jnp.zeros(())
        names = [name.removeprefix("ladrc.") for name in free if name.startswith("ladrc.")]
        return self.ladrc.observer_barrier(names)


class ScheduledLADRC(_ScheduledByMap, eqx.Module):
    """A `LADRC` whose b0 is `map(inertia)` of an inertia in kg m^2 that it is given.

    The `ladrc`'s own b0 has no effect. A loop flies and analyses `scheduled_at(inertia)`; exported
    to C, the controller is given its inertia in flight. Source: Eq. (25) of docs/equations.md, with
    the map of docs/control.md.

    **Arguments:**

    - `ladrc`: the `LADRC` at any b0.
    - `map`: from the inertia in kg m^2 to b0, such as a `jq.control.InertiaMap`.
    """

    ladrc: LADRC
    map: InertiaToGain


class ScheduledPID(eqx.Module):
    """A `PID` of the acceleration: its gains are divided by `map(inertia)`, as a LADRC's by b0.

    kp, ki and kd of `pid` are those of b u, in rad/s^2 per rad, per rad s and per rad/s; its
    feedforward is the share of the reference's acceleration, 1 for all of it. Filters, weights,
    limit and anti-windup do not change. A loop flies and analyses `scheduled_at(inertia)`.

    **Arguments:**

    - `pid`: the `PID` of the acceleration.
    - `map`: from the inertia in kg m^2 to b0, such as a `jq.control.InertiaMap`.
    """

    pid: PID
    map: InertiaToGain

    @property
    def dt(self) -> float:
        return self.pid.dt

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of all gains, () for one controller."""
        return ensemble_shape(self)

    def scheduled_at(self, inertia: Float[ArrayLike, "..."]) -> PID:
        """As `ScheduledLADRC.scheduled_at`."""
        per_gain, names = 1 / gain_at(self.map, inertia), ("kp", "ki", "kd", "feedforward")
        scaled = {name: multiply_gains(getattr(self.pid, name), per_gain) for name in names}
        return dataclasses.replace(self.pid, **scaled)

    def tunable(self) -> dict[str, Transform | None]:
        """What the `pid` and its map say, but not kd where the map is tuned.

        The size of the map and that of all gains are one number; kd fixes it.
        """
        gains, of_map = tunable_of("pid", self.pid), tunable_of("map", self.map)
        return {name: x for name, x in gains.items() if name != "pid.kd" or not of_map} | of_map


def gain_at(map: InertiaToGain, inertia: Float[ArrayLike, "..."]) -> Array:
    """b0 at an inertia in kg m^2, for all the members of `map` and `inertia`."""
    inertia = as_float(inertia)
    require_positive("inertia", inertia, "give kg m^2")
    if inertia.ndim == 0:
        raise ValueError(f"inertia is {inertia}: give one value per axis, in kg m^2.")
    shape = signal_shape(inertia, ensemble_shape(map))
    wide = inertia.reshape(inertia.shape + (1,) * (len(shape) - inertia.ndim))
    return as_float(_evaluate_map(map, wide, shape))


@ft.partial(Jit, options=hasty_options)  # a tune evaluates it for each ensemble that it draws
def _evaluate_map(map: InertiaToGain, inertia: Gain, shape: tuple[int, ...]) -> Array:
    return map(jnp.broadcast_to(inertia, shape))


def tunable_of(owner: str, part: object) -> dict[str, Transform | None]:
    """What `part` says, named as seen from the controller whose field `owner` it is."""
    transforms = part.tunable() if isinstance(part, Tunable) else {}
    return {f"{owner}.{name}": transform for name, transform in transforms.items()}


class AdaptiveLADRCState(NamedTuple):
    """What an adaptive LADRC remembers from the last sample."""

    ladrc: LADRCState
    estimator: PyTree


class AdaptiveLADRC(_ScheduledByMap, eqx.Module):
    """A `LADRC` of order 2 whose b0 follows the inertia that an estimator finds in flight.

    b0 starts as the `ladrc`'s. While the estimate is trusted, b0 moves towards `map(inertia)` by a
    first-order filter of time constant `settling`; otherwise it stays where it is. The estimator
    gets what was applied, saturated and with any test signal; its own test signal is added to the
    command within the ladrc's limit. A change of b0 does not change the command: the estimate of
    the disturbance changes instead (`LADRC.step_with`).
    Source: section 4.2 and Eq. (25) of the paper, docs/equations.md.

    **Arguments:**

    - `ladrc`: of order 2.
    - `estimator`: any `InertiaEstimator`, such as `LockInInertia`.
    - `map`: from an inertia in kg m^2 to b0, such as `certainty_equivalence(..)`.
    - `settling`: in s.

    **Raises:** `ValueError`: the estimator was made for another `dt`, or the ladrc is of order 1.
    """

    ladrc: LADRC | LADRCLaw
    estimator: InertiaEstimator
    map: InertiaToGain
    settling: float = eqx.field(static=True, default=0.5)  # s

    def __check_init__(self):
        require_all_positive(settling=self.settling)
        if not isinstance(self.estimator, InertiaEstimator):
            raise ValueError(
                f"estimator is {self.estimator!r}: give an object with the methods init, update "
                "and estimate, as jq.control.InertiaEstimator describes them."
            )
        for method, count in (("init", 1), ("update", 3), ("estimate", 1)):
            require_signature(self.estimator, InertiaEstimator, method, count)
        if isinstance(self.estimator, ProbingEstimator):
            require_signature(self.estimator, ProbingEstimator, "probe", 1)
            require_signature(self.estimator, ProbingEstimator, "excite", 1)
        if self.ladrc.order != 2:
            raise ValueError(
                f"The ladrc is of order {self.ladrc.order}, but b0 = KT/J is the gain to an angle: "
                "take order=2."
            )
        made_for = getattr(self.estimator, "dt", self.dt)
        if not math.isclose(made_for, self.dt, rel_tol=1e-6):
            raise ValueError(
                f"The estimator was made for samples of {made_for} s, the ladrc for {self.dt} s: "
                "give both the same dt."
            )

    @property
    def limit(self) -> Gain:
        """Of the command, either sign: that of the `ladrc`."""
        return self.ladrc.limit

    def prepared(self) -> "AdaptiveLADRC":
        """The same controller with the gains of its ladrc computed: what to run in a loop."""
        if isinstance(self.ladrc, LADRCLaw):
            return self
        return AdaptiveLADRC(self.ladrc.prepared(), self.estimator, self.map, self.settling)

    def init(self, like: Signal, measurement: Signal | None = None) -> AdaptiveLADRCState:
        """At rest at angle 0, or at `measurement` in rad; shaped as `like` and the ensemble."""
        full = jnp.zeros(signal_shape(like, self.ensemble), like.dtype)
        return AdaptiveLADRCState(self.ladrc.init(full, measurement), self.estimator.init(full))

    def step(
        self, state: AdaptiveLADRCState, reference: Reference, measurement: Signal
    ) -> tuple[AdaptiveLADRCState, Signal]:
        """One sample: the command to hold until the next one, with the test signal in it."""
        memory = self.estimator.update(state.estimator, state.ladrc.command, measurement)
        estimate = self.estimator.estimate(memory)
        share = estimate.trusted * -math.expm1(-self.dt / self.settling)
        inertia = jnp.where(estimate.trusted > 0, estimate.inertia, jnp.ones_like(estimate.inertia))
        b0 = state.ladrc.b0 + share * (self.map(inertia) - state.ladrc.b0)
        ladrc, command = self.ladrc.step_with(state.ladrc, reference, measurement, b0)
        if isinstance(self.estimator, ProbingEstimator):
            limit = broadcast_gain(self.ladrc.limit, command)
            command = jnp.clip(command + self.estimator.probe(memory), -limit, limit)
            ladrc = self.ladrc.applied(ladrc, command)
        return AdaptiveLADRCState(ladrc, memory), command

    def applied(self, state: AdaptiveLADRCState, achieved: Signal) -> AdaptiveLADRCState:
        """What the drive really gave since the last `step`, for ladrc and estimator."""
        return state._replace(ladrc=self.ladrc.applied(state.ladrc, achieved))

    def excite(self, state: AdaptiveLADRCState) -> AdaptiveLADRCState:
        """Put the estimate in doubt, as after a change of payload: the test signal starts."""
        if not isinstance(self.estimator, ProbingEstimator):
            raise ValueError(
                f"A {type(self.estimator).__name__} has no test signal: give an estimator with the "
                "methods probe and excite, as jq.control.ProbingEstimator describes them."
            )
        return state._replace(estimator=self.estimator.excite(state.estimator))

    def signals(self, state: AdaptiveLADRCState) -> dict[str, Array]:
        """ "disturbance" as `LADRC.signals`; "b0" in force; "inertia" and its deviation, kg m^2."""
        estimate = self.estimator.estimate(state.estimator)
        return self.ladrc.signals(state.ladrc) | {
            "b0": state.ladrc.b0,
            "inertia": estimate.inertia,
            "inertia_deviation": estimate.deviation,
        }
