"""A loop in a scenario, from the first sample to the last."""

import functools as ft
import math
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxquad._compile import in_chunks, Jit, most_at_once, scan_members
from jaxquad._core import (
    align,
    ensemble_shape,
    is_concrete,
    mark_members,
    pytree_node,
    require_signature,
)
from jaxquad.loops import CarriesPayload, Loop, Plant
from jaxquad.records import AXES, Record

from ._hardware import Authority, delay_line, find_authority, warn_beyond_authority
from ._parallel import DeviceChoice, Devices, loop_over_devices, over_cores, placed
from ._scenario import require_memory, Scenario
from ._step import Carry, guarded, LoopStep, require_runnable, SampleResult


@pytree_node
class Simulation:
    """What a simulated loop did, sample by sample.

    Where an angle exceeds the loop's `bound`, the member has `diverged`: it is held at that angle
    with command 0. Its numbers are finite, but they describe no flight.

    **Arguments:**

    - `time`, `dt`: s; `angle`: true, rad; `measurement`: rad; `command`: achieved, V.
    - `saturated`: whether the drive gave less than was asked.
    - `signals`: of the controller, [samples, axes, *ensemble].
    - `diverged`: whether the member left the bound.
    - `scenario`: as it was given.
    - `authority`: the torque that the drive can hold; None for a plant that does not tell it.
    """

    time: Float[Array, " samples"]
    angle: Float[Array, " samples axes *ensemble"]
    measurement: Float[Array, " samples axes *ensemble"]
    command: Float[Array, " samples axes *ensemble"]
    saturated: Bool[Array, " samples axes *ensemble"]
    signals: dict[str, Array]
    diverged: Bool[Array, "*ensemble"]
    scenario: Scenario
    dt: float = eqx.field(static=True, default=0.002)
    authority: Authority | None = None

    @property
    def reference(self) -> Float[Array, " samples axes *ensemble"]:
        """The set-point in rad."""
        return self._wide(self.scenario.reference)

    @property
    def injection(self) -> Float[Array, " samples axes *ensemble"]:
        """What was added to the controller's command, V."""
        return self._wide(self.scenario.injection)

    @property
    def disturbance(self) -> Float[Array, " samples axes *ensemble"]:
        """Torque in N m."""
        return self._wide(self.scenario.disturbance)

    def record(self, axis: str = "roll", *, member: int | None = None) -> Record:
        """The axis as it would be logged: achieved command, measured angle, injected sweep.

        `member` picks one of an ensemble. Raises `ValueError` for an axis that does not exist, and
        for a member that diverged.
        """
        names = AXES[: self.angle.shape[1]]
        if axis not in names:
            raise ValueError(f"axis {axis!r}: choose one of {', '.join(names)}")
        k = names.index(axis)
        if member is None and self.angle.ndim > 2:
            raise ValueError(
                f"an ensemble of shape {self.angle.shape[2:]} has many records: pick one, member=0"
            )
        if np.asarray(self.diverged)[() if member is None else member]:
            raise ValueError("the loop diverged, so its flight cannot be a record: stabilise it")
        place = (slice(None), k) if member is None else (slice(None), k, member)
        command, angle, sweep = (
            np.asarray(x)[place] for x in (self.command, self.measurement, self.injection)
        )
        excited = np.ptp(sweep) > 0
        return Record(
            np.asarray(self.time), command, angle, sweep if excited else None,
            input_names=f"{axis}_command", output_names=f"{axis}_angle",
            reference_names="sweep" if excited else None,
            input_units="V", output_units="rad", reference_units="V" if excited else None,
            source="simulation", hold=self.dt, time_unit="s",
        )  # fmt: skip

    def _wide(self, x: Float[Array, "samples axes ..."]) -> Array:
        return jnp.broadcast_to(align(x, self.angle), self.angle.shape)


def simulate(loop: Loop, scenario: Scenario, *, devices: DeviceChoice = None) -> Simulation:
    """Run a sampled-data loop: measure, control, hold the inputs for `dt` seconds, repeat.

    Between samples the plant is integrated by the loop's `substeps` fourth-order Runge-Kutta steps
    under constant inputs. The injected signal is added to the controller's command, so that a sweep
    can excite a plant that needs stabilising. Inputs reach the plant exactly `delay` seconds later.
    A member whose angle leaves +-`bound` rad, or whose numbers grow beyond 1e9, is held there and
    flagged in `diverged`, so that values and gradients of the others, and its own, stay finite.

    **Arguments:**

    - `loop`: one, or an ensemble along the last axis of the plant's parameters, of the controller's
        gains, of the scenario, of the delay, or of several of them.
    - `scenario`: what happens, see `jq.scenario`.
    - `devices`: compute a part of the members each; the result is the same, on the default device.
        None: those of this process, as many as have 32 members (4096 where they are no CPUs), or
        those that the data were put on; the cores of a CPU share 64 members or more, except within
        `jax.jit` and its like, where a loop uses one core. A number: so many of them; 1 is one
        core. A sequence of `jax.Device`: those, of other processes too. A CPU is one device,
        until `jax.config.update("jax_num_cpu_devices", 2)`, before the first computation, makes it
        two. After `jax.distributed.initialize` each process makes the same call of the whole
        ensemble with `devices=jax.devices()`, and gets all of its members.

    **Returns:** a `jq.simulation.Simulation` with all samples of all members.

    **Raises:** ValueError for parts that do not fit together, such as ensembles of different sizes
    or a payload that the plant cannot carry; for devices that JAX does not have; for processes with
    different ensembles (not under jit, vmap or grad); and for a record that does not fit the
    memory: 25 B or more per sample, axis and member.
    """
    check_run(loop, scenario)
    run, places = placed(loop, scenario, devices)
    flown = over_cores(_run, run, (), places, check=_require_room)
    (stored, diverged), authority = flown
    warn_beyond_authority(authority, scenario)
    angle, measurement, command, saturated, signals = stored
    time = _times(loop.dt, angle.shape[0], angle.dtype)
    return Simulation(
        time, angle, measurement, command, saturated, signals, diverged, scenario, loop.dt,
        authority,
    )  # fmt: skip


@ft.lru_cache(maxsize=8)
def _times(dt: float, samples: int, dtype: np.dtype) -> Float[Array, " samples"]:
    with jax.ensure_compile_time_eval():  # a traced array would not outlive its trace
        return jax.device_put((dt * np.arange(samples)).astype(dtype))


_Flown = tuple[tuple[PyTree, Bool[Array, "*ensemble"]], Authority | None]


@Jit
def _run(loop: Loop, scenario: Scenario, devices: Devices | None = None) -> _Flown:
    drive_authority = find_authority(loop.plant, loop.drive, loop.controller)
    store = lambda run, _: scan_loop(run[0], run[1], _Store())[1:]
    stored, running = loop_over_devices(store, (loop, scenario), None, devices)
    result = (stored, ~running), drive_authority
    _require_room(result)
    return result


def _require_room(result: PyTree) -> None:
    (stored, _), _ = result
    samples, axes, *members = stored[0].shape
    what = f"a record of {samples} samples of {axes} axes of {math.prod(members)} members"
    size = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(stored))
    require_memory(what, size, "take jq.evaluate, which stores none, or jq.simulation.in_slices")


class _Store(eqx.Module):
    """An accumulator that adds up nothing and stores what a `Simulation` has."""

    def begin(self, like: Float[Array, " axes *ensemble"]) -> None:
        return None

    def update(self, total: None, now: SampleResult) -> tuple[None, PyTree]:
        return None, (now.angle, now.measurement, now.command, now.saturated, now.signals)


def check_run(loop: Loop, scenario: Scenario) -> None:
    """Raises ValueError for a loop that cannot run, and for a scenario that does not fit it."""
    if not isinstance(loop, Loop):
        raise ValueError(f"loop is a {type(loop).__name__}: give jq.Loop(plant, controller, ...)")
    if not isinstance(scenario, Scenario):
        raise ValueError(
            f"scenario is a {type(scenario).__name__}: give jq.scenario(duration=..., ...)"
        )
    require_runnable(loop.controller)
    if scenario.dt is not None and not math.isclose(scenario.dt, loop.dt, rel_tol=1e-6):
        raise ValueError(
            f"the scenario is sampled every {scenario.dt} s, but the loop runs every {loop.dt} s: "
            f"give jq.scenario(..., dt={loop.dt}), or a loop with dt={scenario.dt}"
        )
    plant, payload = loop.plant, scenario.payload
    if payload is not None:
        if not isinstance(plant, CarriesPayload):
            raise ValueError(
                f"the scenario has a payload, but {type(plant).__name__} has no "
                "with_added_inertia(inertia) to carry it: add that method, or leave the payload "
                "None"
            )
        require_signature(plant, CarriesPayload, "with_added_inertia", 1)
        if is_concrete(payload):  # the plant refuses one that leaves it without inertia
            plant.with_added_inertia(np.min(np.asarray(payload), axis=0))
    for name, part in scenario.parts.items():
        if is_concrete(part) and not (finite := np.isfinite(np.asarray(part))).all():
            bad = np.flatnonzero(~finite.all(axis=tuple(range(1, part.ndim))))
            raise ValueError(
                f"the scenario's {name} is not finite at sample {bad[0]}: look for the nan or inf "
                "in it"
            )


@runtime_checkable
class Accumulator(Protocol):
    """What a run of a loop adds up, and what it stores.

    A frozen module: arrays that differ between members are fields made by `per_member`. All results
    have the members on their last axis.
    """

    def begin(self, like: Float[Array, " axes *ensemble"]) -> PyTree:
        """The total before the first sample; `like` is zeros."""
        ...

    def update(self, total: PyTree, now: SampleResult, /) -> tuple[PyTree, PyTree]:
        """The total after one sample more, and what is stored of it."""
        ...


def scan_loop(
    loop: Loop, scenario: Scenario, accumulator: Accumulator
) -> tuple[PyTree, PyTree, Bool[Array, "*ensemble"]]:
    """Run a loop over a scenario: what was accumulated, what was stored, and who still runs.

    To be jitted by the caller, after `check_run`.
    """
    job, ensemble = (loop, scenario, accumulator), ensemble_shape(loop, scenario)
    if len(ensemble) != 1 or ensemble[0] <= _FEW:
        return _run_members(job, ensemble)
    carry, total = jax.eval_shape(lambda: _begin(job, ensemble)[1])
    most = most_at_once((carry._replace(queue=None), total), ensemble[0])
    if ensemble[0] <= most:
        return _run_members(job, ensemble)
    arrays, rest = eqx.partition(job, eqx.is_array)

    def run(arrays: PyTree) -> PyTree:
        job = eqx.combine(arrays, rest)
        return _run_members(job, ensemble_shape(*job[:2]))

    return in_chunks(run, arrays, mark_members(job, ensemble), most)


_Job = tuple[Loop, Scenario, Accumulator]
_FEW = 16  # members that are one chunk


def _begin(job: _Job, ensemble: tuple[int, ...]) -> tuple[LoopStep, tuple[Carry, PyTree]]:
    """What runs the loop, and its carry before the first sample."""
    loop, scenario, accumulator = job
    controller = require_runnable(loop.controller)
    prepare = getattr(controller, "prepared", None)
    step = LoopStep(
        plant=loop.plant, controller=controller if prepare is None else prepare(),
        drive=loop.drive, encoder=loop.encoder, line=delay_line(loop), dt=loop.dt,
        substeps=loop.substeps, bound=loop.bound, ensemble=ensemble,
    )  # fmt: skip
    state, like = _at_rest(loop.plant, scenario, ensemble)
    return step, (step.begin(state, like), accumulator.begin(like))


def _run_members(
    job: _Job, ensemble: tuple[int, ...]
) -> tuple[PyTree, PyTree, Bool[Array, "*ensemble"]]:
    step, (start, total) = _begin(job, ensemble)
    _, scenario, accumulator = job
    # A member runs where the first number of every array is one.
    numbers = eqx.filter((step, start, total, scenario, accumulator), eqx.is_array)
    firsts = [jnp.ravel(x)[:1] for x in jax.tree.leaves(numbers)]
    sound = ft.reduce(jnp.logical_and, [jnp.all(x == x) for x in firsts], jnp.ones((), bool))
    queue, start = start.queue, start._replace(running=start.running & sound, queue=None)
    arrays, static = eqx.partition((step, accumulator), eqx.is_array)

    def sample(inner: Carry, parts: PyTree, now: PyTree) -> tuple[Carry, SampleResult]:
        step, _ = eqx.combine(parts, static)
        return step.sample(inner, *now)

    def advance(carry: PyTree, parts: PyTree, now: PyTree, *oldest: Array) -> tuple[PyTree, PyTree]:
        parts, at_rest = parts
        inner, result = guarded(sample, ensemble, at_rest, carry[0], parts, (*now, *oldest))
        _, accumulator = eqx.combine(parts, static)
        total, output = accumulator.update(carry[1], result)
        if oldest:
            output = inner.queue[0], output
        return (inner._replace(queue=None), total), output

    parts = arrays, jax.lax.stop_gradient(start)
    signals = jnp.arange(len(scenario.reference)), scenario
    members = ensemble[0] if len(ensemble) == 1 else None
    carried, stored = scan_members(
        advance, (start, total), parts, signals, members=members, queue=queue
    )
    return carried[1], stored, carried[0].running


def _at_rest(
    plant: Plant, scenario: Scenario, ensemble: tuple[int, ...]
) -> tuple[PyTree, Float[Array, " axes *ensemble"]]:
    """The plant at rest, and zeros shaped as its angles; raise ValueError for other axes."""
    axes = scenario.reference.shape[1]
    state = plant.init(ensemble=ensemble)
    angle = jax.eval_shape(plant.measure, state)
    if angle.shape == (axes, *ensemble):
        return state, jnp.zeros(angle.shape, angle.dtype)
    if angle.shape[0] != axes:
        raise ValueError(
            f"the scenario is for {axes} axes, but the plant has {angle.shape[0]}: give "
            f"jq.scenario(..., axes={angle.shape[0]}), or a plant with a value for each axis"
        )
    raise ValueError(
        f"the plant's angles have the shape {angle.shape}, but {(axes, *ensemble)} is expected: "
        "make fields that differ between members by jq.loops.per_member, and let "
        "init(euler, ensemble=...) give a state as wide as the ensemble"
    )
