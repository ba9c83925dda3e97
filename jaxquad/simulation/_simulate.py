import functools as ft
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxquad._compile import Jit
from jaxquad._core import align, pytree_node
from jaxquad.loops import Loop
from jaxquad.records import AXES, Record

from ._authority import Authority, find_authority, warn_beyond_authority
from ._memory import require_memory, size_of
from ._over_cores import over_cores
from ._over_devices import DeviceChoice, Devices, loop_over_devices, placed, Run
from ._run import check_run, scan_loop
from ._scenario import Scenario
from ._step import SampleResult


@pytree_node
class Simulation:
    """What a simulated loop did, sample by sample.

    Where an angle exceeds the loop's `bound`, the member has `diverged`: it is held at that angle
    with command 0. Its numbers are finite, but they describe no flight.

    **Arguments:**

    - `time`: s.
    - `angle`: true, rad.
    - `measurement`: rad.
    - `command`: achieved, V.
    - `saturated`: whether the drive gave less than was asked.
    - `signals`: of the controller, [samples, axes, *ensemble].
    - `diverged`: whether the member left the bound.
    - `scenario`: as it was given.
    - `dt`: s.
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
        k = self._index(axis)
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

    def _index(self, axis: str) -> int:
        names = AXES[: self.angle.shape[1]]
        if axis not in names:
            raise ValueError(f"axis {axis!r}: choose one of {', '.join(names)}")
        return names.index(axis)

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
    ((angle, *others), diverged), authority = flown
    warn_beyond_authority(authority, scenario)
    time = _times(loop.dt, angle.shape[0], angle.dtype)
    measurement, command, saturated, signals = others
    return Simulation(
        time=time,
        angle=angle,
        measurement=measurement,
        command=command,
        saturated=saturated,
        signals=signals,
        diverged=diverged,
        scenario=scenario,
        dt=loop.dt,
        authority=authority,
    )


@ft.lru_cache(maxsize=8)
def _times(dt: float, samples: int, dtype: np.dtype) -> Float[Array, " samples"]:
    with jax.ensure_compile_time_eval():  # a traced array would not outlive its trace
        return jax.device_put((dt * np.arange(samples)).astype(dtype))


_Flown = tuple[tuple[PyTree, Bool[Array, "*ensemble"]], Authority | None]


@Jit
def _run(loop: Loop, scenario: Scenario, devices: Devices | None = None) -> _Flown:
    found = find_authority(loop.plant, loop.drive, loop.controller)
    stored, running = loop_over_devices(_store, (loop, scenario), None, devices)
    result = (stored, ~running), found
    _require_room(result)
    return result


def _require_room(result: PyTree) -> None:
    (stored, _), _ = result
    samples, axes, *members = stored[0].shape
    what = f"a record of {samples} samples of {axes} axes of {math.prod(members)} members"
    require_memory(
        what, size_of(stored), "take jq.evaluate, which stores none, or jq.simulation.in_slices"
    )


def _store(run: Run, nothing: None) -> tuple[PyTree, Bool[Array, "*ensemble"]]:
    return scan_loop(*run, _Store())[1:]


class _Store(eqx.Module):
    """An accumulator that adds up nothing and stores what a `Simulation` has."""

    def begin(self, like: Float[Array, " axes *ensemble"]) -> None:
        return None

    def update(self, total: None, now: SampleResult) -> tuple[None, PyTree]:
        return None, (now.angle, now.measurement, now.command, now.saturated, now.signals)
