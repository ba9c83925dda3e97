"""The noise of the gyros that a log shows, and filters that a firmware could have against it."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from jaxquad.plot import Spectrum
from jaxquad.records import Record
from jaxquad.spectra import find_line, SpectralLine

from ._filters import Filter, FilterChain
from ._firmware import cutoff_of, FilterChoice, FilterOption, firmware_named, Stage
from ._flight_channels import FlightChannels, Samples
from ._law import RateLoop
from ._parameters import find_parameter, flown_loop, gains_of, store_parameters
from ._rate_loops import (
    cells_of,
    Filters,
    Frequencies,
    gyro_chain_response,
    law_paths,
    Paths,
    Response,
)


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


@dataclasses.dataclass(frozen=True)
class GyroNoise:
    """The noise of the three gyros as the filters that flew passed it.

    Densities are one-sided, in (rad/s)^2/Hz. What the set-point explains is taken out, and below
    `least_hz`, where motion is taken for noise, the level above it is used.
    """

    before: Spectrum  # the filters that flew, of the tuned axis, up to `known_hz`
    behind: Spectrum
    others: dict[int, Spectrum]  # behind them, of the other two axes by their index
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

    def powers(self, density: Spectrum, omega: Frequencies) -> Frequencies:
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
    before, behind, reach, is_raw = sources.pop(axis if axis in sources else 0)
    # Whether much of what reaches the command lies beyond what is known.
    hertz = np.linspace(1.0, 0.499 / law.dt, 400)
    through = gains_of(law, axis) @ law_paths(law, axis, 2 * np.pi * hertz)[0]
    passed = np.abs(through * gyro_chain_response(law, 2 * np.pi * hertz)) ** 2
    within = float(np.sum(passed[hertz <= reach]) / np.sum(passed))
    if within < _SHARE:
        needed = hertz[np.searchsorted(np.cumsum(passed), _SHARE * np.sum(passed))]
        what = "gyro" if is_raw else "filtered gyro"
        raise NoNoise(
            f"the {what} of the log shows its noise up to {reach:.0f} Hz, where "
            f"{100 * within:.0f} % of what reaches the command of white noise lies: log the "
            f"unfiltered gyro at {2 * needed / _REACH:.0f} Hz or faster"
        )
    name = flight.names[1] if is_raw else flight.names[0]
    how = "unfiltered" if is_raw else "filtered, divided by the filters that flew"
    return GyroNoise(
        before, behind, {k: source[1] for k, source in sources.items()},
        reach, least, f"{name} ({how}), up to {reach:.0f} Hz",
        _steady_line(flight, axis, least),
    )  # fmt: skip


def _source(
    flight: FlightChannels, k: int, chain: Callable[[Frequencies], Frequencies], least: float,
    loop_dt: float,
) -> tuple[Spectrum, Spectrum, float, bool]:  # fmt: skip
    """A gyro's noise before and behind the filters, its reach in Hz, whether it is unfiltered."""
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
        before = Spectrum(high, _flat_below(high, level, least))
        return before, Spectrum(high, _flat_below(high, behind, least)), reach, True
    behind = _flat_below(hertz, power, least)
    # In a notch the level is that beside it.
    before = np.interp(hertz, hertz[clear], behind[clear] / passed[clear])
    return Spectrum(hertz, before), Spectrum(hertz, behind), min(limit, most), False


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


Picks = Int[np.ndarray, "designs choices"]
_STEPS = 8  # of a cutoff, to either side of the one that flew
_HIGHEST = 0.45  # of the rate at which a filter runs
_WIDTHS = (0.1, 0.2)  # half of a notch, of its centre
_SLOW = 2 * np.pi * 5.0  # rad/s, where delays are compared


def filter_choices(
    firmware: str, values: Mapping[str, str], version: Sequence[int] = (), *, axis: int = 0,
    throttle: float = 0.3, change: float = 3.0, line_hz: float | None = None,
) -> tuple[FilterChoice, ...]:  # fmt: skip
    """The low-passes of gyro and D term that are on, and a notch at a line of the gyro's noise.

    Their kinds stay. A dynamic low-pass is moved as a whole, its lowest and its highest cutoff by
    one factor. A notch, narrow or wide, is offered where one of the static notches is off.

    **Arguments:**

    - `firmware`, `values`, `version`, `throttle`: as in `flown_loop`.
    - `axis`: 0, 1 or 2 for roll, pitch or yaw, whose own filters are offered.
    - `change`: factor by which a cutoff may rise or fall, within its documented range.
    - `line_hz`: of the line; None offers no notch.
    """
    kind, choices = firmware_named(firmware), []
    loop = flown_loop(firmware, values, version, throttle=throttle)
    reach = np.linspace(0.0, np.log(change), _STEPS + 1)[1:]
    factors = [*np.exp(-reach[::-1]), 1.0, *np.exp(reach)]
    for low_pass in kind.low_passes(loop, values, version, axis, throttle):
        # Cutoffs that can be stored: whole numbers, or three digits in single precision.
        stage, flown, filter, rate_hz, shared = low_pass
        assert dataclasses.is_dataclass(filter) and not isinstance(filter, type)
        options: dict[tuple[float, ...], FilterOption] = {}
        for factor in factors:
            stored, moved, scaled = dict(flown), filter, 0.0
            if factor != 1:
                wanted = {name: float(f"{factor * value:.3g}") for name, value in flown.items()}
                stored = store_parameters(firmware, wanted)
                scaled = sum(stored.values()) / sum(flown.values()) * cutoff_of(filter)
                rows = {find_parameter(firmware, name): value for name, value in stored.items()}
                inside = all(max(row.low, 1.0) <= value <= row.high for row, value in rows.items())
                if not inside or scaled >= _HIGHEST * rate_hz:
                    continue
                moved = dataclasses.replace(filter, **{"cutoff_hz": scaled})
            assert isinstance(moved, Filter)
            options[tuple(stored.values())] = FilterOption(stored, moved)
        at = [*options].index(tuple(flown.values()))
        choices.append(FilterChoice(stage, shared, rate_hz, tuple(options.values()), at))
    flown = zip(kind.notches, kind.flown_notches(values), strict=False)
    free = [(names, second) for names, (centre, second) in flown if centre == 0]
    if line_hz is not None and free:
        line, rate_hz = float(np.rint(line_hz)), kind.notch_rate_hz(loop)
        names, second = free[0]
        notches = [FilterOption(dict(zip(names, (0.0, second), strict=True)), None)]
        for half_width in _WIDTHS if line < _HIGHEST * rate_hz else ():
            width, notch = kind.notch(line, half_width)
            notches.append(FilterOption(dict(zip(names, (line, width), strict=True)), notch))
        choices.append(FilterChoice("gyro", True, rate_hz, tuple(notches), 0))
    return tuple(choice for choice in choices if len(choice.options) > 1)


def _other_axes(
    law: RateLoop, noise: GyroNoise, omega: Frequencies
) -> list[tuple[Response, Response, Frequencies]]:
    """What P and I, and D, make of the noise of the other axes' gyros, and that noise.

    Behind the gyro's filters of the law.
    """
    others = []
    for k, density in noise.others.items():
        gains, (back, _) = gains_of(law, k), law_paths(law, k, omega)
        others.append((gains[:2] @ back[:2], gains[2] * back[2], noise.powers(density, omega)))
    return others


class FilterBank:
    """The options of all free filters, as their responses over those that flew."""

    def __init__(
        self, choices: Sequence[FilterChoice], law: RateLoop, noise: GyroNoise, omega: Frequencies
    ):
        self.choices, self.measured = tuple(choices), omega / (2 * np.pi) <= noise.known_hz
        self.flown = np.array([choice.flown for choice in choices])  # the picks of what flew
        self.counts = np.array([len(choice.options) for choice in choices])
        self._others = _other_axes(law, noise, omega)
        low, self._ratios, self._delays = int(np.searchsorted(omega, _SLOW)), [], []
        for choice in self.choices:
            responses = np.stack(
                [
                    np.ones(omega.size, complex) if option.filter is None
                    else FilterChain((option.filter,), choice.rate_hz).response(omega / (2 * np.pi))
                    for option in choice.options
                ]
            )  # fmt: skip
            self._ratios.append(responses / responses[choice.flown])
            self._delays.append(-np.angle(self._ratios[-1][:, low]) / omega[low])

    def filters(self, picks: Picks) -> Filters:
        ones = np.ones((len(picks), self.measured.size), complex)
        responses: dict[Stage, Paths] = {"gyro": ones, "derivative": ones}
        for k, choice in enumerate(self.choices):
            responses[choice.stage] = responses[choice.stage] * self._ratios[k][picks[:, k]]
        return responses

    def beyond(self, picks: Picks) -> Float[np.ndarray, " designs"]:
        """How far the other axes get, over what is allowed: their delay may not grow."""
        late = {"gyro": np.zeros(len(picks)), "derivative": np.zeros(len(picks))}
        for k, choice in enumerate(self.choices):
            if choice.shared:
                late[choice.stage] = late[choice.stage] + self._delays[k][picks[:, k]]
        worst = np.maximum(late["gyro"], late["gyro"] + late["derivative"])
        return np.where(worst > 1e-7, 1 + 1e3 * worst, 0.0)

    def other_noise(self, filters: Filters) -> Float[np.ndarray, " designs"]:
        """Of the other axes' commands, over what flew: rms, and of each frequency not known."""
        if not all(choice.shared for choice in self.choices):  # those of the tuned axis' D term
            filters = {**filters, "derivative": np.ones_like(filters["derivative"])}
        growth = [np.zeros(len(filters["gyro"]))]
        for slow, quick, noise in self._others:
            through = (slow + quick * filters["derivative"]) * filters["gyro"]
            growth.append(noise_growth(through, slow + quick, noise, self.measured))
        return np.max(growth, axis=0)

    def parameters(self, picks: Int[np.ndarray, " choices"]) -> dict[str, float]:
        """The parameters of one design's filters that differ from what flew."""
        changed: dict[str, float] = {}
        for choice, pick in zip(self.choices, picks, strict=True):
            if pick != choice.flown:
                changed |= choice.options[pick].parameters
        return changed


def noise_growth(
    through: Paths, flown: Complex[np.ndarray, " frequencies"], noise: Frequencies,
    measured: np.ndarray,
) -> Float[np.ndarray, " designs"]:  # fmt: skip
    """The command's noise over what flew: its rms, and the gain where the noise is not known."""
    before = np.abs(flown) ** 2
    power = np.abs(through) ** 2
    rms = np.sqrt(power @ noise / max(float(before @ noise), 1e-300))
    if measured.all():
        return rms
    unseen = np.sqrt((power / before)[:, ~measured].max(axis=1))
    return np.maximum(rms, unseen)


class SharedChange(NamedTuple):
    """What changed filters do to the axes that were not tuned."""

    delay_ms: tuple[float, float]  # of the gyro's filters, and with the D term's, over what flew
    noise: float  # the greatest growth of a command's noise


def shared_change(
    law: RateLoop, changed: RateLoop, noise: GyroNoise, omega: Frequencies, axis: int
) -> SharedChange:
    """By the laws as they are built, not by the ratios of a search."""
    measured, growth = omega / (2 * np.pi) <= noise.known_hz, [0.0]
    ratio = gyro_chain_response(changed, omega) / gyro_chain_response(law, omega)
    both = zip(_other_axes(law, noise, omega), _other_axes(changed, noise, omega), strict=True)
    for (slow, quick, power), (later_slow, later_quick, _) in both:
        through = (later_slow + later_quick) * ratio
        growth.append(float(noise_growth(through[None], slow + quick, power, measured)[0]))
    at, phases = np.array([_SLOW]), []
    for one in (law, changed):
        gyro, back = gyro_chain_response(one, at), law_paths(one, (axis + 1) % 3, at)[0]
        phases.append((np.angle(gyro)[0], np.angle(gyro * back[2])[0]))
    (gyro, slope), (later, steeper) = phases
    late = tuple(-1e3 * (b - a) / _SLOW for a, b in ((gyro, later), (slope, steeper)))
    return SharedChange((late[0], late[1]), max(growth))
