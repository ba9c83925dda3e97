from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Float, PyTree


@runtime_checkable
class Plant(Protocol):
    """What a loop is closed around: `jq.models.Multirotor`, `jq.DecoupledAxes`, or a user's own module.

    With `with_added_inertia(inertia)` it can carry a scenario's payload.
    """

    def init(self, euler: Any = None, *, ensemble: tuple[int, ...] = ()) -> PyTree: ...
    def derivative(self, state: Any, inputs: Any, disturbance: Any) -> PyTree: ...
    def measure(self, state: Any) -> Float[Array, " axes *ensemble"]: ...


@runtime_checkable
class Controller(Protocol):
    """What closes a loop, one step a sample.

    Three more methods are used where a controller has them: `applied(state, achieved)` tells it
    what the drive really gave, before the next sample; `signals(state)` is a dict of arrays
    `[axes, *ensemble]` to record; `prepared()` is the controller to run, with what is the same
    for all samples computed. `ensemble` is the trailing shape of its gains.
    """

    def init(self, like: Any) -> PyTree: ...
    def step(self, state: Any, reference: Any, measurement: Any) -> tuple[PyTree, Array]: ...


@runtime_checkable
class Drive(Protocol):
    """From a command to what the plant's inputs can be: `jq.simulation.MotorDrive`, `jq.simulation.Saturation`."""

    def inputs(self, command: Any) -> Float[Array, " inputs *ensemble"]: ...
    def achieved(self, inputs: Any) -> Float[Array, " axes *ensemble"]: ...
