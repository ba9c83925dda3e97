"""The gyro's noise that a log shows: its spectrum, up to which frequency, and its lines."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxquad.records import Record
from jaxquad.spectra import find_line, SpectralLine

from ._flight_channels import FlightChannels, Samples
from ._law import RateLoop
from ._parameters import gains_of
from ._rate_loops import cells_of, gyro_chain_response, law_paths


Frequencies = Float[np.ndarray, " frequencies"]
_WINDOW = 0.5  # s
_REACH = 0.9  # of half a sample rate, up to which a spectrum is used
_PASSED = 0.01  # power of the filters, below which what is behind them does not show the noise
_CLEAR = 0.05  # likewise, below which an unfiltered gyro says more
_FEWEST = 8  # windows
SLOWEST = 20.0  # Hz, below which motion is taken for noise
_SHARE = 0.7  # of what the flown filters let through, that a log has to show
_LINES = 60.0  # Hz, below which no line is looked for
_STEADY = 0.1  # of its frequency, within which a line stays
_FOLLOWS = 0.6  # rank correlation with the throttle, from which a line moves with it


class Density(NamedTuple):
    """A one-sided power spectral density, in (rad/s)^2/Hz."""

    hertz: Frequencies
    power: Frequencies


@dataclasses.dataclass(frozen=True)
class GyroNoise:
    """The noise of the three gyros as the filters that flew passed it.

    What the set-point explains is taken out, and below `least_hz`, where motion is taken for noise,
    the level above it is used.
    """

    before: Density  # the filters that flew, of the tuned axis, up to `known_hz`
    behind: Density
    others: dict[int, Density]  # behind them, of the other two axes by their index
    known_hz: float  # up to which the log shows it
    least_hz: float
    source: str  # in words
    line: SpectralLine | None = None  # a narrow one that stays where it is

    def content(self) -> dict[str, object]:
        """For JSON: without the spectra."""
        line = None if self.line is None else {
            "hertz": self.line.omega / (2 * np.pi), "height_db": self.line.height,
        }  # fmt: skip
        return {"source": self.source, "known_hz": self.known_hz, "line": line}

    def powers(self, density: Density, omega: Frequencies) -> Frequencies:
        """The power around each frequency in (rad/s)^2; 0 beyond `known_hz`."""
        total = np.concatenate([[0.0], np.cumsum(density.power) * np.diff(density.hertz[:2])])
        edges = np.concatenate([density.hertz[:1], density.hertz + np.diff(density.hertz[:2])])
        half, hertz = cells_of(omega) / (4 * np.pi), omega / (2 * np.pi)
        within = np.interp(hertz + half, edges, total) - np.interp(hertz - half, edges, total)
        return np.where(hertz <= self.known_hz, within, 0.0)


class NoNoise(Exception):
    """Why a log does not show the gyro's noise."""


def gyro_noise(flight: FlightChannels, law: RateLoop, axis: int, least_hz: float) -> GyroNoise:
    """The noise of a flight. Raises NoNoise where the log does not show it."""
    if len(flight.setpoint) < round(_WINDOW / flight.dt) * (_FEWEST + 1) / 2:
        raise NoNoise(f"the analysed part is shorter than {_WINDOW * (_FEWEST + 1) / 2:.2g} s")
    least = max(least_hz, SLOWEST)
    chain = lambda hertz: np.abs(gyro_chain_response(law, 2 * np.pi * hertz)) ** 2
    sources = {k: _source(flight, k, chain, least, law.dt) for k in range(len(flight.rates))}
    tuned = sources.pop(axis if axis in sources else 0)
    # Whether much of what reaches the command lies beyond what is known.
    hertz = np.linspace(1.0, 0.499 / law.dt, 400)
    through = gains_of(law, axis) @ law_paths(law, axis, 2 * np.pi * hertz)[0]
    passed = np.abs(through * gyro_chain_response(law, 2 * np.pi * hertz)) ** 2
    within = float(np.sum(passed[hertz <= tuned.reach]) / np.sum(passed))
    if within < _SHARE:
        needed = hertz[np.searchsorted(np.cumsum(passed), _SHARE * np.sum(passed))]
        what = "gyro" if tuned.is_raw else "filtered gyro"
        raise NoNoise(
            f"the {what} of the log shows its noise up to {tuned.reach:.0f} Hz, where "
            f"{100 * within:.0f} % of what reaches the command of white noise lies: log the "
            f"unfiltered gyro at {2 * needed / _REACH:.0f} Hz or faster"
        )
    name = flight.names[1] if tuned.is_raw else flight.names[0]
    how = "unfiltered" if tuned.is_raw else "filtered, divided by the filters that flew"
    return GyroNoise(
        tuned.before, tuned.behind, {k: source.behind for k, source in sources.items()},
        tuned.reach, least, f"{name} ({how}), up to {tuned.reach:.0f} Hz",
        _steady_line(flight, axis, least),
    )  # fmt: skip


class _Source(NamedTuple):
    """The noise of one gyro, behind the filters as it was logged, and before them."""

    before: Density
    behind: Density
    reach: float  # Hz
    is_raw: bool


def _source(
    flight: FlightChannels, k: int, chain: Callable[[Frequencies], Frequencies], least: float,
    loop_dt: float,
) -> _Source:  # fmt: skip
    # All of the loop's band where the gyro was logged as fast as the loop ran.
    reach_of = lambda dt: 0.5 / loop_dt if dt < 1.01 * loop_dt else _REACH * 0.5 / dt
    rate, most = flight.rates[k], reach_of(flight.dt)
    hertz, power = _residual(rate, flight.setpoint, flight.dt)
    passed = chain(hertz)
    clear = passed >= _PASSED
    limit = hertz[min(int(np.flatnonzero(clear)[-1]) + 1, len(hertz) - 1)]
    reach = reach_of(flight.unfiltered_dt) if k < len(flight.unfiltered) else 0.0
    if k < len(flight.unfiltered) and reach >= min(limit, most):
        raw = flight.unfiltered[k]
        time = np.arange(len(raw)) * flight.unfiltered_dt
        wanted = np.interp(time, np.arange(len(rate)) * flight.dt, flight.setpoint)
        high, level = _residual(raw, wanted, flight.unfiltered_dt)
        if flight.averaged:
            level = level / np.sinc(high * flight.unfiltered_dt) ** 2
        through = chain(high)
        both = (through >= _CLEAR) & (high <= most)
        behind = np.where(both, np.interp(high, hertz, power), level * through)
        before = Density(high, _flat_below(high, level, least))
        return _Source(before, Density(high, _flat_below(high, behind, least)), reach, True)
    behind = _flat_below(hertz, power, least)
    # In a notch the level is that beside it.
    before = np.interp(hertz, hertz[clear], behind[clear] / passed[clear])
    return _Source(Density(hertz, before), Density(hertz, behind), min(limit, most), False)


def _residual(rate: Samples, setpoint: Samples, dt: float) -> tuple[Frequencies, Frequencies]:
    """Welch's density of what the set-point does not explain."""
    size = 2 ** int(np.round(np.log2(_WINDOW / dt)))
    spectra = hann_spectra(size, rate, setpoint)
    of_rate, of_setpoint = (np.mean(np.abs(x) ** 2, axis=0) for x in spectra)
    cross = np.mean(spectra[1].conj() * spectra[0], axis=0)
    least = 1e-12 * max(float(of_setpoint.max()), 1e-300)
    explained, many = np.abs(cross) ** 2 / np.maximum(of_setpoint, least), len(spectra[0])
    left = np.maximum(of_rate - explained, 0.0) * many / max(many - 1, 1)
    return np.fft.rfftfreq(size, dt), 2 * dt * left / np.sum(np.hanning(size) ** 2)


def hann_spectra(size: int, *signals: Samples) -> list[Complex[np.ndarray, "windows lines"]]:
    """Of windows that overlap by half, each without its mean."""
    places = np.arange(0, len(signals[0]) - size + 1, size // 2)[:, None] + np.arange(size)
    free = (x[places] - x[places].mean(axis=1, keepdims=True) for x in signals)
    return [np.fft.rfft(x * np.hanning(size), axis=1) for x in free]


def _flat_below(hertz: Frequencies, power: Frequencies, least: float) -> Frequencies:
    near = (hertz >= least) & (hertz <= 2 * least)
    level = float(np.median(power[near])) if near.any() else float(np.median(power))
    return np.where(hertz < least, level, power)


def _steady_line(flight: FlightChannels, axis: int, least: float) -> SpectralLine | None:
    """A line of the gyro that neither wanders nor follows the throttle."""
    raw, throttle = flight.unfiltered, flight.throttle
    rate, dt = flight.rates[min(axis, len(flight.rates) - 1)], flight.dt
    if axis < len(raw):
        rate, dt = raw[axis], flight.unfiltered_dt
    time, drive, over = np.arange(len(rate)) * dt, rate, None
    if throttle is not None and np.ptp(throttle) > 0:
        drive, over = (
            np.interp(time, np.linspace(0.0, time[-1], len(throttle)), throttle), "throttle",
        )  # fmt: skip
    record = Record(time, drive, rate, input_names=("throttle",), output_names=("gyro",))
    line = find_line(record, "gyro", above=2 * np.pi * max(2 * least, _LINES), over=over)
    if line is None or line.high - line.low > _STEADY * line.omega:
        return None
    return None if abs(line.follows) > _FOLLOWS else line
