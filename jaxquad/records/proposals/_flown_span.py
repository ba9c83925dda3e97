"""When a vehicle flies: ground, landing and crash at the ends of a log are no flight."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .._firmwares import firmware_log
from .._log import flattened, Log, Signals
from ._firmware_log import throttle_of
from ._setup import array_of, Setup, values_of


class FlownSpan(NamedTuple):
    """First and last time of flight in s, and what is said of the parts that are not in it."""

    start: float | None = None  # None: the log begins, ends in flight
    stop: float | None = None
    before: str = ""
    after: str = ""
    remarks: tuple[str, ...] = ()


_WINDOW = 0.25  # s
_IDLE = 0.05  # of the throttle
_REST = 2.0  # times what the gyro shows at rest; propellers that lift shake it more
_LOST = 300.0  # deg/s RMS between set-point and rate: more than any manoeuvre that a loop follows
_SHORTEST = 2.0  # s of a flight, and windows at rest that are counted on


def in_flight(
    log: Log, setup: Setup, start: float | None = None, stop: float | None = None
) -> Setup:
    """The set-up from take-off to landing, or to crash; what was injected stays as it is.

    A `start` and `stop` (s) that are given take the place of these ends, and cut what was injected.
    """
    spans = setup.segments or ((setup.start, setup.stop),)
    if setup.start is not None and setup.stop is not None:
        low, high = (-np.inf if start is None else start), (np.inf if stop is None else stop)
        cut = [(max(a, low), min(b, high)) for a, b in spans if a is not None and b is not None]
        inside = tuple((a, b) for a, b in cut if a < b)
        if not inside:
            return setup._replace(start=start, stop=stop, segments=())
        a, b = max(inside, key=lambda span: span[1] - span[0])
        return setup._replace(start=a, stop=b, segments=inside if len(inside) > 1 else ())
    if start is not None and stop is not None:
        return setup._replace(start=start, stop=stop)
    flown = flown_span(log)
    if (flown.stop is not None and start is not None and start >= flown.stop) or (
        flown.start is not None and stop is not None and stop <= flown.start
    ):
        return setup._replace(start=start, stop=stop)
    cut = (flown.before if start is None else "", flown.after if stop is None else "")
    left_out = " and ".join(filter(None, cut))
    said = f"left out, as no flight: {left_out}; --start and --stop take others"
    return setup._replace(
        start=flown.start if start is None else start,
        stop=flown.stop if stop is None else stop,
        remarks=(*setup.remarks, *flown.remarks, *((said,) if left_out else ())),
    )


def flown_span(log: Log) -> FlownSpan:
    """The time from take-off to landing or crash, as far as the log shows it.

    Flight is a window of 0.25 s with the throttle above 5 % in which the gyro moves twice as much
    as at its quietest with the throttle below, before and after all that. Only the ends of a log
    are cut: a dive without throttle is flight. Two windows and more at the end in which rates are
    300 deg/s RMS off their set-points are a crash.
    """
    signals = flattened(log)
    firmware = firmware_log(log.vehicle)
    if firmware is None:
        return FlownSpan()
    throttle = throttle_of(firmware, signals, wanted=True)
    names = [name for rate in firmware.rates if (name := _logged(signals, rate))]
    if not throttle or not names:
        return FlownSpan()
    grid = _Windows.of(signals, names[0])
    if grid is None:
        return FlownSpan()
    collective = sum(factor * grid.mean(signals, name) for name, factor in throttle.items())
    powered = np.nan_to_num(np.asarray(collective)) > _IDLE
    if not powered.any():
        remark = f"the throttle stays below {100 * _IDLE:.0f} %: the log seems to hold no flight"
        return FlownSpan(remarks=(remark,))
    # The gyro shows more than at rest; everywhere where the log does not show rest.
    power = np.zeros(grid.count)
    for name in names:
        mean = grid.mean(signals, name)
        square = grid.mean(signals, name, values_of(signals, name) ** 2)
        power += np.nan_to_num(np.maximum(square - mean**2, 0.0))
    under_power = np.flatnonzero(powered)
    rest = np.delete(power, slice(under_power[0], under_power[-1] + 1))
    flying = powered
    if rest.size * _WINDOW >= _SHORTEST / 4:
        flying = powered & (power > _REST**2 * np.quantile(rest, 0.1))
    controlled = flying.copy()  # where no rate is far from its set-point
    for rate, setpoint in zip(names, firmware.setpoints, strict=False):
        setpoint = _logged(signals, setpoint)
        times = _clock(signals, rate), _clock(signals, setpoint) if setpoint else None
        if times[0] is None or times[1] is None:
            continue
        factor = 180 / np.pi if array_of(signals, rate)[1] == "rad/s" else 1.0
        wanted = np.interp(times[0], times[1], values_of(signals, setpoint))
        square = grid.mean(signals, rate, (factor * (values_of(signals, rate) - wanted)) ** 2)
        controlled &= ~(np.nan_to_num(square) > _LOST**2)
    # From the first two windows of flight to the last two.
    first = np.flatnonzero(flying[:-1] & flying[1:])
    last = np.flatnonzero(controlled[:-1] & controlled[1:])
    if not first.size or not last.size or (last[-1] + 2 - first[0]) * _WINDOW < _SHORTEST:
        return FlownSpan()
    begins, ends = int(first[0]), int(last[-1]) + 2
    start = grid.begin + begins * _WINDOW if begins > 0 else None
    stop = grid.begin + ends * _WINDOW if ends + 1 < grid.count else None
    kind = "a crash" if flying[ends:].any() else "landed"
    before = "" if start is None else f"t = {grid.begin:.6g} .. {start:.6g} s (on the ground)"
    after = "" if stop is None else f"t = {stop:.6g} .. {grid.end:.6g} s ({kind})"
    return FlownSpan(start, stop, before, after)


def _logged(signals: Signals, name: str) -> str:
    """The full name of a channel in a log of one flight; empty where it is not logged."""
    full = next((x for x in signals.arrays if x == name or x.endswith(f".{name}")), name)
    return full if values_of(signals, full).size else ""


class _Windows(NamedTuple):
    """Windows of equal length over a log, with their means."""

    begin: float  # s
    end: float
    count: int

    @classmethod
    def of(cls, signals: Signals, name: str) -> "_Windows | None":
        time = _clock(signals, name)
        if time is None or not time.size or not np.isfinite(time).all():
            return None
        count = int((time[-1] - time[0]) / _WINDOW)
        enough = time[0] < time[-1] and _SHORTEST / _WINDOW <= count < 1_000_000
        return cls(float(time[0]), float(time[-1]), count) if enough else None

    def mean(
        self, signals: Signals, name: str, values: np.ndarray | None = None
    ) -> Float[np.ndarray, " windows"]:
        """Of a channel, or of other `values` on its clock; NaN where a window holds none."""
        time = _clock(signals, name)
        values = values_of(signals, name) if values is None else values
        if time is None or time.size != values.size:
            return np.full(self.count, np.nan)
        place = np.floor((time - self.begin) / _WINDOW)
        good = np.isfinite(values) & np.isfinite(place) & (place >= 0) & (place < self.count)
        rows = place[good].astype(int)
        number = np.bincount(rows, minlength=self.count)
        total = np.bincount(rows, weights=values[good], minlength=self.count)
        return np.divide(total, number, out=np.full(self.count, np.nan), where=number > 0)


def _clock(signals: Signals, name: str) -> np.ndarray | None:
    array = name if name in signals.arrays else name.rpartition("[")[0]
    signal = signals.arrays.get(array)
    return None if signal is None else signals.clocks.get(signal.clock)
