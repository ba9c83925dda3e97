from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxquad._core import align, whole_samples


_REST = 20  # the last of so many parts of the window, in which a step's reference stands still
_STILL = 0.02  # of the step
_ROUNDING = 1e-6
_ASIDE = 0.2  # of the step, how far the reference may leave the way from start to end


class Window(NamedTuple):
    """The samples that are judged, by their index."""

    first: Int[Array, ""]
    last: Int[Array, ""]
    loaded: Int[Array, ""]  # first of those that count as under load
    until: Int[Array, ""]  # last of those that count as the answer to a step


def window(
    samples: int, dt: float, *, start: float, stop: float | None, load_start: float | None
) -> tuple[int, int, int, int]:
    """The indices of a `Window` for `start` <= t < `stop`.

    The answer to a step ends where the load begins, if that is later than `start`.
    Raises ValueError for times that are no whole samples and for a window that is none.
    """
    rate = 1 / dt
    first = whole_samples("start", start, rate, fewest=0)
    end = samples if stop is None else whole_samples("stop", stop, rate)
    loaded = (
        first if load_start is None else whole_samples("load_start", load_start, rate, fewest=0)
    )
    if not (first + 2 <= end <= samples and first <= loaded < end):
        raise ValueError(
            f"a window from {start:.6g} to {end * dt:.6g} s, under load from {loaded * dt:.6g} s: "
            f"of the {samples * dt:.6g} s that there are, give two samples or more, and "
            "start <= load_start < stop"
        )
    return first, end - 1, loaded, (loaded if loaded > first else end) - 1


def makes_step(
    reference: Float[Array, "samples axes ..."], judged: Window
) -> Bool[Array, "axes ..."]:
    """Whether the reference goes from one value to another, more or less straight, and stays."""
    judged = judged._replace(last=judged.until)
    start, end = reference[jnp.maximum(judged.first - 1, 0)], reference[judged.last]
    size, low, high = jnp.abs(end - start), jnp.minimum(start, end), jnp.maximum(start, end)
    aside = (reference < (low - _ASIDE * size)[None]) | (reference > (high + _ASIDE * size)[None])
    moving = jnp.abs(reference - end[None]) > (_STILL * size)[None]
    resting = judged._replace(first=judged.last - (judged.last - judged.first) // _REST)
    wrong = (aside & inside(judged, reference)) | (moving & inside(resting, reference))
    return ~wrong.any(axis=0)


def share_beyond(
    limit: Float[Array, "axes ..."], signal: Float[Array, "samples axes ..."], judged: Window
) -> Float[Array, "axes ..."]:
    """Share of the window's samples in which a signal exceeds a limit in size."""
    rows = limit.astype(signal.dtype)[None]
    members = max(rows.ndim, signal.ndim)
    rows, signal = (x.reshape(x.shape + (1,) * (members - x.ndim)) for x in (rows, signal))
    shape = jnp.broadcast_shapes(rows.shape, signal.shape)
    rows, signal = jnp.broadcast_to(rows, shape), jnp.broadcast_to(signal, shape)
    beyond = (jnp.abs(signal) > rows * (1 + _ROUNDING)) & inside(judged, signal)
    count = (judged.last - judged.first + 1).astype(rows.dtype)
    return jnp.sum(beyond.astype(rows.dtype), axis=0) / count


def inside(judged: Window, like: Float[Array, "samples ..."]) -> Bool[Array, "samples ..."]:
    """Which samples are judged, shaped to go with `like`."""
    index = jnp.arange(like.shape[0]).reshape((-1,) + (1,) * (like.ndim - 1))
    return jnp.broadcast_to((index >= judged.first) & (index <= judged.last), like.shape)


LEVELS = (0.1, 0.9)  # of the step, between which it rises
BANDS = (0.02, 0.05)  # of the step, within which it has settled
_CLOSE = 1e-5
_OPEN = -1.0  # a time that has not come yet


class Tally(NamedTuple):
    """Running sums of one loop, or of every loop of an ensemble: all that is kept of it.

    Each [axes, *ensemble] by itself: stacked, they would not be vectorised.
    """

    iae: Array  # rad s
    itae: Array  # rad s^2
    ise: Array  # rad^2 s
    energy: Array  # squared command times s
    activity: Array  # squared command
    saturated: Array  # samples
    load: Array  # sum of squared errors under load, rad^2
    missed: Array  # the same of the disturbance's estimate, (N m)^2
    overshoot: Array  # share of the step
    peak: Array  # rad
    left: Array  # s, when LEVELS[0] was passed first
    arrived: Array  # s, when LEVELS[1] was passed first
    settled: Array  # s, when BANDS[0] was entered last
    settled_5: Array  # s, when BANDS[1] was entered last
    before: Array  # rad, from where the step starts
    progress: Array  # of the last sample, 0 at the start, 1 at the target
    command: Array  # of the last sample


class Meter(eqx.Module):
    """Judges a loop sample by sample, while it runs or from its record."""

    judged: Window
    dt: float = eqx.field(static=True)
    target: Float[Array, " axes *members"]  # rad, where the reference ends
    before: Float[Array, " axes *members"]  # rad, where the reference was before
    from_first: Bool[Array, ""]  # nothing was before: the step starts from the first angle
    torque_gain: Float[Array, "axes ..."] | None  # N m per unit of command
    limit: Float[Array, "axes ..."] | None  # of the command; reaching it counts as saturated

    def begin(self, like: Float[Array, " axes *ensemble"]) -> Tally:
        """Before the first sample; arrays are shaped as `like`."""
        still = jnp.zeros_like(like)
        empty = Tally(*(still for _ in Tally._fields))
        times = {name: still + _OPEN for name in ("left", "arrived", "settled", "settled_5")}
        return empty._replace(before=wide(self.before, like), **times)

    def update(self, tally: Tally, now: Any) -> tuple[Tally, None]:
        """One sample more; `now` is a `SampleResult`."""
        is_first = now.index == self.judged.first
        elapsed = (now.index - self.judged.first).astype(now.angle.dtype) * self.dt
        course = self._course(tally, now, elapsed, is_first)
        answering = now.index <= self.judged.until
        course = {k: jnp.where(answering, x, getattr(tally, k)) for k, x in course.items()}
        after = self._summed(tally, now, elapsed, is_first)._replace(**course)
        inside = (now.index >= self.judged.first) & (now.index <= self.judged.last)
        return jax.tree.map(lambda new, old: jnp.where(inside, new, old), after, tally), None

    def _summed(self, tally: Tally, now: Any, elapsed: Array, is_first: Array) -> Tally:
        error, command = now.reference - now.angle, now.command
        # The trapezoidal rule: what jumps at the first sample would count half a sample too much.
        at_end = is_first | (now.index == self.judged.last)
        weight = jnp.where(at_end, 0.5 * self.dt, self.dt).astype(error.dtype)
        loaded = now.index >= self.judged.loaded
        size, change = jnp.abs(error), jnp.where(is_first, 0, command - tally.command)
        return tally._replace(
            iae=tally.iae + weight * size,
            itae=tally.itae + weight * elapsed * size,
            ise=tally.ise + weight * error**2,
            energy=tally.energy + self.dt * command**2,
            activity=tally.activity + change**2,
            saturated=tally.saturated + self._saturated(now).astype(error.dtype),
            load=tally.load + jnp.where(loaded, error**2, 0),
            missed=tally.missed + jnp.where(loaded, self._missed(now) ** 2, 0),
            peak=jnp.maximum(tally.peak, jnp.where(loaded, size, 0)),
            command=command,
        )

    def _course(
        self, tally: Tally, now: Any, elapsed: Array, is_first: Array
    ) -> dict[str, Float[Array, " axes *ensemble"]]:
        """Overshoot, and when levels were passed and bands entered."""
        before = jnp.where(is_first & self.from_first, now.angle, tally.before)
        progress = (now.angle - before) / divisor(wide(self.target, now.angle) - before)
        last = jnp.where(is_first, progress, tally.progress)
        pace = self.dt / divisor(progress - last)

        def crossing(level: Array | float) -> Array:
            # By a straight line from the last sample.
            since = jnp.clip((progress - level) * pace, 0, self.dt)
            return jnp.maximum(elapsed - since, 0)

        def passed(level: float, time: Array) -> Array:
            passes = ((last < level) | is_first) & (progress >= level) & (time < 0)
            return jnp.where(passes, crossing(level), time)

        def entered(band: float, time: Array) -> Array:
            enters = (jnp.abs(last - 1) > band) | is_first
            time = jnp.where(enters, crossing(jnp.where(last < 1, 1 - band, 1 + band)), time)
            return jnp.where(jnp.abs(progress - 1) <= band, time, _OPEN)

        return {
            "before": before,
            "progress": progress,
            "overshoot": jnp.maximum(tally.overshoot, progress - 1),
            "left": passed(LEVELS[0], tally.left),
            "arrived": passed(LEVELS[1], tally.arrived),
            "settled": entered(BANDS[0], tally.settled),
            "settled_5": entered(BANDS[1], tally.settled_5),
        }

    def _saturated(self, now: Any) -> Bool[Array, " axes *ensemble"]:
        if self.limit is None:
            return now.saturated
        # A controller that knows its limit asks the drive for no more.
        return now.saturated | (jnp.abs(now.command) >= (1 - _CLOSE) * wide(self.limit, now.angle))

    def _missed(self, now: Any) -> Float[Array, " axes *ensemble"]:
        """Error in N m of the controller's estimate of the disturbance, nan without one."""
        if self.torque_gain is None or "disturbance" not in now.signals:
            return jnp.full_like(now.angle, jnp.nan)
        torque = wide(self.torque_gain, now.angle) * now.signals["disturbance"]
        return torque - now.disturbance


def divisor(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """x, or 1 where x is 0: for quotients that are not used there."""
    return jnp.where(x == 0, 1, x)


def wide(values: Shaped[Array, " axes ..."], like: Array) -> Array:
    """Values of each axis for each member that `like` has."""
    dtype = values.dtype if values.dtype == bool else like.dtype
    return jnp.broadcast_to(align(values.astype(dtype), like), like.shape)
