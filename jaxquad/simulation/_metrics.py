"""The numbers of a flight or an ensemble of flights, and their table."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from jaxquad._compile import Jit, scan_members
from jaxquad._core import as_float
from jaxquad.loops import Loop

from ._flight_metrics import (
    find_steps,
    FlightMetrics,
    Sample,
    share_beyond,
    Sums,
    widened,
    Window,
    window,
)
from ._hardware import Authority, find_authority, warn_beyond_authority
from ._parallel import DeviceChoice, Devices, loop_over_devices, over_cores, placed, Run
from ._scenario import axis_names, Scenario
from ._simulate import check_run, scan_loop, Simulation


if TYPE_CHECKING:
    import xarray


class Spread(NamedTuple):
    """One number over an ensemble; inf where it rests on members that never get there.

    **Arguments:**

    - `mean`: over the members.
    - `p95`: their 95 % quantile.
    - `worst`: of them.
    - `cvar20`: mean of the worst fifth.
    """

    mean: Float[Array, " axes"]
    p95: Float[Array, " axes"]
    worst: Float[Array, " axes"]
    cvar20: Float[Array, " axes"]


class Summary(eqx.Module):
    """The numbers of `Metrics` over all members, those that diverged among them.

    `summary.itae.mean` and so on, each with one value per axis.
    """

    itae: Spread
    iae: Spread
    ise: Spread
    overshoot: Spread
    rise_time: Spread
    settling_time: Spread
    settling_time_5: Spread
    peak: Spread
    rms: Spread
    disturbance_rmse: Spread
    activity: Spread
    energy: Spread
    saturation_share: Spread
    diverged_share: Float[Array, ""]
    members: int = eqx.field(static=True)


NUMBERS = tuple(name for name, kind in Summary.__annotations__.items() if kind is Spread)


def spread_of(values: Float[Array, " axes *ensemble"]) -> Spread:
    """Mean, 95 % quantile, maximum and CVaR20 of each axis. nan members make the result nan."""
    rising = jnp.sort(values.reshape(values.shape[0], -1), axis=1)
    members = rising.shape[1]
    # The quantile is interpolated as numpy does, and inf as soon as it rests on one.
    place = 0.95 * (members - 1)
    below, part = int(place), place - int(place)
    low, high = rising[:, below], rising[:, min(below + 1, members - 1)]
    finite = jnp.isfinite(high) | (part == 0)
    step = jnp.where(finite, high, 0) - jnp.where(finite, low, 0)
    p95 = jnp.where(finite, low + part * step, high)
    # The mean of the worst fifth: the next one counts in part, so none is lost.
    count = 0.2 * members
    parts = jnp.clip(count - jnp.arange(members, dtype=rising.dtype), 0, 1)[::-1] / count
    counted: Bool[Array, " members"] = parts > 0
    weighed = jnp.where(counted[None], parts[None] * jnp.where(counted[None], rising, 0), 0)
    spread = (p95, rising[:, -1], jnp.sum(weighed, axis=1))
    unknown = jnp.isnan(rising[:, -1])  # sorted to the end
    return Spread(jnp.mean(rising, axis=1), *(jnp.where(unknown, jnp.nan, x) for x in spread))


class Metrics(eqx.Module):
    """How well a loop did in a window of time, for each axis and each member of an ensemble.

    The error is the reference less the true angle. `str()` shows one loop as it is, and an ensemble
    by mean, 95 % quantile, worst and CVaR20. A member that has diverged, in the window or not, is
    evaluated with its angle held where it left the bound: `diverged` says so, its integrals are
    finite, and it never settles.
    The step goes from where the reference stands before the window (with a window from 0 s, from
    the first angle) to where it is when the window ends or the load begins. Overshoot, rise and
    settling are nan on an axis whose reference does not go from one value to another and stay
    there; the rise time also if 90 % is never reached, a settling time if the angle is outside
    the band at the end. Times are interpolated between samples, so that they have gradients.

    **Arguments:**

    - `itae`: integral of (t - start) |error|, rad s^2; `iae`: of |error|, rad s; `ise`: of error^2,
        rad^2 s.
    - `overshoot`: % of the step, 0 if there is none.
    - `rise_time`: s, from 10 to 90 % of the step.
    - `settling_time`, `settling_time_5`: s, to within 2 % and 5 % of the step for good.
    - `peak`, `rms`: greatest |error| and its root mean square under load, rad.
    - `disturbance_rmse`: root mean square error of its estimate under load, N m; nan without one.
    - `activity`: sum of squared changes of the command; `energy`: integral of its square, unit^2 s.
    - `saturation_share`: of the samples.
    - `step`: rad, from first to last, 0 without one; `stepped`: whether the reference makes one.
    - `diverged`: whether the member left the bound.
    - `beyond_authority`: share of samples with a disturbance that the drive cannot hold; nan if
        that is not known. `reversing`: share of samples at which motors turn backwards.
    - `start`, `stop`, `load_start`: s, of the window and of the load in it.
    - `per_step`: whether the integrals are divided by the step.
    """

    itae: Float[Array, " axes *ensemble"]
    iae: Float[Array, " axes *ensemble"]
    ise: Float[Array, " axes *ensemble"]
    overshoot: Float[Array, " axes *ensemble"]
    rise_time: Float[Array, " axes *ensemble"]
    settling_time: Float[Array, " axes *ensemble"]
    settling_time_5: Float[Array, " axes *ensemble"]
    peak: Float[Array, " axes *ensemble"]
    rms: Float[Array, " axes *ensemble"]
    disturbance_rmse: Float[Array, " axes *ensemble"]
    activity: Float[Array, " axes *ensemble"]
    energy: Float[Array, " axes *ensemble"]
    saturation_share: Float[Array, " axes *ensemble"]
    step: Float[Array, " axes *ensemble"]
    stepped: Bool[Array, " axes *ensemble"]
    diverged: Bool[Array, "*ensemble"]
    beyond_authority: Float[Array, " axes *ensemble"]
    reversing: Float[Array, " axes *ensemble"]
    start: float = eqx.field(static=True)
    stop: float = eqx.field(static=True)
    load_start: float = eqx.field(static=True)
    per_step: bool = eqx.field(static=True, default=False)

    def normalised(self) -> "Metrics":
        """The same with ITAE, IAE and ISE of a unit step; nan on axes without a step."""
        if self.per_step:
            return self
        size = jnp.where(self.stepped, jnp.abs(self.step), jnp.nan)
        integrals = {"itae": self.itae / size, "iae": self.iae / size, "ise": self.ise / size**2}
        return dataclasses.replace(self, **integrals, per_step=True)

    def summary(self) -> Summary:
        """Mean, 95 % quantile, worst and CVaR20 of every number over the ensemble.

        A time that a member never reaches counts as infinite.
        """
        spreads = {}
        for name in NUMBERS:
            values = vars(self)[name]
            if name in ("rise_time", "settling_time", "settling_time_5"):
                values = jnp.where(self.stepped & jnp.isnan(values), jnp.inf, values)
            spreads[name] = spread_of(values)
        share = jnp.mean(self.diverged.astype(self.itae.dtype))
        return Summary(**spreads, diverged_share=share, members=self.diverged.size)

    def to_xarray(self) -> "xarray.Dataset":
        """Every number with its dimensions `axis` and `member`, for xarray (extra `interop`).

        Each variable has its unit in `attrs`, the dataset the window in s.
        """
        import xarray

        depth = self.diverged.ndim
        members = ("member",) if depth == 1 else tuple(f"member_{k}" for k in range(depth))
        units = _UNITS | (_OF_A_UNIT_STEP if self.per_step else {})
        variables = {}
        for name, unit in units.items():
            values = np.asarray(vars(self)[name])
            dims = members if name == "diverged" else ("axis", *members)
            variables[name] = (dims, values, {"units": unit} if unit else {})
        counts = {n: np.arange(k) for n, k in zip(members, self.diverged.shape, strict=True)}
        window = {name: vars(self)[name] for name in ("start", "stop", "load_start")}  # s
        axes = list(axis_names(self.itae.shape[0]))
        return xarray.Dataset(variables, coords={"axis": axes, **counts}, attrs=window)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader has to know: a number is missing, who diverged, what a drive cannot do."""
        names, texts = axis_names(self.itae.shape[0]), []
        count, members = int(np.sum(self.diverged)), self.diverged.size
        if count:
            who = (
                f"{count} of {members} members ({count / members:.1%})"
                if members > 1
                else "the loop"
            )
            texts.append(
                f"{who} diverged: the numbers count its angle as held where it left the bound"
            )
        stepped = _flat(self.stepped)
        missing = ~stepped.any(axis=1) & ~at_rest(self)
        without = [name for name, there in zip(names, missing, strict=True) if there]
        if without:
            texts.append(
                f"{', '.join(without)}: the reference makes no step that it holds, hence no "
                "overshoot, rise or settling"
            )
        for field, what in (
            ("rise_time", "does not reach 90 % of the step"),
            ("settling_time", "is outside 2 % of the step at the end"),
        ):
            never = np.isnan(_flat(vars(self)[field])) & stepped
            of_many = never.shape[1] > 1
            for name, share in zip(names, never.mean(axis=1), strict=True):
                if share:
                    who = f"{name}: {share:.1%} of the members: the angle" if of_many else name
                    texts.append(f"{who} {what}")
        if np.isnan(np.asarray(self.disturbance_rmse)).all():
            texts.append(
                "no error of the disturbance estimate: the controller makes none, or the plant's "
                "torque per unit of command is not known (give torque_gain)"
            )
        for field, what in (
            ("beyond_authority", "exceed the torque of the drive"),
            ("reversing", "need motors that turn backwards"),
        ):
            shares = np.nan_to_num(_flat(vars(self)[field])).mean(axis=1)
            where = [f"{x:.1%} on {name}" for name, x in zip(names, shares, strict=True) if x]
            if where:
                texts.append(f"disturbances {what}: samples {', '.join(where)}")
        return tuple(texts)

    def __str__(self) -> str:
        names, members, still = axis_names(self.itae.shape[0]), self.diverged.size, at_rest(self)
        head = f"metrics, {self.start:.6g} .. {self.stop:.6g} s"
        if self.load_start != self.start:
            head += f", under load from {self.load_start:.6g} s"
        if self.per_step:
            head += ", integrals of a unit step"
        if not self.diverged.ndim:
            values = [np.asarray(vars(self)[row[0]]) for row in _ROWS]
            table = _table("", list(names), values, self.per_step)
        else:
            head += f", {members} member{'s' * (members > 1)}"
            spreads, table = vars(self.summary()), []
            for k, name in enumerate(names):
                if still[k]:
                    table.append(f"  {name}: at rest")
                    continue
                values = [np.array([x[k] for x in spreads[row[0]]]) for row in _ROWS]
                table += _table(name, ["mean", "p95", "worst", "CVaR20"], values, self.per_step)
        return "\n".join([head, *table, *(f"  ! {remark}" for remark in self.remarks)])


_NOTHING = 1e-9  # in every unit of the table
_MISSING = {"nan": "-", "inf": "never", "-inf": "never"}
_DEGREE = float(np.degrees(1.0))
# Field, title, unit and factor of the absolute number, unit and factor of that of a unit step.
_ROWS = (
    ("itae", "ITAE", ("deg s^2", _DEGREE), ("s^2", 1.0)),
    ("iae", "IAE", ("deg s", _DEGREE), ("s", 1.0)),
    ("ise", "ISE", ("deg^2 s", _DEGREE**2), ("s", 1.0)),
    ("overshoot", "overshoot", ("%", 1.0), None),
    ("rise_time", "rise time", ("s", 1.0), None),
    ("settling_time", "settling time 2 %", ("s", 1.0), None),
    ("settling_time_5", "settling time 5 %", ("s", 1.0), None),
    ("peak", "peak error", ("deg", _DEGREE), None),
    ("rms", "rms error", ("deg", _DEGREE), None),
    ("disturbance_rmse", "disturbance error", ("N m", 1.0), None),
    ("activity", "activity", ("", 1.0), None),
    ("energy", "energy", ("", 1.0), None),
    ("saturation_share", "saturated", ("%", 100.0), None),
)


def at_rest(metrics: "Metrics") -> np.ndarray:
    """Axes in which nothing happens."""
    names = ("itae", "activity", "energy")
    moved = [np.nan_to_num(_flat(vars(metrics)[name])).any(axis=1) for name in names]
    return ~np.any(moved, axis=0)


def _table(name: str, columns: list[str], values: list[np.ndarray], per_step: bool) -> list[str]:
    lines = [f"  {name:<28}" + "".join(f"{column:>11}" for column in columns)]
    for (_, title, absolute, relative), numbers in zip(_ROWS, values, strict=True):
        unit, scale = relative if per_step and relative is not None else absolute
        shown = (f"{0 if abs(x) <= _NOTHING else x:.4g}" for x in scale * np.asarray(numbers))
        texts = "".join(f"{_MISSING.get(x, x):>11}" for x in shown)
        lines.append(f"  {title:<19}{unit:<9}{texts}")
    return lines


def _flat(values: ArrayLike) -> np.ndarray:
    array = np.asarray(values)
    return array.reshape(array.shape[0], -1)


_UNITS = {
    "itae": "rad s^2", "iae": "rad s", "ise": "rad^2 s", "overshoot": "%", "rise_time": "s",
    "settling_time": "s", "settling_time_5": "s", "peak": "rad", "rms": "rad",
    "disturbance_rmse": "N m", "activity": "", "energy": "", "saturation_share": "1",
    "step": "rad", "stepped": "", "diverged": "", "beyond_authority": "1", "reversing": "1",
}  # fmt: skip
_OF_A_UNIT_STEP = {"itae": "s^2", "iae": "s", "ise": "s"}


def metrics(
    simulation: Simulation, *, start: float = 0.0, stop: float | None = None,
    load_start: float | None = None, torque_gain: ArrayLike | Sequence[float] | None = None,
) -> Metrics:  # fmt: skip
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
    loop: Loop, scenario: Scenario, *, start: float = 0.0, stop: float | None = None,
    load_start: float | None = None, devices: DeviceChoice = None,
) -> Metrics:  # fmt: skip
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
        index, reference, disturbance, angle, *others = now
        wide = widened(reference, angle), widened(disturbance, angle)
        return eqx.combine(arrays, static).update(total, Sample(index, angle, *wide, *others))

    start = sums.begin(jnp.zeros_like(simulation.angle[0]))
    total, _ = scan_members(sample, start, arrays, signals)
    return _numbers(sums, total, simulation.diverged, scenario, drive_authority)


def _accumulator(
    scenario: Scenario, span: Window, dt: float, authority: Authority | None, gain: Array | None
) -> FlightMetrics:
    return FlightMetrics(
        wanted=(*NUMBERS, "step", "stepped"), window=span, dt=dt,
        steps=find_steps(scenario.reference, [(span.first, span.until)]),
        from_first=jnp.asarray(span.first == 0), torque_gain=gain,
        limit=None if authority is None else authority.command,
    )  # fmt: skip


def _numbers(
    sums: FlightMetrics, total: Sums, diverged: Bool[Array, "*ensemble"], scenario: Scenario,
    authority: Authority | None,
) -> dict[str, Array]:  # fmt: skip
    """What `Metrics` hold, of finished sums and of what the scenario asks of the drive."""
    values = sums.finish(total)
    for name in ("settling_time", "settling_time_5"):
        values[name] = jnp.where(diverged[None], jnp.nan, values[name])
    like, torque = values["itae"], scenario.disturbance
    shares = [jnp.full_like(like, jnp.nan)] * 2
    if authority is not None:
        limits = (authority.torque, authority.forward)
        shares = [widened(share_beyond(x, torque, sums.window), like) for x in limits]
    named = {"beyond_authority": shares[0], "reversing": shares[1], "diverged": diverged}
    return values | named
