"""What a firmware's log says of one axis: its channels, and what excited them."""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from .._clock import FEWEST, native_rate
from .._errors import RecordError
from .._log import Signals


AXES: tuple[str, ...] = ("roll", "pitch", "yaw")
Mix = Mapping[str, float]


Point = Literal["", "rate", "mixer", "angle"]


class NumberedChirp(NamedTuple):
    """One of the chirps that a log holds.

    `number` counts them in the order of time, from 1; `axis` is empty where it turns none; `place`
    says in words what it was added to; `low` and `high` are its band, 0 where it is unknown.
    """

    number: int
    axis: str
    place: str
    point: Point
    start: float  # s
    stop: float
    low: float = 0.0  # Hz
    high: float = 0.0

    def __str__(self) -> str:
        band = f", {self.low:.4g} .. {self.high:.4g} Hz" if 0 < self.low < self.high else ""
        span = f"t = {self.start:.6g} .. {self.stop:.6g} s"
        return f"{self.number}: {self.axis or 'no axis'}, {self.place}, {span}{band}"


class Selection(NamedTuple):
    """What a proposal is for: an axis, one of the log's chirps, a span of time; None: all."""

    axis: str | None = None
    chirp: int | None = None  # its number
    start: float | None = None  # s
    stop: float | None = None

    def part_of(self, chirp: NumberedChirp) -> NumberedChirp | None:
        """What the span leaves of a chirp."""
        start = chirp.start if self.start is None else max(chirp.start, self.start)
        stop = chirp.stop if self.stop is None else min(chirp.stop, self.stop)
        return chirp._replace(start=start, stop=stop) if start < stop else None


class Injection(NamedTuple):
    """A signal that was injected: when, and from which to which frequency (0: unknown)."""

    start: float  # s
    stop: float
    low: float = 0.0  # Hz
    high: float = 0.0


class Setup(NamedTuple):
    """The channels and excitation of one axis in a vehicle's log.

    `start` and `stop` are those of the longest injection, `segments` those of all injections of the
    same kind, in the order of time. Without an injection `start` and `stop` are take-off and
    landing, None where the log begins or ends in flight. `injected_at` says where the reference
    enters the loop: at the set-point of the rate or of the angle, or at the mixer, behind the
    controller, whose logged output, the `command`, contains it all the same. `late_s` are channels
    whose value acts that long after its stamp, and is computed from measurements of that stamp.
    """

    axis: str
    command: Mix  # a weighted sum of channels
    rate: str
    reference: str = ""  # external signal; empty if there is none
    start: float | None = None  # s
    stop: float | None = None
    band: tuple[float, float] | None = None  # Hz
    excitation: str = "no injected excitation found"
    remarks: tuple[str, ...] = ()
    segments: tuple[tuple[float, float], ...] = ()  # s
    hold: float | None = None  # s; of the command, where the log says it
    throttle: Mix = {}  # the collective, 0 to 1 but for PX4's sign; empty if it is not logged
    injected_at: Point = ""  # empty: nothing was injected, or it is not known
    late_s: Mapping[str, float] = {}
    chirps: tuple[NumberedChirp, ...] = ()  # all of the log, of any axis
    levelled: bool = False  # whether an angle loop of Betaflight is known to have been closed


def with_injections(setup: Setup, runs: Sequence[Injection], what: str) -> Setup:
    """The `setup` with what was injected and when: all `runs` of one kind."""
    best = max(runs, key=lambda run: run.stop - run.start)
    swept = [run for run in runs if 0 < run.low < run.high]
    band = (min(r.low for r in swept), max(r.high for r in swept)) if swept else None
    lasted = " + ".join(f"{run.stop - run.start:.4g}" for run in runs)
    times = f"{len(runs)} times: " if len(runs) > 1 else ""
    span = ""
    if band:
        low, high = (2 * np.pi * end for end in band)
        span = f"{band[0]:.4g} .. {band[1]:.4g} Hz ({low:.3g} .. {high:.3g} rad/s), "
    return setup._replace(
        start=best.start,
        stop=best.stop,
        band=band,
        excitation=f"{what}, {times}{span}{lasted} s",
        segments=tuple((run.start, run.stop) for run in runs) if len(runs) > 1 else (),
    )


def choose_chirps(chirps: Sequence[NumberedChirp], wanted: Selection) -> list[NumberedChirp]:
    """The chirp of that number; else the longest within the span and on the axis that are wanted.

    With it come all others on its axis at its place. One that turns no axis is taken where there is
    no other. Raises RecordError for a number that no chirp has.
    """
    if wanted.chirp is not None:
        listed = "; ".join(map(str, chirps)) or "none"
        chirp = next((x for x in chirps if x.number == wanted.chirp), None)
        if chirp is None:
            raise RecordError(f"there is no chirp {wanted.chirp}. Chirps of this log: {listed}.")
        if wanted.axis not in (None, chirp.axis):
            raise RecordError(
                f"chirp {wanted.chirp} is not on the axis {wanted.axis}: leave one of them out. "
                f"Chirps of this log: {listed}."
            )
        part = wanted.part_of(chirp)
        if part is None:
            raise RecordError(
                f"chirp {wanted.chirp} lies outside the span of start and stop: leave them out. "
                f"Chirps of this log: {listed}."
            )
        return [part]
    inside = [part for chirp in chirps if (part := wanted.part_of(chirp))]
    turning = [chirp for chirp in inside if chirp.axis]
    candidates = [chirp for chirp in turning if wanted.axis in (None, chirp.axis)]
    candidates = candidates if turning else inside
    if not candidates:
        return []
    best = max(candidates, key=lambda chirp: chirp.stop - chirp.start)
    return [x for x in candidates if (x.axis, x.place) == (best.axis, best.place)]


def channel_rate(signals: Signals, name: str) -> float:
    """Samples per second, of a channel on a clock that the log knows."""
    clock = signals.clocks[signals.arrays[array_of(signals, name)[0]].clock]
    increasing = np.unique(clock[np.isfinite(clock)])
    return native_rate(increasing) if increasing.size > 1 else 0.0


def array_of(signals: Signals, name: str) -> tuple[str, str]:
    """The array that holds a channel, and its unit."""
    array = name if name in signals.arrays else name.rpartition("[")[0]
    if array not in signals.arrays:
        raise RecordError(f"the log has no channel {name}.")
    return array, signals.arrays[array].unit


def values_of(signals: Signals, name: str) -> np.ndarray:
    """The values of a channel, empty where there is no such channel."""
    if name in signals.arrays:
        signal = signals.arrays[name]
        return np.asarray(signal.values, np.float64) * signal.scale
    array, _, column = name.rpartition("[")
    if array not in signals.arrays or signals.arrays[array].values.ndim != 2:
        return np.empty(0)
    signal, i = signals.arrays[array], int(column.rstrip("]"))
    inside = i < signal.values.shape[1]
    return np.asarray(signal.values[:, i], np.float64) * signal.scale if inside else np.empty(0)


def first_logged(signals: Signals, names: Sequence[str]) -> str:
    """The first of the channels that the log holds with enough samples, or an empty string."""
    return next((name for name in names if values_of(signals, name).size >= FEWEST), "")


def moves(signals: Signals, name: str) -> bool:
    """Whether a channel is logged and not constant."""
    values = values_of(signals, name)
    finite = values[np.isfinite(values)]
    return finite.size >= FEWEST and float(np.ptp(finite)) > 0


def most_active_axis(signals: Signals, rates: Mapping[str, str]) -> str:
    """The axis whose rate varies most; one of them has to have a name."""
    spread = {}
    for axis, name in rates.items():
        values = values_of(signals, name)
        finite = values[np.isfinite(values)]
        if name:
            spread[axis] = float(finite.std()) if finite.size else 0.0
    return max(spread, key=lambda axis: spread[axis])
