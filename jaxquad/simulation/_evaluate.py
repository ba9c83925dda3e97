from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from jaxquad._compile import Jit, scan_members
from jaxquad._core import as_float
from jaxquad.loops import Loop

from ._authority import Authority, find_authority, warn_beyond_authority
from ._flight_metrics import (
    find_steps,
    FlightMetrics,
    share_beyond,
    Sums,
    widened,
    Window,
    window,
)
from ._metrics import Metrics, NUMBERS
from ._parallel import DeviceChoice, Devices, loop_over_devices, over_cores, placed, Run
from ._scenario import Scenario
from ._simulate import check_run, scan_loop, Simulation


class _Sample(NamedTuple):
    """What `FlightMetrics` need of a stored sample; see `SampleResult`."""

    index: Int[Array, ""]
    angle: Float[Array, " axes *ensemble"]
    reference: Float[Array, " axes *ensemble"]
    disturbance: Float[Array, " axes *ensemble"]
    command: Float[Array, " axes *ensemble"]
    saturated: Bool[Array, " axes *ensemble"]
    signals: dict[str, Float[Array, " axes *ensemble"]]


def metrics(
    simulation: Simulation,
    *,
    start: float = 0.0,
    stop: float | None = None,
    load_start: float | None = None,
    torque_gain: ArrayLike | Sequence[float] | None = None,
) -> Metrics:
    """The `Metrics` of a stored `jq.simulation.Simulation`, for start <= t < stop.

    Differentiable with respect to the simulation.

    **Arguments:**

    - `simulation`: from `jq.simulate`.
    - `start`, `stop`: s; None is the end. ITAE counts time from `start`, which is best the instant
        of a step.
    - `load_start`: s. Peak, rms and the error of the disturbance's estimate count from here on
        (None: from `start`); the step's overshoot, rise and settling end here, if that is later
        than `start`.
    - `torque_gain`: N m per unit of command [axes], to make a torque of the estimate where the
        simulation does not know it from its plant.

    **Returns:** `jq.simulation.Metrics` of each axis and member.

    **Raises:** ValueError for a window that does not lie in the simulation.
    """
    gain = None if torque_gain is None else jnp.atleast_1d(as_float(torque_gain))
    dt, samples = simulation.dt, len(simulation.angle)
    place = window(samples, dt, start=start, stop=stop, load_start=load_start)
    numbers = _replay(simulation, Window(*map(jnp.asarray, place)), gain)
    return _metrics(numbers, place, dt)


def evaluate(
    loop: Loop,
    scenario: Scenario,
    *,
    start: float = 0.0,
    stop: float | None = None,
    load_start: float | None = None,
    devices: DeviceChoice = None,
) -> Metrics:
    """The `Metrics` of a loop without its trajectories: what is kept does not grow with time.

    The same numbers as `jq.simulation.metrics(jq.simulate(loop, scenario), ...)` in the memory of
    one sample: about 0.5 kB per axis and member, and what the scenario holds for each member. Where
    that is too much, `jq.simulation.in_slices`. Differentiable with respect to plant, controller,
    scenario and delay; a gradient needs memory as the square root of the number of samples, and
    `jq.simulation.over_devices` splits a cost of your own as `devices` splits this.

        loop = jq.Loop(plant, jq.LADRC(10.0, 30.0, 0.85), delay=0.004)
        print(jq.evaluate(loop, scenario, start=1.0, load_start=5.0))

    **Arguments:**

    - `loop`, `scenario`, `devices`: as in `jq.simulate`.
    - `start`, `stop`, `load_start`: s, as in `jq.simulation.metrics`.

    **Returns:** `jq.simulation.Metrics` of each axis and member.

    **Raises:** ValueError as `jq.simulate` and `jq.simulation.metrics` do. Warns of disturbances
    beyond the torque of the drive.
    """
    check_run(loop, scenario)
    place = window(len(scenario.reference), loop.dt, start=start, stop=stop, load_start=load_start)
    span = Window(*map(jnp.asarray, place))
    run, places = placed(loop, scenario, devices)
    drive_authority, numbers = over_cores(_run, run, (span,), places)
    warn_beyond_authority(drive_authority, scenario)
    return _metrics(numbers, place, loop.dt)


def _metrics(numbers: dict[str, PyTree], place: tuple[int, int, int, int], dt: float) -> Metrics:
    first, last, loaded, _ = place
    return Metrics(**numbers, start=first * dt, stop=(last + 1) * dt, load_start=loaded * dt)


@Jit
def _run(
    loop: Loop, scenario: Scenario, span: Window, devices: Devices | None = None
) -> tuple[Authority | None, dict[str, Array]]:
    drive_authority = find_authority(loop.plant, loop.drive, loop.controller)
    return drive_authority, loop_over_devices(_measure, (loop, scenario), span, devices)


def _measure(run: Run, span: Window) -> dict[str, Array]:
    loop, scenario = run
    drive_authority = find_authority(loop.plant, loop.drive, loop.controller)
    gain = None if drive_authority is None else drive_authority.torque_gain
    sums = _accumulator(scenario, span, loop.dt, drive_authority, gain)
    total, _, running = scan_loop(loop, scenario, sums)
    return _numbers(sums, total, ~running, scenario, drive_authority)


@eqx.filter_jit
def _replay(simulation: Simulation, span: Window, gain: Array | None) -> dict[str, Array]:
    scenario, drive_authority = simulation.scenario, simulation.authority
    if gain is None and drive_authority is not None:
        gain = drive_authority.torque_gain
    sums = _accumulator(scenario, span, simulation.dt, drive_authority, gain)
    index = jnp.arange(simulation.angle.shape[0])
    stored = (simulation.angle, simulation.command, simulation.saturated, simulation.signals)
    signals = (index, scenario.reference, scenario.disturbance, *stored)
    arrays, static = eqx.partition(sums, eqx.is_array)

    def sample(total: Sums, arrays: PyTree, now: tuple) -> tuple[Sums, None]:
        index, reference, disturbance, angle, command, saturated, signals = now
        wide = widened(reference, angle), widened(disturbance, angle)
        sums = eqx.combine(arrays, static)
        return sums.update(total, _Sample(index, angle, *wide, command, saturated, signals))

    start = sums.begin(jnp.zeros_like(simulation.angle[0]))
    total, _ = scan_members(sample, start, arrays, signals)
    return _numbers(sums, total, simulation.diverged, scenario, drive_authority)


def _accumulator(
    scenario: Scenario,
    span: Window,
    dt: float,
    drive_authority: Authority | None,
    torque_gain: Array | None,
) -> FlightMetrics:
    return FlightMetrics(
        wanted=(*NUMBERS, "step", "stepped"),
        window=span,
        dt=dt,
        steps=find_steps(scenario.reference, [(span.first, span.until)]),
        from_first=jnp.asarray(span.first == 0),
        torque_gain=torque_gain,
        limit=None if drive_authority is None else drive_authority.command,
    )


def _numbers(
    sums: FlightMetrics,
    total: Sums,
    diverged: Bool[Array, "*ensemble"],
    scenario: Scenario,
    drive_authority: Authority | None,
) -> dict[str, Array]:
    """What `Metrics` hold, of finished sums and of what the scenario asks of the drive."""
    values = sums.finish(total)
    for name in ("settling_time", "settling_time_5"):
        values[name] = jnp.where(diverged[None], jnp.nan, values[name])
    like, torque = values["itae"], scenario.disturbance
    shares = [jnp.full_like(like, jnp.nan)] * 2
    if drive_authority is not None:
        limits = (drive_authority.torque, drive_authority.forward)
        shares = [widened(share_beyond(x, torque, sums.window), like) for x in limits]
    named = {"beyond_authority": shares[0], "reversing": shares[1], "diverged": diverged}
    return values | named
