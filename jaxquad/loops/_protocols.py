"""What the parts of a loop need: methods, and nothing else. Optional ones are asked for here."""

from typing import Protocol, runtime_checkable

from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from jaxquad.control import Reference
from jaxquad.models import LinearAxis


Vector = Float[Array, " axes *ensemble"]


@runtime_checkable
class Plant(Protocol):
    """What a loop is closed around: `jq.DecoupledAxes`, `jq.models.Multirotor`, or your own module.

    `init` gives the state at rest at the angles `euler` in rad, as wide as `ensemble` and the
    plant's own arrays ask for; `derivative` its rate of change under held inputs and a disturbance
    torque in N m; `measure` the angles in rad. With `with_added_inertia(inertia)` a plant can carry
    a scenario's payload.
    """

    def init(self, euler: ArrayLike | None = None, *, ensemble: tuple[int, ...] = ()) -> PyTree: ...
    def derivative(self, state: PyTree, inputs: Vector, disturbance: Vector) -> PyTree: ...
    def measure(self, state: PyTree) -> Vector: ...


@runtime_checkable
class Controller(Protocol):
    """What closes a loop, one step a sample.

    `init(like)` gives its state at rest, for measurements shaped as `like`; `step` the next state
    and the command to hold. Further members are used where a controller has them:

    - `dt`: the sample interval in s that it was made for;
    - `applied(state, achieved)`: gets what the drive really gave, before the next sample;
    - `signals(state)`: a dict of arrays `[axes, *ensemble]` to record;
    - `prepared()`: the controller to run, with what is the same for all samples computed;
    - `linear(axis, member)`: a `jq.control.LinearController` to analyse.
    """

    def init(self, like: Vector) -> PyTree: ...
    def step(
        self, state: PyTree, reference: Reference, measurement: Vector
    ) -> tuple[PyTree, Vector]: ...


@runtime_checkable
class Drive(Protocol):
    """From a command to the plant's inputs within their limits, as `jq.simulation.MotorDrive`."""

    def inputs(self, command: Vector) -> Float[Array, " inputs *ensemble"]: ...
    def achieved(self, inputs: Vector) -> Vector: ...


@runtime_checkable
class Sensor(Protocol):
    """From true angles to measured ones, rad: `jq.simulation.Encoder`."""

    def __call__(self, angle: Vector) -> Vector: ...


@runtime_checkable
class LinearisablePlant(Protocol):
    """A plant that `jq.analyse`, `jq.tune` and `jq.certify` can analyse as a linear loop."""

    def linearise(self, axis: int) -> LinearAxis:
        """One axis about rest."""
        ...


@runtime_checkable
class _HasPlantGain(Protocol):
    b0: Float[Array, "..."]


@runtime_checkable
class _HasSampleInterval(Protocol):
    dt: float


@runtime_checkable
class _HasApplied(Protocol):
    def applied(self, state: PyTree, achieved: Vector) -> PyTree: ...


@runtime_checkable
class _HasSignals(Protocol):
    def signals(self, state: PyTree) -> dict[str, Array]: ...


@runtime_checkable
class _HasPrepared(Protocol):
    def prepared(self) -> Controller: ...


@runtime_checkable
class CarriesPayload(Protocol):
    """A plant that can carry a scenario's payload."""

    def with_added_inertia(self, inertia: Float[ArrayLike, "..."]) -> Plant: ...


@runtime_checkable
class ChecksState(Protocol):
    """A plant that knows a state which integration has spoilt, such as a short quaternion."""

    def is_resolved(self, state: PyTree) -> Bool[Array, "*ensemble"]: ...


def sample_interval(controller: object) -> float | None:
    """The interval in s that a controller was made for; None where it has no `dt`."""
    return controller.dt if isinstance(controller, _HasSampleInterval) else None


def assumed_gain(controller: object, axis: int) -> Float[Array, "..."] | float:
    """The b0 of a controller on one axis, rad/s^2 per unit of command; 1 where it has none."""
    if not isinstance(controller, _HasPlantGain):
        return 1.0
    b0 = controller.b0
    return b0[axis if b0.shape[0] > 1 else 0] if b0.ndim else b0


def prepared(controller: Controller) -> Controller:
    """The controller to run sample by sample."""
    return controller.prepared() if isinstance(controller, _HasPrepared) else controller


def after_drive(controller: Controller, state: PyTree, achieved: Vector) -> PyTree:
    """The controller's state once it knows what the drive really gave."""
    return controller.applied(state, achieved) if isinstance(controller, _HasApplied) else state


def signals_of(controller: Controller, state: PyTree) -> dict[str, Array]:
    """What a controller gives to record."""
    return controller.signals(state) if isinstance(controller, _HasSignals) else {}
