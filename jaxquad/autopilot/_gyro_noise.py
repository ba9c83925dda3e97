"""The gyro's noise that a log shows: its spectrum, up to which frequency, and its lines."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad.records import Record
from jaxquad.spectra import find_line, SpectralLine

from ._flight_channels import FlightChannels
from ._law import RateLoop
from ._rate_loops import cells_of, gains_of, gyro_chain_response, law_paths


Frequencies = Float[np.ndarray, " frequencies"]
_WINDOW = 0.5  # s
_REACH = 0.9  # of half a sample rate, up to which a spectrum is used
_PASSED = 0.01  # power of the filters, below which what is behind them does not show the noise
_CLEAR = 0.05  # likewise, below which an unfiltered gyro says more
_FEWEST = 8  # windows
_SLOWEST = 20.0  # Hz, below which motion is taken for noise
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

    **Attributes:**

    - `before`, `behind`: the filters that flew, of the tuned axis, up to `known_hz`.
    - `others`: behind them, of the other two axes by their index.
    - `known_hz`: up to which the log shows it.
    - `source`: in words.
    - `line`: a narrow line that stays where it is; None without one.
    """

    before: Density
    behind: Density
    others: dict[int, Density]
    known_hz: float
    least_hz: float
    source: str
    line: SpectralLine | None = None

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
        half = cells_of(omega) / (4 * np.pi)
        hertz = omega / (2 * np.pi)
        within = np.interp(hertz + half, edges, total) - np.interp(hertz - half, edges, total)
        return np.where(hertz <= self.known_hz, within, 0.0)


class NoNoise(NamedTuple):
    """Why a log does not show the gyro's noise."""

    reason: str


def gyro_noise(
    flight: FlightChannels, law: RateLoop, axis: int, least_hz: float
) -> GyroNoise | NoNoise:
    """The noise of a flight, or why the log does not show it."""
    size = round(_WINDOW / flight.dt)
    if len(flight.setpoint) < size * (_FEWEST + 1) / 2:
        return NoNoise(f"the analysed part is shorter than {_WINDOW * (_FEWEST + 1) / 2:.2g} s")
    least = max(least_hz, _SLOWEST)
    chain = lambda hertz: np.abs(gyro_chain_response(law, 2 * np.pi * hertz)) ** 2
    sources = _sources(flight, chain, least, law.dt)
    behind = {k: source for k, source in enumerate(sources)}
    tuned = behind.pop(axis if axis in behind else 0)
    reach = tuned.reach
    name = flight.names[1] if tuned.is_raw else flight.names[0]
    how = "unfiltered" if tuned.is_raw else "filtered, divided by the filters that flew"
    shown = [Density(x.behind.hertz, x.behind.power) for x in behind.values()]
    noise = GyroNoise(
        tuned.before, tuned.behind, dict(zip(behind, shown, strict=True)), reach, least,
        f"{name} ({how}), up to {reach:.0f} Hz", _steady_line(flight, axis, least),
    )  # fmt: skip
    return _unless_unseen(noise, tuned.is_raw, law, axis)


class _Source(NamedTuple):
    before: Density
    behind: Density
    reach: float
    is_raw: bool


def _sources(flight, chain, least: float, loop_dt: float) -> list[_Source]:
    """Of each axis: behind the filters as it was logged, and before them."""
    sources = []
    most = _reach(flight.dt, loop_dt)
    for k, rate in enumerate(flight.rates):
        hertz, power = _residual(rate, flight.setpoint, flight.dt)
        passed = chain(hertz)
        clear = passed >= _PASSED
        limit = hertz[min(int(np.flatnonzero(clear)[-1]) + 1, len(hertz) - 1)]
        if k < len(flight.unfiltered):
            raw = flight.unfiltered[k]
            time = np.arange(len(raw)) * flight.unfiltered_dt
            wanted = np.interp(time, np.arange(len(rate)) * flight.dt, flight.setpoint)
            high, level = _residual(raw, wanted, flight.unfiltered_dt)
            if flight.averaged:
                level = level / np.sinc(high * flight.unfiltered_dt) ** 2
            reach = _reach(flight.unfiltered_dt, loop_dt)
            if reach >= min(limit, most):
                through = chain(high)
                near = np.interp(high, hertz, power)
                both = (through >= _CLEAR) & (high <= most)
                behind = np.where(both, near, level * through)
                sources.append(
                    _Source(
                        Density(high, _flat_below(high, level, least)),
                        Density(high, _flat_below(high, behind, least)), reach, True,
                    )
                )  # fmt: skip
                continue
        behind = _flat_below(hertz, power, least)
        # In a notch the level is that beside it.
        before = np.interp(hertz, hertz[clear], behind[clear] / passed[clear])
        sources.append(
            _Source(Density(hertz, before), Density(hertz, behind), min(limit, most), False)
        )
    return sources


def _reach(dt: float, loop_dt: float) -> float:
    """In Hz; all of the loop's band where the gyro was logged as fast as the loop ran."""
    return 0.5 / loop_dt if dt < 1.01 * loop_dt else _REACH * 0.5 / dt


def _residual(
    rate: Float[np.ndarray, " samples"], setpoint: Float[np.ndarray, " samples"], dt: float
) -> tuple[Frequencies, Frequencies]:
    """Welch's density of what the set-point does not explain."""
    size = 2 ** int(np.round(np.log2(_WINDOW / dt)))
    places = np.arange(0, len(rate) - size + 1, size // 2)[:, None] + np.arange(size)
    taper = np.hanning(size)
    spectra = [np.fft.rfft((x[places] - x[places].mean(1, keepdims=True)) * taper, axis=1)
               for x in (rate, setpoint)]  # fmt: skip
    of_rate, of_setpoint = (np.mean(np.abs(x) ** 2, axis=0) for x in spectra)
    cross = np.mean(spectra[1].conj() * spectra[0], axis=0)
    explained = np.abs(cross) ** 2 / np.maximum(
        of_setpoint, 1e-12 * max(float(of_setpoint.max()), 1e-300)
    )
    many = len(places)
    left = np.maximum(of_rate - explained, 0.0) * many / max(many - 1, 1)
    return np.fft.rfftfreq(size, dt), 2 * dt * left / np.sum(taper**2)


def _flat_below(hertz: Frequencies, power: Frequencies, least: float) -> Frequencies:
    near = (hertz >= least) & (hertz <= 2 * least)
    level = float(np.median(power[near])) if near.any() else float(np.median(power))
    return np.where(hertz < least, level, power)


def _steady_line(flight: FlightChannels, axis: int, least: float) -> SpectralLine | None:
    """A line of the gyro that neither wanders nor follows the throttle."""
    raw = flight.unfiltered
    rate, dt = (raw[axis], flight.unfiltered_dt) if axis < len(raw) else (
        flight.rates[min(axis, len(flight.rates) - 1)], flight.dt,
    )  # fmt: skip
    time = np.arange(len(rate)) * dt
    moving = flight.throttle is not None and np.ptp(flight.throttle) > 0
    drive = rate if flight.throttle is None or not moving else np.interp(
        time, np.linspace(0.0, time[-1], len(flight.throttle)), flight.throttle
    )  # fmt: skip
    record = Record(time, drive, rate, input_names=("throttle",), output_names=("gyro",))
    above = 2 * np.pi * max(2 * least, _LINES)
    line = find_line(record, "gyro", above=above, over="throttle" if moving else None)
    if line is None or line.high - line.low > _STEADY * line.omega:
        return None
    return None if abs(line.follows) > _FOLLOWS else line


def _unless_unseen(noise: GyroNoise, is_raw: bool, law: RateLoop, axis: int) -> GyroNoise | NoNoise:
    """The noise, unless much of what reaches the command lies beyond what is known."""
    hertz = np.linspace(1.0, 0.499 / law.dt, 400)
    omega = 2 * np.pi * hertz
    through = gains_of(law, axis) @ law_paths(law, axis, omega)[0]
    passed = np.abs(through * gyro_chain_response(law, omega)) ** 2
    within = float(np.sum(passed[hertz <= noise.known_hz]) / np.sum(passed))
    if within >= _SHARE:
        return noise
    needed = hertz[np.searchsorted(np.cumsum(passed), _SHARE * np.sum(passed))]
    what = "gyro" if is_raw else "filtered gyro"
    return NoNoise(
        f"the {what} of the log shows its noise up to {noise.known_hz:.0f} Hz, where "
        f"{100 * within:.0f} % of what reaches the command of white noise lies: log the unfiltered "
        f"gyro at {2 * needed / _REACH:.0f} Hz or faster"
    )
