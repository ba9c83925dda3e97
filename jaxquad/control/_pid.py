from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from jaxquad.models._parameters import (
    as_float,
    as_float_or_none,
    require_finite,
    require_positive,
)

from ._anti_windup import AntiWindup, Clamping
from ._linear import LinearController
from ._measurement_filter import butterworth
from ._per_axis import (
    ensemble_shape,
    pick,
    require_below,
    require_limit,
    require_sample,
    require_shapes,
)
from ._pid_law import PIDLaw, PIDState
from ._pid_linear import linear_pid


class PID(eqx.Module):
    """PID control with two degrees of freedom, a filtered derivative and anti-windup, sampled.

    u = kp (proportional_weight r - y) + ki int(r - y)
        + kd s/(1 + s/filter) (derivative_weight r - y),
    exactly for signals that are straight between samples. A `Setpoint` brings its rate, which then
    stands in for derivative_weight r', and its acceleration times `feedforward` (1/b of the plant).

    The command is bounded by `limit`, which must be the tightest one in the loop: what a drive cuts
    off beyond it winds the integral up. Every gain is a scalar, one value per axis, or
    `[axes, *ensemble]`, and differentiable. Source: Åström & Hägglund, Advanced PID Control, ch. 3.

    With a `measurement_filter`, in rad/s, y is what a second-order Butterworth filter makes of the
    measurement and y' that filter's own rate, so that noise rolls off in all three terms; `filter`
    then acts on the reference's rate alone. It is exact for a measurement held over the sample
    before it, must be below 1/dt, and the integral is then dt times the sum of the errors.
    Raises ValueError for gains that are not finite or fit no common shape, and for a filter, limit
    or dt that is not above 0.
    """

    kp: Float[Array, "..."] = eqx.field(converter=as_float)  # per rad
    ki: Float[Array, "..."] = eqx.field(converter=as_float)  # per rad s
    kd: Float[Array, "..."] = eqx.field(converter=as_float)  # per rad/s
    filter: Float[Array, "..."] = eqx.field(converter=as_float, default=125.0)  # rad/s: 20 Hz
    proportional_weight: Float[Array, "..."] = eqx.field(converter=as_float, default=1.0)
    derivative_weight: Float[Array, "..."] = eqx.field(converter=as_float, default=0.0)
    feedforward: Float[Array, "..."] = eqx.field(converter=as_float, default=0.0)  # per rad/s^2
    measurement_filter: Float[Array, "..."] | None = eqx.field(  # rad/s
        converter=as_float_or_none, default=None
    )
    limit: Float[Array, "..."] = eqx.field(converter=as_float, default=float("inf"))  # of |u|
    anti_windup: AntiWindup | None = Clamping()  # None: the integral winds up
    dt: float = eqx.field(static=True, default=0.002)  # s

    def __check_init__(self):
        if self.anti_windup is not None and not isinstance(self.anti_windup, AntiWindup):
            raise ValueError(
                f"anti_windup is {self.anti_windup!r}: choose Clamping(), BackCalculation(time) or "
                "None."
            )
        require_sample(self.dt)
        for name, gain in _gains(self).items():
            if name == "limit":
                require_limit(gain)
            elif name in _BANDWIDTHS:
                require_positive(name, gain, _BANDWIDTHS[name])
            else:
                require_finite(name, gain)
        require_shapes(_gains(self))
        if self.measurement_filter is not None:
            require_below("measurement_filter", self.measurement_filter, _FASTEST, self.dt)

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the gains, () for one controller."""
        return ensemble_shape(_gains(self))

    def prepared(self) -> PIDLaw:
        """The same law with its filter of the measurement computed: what to run in a loop."""
        smooth = self.measurement_filter
        transition = None if smooth is None else butterworth(smooth, self.dt)
        return PIDLaw(_gains(self), transition, self.anti_windup, self.ensemble, self.dt)

    def init(
        self,
        like: Float[Array, " axes *ensemble"],
        measurement: Float[Array, " axes *ensemble"] | None = None,
    ) -> PIDState:
        """With an empty integral; shaped as `like` and the ensemble of the gains.

        A filter of the measurement starts at rest at angle 0, or at `measurement` in rad.
        """
        return self.prepared().init(like, measurement)

    def step(
        self, state: PIDState, reference: Any, measurement: Float[Array, " axes *ensemble"]
    ) -> tuple[PIDState, Float[Array, " axes *ensemble"]]:
        """One sample: the command to hold until the next one.

        `reference` is a `Setpoint`, or angles in rad without feed-forward. The first sample starts
        the derivative without a kick.
        """
        return self.prepared().step(state, reference, measurement)

    def linear(self, axis: int = 0, member: Any = None) -> LinearController:
        """One axis without its limit, exactly; `member` picks one of an ensemble."""
        gains = {name: pick(gain, axis, member) for name, gain in _gains(self).items()}
        return linear_pid(gains, self.dt)


_FASTEST = 1.0  # filter's rad/s times dt: its rate is 8 % low there, and 0 far beyond
_BANDWIDTHS = {
    "filter": "give the derivative's bandwidth in rad/s",
    "measurement_filter": "give rad/s, some ten times the loop's crossover, or None for no filter",
}


def _gains(pid: PID) -> dict[str, Array]:
    names = ("kp", "ki", "kd", "filter", "proportional_weight", "derivative_weight")
    names = (*names, "feedforward", "measurement_filter", "limit")
    found = {name: getattr(pid, name) for name in names}
    return {name: gain for name, gain in found.items() if gain is not None}
