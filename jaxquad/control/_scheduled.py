"""Controllers whose gains follow from an inertia: given, or estimated in flight."""

import dataclasses
import functools as ft
import math
from collections.abc import Callable, Collection
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PyTree

from jaxquad._compile import hasty_options, Jit
from jaxquad._core import (
    as_float,
    broadcast_gain,
    ensemble_shape,
    multiply_gains,
    require_all_positive,
    require_positive,
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


class ScheduledLADRC(eqx.Module):
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

    @property
    def dt(self) -> float:
        return self.ladrc.dt

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of all gains, () for one controller."""
        return ensemble_shape(self)

    def scheduled_at(self, inertia: Float[ArrayLike, "..."]) -> LADRC:
        """The LADRC at this `inertia`, with b0 fixed.

        **Arguments:**

        - `inertia`: in kg m^2, one value per axis, or `[axes, *ensemble]`.

        **Raises:**

        - `ValueError`: the inertia is not above 0, or does not fit the axes of the map.
        """
        return dataclasses.replace(self.ladrc, b0=gain_at(self.map, inertia))

    def tunable(self) -> dict[str, Transform | None]:
        """The bandwidths of the `ladrc` and what its map says."""
        return tunable_bandwidths("ladrc", self.ladrc) | tunable_of("map", self.map)

    def observer_instability(self) -> str:
        """As `LADRC.observer_instability`."""
        return self.ladrc.observer_instability()

    def observer_slowness(self) -> str:
        """As `LADRC.observer_slowness`."""
        return self.ladrc.observer_slowness()

    def observer_barrier(self, free: Collection[str]) -> Float[Array, ""]:
        """As `LADRC.observer_barrier`."""
        return self.ladrc.observer_barrier(names_within("ladrc", free))


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
        """The PID at this `inertia`, with its gains fixed.

        **Arguments:**

        - `inertia`: in kg m^2, one value per axis, or `[axes, *ensemble]`.

        **Raises:**

        - `ValueError`: the inertia is not above 0, or does not fit the axes of the map.
        """
        per_gain, pid = 1 / gain_at(self.map, inertia), self.pid
        return dataclasses.replace(
            pid, kp=multiply_gains(pid.kp, per_gain), ki=multiply_gains(pid.ki, per_gain),
            kd=multiply_gains(pid.kd, per_gain),
            feedforward=multiply_gains(pid.feedforward, per_gain),
        )  # fmt: skip

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


def tunable_bandwidths(owner: str, ladrc: object) -> dict[str, Transform | None]:
    """What a LADRC says, without its b0, which a map gives."""
    return {k: x for k, x in tunable_of(owner, ladrc).items() if k != f"{owner}.b0"}


def names_within(owner: str, names: Collection[str]) -> list[str]:
    """The names of what is in the field `owner`, as seen from there."""
    return [name.removeprefix(f"{owner}.") for name in names if name.startswith(f"{owner}.")]


class AdaptiveLADRCState(NamedTuple):
    """What an adaptive LADRC remembers from the last sample."""

    ladrc: LADRCState
    estimator: PyTree


@runtime_checkable
class _Sampled(Protocol):
    @property
    def dt(self) -> float: ...


class AdaptiveLADRC(eqx.Module):
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

    **Raises:**

    - `ValueError`: the estimator was made for another `dt`, or the ladrc is of order 1.
    """

    ladrc: LADRC | LADRCLaw
    estimator: InertiaEstimator
    map: Callable[[Array], Array]  # kg m^2 to rad/s^2 per unit of command
    settling: float = eqx.field(static=True, default=0.5)  # s

    def __check_init__(self):
        require_all_positive(settling=self.settling)
        if not isinstance(self.estimator, InertiaEstimator):
            raise ValueError(
                f"estimator is {self.estimator!r}: give an object with the methods init, update "
                "and estimate, as jq.control.InertiaEstimator describes them."
            )
        if self.ladrc.order != 2:
            raise ValueError(
                f"The ladrc is of order {self.ladrc.order}, but b0 = KT/J is the gain to an angle: "
                "take order=2."
            )
        made_for = self.estimator.dt if isinstance(self.estimator, _Sampled) else self.dt
        if not math.isclose(made_for, self.dt, rel_tol=1e-6):
            raise ValueError(
                f"The estimator was made for samples of {made_for} s, the ladrc for {self.dt} s: "
                "give both the same dt."
            )

    @property
    def dt(self) -> float:
        return self.ladrc.dt

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of all gains, () for one controller."""
        return ensemble_shape(self)

    @property
    def limit(self) -> Gain:
        """Of the command, either sign: that of the `ladrc`."""
        return self.ladrc.limit

    def prepared(self) -> "AdaptiveLADRC":
        """The same controller with the gains of its ladrc computed: what to run in a loop."""
        if isinstance(self.ladrc, LADRCLaw):
            return self
        return AdaptiveLADRC(self.ladrc.prepared(), self.estimator, self.map, self.settling)

    def scheduled_at(self, inertia: Float[ArrayLike, "..."]) -> LADRC:
        """The LADRC that it is while its estimate is `inertia`, for a linear analysis.

        **Arguments:**

        - `inertia`: in kg m^2, one value per axis, or `[axes, *ensemble]`.

        **Raises:**

        - `ValueError`: the inertia is not above 0 or does not fit the axes of the map, or the
            controller has been prepared.
        """
        if isinstance(self.ladrc, LADRCLaw):
            raise ValueError(
                "A prepared controller has no wc and wo: schedule the one that it was made of."
            )
        return dataclasses.replace(self.ladrc, b0=gain_at(self.map, inertia))

    def tunable(self) -> dict[str, Transform | None]:
        """The bandwidths of the `ladrc` and what the map says."""
        return tunable_bandwidths("ladrc", self.ladrc) | tunable_of("map", self.map)

    def observer_instability(self) -> str:
        """As `LADRC.observer_instability`; a prepared controller is not looked at."""
        return "" if isinstance(self.ladrc, LADRCLaw) else self.ladrc.observer_instability()

    def observer_slowness(self) -> str:
        """As `LADRC.observer_slowness`; a prepared controller is not looked at."""
        return "" if isinstance(self.ladrc, LADRCLaw) else self.ladrc.observer_slowness()

    def observer_barrier(self, free: Collection[str]) -> Float[Array, ""]:
        """As `LADRC.observer_barrier`."""
        if isinstance(self.ladrc, LADRCLaw):
            return jnp.zeros(())
        return self.ladrc.observer_barrier(names_within("ladrc", free))

    def init(self, like: Signal, measurement: Signal | None = None) -> AdaptiveLADRCState:
        """At rest at angle 0, or at `measurement` in rad; shaped as `like` and the ensemble."""
        full = jnp.zeros(signal_shape(like, self.ensemble), like.dtype)
        return AdaptiveLADRCState(self.ladrc.init(full, measurement), self.estimator.init(full))

    def step(
        self, state: AdaptiveLADRCState, reference: Reference, measurement: Signal
    ) -> tuple[AdaptiveLADRCState, Signal]:
        """One sample: the command to hold until the next one, with the test signal in it."""
        memory = self.estimator.update(state.estimator, state.ladrc.command, measurement)
        b0 = self._adapt(state.ladrc.b0, memory)
        ladrc, command = self.ladrc.step_with(state.ladrc, reference, measurement, b0)
        if isinstance(self.estimator, ProbingEstimator):
            limit = broadcast_gain(self.ladrc.limit, command)
            command = jnp.clip(command + self.estimator.probe(memory), -limit, limit)
            ladrc = self.ladrc.applied(ladrc, command)
        return AdaptiveLADRCState(ladrc, memory), command

    def _adapt(self, b0: Signal, memory: PyTree) -> Signal:
        estimate = self.estimator.estimate(memory)
        share = estimate.trusted * -math.expm1(-self.dt / self.settling)
        inertia = jnp.where(estimate.trusted > 0, estimate.inertia, jnp.ones_like(estimate.inertia))
        return b0 + share * (self.map(inertia) - b0)

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
