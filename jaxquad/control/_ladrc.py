import dataclasses
from collections.abc import Collection, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import (
    align,
    as_float,
    broadcast_gain,
    ensemble_shape,
    match_reference,
    multiply_gains,
    per_member,
    pick_gain,
    require_below_sampling,
    require_common_shape,
    require_limit,
    require_positive,
    require_sample_interval,
    signal_shape,
)
from jaxquad.models import TransferFunction

from ._protocols import (
    barrier,
    continuous_gains,
    CurrentObserver,
    error_dynamics,
    Gain,
    LinearController,
    Member,
    Observer,
    Reference,
    Setpoint,
    Signal,
    Transform,
)


Placement = Literal["discrete", "continuous"]


class LADRCGains(eqx.Module):
    """The gains on errors of the angle, of the rate and of the observer, half gains included."""

    proportional: Gain = per_member(rank=1)  # 1/s^2; order 1: 1/s
    derivative: Gain | None = per_member(rank=1)  # 1/s; None for order 1
    correction: Float[Array, "states ..."] = per_member(rank=2)  # of the observer's prediction


class LADRCState(NamedTuple):
    """What a LADRC remembers from the last sample."""

    estimate: Float[Array, "states axes *ensemble"]  # [y, y', f], order 1 [y, f]
    command: Signal  # as applied
    b0: Signal  # in force


class LADRCLaw(eqx.Module):
    """A `LADRC` with its gains computed, for a loop to run sample by sample."""

    gains: LADRCGains
    b0: Gain = per_member(rank=1)
    limit: Gain = per_member(rank=1)
    observer: Observer
    dt: float = eqx.field(static=True)

    @property
    def order(self) -> int:
        return len(self.gains.correction) - 1

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the gains, () for one controller."""
        return ensemble_shape(self)

    def init(self, like: Signal, measurement: Signal | None = None) -> LADRCState:
        zero = jnp.zeros(signal_shape(like, self.ensemble), like.dtype)
        first = zero if measurement is None else zero + align(measurement, zero)
        estimate = jnp.stack([first] + [zero] * (len(self.gains.correction) - 1))
        return LADRCState(estimate, zero, zero + broadcast_gain(self.b0, zero))

    def step(
        self, state: LADRCState, reference: Reference, measurement: Signal
    ) -> tuple[LADRCState, Signal]:
        return self._advance(state, state.estimate[-1], reference, measurement, self.b0)

    def step_with(
        self, state: LADRCState, reference: Reference, measurement: Signal, b0: Gain
    ) -> tuple[LADRCState, Signal]:
        # f = y'' - b0 u: another b0 moves the disturbance, so that y'' and u stay as they are.
        unknown = state.estimate[-1] + (state.b0 - broadcast_gain(b0, measurement)) * state.command
        return self._advance(state, unknown, reference, measurement, b0)

    def applied(self, state: LADRCState, achieved: Signal) -> LADRCState:
        return state._replace(command=achieved)

    def signals(self, state: LADRCState) -> dict[str, Array]:
        return {"disturbance": state.estimate[-1] / state.b0}

    def _advance(self, state, unknown, reference, measurement, b0):
        reference = match_reference(reference, measurement, state.command)
        # Row by row: stacks and slices of the estimate cost most of a reverse pass.
        b0 = jnp.broadcast_to(broadcast_gain(b0, measurement), measurement.shape)
        estimate = [*state.estimate[:-1], unknown]
        predicted = self.observer.predict(estimate, b0 * state.command, self.dt)
        error = measurement - predicted[0]
        gains = [broadcast_gain(row, measurement) for row in self.gains.correction]
        corrected = [x + l * error for x, l in zip(predicted, gains, strict=True)]
        command = self._feedback(corrected if self.observer.current else predicted, reference) / b0
        limit = broadcast_gain(self.limit, command)
        command = jnp.clip(command, -limit, limit)
        return LADRCState(jnp.stack(corrected), command, b0), command

    def _feedback(self, estimate: Sequence[Array], reference: Reference) -> Array:
        """The wanted b0 u in rad/s^2; order 1 in rad/s."""
        ahead = isinstance(reference, Setpoint)
        angle = reference.angle if ahead else reference
        gain = broadcast_gain(self.gains.proportional, angle)
        drive = gain * (angle - estimate[0]) - estimate[-1]
        if self.gains.derivative is None:
            return drive + reference.rate if ahead else drive
        error = reference.rate - estimate[1] if ahead else -estimate[1]
        drive = drive + broadcast_gain(self.gains.derivative, angle) * error
        return drive + reference.acceleration if ahead else drive


class LADRC(eqx.Module):
    """Linear active disturbance rejection control of y'' = b0 u + f (order 1: y' = b0 u + f).

    An extended state observer with bandwidth `wo` estimates y, y' and f; the feedback cancels f and
    places the poles at `wc`: b0 u = kp (r - y) + kd (r' - y') + r'' - f, with r' and r'' of a
    `Setpoint`, else 0. The observer sees the bounded command, which is the anti-windup.
    Source: section 4.2 of the paper, which does not print the law; docs/control.md; Gao (2003);
    Herbst, arXiv 1908.04610 and 2003.03986 (half gain).

    !!! example

        ```python
        controller = jq.LADRC(wc=10.0, wo=30.0, b0=0.848, limit=10.0)
        ```

    **Arguments:** (each gain is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `wc`, `wo`: the bandwidths of feedback and observer in rad/s.
    - `b0`: the gain of the plant, in rad/s^2 (order 1: rad/s) per unit of command.
    - `order`: 2, or 1 for a rate.
    - `observer`: `CurrentObserver()`, or any other `jq.control.Observer`.
    - `placement`: "discrete" places the poles of the sampled loop, "continuous" those of a loop
        without sampling.
    - `feedback_factor`, `observer_factor`: for half-gain tuning. 0.5 halves kp and kd, or the gains
        of the observer; f is cancelled in full either way.
    - `limit`: of |u|, in units of the command.
    - `dt`: the sample interval in s.

    **Raises:** `ValueError`: a gain is not above 0, is too fast for `dt` or does not fit the
    others' shapes; order, placement or observer is unknown.
    """

    wc: Gain = per_member(rank=1, converter=as_float)  # rad/s
    wo: Gain = per_member(rank=1, converter=as_float)  # rad/s
    b0: Gain = per_member(rank=1, converter=as_float)  # rad/s^2 (order 1: rad/s) per unit
    order: int = eqx.field(static=True, default=2)
    observer: Observer = CurrentObserver()
    placement: Placement = eqx.field(static=True, default="discrete")
    feedback_factor: Gain = per_member(rank=1, converter=as_float, default=1.0)
    observer_factor: Gain = per_member(rank=1, converter=as_float, default=1.0)
    limit: Gain = per_member(rank=1, converter=as_float, default=float("inf"))  # of |u|
    dt: float = eqx.field(static=True, default=0.002)  # s

    def __check_init__(self):
        if self.order not in (1, 2):
            raise ValueError(
                f"order is {self.order}, but it must be 1 or 2: the plant's, from command to angle."
            )
        if self.placement not in ("discrete", "continuous"):
            raise ValueError(f'placement is {self.placement!r}: choose "discrete" or "continuous".')
        if not isinstance(self.observer, Observer):
            raise ValueError(
                f"observer is {self.observer!r}: choose CurrentObserver(), PredictiveObserver() or "
                "EulerObserver(), or give an object with the methods of jq.control.Observer."
            )
        require_sample_interval(self.dt)
        for name, gain in _gains(self).items():
            if name == "limit":
                require_limit(gain)
            else:
                require_positive(
                    name, gain, _REMEDIES.get(name, "1 keeps the gains, 0.5 halves them")
                )
        require_common_shape(_gains(self))
        # Nyquist's, or where the held feedback turns unstable.
        fastest = jnp.pi if self.placement == "discrete" else 2.0 / self.order
        require_below_sampling("wc", self.wc, fastest, self.dt)
        require_below_sampling("wo", self.wo, self.observer.fastest, self.dt)

    @property
    def gains(self) -> LADRCGains:
        """Of the feedback and of the observer, with the half-gain factors in them.

        The feedback places the poles of u0/s^2 (order 1: u0/s) at -wc; order 1 has no kd.
        "discrete": at exp(-wc dt) exactly, with u0 held over the sample. "continuous": kp = wc^2
        and kd = 2 wc, so at -wc only as dt goes to 0. Source: docs/control.md.
        """
        wc, dt = self.wc, self.dt
        if self.placement == "continuous":
            kp, kd = (wc, None) if self.order == 1 else (wc**2, 2 * wc)
        else:
            off = -jnp.expm1(-wc * dt)  # 1 - exp(-wc dt) without cancellation
            kp = off / dt if self.order == 1 else (off / dt) ** 2
            kd = None if self.order == 1 else off * (4 - off) / (2 * dt)
        correction = self.observer.correction(self.wo, dt, self.order)
        return LADRCGains(
            multiply_gains(kp, self.feedback_factor),
            None if kd is None else multiply_gains(kd, self.feedback_factor),
            multiply_gains(correction, self.observer_factor[None]),
        )

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the gains, () for one controller."""
        return ensemble_shape(_gains(self), rank=1)

    def prepared(self) -> LADRCLaw:
        """The same law with its gains computed: what to run in a loop, once outside of it."""
        return LADRCLaw(self.gains, self.b0, self.limit, self.observer, self.dt)

    def init(self, like: Signal, measurement: Signal | None = None) -> LADRCState:
        """At rest at angle 0, or at `measurement` in rad; shaped as `like` and the ensemble."""
        return self.prepared().init(like, measurement)

    def step(
        self, state: LADRCState, reference: Reference, measurement: Signal
    ) -> tuple[LADRCState, Signal]:
        """One sample: the command to hold until the next one.

        `reference` is a `Setpoint`, or angles in rad without feed-forward.
        """
        return self.prepared().step(state, reference, measurement)

    def step_with(
        self, state: LADRCState, reference: Reference, measurement: Signal, b0: Gain
    ) -> tuple[LADRCState, Signal]:
        """As `step`, with another `b0` from this sample on.

        The estimate of f = y'' - b0 u changes with b0, so that an unsaturated command and the
        predicted y'' do not. Where b0 varies, call this method at each sample.
        """
        return self.prepared().step_with(state, reference, measurement, b0)

    def applied(self, state: LADRCState, achieved: Signal) -> LADRCState:
        """The state with the command that the drive really gave since the last `step`."""
        return self.prepared().applied(state, achieved)

    def signals(self, state: LADRCState) -> dict[str, Array]:
        """ "disturbance": f/b0 in units of the command; times the torque per unit it is in N m."""
        return self.prepared().signals(state)

    def linear(self, axis: int = 0, member: Member = None) -> LinearController:
        """One axis without its limit, exactly; `member` picks one member of an ensemble.

        The state is the observer's prediction.
        """
        at = lambda gain: pick_gain(gain, axis, member)
        gains, b0, dt, observer = self.gains, at(self.b0), self.dt, self.observer
        proportional, correction = at(gains.proportional), jnp.stack([*map(at, gains.correction)])
        slope = [] if gains.derivative is None else [at(gains.derivative)]
        unit, zero = jnp.eye(len(correction), dtype=b0.dtype), jnp.zeros(len(correction), b0.dtype)
        transition = jnp.stack(observer.predict(list(unit), zero, dt))
        drive = jnp.stack(observer.predict(list(zero), jnp.ones_like(b0), dt))
        feedback = jnp.stack([proportional, *slope, jnp.ones_like(b0)])
        keep = unit.at[:, 0].add(-correction)
        dot = lambda a, b: jnp.dot(a, b, precision="highest")
        # b0 u = kp r - late x - direct y
        late = dot(feedback, keep) if observer.current else feedback
        direct = dot(feedback, correction) if observer.current else jnp.zeros_like(b0)
        return LinearController(
            A=dot(transition, keep) - drive[:, None] * late[None],
            reference_in=drive * proportional,
            measurement_in=dot(transition, correction) - drive * direct,
            C=-late / b0,
            reference_through=proportional / b0,
            measurement_through=-direct / b0,
            dt=dt,
        )

    def tunable(self) -> dict[str, Transform | None]:
        """The bandwidths and the gain of the plant."""
        return {"wc": None, "wo": None, "b0": None}

    def observer_instability(self) -> str:
        """Why the observer alone is unstable; empty if it is stable.

        The feedback can hold an observer that diverges as soon as the command stays at its limit.
        Only half-gain factors bring that about.
        """
        if self._has_full_gains or (radius := float(np.max(self._radius))) < _STABLE:
            return ""
        return (
            f"The observer alone is unstable at {self._named_gains} (spectral radius {radius:.4g} "
            "per sample): it would diverge while the command saturates. Raise observer_factor or "
            "lower wo."
        )

    def observer_slowness(self) -> str:
        """Why the observer alone is slower than the feedback; empty if it is not.

        After each saturation the feedback would act on an estimate that is still wrong.
        """
        if self._has_full_gains:
            return ""
        decay = jnp.asarray(-np.log(self._radius) / self.dt)
        ratio = np.asarray(multiply_gains(1 / self.wc, decay))
        if np.all(ratio >= 1):
            return ""
        return (
            f"The observer alone decays at {ratio.min():.3g} wc at {self._named_gains}, slower "
            "than the feedback: after saturation its estimate would mislead. Raise "
            "observer_factor or wo."
        )

    def observer_barrier(self, free: Collection[str]) -> Float[Array, ""]:
        """-ln of the room that Jury's conditions leave the observer, until it is as slow as wc.

        0 unless `observer_factor` is `free`, because with all of the gains the observer has the
        poles that wo says.
        """
        if not any(name.partition("[")[0] == "observer_factor" for name in free):
            return jnp.zeros(())
        full = dataclasses.replace(self, observer_factor=jnp.ones(()))
        return barrier(self._error, full._error, self.wc, self.dt)

    @property
    def _has_full_gains(self) -> bool:
        return not np.any(np.asarray(self.observer_factor) != 1)

    @property
    def _error(self) -> Float[Array, "... states states"]:
        return error_dynamics(self.observer, self.gains.correction, self.dt)

    @property
    def _radius(self) -> Float[np.ndarray, "..."]:
        return np.asarray(np.max(np.abs(np.linalg.eigvals(np.asarray(self._error))), axis=-1))

    @property
    def _named_gains(self) -> str:
        ends = [
            np.unique([np.min(x), np.max(x)])
            for x in map(np.asarray, (self.wo, self.observer_factor))
        ]
        wo, factor = (" .. ".join(f"{x:.4g}" for x in pair) for pair in ends)
        return f"wo = {wo} rad/s and an observer_factor of {factor}"

    def transfer_functions(
        self, axis: int = 0, member: Member = None
    ) -> tuple[TransferFunction, TransferFunction]:
        """C and F of u = F r - C y in continuous time: LADRC in the limit of `dt` = 0.

        C is a PID with a second-order filter (order 1: PI with one of first order), F/C the
        prefilter of the reference.
        """
        at = lambda gain: pick_gain(gain, axis, member)
        wc, b0, half = at(self.wc), at(self.b0), at(self.feedback_factor)
        l = at(self.observer_factor) * continuous_gains(at(self.wo), self.order)
        one, zero = jnp.ones_like(b0), jnp.zeros_like(b0)
        if self.order == 1:
            kp = half * wc
            back = [kp * l[0] + l[1], kp * l[1]]
            below = [one, l[0] + kp, zero]
        else:
            kp, kd = half * wc**2, half * 2 * wc
            back = [kp * l[0] + kd * l[1] + l[2], kp * l[1] + kd * l[2], kp * l[2]]
            below = [one, l[0] + kd, l[1] + kd * l[0] + kp, zero]
        ahead, below = kp * jnp.concatenate([one[None], l]), jnp.stack(below)
        return TransferFunction(jnp.stack(back) / b0, below), TransferFunction(ahead / b0, below)


_STABLE = 1 - 1e-9  # the spectral radius below which an error of the observer decays
_REMEDIES = {
    "wc": "give the closed loop's bandwidth in rad/s",
    "wo": "give the observer's bandwidth in rad/s, a few times wc",
    "b0": "give the plant's gain; if it is negative, reverse the sign of the command",
}


def _gains(ladrc: LADRC) -> dict[str, Array]:
    return {
        "wc": ladrc.wc, "wo": ladrc.wo, "b0": ladrc.b0, "feedback_factor": ladrc.feedback_factor,
        "observer_factor": ladrc.observer_factor, "limit": ladrc.limit,
    }  # fmt: skip
