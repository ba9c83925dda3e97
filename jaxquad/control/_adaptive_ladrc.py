import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from jaxquad._core import fit

from ._ladrc import LADRC, LADRCLaw, LADRCState
from ._scheduled import gain_at
from .inertia._estimate import InertiaEstimator, require_above_zero


class AdaptiveLADRCState(NamedTuple):
    """What an adaptive LADRC remembers from the last sample."""

    ladrc: LADRCState
    estimator: PyTree


class AdaptiveLADRC(eqx.Module):
    """A `LADRC` of order 2 whose b0 follows the inertia that an estimator hears.

    b0 starts as the `ladrc`'s. While the estimate is trusted, it moves towards `map(inertia)` by a
    first-order filter of time constant `settling`; otherwise it stays where it is. The estimator
    hears what was applied, saturated and with any test signal, and its own probe is added to
    the command within the ladrc's limit. A b0 that moves does not move the command: the estimate
    of the disturbance moves instead (`LADRC.step_with`). Source: section 4.2 and Eq. (25).
    Raises `ValueError` for an estimator made for another `dt` and for a ladrc of order 1.
    """

    ladrc: LADRC | LADRCLaw
    estimator: InertiaEstimator
    map: Callable[[Array], Array]  # kg m^2 to rad/s^2 per unit of command
    settling: float = eqx.field(static=True, default=0.5)  # s

    def __check_init__(self):
        require_above_zero("s", settling=self.settling)
        if getattr(self.ladrc, "order", 2) != 2:
            raise ValueError(
                f"the ladrc's order is {getattr(self.ladrc, 'order', None)}: b0 = KT/J belongs to "
                "an angle, take order 2"
            )
        made_for = getattr(self.estimator, "dt", self.dt)
        if not math.isclose(made_for, self.dt, rel_tol=1e-6):
            raise ValueError(
                f"the estimator was made for samples of {made_for} s, the ladrc for {self.dt} s"
            )

    @property
    def dt(self) -> float:
        return self.ladrc.dt

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of all gains, () for one controller."""
        parts = (self.ladrc, self.estimator, self.map)
        return np.broadcast_shapes(*(getattr(part, "ensemble", ()) for part in parts))

    def prepared(self) -> Any:
        """The same controller with the gains of its ladrc computed: what to run in a loop."""
        if isinstance(self.ladrc, LADRCLaw):
            return self
        return AdaptiveLADRC(self.ladrc.prepared(), self.estimator, self.map, self.settling)

    def told(self, inertia: Float[ArrayLike, "..."]) -> LADRC:
        """The LADRC that it is while its estimate is `inertia`, kg m^2: for a linear analysis.

        Raises ValueError for an inertia that is not above 0 or does not fit the map's axes, and
        for a controller that is already prepared.
        """
        if isinstance(self.ladrc, LADRCLaw):
            raise ValueError("a prepared controller has no wc and wo: tell the one it was made of")
        return dataclasses.replace(self.ladrc, b0=gain_at(self.map, inertia))

    def init(
        self,
        like: Float[Array, " axes *ensemble"],
        measurement: Float[Array, " axes *ensemble"] | None = None,
    ) -> AdaptiveLADRCState:
        """At rest at angle 0, or at `measurement` in rad; shaped as `like` and the ensemble."""
        full = jnp.zeros(like.shape[:1] + self._members(like), like.dtype)
        return AdaptiveLADRCState(self.ladrc.init(full, measurement), self.estimator.init(full))

    def _members(self, like: Float[Array, " axes *ensemble"]) -> tuple[int, ...]:
        return np.broadcast_shapes(like.shape[1:], self.ensemble)

    def step(
        self,
        state: AdaptiveLADRCState,
        reference: Any,
        measurement: Float[Array, " axes *ensemble"],
    ) -> tuple[AdaptiveLADRCState, Float[Array, " axes *ensemble"]]:
        """One sample: the command to hold until the next one, with the probe in it."""
        memory = self.estimator.update(state.estimator, state.ladrc.command, measurement)
        b0 = self._moved(state.ladrc.b0, memory)
        ladrc, command = self.ladrc.step_with(state.ladrc, reference, measurement, b0)
        limit = fit(self.ladrc.limit, command)
        command = jnp.clip(command + self.estimator.probe(memory), -limit, limit)
        return AdaptiveLADRCState(self.ladrc.applied(ladrc, command), memory), command

    def _moved(
        self, b0: Float[Array, " axes *ensemble"], memory: PyTree
    ) -> Float[Array, " axes *ensemble"]:
        found = self.estimator.estimate(memory)
        share = found.trusted * -math.expm1(-self.dt / self.settling)
        known = jnp.where(found.trusted > 0, found.inertia, jnp.ones_like(found.inertia))
        return b0 + share * (self.map(known) - b0)

    def applied(
        self, state: AdaptiveLADRCState, achieved: Float[Array, " axes *ensemble"]
    ) -> AdaptiveLADRCState:
        """What the drive really gave since the last `step`: ladrc and estimator go by it."""
        return state._replace(ladrc=self.ladrc.applied(state.ladrc, achieved))

    def excite(self, state: AdaptiveLADRCState) -> AdaptiveLADRCState:
        """On demand, as after a payload: the inertia is in doubt and the probe starts."""
        return state._replace(estimator=self.estimator.excite(state.estimator))

    def signals(self, state: AdaptiveLADRCState) -> dict[str, Array]:
        """ "disturbance" as `LADRC.signals`; "b0" in force; "inertia" and its deviation, kg m^2."""
        found = self.estimator.estimate(state.estimator)
        return self.ladrc.signals(state.ladrc) | {
            "b0": state.ladrc.b0,
            "inertia": found.inertia,
            "inertia_deviation": found.deviation,
        }
