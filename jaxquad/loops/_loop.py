"""A loop, and what its parts need: methods, and nothing else."""

import math
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from jaxquad._core import as_float, per_member, require_sample_interval, require_signature
from jaxquad.control import LinearController, LinearisableController, Reference, ScheduledController
from jaxquad.models import LinearAxis, Multirotor


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
    - `linear(axis, member)`: a `jq.control.LinearController` to analyse and to certify;
    - `tunable()`: what `jq.tune` varies, see `jq.control.Tunable`;
    - `scheduled_at(inertia)`: the gains of an inertia, see `jq.control.ScheduledController`;
    - `c_source(axes, precision)`: a `jq.export.Source` for `jq.export.write_c_header`.
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
        """One axis about rest; all axes have as many states."""
        ...


@runtime_checkable
class CarriesPayload(Protocol):
    """A plant that can carry a scenario's payload."""

    def with_added_inertia(self, inertia: Float[ArrayLike, "..."]) -> Plant: ...


@runtime_checkable
class ChecksState(Protocol):
    """A plant that knows a state which integration has spoilt, such as a short quaternion."""

    def is_resolved(self, state: PyTree) -> Bool[Array, "*ensemble"]: ...


_DEFAULT_DT = 0.002  # s
_CALLS = (  # of a simulation: arguments by position, and by name
    ("plant", Plant, "init", 0, "ensemble"),
    ("plant", Plant, "derivative", 3),
    ("plant", Plant, "measure", 1),
    ("controller", Controller, "init", 1),
    ("controller", Controller, "step", 3),
    ("drive", Drive, "inputs", 1),
    ("drive", Drive, "achieved", 1),
    ("encoder", Sensor, "__call__", 1),
)
# A scheduled controller is tuned and certified: its members fly it at the inertia they are given.
AnyController = Controller | LinearisableController | ScheduledController | LinearController


class DelayQueue(NamedTuple):
    """How many past inputs a delay needs, fixed when the loop is built."""

    length: int
    splits: bool  # whether a delay may end within a sample interval
    traced: bool  # its value was not known when the loop was built
    fewest: int = 0  # whole samples by which every member's input is late

    @classmethod
    def of(cls, delay: ArrayLike, dt: float, longest: float | None) -> "DelayQueue":
        """The queue of a delay in s. Raises ValueError for a delay that makes no sense."""
        if isinstance(delay, Tracer):
            if longest is None or not 0 < longest < math.inf:
                raise ValueError(
                    f"the delay is traced by jit, vmap or grad, and longest_delay is {longest}: "
                    "give longest_delay=, the longest delay in s that can occur"
                )
            return cls(math.floor(longest / dt * (1 + 1e-9)) + 1, True, True)
        values = np.asarray(delay, dtype=float)
        if not np.all(np.isfinite(values) & (values >= 0)):
            raise ValueError(f"delay is {delay} s, but it must be 0 or above and finite")
        greatest = float(np.max(values, initial=0.0))
        if longest is not None and not 0 <= longest < math.inf:
            raise ValueError(f"longest_delay is {longest} s, but it must be 0 or above and finite")
        if longest is not None and greatest > longest * (1 + 1e-9):
            raise ValueError(
                f"delay is {delay} s, above longest_delay = {longest} s: raise the latter"
            )
        samples = np.asarray(values / dt)
        nearest = np.round(samples)
        is_integer = bool(np.all(np.abs(samples - nearest) < 1e-9 * np.maximum(nearest, 1)))
        samples = nearest if is_integer else np.floor(samples)
        most, fewest = (int(f(samples)) if samples.size else 0 for f in (np.max, np.min))
        return cls(most if is_integer else most + 1, not is_integer, False, fewest)


class Loop(eqx.Module):
    """A plant, its sampled controller, and all that is between them.

        loop = jq.Loop(plant, controller, drive=jq.simulation.Saturation(20.0), delay=0.004)
        flight, numbers = jq.simulate(loop, scenario), jq.analyse(loop, "roll")

    Every `dt` seconds the controller measures through the `encoder` and its command, made inputs by
    the `drive`, is held; it reaches the plant `delay` seconds later. Plant, controller, drive and
    delay may each be one or an ensemble, along the last axis of their arrays.

    **Arguments:**

    - `plant`: the vehicle, see `jq.loops.Plant`. A `jq.models.Multirotor` needs a `drive`.
    - `controller`: see `jq.loops.Controller`; a `jq.control.LinearController` can be analysed only.
    - `drive`: from commands to inputs; None hands commands to the plant as they are.
    - `encoder`: from angles to measured angles; None measures exactly.
    - `delay`: s, 0 or above, whole samples or not, one for all or one per member. The loop is
        differentiable with respect to it where `longest_delay` is given and the delay is traced.
    - `dt`: sample interval in s; None is the controller's, or 0.002 if it has none.
    - `substeps`: Runge-Kutta steps of the plant in a sample interval.
    - `bound`: rad; a loop whose angle exceeds it has diverged.
    - `longest_delay`: s, the most that a `delay` traced by jit, vmap or grad can become.

    **Raises:** ValueError for a value out of range, for a controller made for another `dt`, for a
    method with other arguments than its protocol's, and for a `jq.models.Multirotor` without a
    drive.
    """

    plant: Plant
    controller: AnyController
    drive: Drive | None
    encoder: Sensor | None
    delay: Float[Array, "*ensemble"] = per_member(rank=0)  # s
    dt: float = eqx.field(static=True)  # s
    substeps: int = eqx.field(static=True)
    bound: float = eqx.field(static=True)  # rad
    longest_delay: float | None = eqx.field(static=True)  # s
    queue: DelayQueue = eqx.field(static=True)

    def __init__(
        self, plant: Plant, controller: AnyController, *, drive: Drive | None = None,
        encoder: Sensor | None = None, delay: Float[ArrayLike, "..."] = 0.0,
        dt: float | None = None, substeps: int = 1, bound: float = 100.0,
        longest_delay: float | None = None,
    ):  # fmt: skip
        made_for: float | None = getattr(controller, "dt", None)
        dt = (made_for or _DEFAULT_DT) if dt is None else dt
        require_sample_interval(dt)
        self.plant, self.controller, self.drive, self.encoder = plant, controller, drive, encoder
        self.dt, self.substeps, self.bound = float(dt), substeps, float(bound)
        self.queue, self.longest_delay = DelayQueue.of(delay, self.dt, longest_delay), longest_delay
        self.delay = as_float(delay)

    def __check_init__(self):
        if not (isinstance(self.substeps, int | np.integer) and self.substeps >= 1):
            raise ValueError(f"substeps is {self.substeps}: give a whole number, 1 or more")
        if not (self.bound > 0 and math.isfinite(self.bound)):
            raise ValueError(f"bound is {self.bound} rad: give an angle above 0")
        if isinstance(self.controller, Plant) and not isinstance(self.controller, Controller):
            raise ValueError(
                f"the controller is a {type(self.controller).__name__}, which is a plant: give "
                "jq.Loop(plant, controller, ...)"
            )
        for part, protocol, method, count, *names in _CALLS:
            require_signature(getattr(self, part), protocol, method, count, *names)
        made_for = getattr(self.controller, "dt", None)
        if made_for is not None and not math.isclose(made_for, self.dt, rel_tol=1e-6):
            raise ValueError(
                f"the controller was made for samples of {made_for} s, not {self.dt} s: "
                "leave dt out, or make the controller with this dt"
            )
        if isinstance(self.plant, Multirotor) and self.drive is None:
            volts = self.plant.allocation.input == "voltage"
            drive = "MotorDrive(plant.allocation)" if volts else "RotorDrive(plant.allocation, ...)"
            raise ValueError(
                "drive is None, but a Multirotor takes four motor inputs: give "
                f"drive=jq.simulation.{drive}"
            )

    @property
    def memory(self) -> int:
        """Samples that a command may be on its way, 0 without a delay."""
        longest, (length, splits, *_) = self.longest_delay, self.queue
        if longest is not None:
            return math.floor(longest / self.dt + 1e-9) + 1 if longest > 0 else 0
        return length + (0 < length and not splits)

    def with_controller(self, controller: AnyController) -> "Loop":
        """The same loop with another controller. Raises ValueError for one of another `dt`."""
        loop = eqx.tree_at(lambda x: x.controller, self, controller)
        loop.__check_init__()
        return loop

    def with_plant(self, plant: Plant) -> "Loop":
        """The same loop around another plant."""
        loop = eqx.tree_at(lambda x: x.plant, self, plant)
        loop.__check_init__()
        return loop
