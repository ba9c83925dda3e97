from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad.models import TransferFunction
from jaxquad.models._parameters import as_float, require_positive

from ._ladrc_gains import fastest_feedback, feedback_gains, LADRCGains, Placement
from ._ladrc_law import LADRCLaw, LADRCState
from ._ladrc_linear import continuous_ladrc, linear_ladrc
from ._linear import LinearController
from ._observers import CurrentObserver, Observer
from ._per_axis import (
    ensemble_shape,
    pick,
    require_below,
    require_limit,
    require_sample,
    require_shapes,
    times,
)


class LADRC(eqx.Module):
    """Linear active disturbance rejection control of y'' = b0 u + f (order 1: y' = b0 u + f).

    An extended state observer with bandwidth `wo` estimates y, y' and f; the feedback cancels f and
    places the poles at `wc`: b0 u = kp (r - y) + kd (r' - y') + r'' - f, with r' and r'' of a
    `Setpoint`, else 0. The command is bounded by `limit`, and the observer sees the bounded one,
    which is the anti-windup. Half-gain tuning: a `feedback_factor` of 0.5 halves kp (of r too) and
    kd, an `observer_factor` of 0.5 the observer's gains; 1/b0 acts on f in full either way.

    Every gain is a scalar, one value per axis, or `[axes, *ensemble]`, and differentiable.
    Source: docs/control.md; Gao (2003); Herbst, arXiv 1908.04610 and 2003.03986 (half gain).
    Raises ValueError for gains that are not above 0, that fit no common shape, or that are too fast
    for `dt`, and for an unknown order, placement or observer.
    """

    wc: Float[Array, "..."] = eqx.field(converter=as_float)  # rad/s
    wo: Float[Array, "..."] = eqx.field(converter=as_float)  # rad/s
    b0: Float[Array, "..."] = eqx.field(converter=as_float)  # rad/s^2 (order 1: rad/s) per unit
    order: int = eqx.field(static=True, default=2)
    observer: Observer = CurrentObserver()
    placement: Placement = eqx.field(static=True, default="discrete")
    feedback_factor: Float[Array, "..."] = eqx.field(converter=as_float, default=1.0)
    observer_factor: Float[Array, "..."] = eqx.field(converter=as_float, default=1.0)
    limit: Float[Array, "..."] = eqx.field(converter=as_float, default=float("inf"))  # of |u|
    dt: float = eqx.field(static=True, default=0.002)  # s

    def __check_init__(self):
        _require_choices(self)
        require_sample(self.dt)
        for name, gain in _gains(self).items():
            if name == "limit":
                require_limit(gain)
            else:
                require_positive(name, gain, _REMEDIES.get(name, "1 leaves the gains, 0.5 halves"))
        require_shapes(_gains(self))
        require_below("wc", self.wc, fastest_feedback(self.order, self.placement), self.dt)
        require_below("wo", self.wo, self.observer.fastest, self.dt)

    @property
    def gains(self) -> LADRCGains:
        """Of the feedback and of the observer, with the half-gain factors in them."""
        kp, kd = feedback_gains(self.wc, self.dt, self.order, self.placement)
        correction = self.observer.correction(self.wo, self.dt, self.order)
        return LADRCGains(
            times(kp, self.feedback_factor),
            None if kd is None else times(kd, self.feedback_factor),
            times(correction, self.observer_factor[None]),
        )

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the gains, () for one controller."""
        return ensemble_shape(_gains(self))

    def prepared(self) -> LADRCLaw:
        """The same law with its gains computed: what to run in a loop, once outside of it."""
        return LADRCLaw(self.gains, self.b0, self.limit, self.ensemble, self.observer, self.dt)

    def init(
        self,
        like: Float[Array, " axes *ensemble"],
        measurement: Float[Array, " axes *ensemble"] | None = None,
    ) -> LADRCState:
        """At rest at angle 0, or at `measurement` in rad; shaped as `like` and the ensemble."""
        return self.prepared().init(like, measurement)

    def step(
        self, state: LADRCState, reference: Any, measurement: Float[Array, " axes *ensemble"]
    ) -> tuple[LADRCState, Float[Array, " axes *ensemble"]]:
        """One sample: the command to hold until the next one.

        `reference` is a `Setpoint`, or angles in rad without feed-forward.
        """
        return self.prepared().step(state, reference, measurement)

    def step_with(
        self,
        state: LADRCState,
        reference: Any,
        measurement: Float[Array, " axes *ensemble"],
        b0: Float[Array, "..."],
    ) -> tuple[LADRCState, Float[Array, " axes *ensemble"]]:
        """As `step`, with another `b0` from this sample on.

        The estimate of f = y'' - b0 u moves by what b0 moves, so that an unsaturated command, and
        the predicted y'', stay where they are. Where b0 changes, use it for every sample.
        """
        return self.prepared().step_with(state, reference, measurement, b0)

    def applied(self, state: LADRCState, achieved: Float[Array, " axes *ensemble"]) -> LADRCState:
        """What the drive really gave since the last `step`: saturated, or with a test signal."""
        return self.prepared().applied(state, achieved)

    def signals(self, state: LADRCState) -> dict[str, Array]:
        """ "disturbance" f/b0 in units of the command: times the torque per unit, it is in N m."""
        return self.prepared().signals(state)

    def linear(self, axis: int = 0, member: Any = None) -> LinearController:
        """One axis without its limit, exactly; `member` picks one of an ensemble."""
        at = lambda gain: pick(gain, axis, member)
        kp, kd, correction = self.gains
        correction = jnp.stack([at(row) for row in correction])
        gains = LADRCGains(at(kp), None if kd is None else at(kd), correction)
        return linear_ladrc(gains, at(self.b0), self.observer, self.dt)

    def transfer_functions(
        self, axis: int = 0, member: Any = None
    ) -> tuple[TransferFunction, TransferFunction]:
        """C and F of u = F r - C y in continuous time, which is LADRC as `dt` goes to 0.

        C is a PID with a second-order filter (order 1: PI with one of first order), F/C the
        prefilter of the reference.
        """
        at = lambda gain: pick(gain, axis, member)
        factors = at(self.feedback_factor), at(self.observer_factor)
        return continuous_ladrc(at(self.wc), at(self.wo), at(self.b0), self.order, factors)


_REMEDIES = {
    "wc": "give the closed loop's bandwidth in rad/s",
    "wo": "give the observer's bandwidth in rad/s, a few times wc",
    "b0": "give the plant's gain; if it answers the other way, turn the sign of its command",
}


def _gains(ladrc: LADRC) -> dict[str, Array]:
    names = ("wc", "wo", "b0", "feedback_factor", "observer_factor", "limit")
    return {name: getattr(ladrc, name) for name in names}


def _require_choices(ladrc: LADRC) -> None:
    if ladrc.order not in (1, 2):
        raise ValueError(
            f"order is {ladrc.order}, but it must be 1 or 2: the plant's, from command to angle."
        )
    if ladrc.placement not in ("discrete", "continuous"):
        raise ValueError(f'placement is {ladrc.placement!r}: choose "discrete" or "continuous".')
    if not isinstance(ladrc.observer, Observer):
        raise ValueError(
            f"observer is {ladrc.observer!r}: choose CurrentObserver(), PredictiveObserver() or "
            "EulerObserver()."
        )
