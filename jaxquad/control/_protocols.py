"""What controllers exchange with a loop, methods of parts of a user's own, and observers."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from jaxquad._core import multiply_gains, require_signature


Signal = Float[Array, " axes *ensemble"]  # of each axis and each member
Gain = Float[Array, "..."]  # one number, one for each axis, or `[axes, *ensemble]`


class Setpoint(NamedTuple):
    """A reference with its derivatives, for feed-forward."""

    angle: Signal  # rad
    rate: Signal  # rad/s
    acceleration: Signal  # rad/s^2


Reference = Setpoint | Signal  # angles in rad have no feed-forward
Member = int | tuple[int | Array, ...] | Array | None  # None where there is no ensemble


def as_setpoint(reference: Reference) -> Setpoint:
    """Return `reference`, or, for an array of angles, a set-point whose derivatives are 0."""
    if isinstance(reference, Setpoint):
        return reference
    return Setpoint(reference, jnp.zeros_like(reference), jnp.zeros_like(reference))


class LinearController(eqx.Module):
    """One axis of a controller without limits: x[k+1] = A x + Br r + By y, u = C x + Dr r + Dy y.

    r is the angle of the set-point, y the measurement of the same sample, in rad; u the command
    that is held until the next sample. By and Dy carry the sign of the feedback.
    """

    A: Float[Array, "states states"]
    reference_in: Float[Array, " states"]  # Br
    measurement_in: Float[Array, " states"]  # By
    C: Float[Array, " states"]
    reference_through: Float[Array, ""]  # Dr
    measurement_through: Float[Array, ""]  # Dy
    dt: float = eqx.field(static=True)  # s


@runtime_checkable
class LinearisableController(Protocol):
    """A controller that `jq.analyse`, `jq.tune` and `jq.certify` can analyse as a linear loop."""

    def linear(self, axis: int = 0, member: Member = None) -> LinearController:
        """One axis without its limits; `member` picks one member of an ensemble."""
        ...


@runtime_checkable
class ScheduledController(Protocol):
    """A controller whose gains depend on an inertia that it is given."""

    def scheduled_at(self, inertia: Float[ArrayLike, "..."]) -> Any:
        """The controller with the gains of this `inertia` in kg m^2, fixed."""
        ...


@runtime_checkable
class Transform(Protocol):
    """Unbounded coordinates for an array that is not free in every direction."""

    def forward(self, z: Gain) -> Gain:
        """The array at any coordinates `z` of its shape, differentiable."""
        ...

    def inverse(self, values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Coordinates of the array nearest to `values`."""
        ...


@runtime_checkable
class Tunable(Protocol):
    """A controller, or a part of one, that says what a tune varies."""

    def tunable(self) -> Mapping[str, Transform | None]:
        """The arrays that are varied unless `free=` names others.

        Keys are names as in `free=`, such as "wc" or "ladrc.wc"; values are the coordinates of the
        array, or None for logarithms of its elements, as in `jq.fit`.
        """
        ...


@runtime_checkable
class ObserverController(Protocol):
    """A controller with an observer that may misbehave by itself while the linear loop is stable.

    While the command saturates no feedback acts, and the error of the observer moves by the
    observer's own poles alone.
    """

    def observer_instability(self) -> str:
        """Why the observer alone is unstable; empty if it is stable."""
        ...

    def observer_slowness(self) -> str:
        """Why the observer alone is slower than the feedback; empty if it is not."""
        ...

    def observer_barrier(self, free: Collection[str]) -> Float[Array, ""]:
        """A penalty that is near 0 for fast observers and grows without bound towards slow ones.

        It is 0 where none of the `free` numbers, named as in `tunable`, can make the observer slow.
        """
        ...


def find_transform(part: object, name: str) -> Transform | None:
    """The coordinates of the array `name`, as `part` or the innermost part that owns it says."""
    if isinstance(part, Tunable) and (transform := part.tunable().get(name)) is not None:
        return transform
    owner, dot, rest = name.partition(".")
    return find_transform(getattr(part, owner, None), rest) if dot else None


def schedule_for_analysis(controller: object, inertia: Float[ArrayLike, "..."]) -> Any:
    """`controller.scheduled_at(inertia)` of a scheduled controller, any other one as it is.

    An adaptive controller becomes the one that it is once its estimate has reached `inertia`.
    """
    if isinstance(controller, ScheduledController):
        require_signature(controller, ScheduledController, "scheduled_at", 1)
        return controller.scheduled_at(inertia)
    return controller


def schedule_for_flight(controller: object, inertia: Float[ArrayLike, "..."]) -> Any:
    """What to simulate: a controller that has `step` as it is, another one scheduled."""
    return controller if hasattr(controller, "step") else schedule_for_analysis(controller, inertia)


@runtime_checkable
class Observer(Protocol):
    """An extended state observer of y'' = u0 + f (order 2) or y' = u0 + f (order 1), sampled.

    At each sample it predicts the states [y, y', f] (or [y, f]) from the last estimate and from
    `drive` = b0 u, the acceleration (or rate) that was held since, and adds `correction` times the
    error of the predicted y.
    """

    @property
    def current(self) -> bool:
        """Whether the feedback uses the corrected estimate; else it uses the prediction."""
        ...

    @property
    def fastest(self) -> float:
        """The highest wo dt."""
        ...

    def gains(self, wo: Gain, dt: float, order: int) -> Float[Array, "states ..."]:
        """The gains as textbooks print them for this form; `wo` in rad/s, `dt` in s."""
        ...

    def correction(self, wo: Gain, dt: float, order: int) -> Float[Array, "states ..."]:
        """What multiplies the error of the predicted y."""
        ...

    def predict(self, estimate: Sequence[Gain], drive: Gain, dt: float) -> list[Gain]:
        """The states one sample later."""
        ...


@runtime_checkable
class AntiWindup(Protocol):
    """Decides what a sample adds to the integral of a bounded controller, in units of the command.

    `growth` is what the error asks for, `wanted` the command before its limit, `bounded` after it.
    """

    def __call__(self, growth: Signal, wanted: Signal, bounded: Signal, dt: float) -> Signal: ...


class InertiaEstimate(NamedTuple):
    """An estimate of the inertia with its uncertainty."""

    inertia: Signal  # kg m^2; the nominal one before any excitation
    deviation: Signal  # kg m^2, one standard deviation
    trusted: Signal  # 1 where excited and precise enough, else 0


@runtime_checkable
class InertiaEstimator(Protocol):
    """Estimates the inertia in flight, for `jq.AdaptiveLADRC`.

    An estimator made for one sample interval says so by an attribute `dt` in s.
    """

    def init(self, like: Signal) -> PyTree:
        """The state before the first sample, for measurements shaped as `like`."""
        ...

    def update(self, state: PyTree, command: Signal, measurement: Signal) -> PyTree:
        """The state after one more sample.

        `command` is what the plant received since the last sample, `measurement` the angle in rad
        at the end of it.
        """
        ...

    def estimate(self, state: PyTree) -> InertiaEstimate:
        """The estimate by the samples so far."""
        ...


@runtime_checkable
class ProbingEstimator(InertiaEstimator, Protocol):
    """An `InertiaEstimator` with a test signal of its own."""

    def probe(self, state: PyTree) -> Signal:
        """The test signal to add to the next command."""
        ...

    def excite(self, state: PyTree) -> PyTree:
        """The state with the estimate in doubt, in which the test signal starts."""
        ...


Rows = Float[Array, "states ..."]
Matrices = Float[Array, "... states states"]


class _ZeroOrderHold(eqx.Module):
    fastest = math.pi

    def correction(self, wo: Gain, dt: float, order: int) -> Rows:
        off = _off_unity(wo, dt)
        if order == 1:
            return jnp.stack([off * (2 - off), off**2 / dt])
        first = off * (3 - 3 * off + off**2)
        return jnp.stack([first, 1.5 / dt * off**2 * (2 - off), off**3 / dt**2])

    def predict(self, estimate: Sequence[Gain], drive: Gain, dt: float) -> list[Gain]:
        if len(estimate) == 2:
            y, unknown = estimate
            return [y + dt * (unknown + drive), unknown]
        y, rate, unknown = estimate
        push = dt * (unknown + drive)
        return [y + dt * (rate + 0.5 * push), rate + push, unknown]


class CurrentObserver(_ZeroOrderHold):
    """The zero-order-hold observer whose estimate holds the latest measurement (Herbst).

    All poles at exp(-wo dt), exactly. Source: docs/control.md; Herbst, "A simulative study on
    active disturbance rejection control" (2013) and arXiv 1908.04610.
    """

    current = True

    def gains(self, wo: Gain, dt: float, order: int) -> Rows:
        """l of z[k] = (I - l C) (Ad z[k-1] + Bd b0 u[k-1]) + l y[k]; `wo` in rad/s."""
        return self.correction(wo, dt, order)


class PredictiveObserver(_ZeroOrderHold):
    """The zero-order-hold observer whose estimate precedes the measurement: a sample to compute.

    All poles at exp(-wo dt), exactly. Source: docs/control.md.
    """

    current = False

    def gains(self, wo: Gain, dt: float, order: int) -> Rows:
        """l of z[k+1] = (Ad - l C) z[k] + Bd b0 u[k] + l y[k], that is, Ad times the current."""
        off = _off_unity(wo, dt)
        if order == 1:
            return jnp.stack([2 * off, off**2 / dt])
        return jnp.stack([3 * off, off**2 * (6 - off) / (2 * dt), off**3 / dt**2])


class EulerObserver(eqx.Module):
    """The continuous observer stepped forward by Euler's rule, as much code in use has it.

    For comparison: the loop's poles are not where wc and wo say, the more so the slower the
    sampling (docs/control.md).
    """

    current = False
    fastest = 2.0  # the observer alone diverges beyond it

    def gains(self, wo: Gain, dt: float, order: int) -> Rows:
        """dt times the continuous gains [3 wo, 3 wo^2, wo^3], or [2 wo, wo^2]."""
        return dt * continuous_gains(wo, order)

    def correction(self, wo: Gain, dt: float, order: int) -> Rows:
        rows = list(self.gains(wo, dt, order))
        for k in reversed(range(order)):  # what the next prediction turns into the gains
            rows[k] = rows[k] - dt * rows[k + 1]
        return jnp.stack(rows)

    def predict(self, estimate: Sequence[Gain], drive: Gain, dt: float) -> list[Gain]:
        *derivatives, unknown = estimate
        slopes = [*derivatives[1:], unknown + drive]
        return [*(x + dt * v for x, v in zip(derivatives, slopes, strict=True)), unknown]


def continuous_gains(wo: Gain, order: int) -> Rows:
    """Those that place all poles of the continuous observer at -wo."""
    rows = [2 * wo, wo**2] if order == 1 else [3 * wo, 3 * wo**2, wo**3]
    return jnp.stack(rows)


def _off_unity(wo: Gain, dt: float) -> Gain:
    """1 - exp(-wo dt), which would lose half its digits as written."""
    return -jnp.expm1(-wo * dt)


def error_dynamics(observer: Observer, correction: Rows, dt: float) -> Matrices:
    """(I - l C) Ad: the matrix that takes an error of the estimate to the next sample."""
    rows = jnp.moveaxis(correction, 0, -1)
    unit = jnp.eye(len(correction), dtype=rows.dtype)
    predict = jnp.stack(observer.predict(list(unit), jnp.zeros_like(unit[0]), dt))
    shape = (*rows.shape, len(unit))
    observed = rows[..., None] * jnp.broadcast_to(predict[0], shape)
    return jnp.broadcast_to(predict, shape) - observed


def barrier(error: Matrices, full: Matrices, wc: Gain, dt: float) -> Float[Array, ""]:
    """-ln of the room left to an observer before it is as slow as wc; near 0 for a fast one.

    The room is that of Jury's conditions on the polynomial of the observer's `error`, its roots
    scaled so that those of wc come to 1, over the room that the observer with `full` gains has to
    where it is unstable. NaN for a slower observer.
    """
    pairs = zip(_room(error, wc, dt), _room(full, 0 * wc, dt), strict=True)
    share = [multiply_gains(x, 1 / full_room) for x, full_room in pairs]
    return sum((jnp.mean(0.5 * jnp.log1p(x**2) - jnp.log(x)) for x in share), jnp.zeros(()))


def _room(error: Matrices, decay: Gain, dt: float) -> list[Gain]:
    """What is above 0 while every root of the error's polynomial is within exp(-decay dt)."""
    states, closer = error.shape[-1], jnp.exp(decay * dt)
    trace = multiply_gains(jnp.trace(error, axis1=-2, axis2=-1), closer)
    determinant = multiply_gains(jnp.linalg.det(error), closer**states)
    if states == 2:
        return [1 - trace + determinant, 1 - determinant]
    square = multiply_gains(jnp.trace(error @ error, axis1=-2, axis2=-1), closer**2)
    minors = 0.5 * (trace**2 - square)
    real = 1 - trace + minors - determinant
    return [real, 1 - minors + determinant * (trace - determinant)]
