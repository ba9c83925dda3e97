"""What one flight shows of a rate loop: its step, its sensitivity, its noise in hover, with errors.

Of the plants that the fit leaves possible, under the law that flew; where the log does not identify
the plant, the step is the log's response itself.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad.plot import Spectrum, StepBand
from jaxquad.records import Record
from jaxquad.spectra import estimate_step

from ._filter_bank import hann_spectra
from ._flight_channels import FlightChannels, FlownAutopilot, IdentifiedPlant
from ._identified_log import StepGrid
from ._law_check import LoopCheck
from ._parameters import gains_of
from ._rate_loops import draw_loops


_NORMAL = 1.96  # standard errors in half of a 95 % interval
_PLANTS, _SEED = 512, 77
_AT = 3.0  # rad/s, where the plant is gain / (s + damping), above its damping and below its lag
_WINDOW, _FEWEST, _BLOCK = 0.25, 8, 4  # s of a window; windows of a spectrum; windows in a block
_STILL, _CALM = np.radians(20.0), np.radians(100.0)  # most movement of set-point and rate, rad/s
_STEADY = 0.05  # likewise of the throttle
_LOWEST = 30.0  # Hz, above the band of the loop
_REACH = 0.9  # of half the log's rate, to which spectra are used


class Estimate(NamedTuple):
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float

    @property
    def log_error(self) -> float:
        """The standard error of its logarithm; below it alone where some plants are unstable."""
        if not (0 < self.low <= self.value < np.inf):
            return float("inf")
        if np.isinf(self.high):
            return float(np.log(self.value / self.low)) / _NORMAL
        return float(np.log(self.high / self.low)) / (2 * _NORMAL)

    @classmethod
    def of_error(cls, value: float, error: float) -> "Estimate":
        """From a standard error."""
        return cls(float(value), float(value - _NORMAL * error), float(value + _NORMAL * error))

    @classmethod
    def of_draws(cls, draws: Float[np.ndarray, " draws"]) -> "Estimate":
        low, middle, high = np.percentile(draws, [2.5, 50.0, 97.5], method="nearest")
        return cls(float(middle), float(low), float(high))


@dataclasses.dataclass(frozen=True)
class FlownAxis:
    """One axis of a log: its law, its plant, and all of the flight around what was identified."""

    flown: FlownAutopilot
    flight: FlightChannels | None  # with what was flown before and after the excitation
    plant: IdentifiedPlant | None = None  # None where the axis rests
    check: LoopCheck | None = None  # None where the plant is not identified
    doubt: str = ""  # why there is no plant, or none to believe

    def parameter(self, name: str) -> Estimate | None:
        """Of the plant from the command to the rate; None where it is not identified."""
        fit = None if self.plant is None else self.plant.fit
        if fit is None or not fit.identifiable or name not in fit.names:
            return None
        return Estimate(float(fit[name]), *map(float, fit.interval(name)))


class LoopShown(NamedTuple):
    """Qualities of the loop by their names, and the step from set-point to rate."""

    qualities: Mapping[str, Estimate]
    step: StepBand


PEAK, HALF_WAY, MS, TORQUE, NOISE = (
    "peak of the step", "half way after", "Ms, the peak of |S|", "effect of a torque step",
    "noise of the command",
)  # fmt: skip


def identified_loop(axis: FlownAxis) -> LoopShown | None:
    """By the identified plant in the law that flew; None where flight and law do not agree."""
    plant, flown, check = axis.plant, axis.flown, axis.check
    if plant is None or check is None or check.kind != "flown":
        return None
    grid, gains = StepGrid.of(flown.law.dt), gains_of(flown.law, flown.axis)
    try:
        loops = draw_loops(plant, None, flown, _PLANTS, _SEED)
        timed = draw_loops(plant, None, flown, _PLANTS, _SEED, omega=grid.omega)
    except ValueError:  # a gain of either sign is possible
        return None
    [back], [ahead] = timed.paths(gains[None])
    steps = grid.steps(ahead * timed.plants / (1 + back * timed.plants))
    half = grid.dt * _crossings(steps, 0.5)
    numbers = loops.qualities(gains[None])
    # A torque turns the vehicle, whatever a unit of the command does: without the gain.
    place, damping = int(np.argmin(np.abs(loops.omega - _AT))), float(plant.fit.model.damping)
    command = np.abs(loops.plants[:, place] * (1j * loops.omega[place] + damping))
    draws = {
        PEAK: steps.max(axis=1),
        HALF_WAY: half,
        MS: np.where(numbers.stable[0], numbers.peak[0], np.inf),
        TORQUE: np.where(numbers.stable[0], numbers.rejection[0] / command, np.inf),
    }
    shown = {name: Estimate.of_draws(values) for name, values in draws.items()}
    return LoopShown(shown, grid.band_of(steps))


def measured_step(flight: FlightChannels | None) -> LoopShown | None:
    """By the log's own response from set-point to rate; None where it is not conclusive."""
    if flight is None or np.ptp(flight.setpoint) == 0:
        return None
    time = flight.start + flight.dt * np.arange(len(flight.setpoint))
    record = Record(
        time, flight.setpoint, flight.rates[flight.axis], flight.setpoint,
        input_names=["command"], output_names=["rate"], reference_names=["set-point"],
    )  # fmt: skip
    try:
        step = estimate_step(record)
    except ValueError:  # too short
        return None
    if not step.is_conclusive:
        return None
    mean, error = step.mean / step.final, step.standard_error / abs(step.final)
    top, half = int(np.argmax(mean)), float(_crossings(mean[None], 0.5)[0])
    near = int(half)
    slope = (mean[near + 1] - mean[near]) / flight.dt
    qualities = {PEAK: Estimate.of_error(mean[top], error[top])}
    if step.is_resolved:
        late = step.time[near] + (half - near) * flight.dt
        qualities[HALF_WAY] = Estimate.of_error(late, error[near] / slope)
    band = StepBand(step.time, mean, mean - _NORMAL * error, mean + _NORMAL * error)
    return LoopShown(qualities, StepBand(*(x[step.time >= 0] for x in band)))


def _crossings(
    steps: Float[np.ndarray, "steps samples"], level: float
) -> Float[np.ndarray, " steps"]:
    """The sample at which each first passes a level, between samples by a straight line."""
    after = np.maximum(np.argmax(steps >= level, axis=1), 1)
    rows = np.arange(len(steps))
    before, here = steps[rows, after - 1], steps[rows, after]
    return after - 1 + (level - before) / np.where(here == before, 1.0, here - before)


class HoverNoise(NamedTuple):
    """The noise of an axis in steady hover, above the band of the loop."""

    rms: Estimate  # of the law's output, in the firmware's unit
    command: Spectrum  # of that
    gyro: Spectrum  # behind its filters
    seconds: float  # of steady hover


class NoHover(Exception):
    """Why a log does not show the noise in hover."""


def hover_noise(axis: FlownAxis) -> HoverNoise:
    """Of windows in which set-point, throttle and vehicle rest in the air. Raises NoHover."""
    flight = axis.flight
    if flight is None or flight.output is None:
        raise NoHover("the log does not hold the law's output")
    if flight.throttle is None:
        raise NoHover("the log does not hold the throttle, so nothing says when it flew")
    size = 2 ** int(np.round(np.log2(_WINDOW / flight.dt)))
    starts = np.arange(0, len(flight.setpoint) - size + 1, size // 2)
    inside = starts[:, None] + np.arange(size)
    span = lambda x: np.ptp(x[inside], axis=1)
    throttle, rate = flight.throttle, flight.rates[flight.axis]
    still = (span(flight.setpoint) <= _STILL) & (span(throttle) <= _STEADY)
    still &= throttle[inside].min(axis=1) > 0.5 * np.percentile(throttle, 75)
    still &= (np.abs(rate[inside]).max(axis=1) <= _CALM) & (span(flight.limited) == 0)
    if flight.injected is not None:
        still &= span(flight.injected) == 0
    if np.sum(still) < _FEWEST:
        seconds = np.sum(still) * (size // 2) * flight.dt
        raise NoHover(
            f"the log holds {seconds:.1f} s of steady hover: rest the sticks in the air for "
            f"{_FEWEST * _WINDOW:.0f} s or more"
        )
    spectra = hann_spectra(size, flight.output, rate)
    hertz = np.fft.rfftfreq(size, flight.dt)
    scale = 2 * flight.dt / np.sum(np.hanning(size) ** 2)
    command, gyro = (scale * np.abs(x[still]) ** 2 for x in spectra)
    high = (hertz >= _LOWEST) & (hertz <= _REACH * 0.5 / flight.dt)
    power = command[:, high].sum(axis=1) * (hertz[1] - hertz[0])
    # The greatest of what Gaussian noise of this spectrum leaves (Bendat and Piersol, "Random
    # Data", ch. 8) and the scatter of windows and of blocks: noise may come and go more slowly.
    shape, seconds = command.mean(axis=0)[high], float(np.sum(still) * (size // 2) * flight.dt)
    width = shape.sum() ** 2 / np.sum(shape**2) * (hertz[1] - hertz[0])
    scatter = [np.mean(power) / np.sqrt(width * seconds), np.std(power, ddof=1) / len(power) ** 0.5]
    blocks = power[: len(power) // _BLOCK * _BLOCK].reshape(-1, _BLOCK).mean(axis=1)
    if len(blocks) >= _FEWEST:
        scatter.append(np.std(blocks, ddof=1) / np.sqrt(len(blocks)))
    mean = float(np.mean(power))
    rms, error = np.sqrt(mean), max(scatter) / (2 * max(mean, 1e-300))
    far = float(np.exp(_NORMAL * error))
    return HoverNoise(
        Estimate(float(rms), float(rms / far), float(rms * far)),
        Spectrum(hertz[1:], command.mean(axis=0)[1:]), Spectrum(hertz[1:], gyro.mean(axis=0)[1:]),
        seconds,
    )  # fmt: skip
