"""Numbers of a flight, added up sample by sample while it runs or from its record."""

import functools as ft
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxquad._core import align, of_one_rank, per_member, whole_samples

from ._step import SampleResult


_REST = 20  # the last of so many parts of the window, in which a step's reference stands still
_STILL = 0.02  # of the step
_ROUNDING = 1e-6
_ASIDE = 0.2  # of the step, how far the reference may leave the way from start to end
_LEVELS = (0.1, 0.9)  # of the step, between which it rises
_BANDS = {"settled": 0.02, "settled_5": 0.05}  # of the step, within which it has settled
_CLOSE = 1e-5  # of the limit, within which a command counts as saturated
_SOFTNESS = 0.005  # of the limit, over which a command becomes saturated in the smooth variant
_OPEN = -1.0  # a time that has not come yet
_LEAST_SQUARE = 1e-30  # keeps the smooth square root differentiable

Sums = dict[str, Float[Array, " axes *ensemble"]]


class Window(NamedTuple):
    """The samples that count, by their index."""

    first: Int[Array, ""] | int
    last: Int[Array, ""] | int
    loaded: Int[Array, ""] | int  # first of those that count as under load
    until: Int[Array, ""] | int  # last of those that count as the answer to a step


def window(
    samples: int, dt: float, *, start: float, stop: float | None, load_start: float | None
) -> tuple[int, int, int, int]:
    """The indices of a `Window` for `start` <= t < `stop`.

    The answer to a step ends where the load begins, if that is later than `start`.
    Raises ValueError for times that are no whole samples and for a window that is empty.
    """
    rate = 1 / dt
    first = whole_samples("start", start, rate, fewest=0)
    end = samples if stop is None else whole_samples("stop", stop, rate)
    loaded = (
        first if load_start is None else whole_samples("load_start", load_start, rate, fewest=0)
    )
    if not (first + 2 <= end <= samples and first <= loaded < end):
        raise ValueError(
            f"the window from {start:.6g} to {end * dt:.6g} s, under load from "
            f"{loaded * dt:.6g} s, does not lie in the flight of {samples * dt:.6g} s: give at "
            "least two samples, and start <= load_start < stop"
        )
    return first, end - 1, loaded, (loaded if loaded > first else end) - 1


class Steps(NamedTuple):
    """Where the reference goes in each part of a flight, from event to event."""

    first: Sequence[Int[Array, ""] | int]  # sample of each part at which it starts
    target: Float[Array, "parts axes ..."]  # rad, where the reference ends
    before: Float[Array, "parts axes ..."]  # rad, where it was before
    is_single: Bool[Array, "parts axes ..."]  # whether the reference makes one step


def find_steps(
    reference: Float[Array, "samples axes ..."],
    parts: Sequence[tuple[Int[Array, ""] | int, Int[Array, ""] | int]],
) -> Steps:
    """The steps of a reference in `parts` from one sample to another; at sample 0 it was at 0."""
    start = lambda a: jnp.where(a == 0, 0.0, reference[jnp.maximum(a - 1, 0)])
    before = jnp.stack([start(a) for a, _ in parts])
    target = jnp.stack([reference[b] for _, b in parts])
    is_single = jnp.stack([_makes_step(reference, a, b) for a, b in parts])
    return Steps([a for a, _ in parts], target, before, is_single)


def _makes_step(
    reference: Float[Array, "samples axes ..."], first: Array | int, last: Array | int
) -> Bool[Array, "axes ..."]:
    """Whether the reference goes from one value to another, more or less straight, and stays."""
    start, end = reference[jnp.maximum(first - 1, 0)], reference[last]
    size, low, high = jnp.abs(end - start), jnp.minimum(start, end), jnp.maximum(start, end)
    aside = (reference < (low - _ASIDE * size)[None]) | (reference > (high + _ASIDE * size)[None])
    moving = jnp.abs(reference - end[None]) > (_STILL * size)[None]
    resting = last - (last - first) // _REST
    wrong = (aside & _inside(first, last, reference)) | (moving & _inside(resting, last, reference))
    return ~wrong.any(axis=0)


def share_beyond(
    limit: Float[Array, "axes ..."], signal: Float[Array, "samples axes ..."], span: Window
) -> Float[Array, "axes ..."]:
    """Share of the window's samples in which a signal exceeds a limit in size."""
    rows, signal = of_one_rank(limit.astype(signal.dtype)[None], signal)
    within = _inside(span.first, span.last, signal)
    beyond = (jnp.abs(signal) > rows * (1 + _ROUNDING)) & within
    count = jnp.asarray(span.last - span.first + 1).astype(rows.dtype)
    return jnp.sum(beyond.astype(rows.dtype), axis=0) / count


def _inside(
    first: Array | int, last: Array | int, like: Float[Array, "samples ..."]
) -> Bool[Array, "samples ..."]:
    """Which samples lie between two, shaped to go with `like`."""
    index = jnp.arange(like.shape[0]).reshape((-1,) + (1,) * (like.ndim - 1))
    return jnp.broadcast_to((index >= first) & (index <= last), like.shape)


class Sample(NamedTuple):
    index: Int[Array, ""]
    angle: Float[Array, " axes *ensemble"]
    reference: Float[Array, " axes *ensemble"]
    disturbance: Float[Array, " axes *ensemble"]
    command: Float[Array, " axes *ensemble"]
    saturated: Bool[Array, " axes *ensemble"]
    signals: dict[str, Float[Array, " axes *ensemble"]]


class FlightMetrics(eqx.Module):
    """Adds up what the `wanted` numbers of a flight need, an accumulator for `scan_loop`.

    The numbers are those of `Metrics`, by their names there. In a flight of several parts the clock
    of ITAE starts again with each, overshoot is the greatest, and times are those of the last part.
    With `smooth` all numbers have useful gradients: saturation sets in gradually, roots stay
    differentiable at 0, and overshoot is 0 where the reference makes no step (else it is nan).
    """

    wanted: tuple[str, ...] = eqx.field(static=True)
    window: Window
    dt: float = eqx.field(static=True)
    steps: Steps = per_member(rank=2)
    from_first: Bool[Array, ""] | None = None  # the first step starts from the first angle
    torque_gain: Float[Array, "axes ..."] | None = per_member(
        rank=1, default=None
    )  # N m per command
    limit: Float[Array, "axes ..."] | None = per_member(rank=1, default=None)  # of the command
    smooth: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.from_first is not None and len(self.steps.first) > 1:
            raise ValueError("only a flight of one part can start from its first angle")

    def begin(self, like: Float[Array, " axes *ensemble"]) -> Sums:
        """The sums before the first sample, shaped as `like`."""
        needs = (_NEEDS.get(wanted, (wanted,)) for wanted in self.wanted)
        needed = dict.fromkeys(itertools.chain.from_iterable(needs))
        begins = lambda name: _OPEN if name in _TIMES else 0.0
        sums = {name: jnp.full_like(like, begins(name)) for name in needed}
        if self.from_first is not None:
            sums["before"] = widened(self.steps.before[0], like)
        return sums

    def update(self, sums: Sums, now: Sample | SampleResult) -> tuple[Sums, None]:
        """One sample more."""
        moment = _Moment(self, sums, now)
        after = {name: _UPDATES[name](moment, sums[name]) for name in sums}
        answering = now.index <= self.window.until
        for name in [name for name in sums if name in _OF_STEP]:
            after[name] = jnp.where(answering, after[name], sums[name])
        inside = (now.index >= self.window.first) & (now.index <= self.window.last)
        return jax.tree.map(lambda new, old: jnp.where(inside, new, old), after, sums), None

    def finish(self, sums: Sums) -> dict[str, Array]:
        """The wanted numbers."""
        finished = lambda name: _FINISHED[name](self, sums) if name in _FINISHED else sums[name]
        return {name: finished(name) for name in self.wanted}

    def count(self, first: Array | int, like: Array) -> Array:
        """The samples from `first` to the end of the window."""
        return jnp.asarray(self.window.last - first + 1).astype(like.dtype)


class _Moment:
    """One sample, with what several numbers need of it."""

    def __init__(self, of: FlightMetrics, sums: Sums, now: Sample | SampleResult):
        self.of, self.sums, self.now = of, sums, now
        self.begins = now.index == of.window.first
        self.loaded = now.index >= of.window.loaded

    @ft.cached_property
    def error(self) -> Array:
        return self.now.reference - self.now.angle

    @ft.cached_property
    def weight(self) -> Array:
        """s, by the trapezoidal rule: what jumps at the first sample would count too much."""
        at_end = self.begins | (self.now.index == self.of.window.last)
        return jnp.where(at_end, 0.5 * self.of.dt, self.of.dt).astype(self.now.angle.dtype)

    @ft.cached_property
    def starts(self) -> Array:
        return ft.reduce(jnp.logical_or, [self.now.index == a for a in self.of.steps.first])

    @ft.cached_property
    def elapsed(self) -> Array:
        """s since the part of the flight started."""
        index = self.now.index
        since = index - self.of.steps.first[0]
        for first in self.of.steps.first[1:]:
            since = jnp.where(index >= first, index - first, since)
        return since.astype(self.now.angle.dtype) * self.of.dt

    @ft.cached_property
    def step(self) -> tuple[Array, Array, Array]:
        """Where the reference goes, where it was before, and whether that is a step."""
        stacks = self.of.steps[1:]
        values = [widened(x[0], self.now.angle) for x in stacks]
        for k, first in enumerate(self.of.steps.first[1:], 1):
            later = [widened(x[k], self.now.angle) for x in stacks]
            values = [
                jnp.where(self.now.index >= first, b, a) for a, b in zip(values, later, strict=True)
            ]
        return values[0], values[1], values[2]

    @ft.cached_property
    def before(self) -> Array:
        """rad, where the step starts."""
        before = self.step[1]
        if self.of.from_first is None:
            return before
        return jnp.where(self.begins & self.of.from_first, self.now.angle, self.sums["before"])

    @ft.cached_property
    def progress(self) -> Array:
        """0 at the start of the step, 1 at its target."""
        return (self.now.angle - self.before) / _divisor(self.step[0] - self.before)

    @ft.cached_property
    def last(self) -> Array:
        """The progress of the sample before."""
        return jnp.where(self.starts, self.progress, self.sums["progress"])

    def crossing(self, level: Array | float) -> Array:
        """s, when a level was crossed, by a straight line from the last sample."""
        pace = self.of.dt / _divisor(self.progress - self.last)
        since = jnp.clip((self.progress - level) * pace, 0, self.of.dt)
        return jnp.maximum(self.elapsed - since, 0)

    @ft.cached_property
    def missed(self) -> Array:
        """Error in N m of the controller's estimate of the disturbance, nan without one."""
        if self.of.torque_gain is None or "disturbance" not in self.now.signals:
            return jnp.full_like(self.now.angle, jnp.nan)
        torque = widened(self.of.torque_gain, self.now.angle) * self.now.signals["disturbance"]
        return torque - self.now.disturbance


def _saturated(at: _Moment) -> Array:
    """How much a command is at its limit: 0 or 1, or in between if smooth."""
    now, dtype = at.now, at.now.angle.dtype
    if at.of.limit is None:
        return now.saturated.astype(dtype)
    limit, command = widened(at.of.limit, now.angle), jnp.abs(now.command)
    if not at.of.smooth:  # A controller that knows its limit asks the drive for no more.
        return (now.saturated | (command >= (1 - _CLOSE) * limit)).astype(dtype)
    is_finite = jnp.isfinite(limit)
    used = command / jnp.where(is_finite, limit, 1)
    share = jax.nn.sigmoid((used - (1 - 2 * _SOFTNESS)) / (0.4 * _SOFTNESS))
    return jnp.where(is_finite, share, 0)


def _passed(at: _Moment, time: Array, level: float) -> Array:
    time = jnp.where(at.starts, _OPEN, time)
    passes = ((at.last < level) | at.starts) & (at.progress >= level) & (time < 0)
    return jnp.where(passes, at.crossing(level), time)


def _entered(at: _Moment, time: Array, band: float) -> Array:
    enters = (jnp.abs(at.last - 1) > band) | at.starts
    edge = jnp.where(at.last < 1, 1 - band, 1 + band)
    time = jnp.where(enters, at.crossing(edge), time)
    return jnp.where(jnp.abs(at.progress - 1) <= band, time, _OPEN)


# A number is the sum of its name in `_UPDATES`, which starts at 0 (`_OPEN` for one of `_TIMES`).
_NEEDS: dict[str, tuple[str, ...]] = {  # of numbers that need other sums
    "activity": ("activity", "command"),
    "rise_time": ("progress", "left", "arrived"),
    "settling_time": ("progress", "settled"),
    "settling_time_5": ("progress", "settled_5"),
    "step": (),
    "stepped": (),
}
_TIMES = {"left", "arrived", "settled", "settled_5"}
_OF_STEP = {"overshoot", "before", "progress", *_TIMES}
_UPDATES: dict[str, Callable[[_Moment, Array], Array]] = {
    "itae": lambda at, total: total + at.weight * at.elapsed * jnp.abs(at.error),
    "iae": lambda at, total: total + at.weight * jnp.abs(at.error),
    "ise": lambda at, total: total + at.weight * at.error**2,
    "energy": lambda at, total: total + at.of.dt * at.now.command**2,
    "activity": lambda at, total: (
        total + jnp.where(at.begins, 0, at.now.command - at.sums["command"]) ** 2
    ),
    "command": lambda at, _: at.now.command,
    "saturation_share": lambda at, total: total + _saturated(at),
    "peak": lambda at, most: jnp.maximum(most, jnp.where(at.loaded, jnp.abs(at.error), 0)),
    "rms": lambda at, total: total + jnp.where(at.loaded, at.error**2, 0),
    "disturbance_rmse": lambda at, total: total + jnp.where(at.loaded, at.missed**2, 0),
    "overshoot": lambda at, most: jnp.where(
        at.step[2] & (at.step[0] != at.before), jnp.maximum(most, at.progress - 1), most
    ),
    "before": lambda at, _: at.before,
    "progress": lambda at, _: at.progress,
    "left": lambda at, time: _passed(at, time, _LEVELS[0]),
    "arrived": lambda at, time: _passed(at, time, _LEVELS[1]),
    "settled": lambda at, time: _entered(at, time, _BANDS["settled"]),
    "settled_5": lambda at, time: _entered(at, time, _BANDS["settled_5"]),
}


def _step_size(of: FlightMetrics, sums: Sums) -> Array:
    like = next(iter(sums.values()))
    before = widened(of.steps.before[-1], like) if of.from_first is None else sums["before"]
    return widened(of.steps.target[-1], like) - before


def _stepped(of: FlightMetrics, sums: Sums) -> Array:
    size = _step_size(of, sums)
    return widened(of.steps.is_single[-1], size) & (size != 0)


def _final_overshoot(of: FlightMetrics, sums: Sums) -> Array:
    percent = 100 * sums["overshoot"]
    return percent if of.smooth else _only(_stepped(of, sums), percent)


def _settling_time(of: FlightMetrics, sums: Sums, name: str) -> Array:
    return _only(_stepped(of, sums) & (sums[name] >= 0), sums[name])


def _rms(of: FlightMetrics, sums: Sums, name: str) -> Array:
    mean = sums[name] / of.count(of.window.loaded, sums[name])
    if of.smooth:
        return _only(~jnp.isnan(mean), jnp.sqrt(jnp.maximum(mean, _LEAST_SQUARE)))
    # With the gradient 0 at 0.
    root = jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1)), 0)
    return _only(~jnp.isnan(mean), root)


# What is made of the sums in the end; of others the sum is the number.
_FINISHED: dict[str, Callable[[FlightMetrics, Sums], Array]] = {
    "saturation_share": lambda of, sums: (
        sums["saturation_share"] / of.count(of.window.first, sums["saturation_share"])
    ),
    "overshoot": _final_overshoot,
    "rms": ft.partial(_rms, name="rms"),
    "disturbance_rmse": ft.partial(_rms, name="disturbance_rmse"),
    "rise_time": lambda of, sums: _only(
        _stepped(of, sums) & (sums["left"] >= 0) & (sums["arrived"] >= 0),
        sums["arrived"] - sums["left"],
    ),
    "settling_time": ft.partial(_settling_time, name="settled"),
    "settling_time_5": ft.partial(_settling_time, name="settled_5"),
    "step": _step_size,
    "stepped": _stepped,
}


def _only(there: Bool[Array, "..."], value: Float[Array, "..."]) -> Float[Array, "..."]:
    return jnp.where(there, value, jnp.nan)


def _divisor(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """x, or 1 where x is 0: for quotients that are not used there."""
    return jnp.where(x == 0, 1, x)


def widened(values: Shaped[Array, " axes ..."], like: Array) -> Array:
    """Values of each axis for each member that `like` has."""
    dtype = values.dtype if values.dtype == bool else like.dtype
    return jnp.broadcast_to(align(values.astype(dtype), like), like.shape)
