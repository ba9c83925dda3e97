"""What controllers exchange with a loop, and the methods by which parts of a user's own fit in."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree


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
