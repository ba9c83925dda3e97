"""The response of a gyro's filters as a log shows it: the filtered rate over the unfiltered one.

What follows motors or spectrum, as notches by the motors' speed do, is in no parameter. Far above
the loop's frequencies it delays the rate, and that a log shows that holds both.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ._known_filters import filter_response, Frequencies, KnownFilter


Samples = Float[np.ndarray, " samples"]
_SECONDS = 1.0  # of a window: far longer than any filter remembers, so that leakage is small
_LOWEST, _HIGHEST = 1.0, 0.3  # Hz, and of the sample rate: where the ratio is used
_CLEAR = 0.3  # relative random error, above which a frequency is left out
_FOLDED = 0.02  # of the power, that noise from above half the sample rate may have
_FEWEST = 4  # frequencies
_SHOWN = 10.0  # Hz, of the delay in print
_LONGEST, _FINEST = 5e-3, 501  # s, and trials, of the first-order lag
_SEEN = 9.0  # by which chi squared falls with a lag that the ratio shows
_NEIGHBOURS, _WIDER = 3, 1.12  # of a band of frequencies: so many, or up to this ratio
_SHARED = 0.5  # of overlapping windows, that count as if they were apart


_Spectra = Complex[np.ndarray, "windows frequencies"]


class _Ratio(NamedTuple):
    """The measured response, with its relative random error, where it is clear."""

    hertz: Frequencies
    response: Complex[np.ndarray, " frequencies"]
    error: Frequencies


@dataclasses.dataclass(frozen=True)
class MeasuredChain:
    """Filters of a log's output as measured: known ones times e^(-delay s) / (lag s + 1).

    It is a `KnownFilter`. The correction is fitted to the ratio of both signals; it is smooth and
    goes on beyond the measured band, where filters that follow something else lie.

    **Attributes:**

    - `known`: the filters that parameters describe.
    - `delay`, `lag`: of the correction, in s; what the known filters delay too much is negative.
    - `covariance`: of these two, in s^2, random errors times the misfit where it is above 1.
    - `misfit`: rms of what the fit leaves, in random errors.
    - `hertz`, `ratio`, `ratio_error`: the measured response with its relative random error.
    - `names`: of the unfiltered and the filtered signal.
    """

    known: tuple[KnownFilter, ...]
    delay: float
    lag: float
    covariance: Float[np.ndarray, "2 2"]
    misfit: float
    hertz: Frequencies
    ratio: Complex[np.ndarray, " frequencies"]
    ratio_error: Frequencies
    names: tuple[str, str] = ("the unfiltered rate", "the filtered rate")

    def response(self, frequency_hz: Frequencies) -> Complex[np.ndarray, " frequencies"]:
        """At frequencies in Hz."""
        omega = 2 * np.pi * np.asarray(frequency_hz, float)
        return filter_response(self.known, omega) * _correction(omega, self.delay, self.lag)

    def error(self, frequency_hz: Frequencies) -> Frequencies:
        """The standard error of the response at frequencies in Hz, relative and in rad."""
        omega = 2 * np.pi * np.asarray(frequency_hz, float)
        slopes, covariance = _slopes(omega, self.lag), self.covariance
        size, turn = (
            np.einsum("fp,pq,fq->f", x, covariance, x) for x in (np.real(slopes), np.imag(slopes))
        )
        return np.sqrt(np.maximum(size, turn))

    def delay_ms(self, frequency_hz: Frequencies) -> Frequencies:
        """The phase delay in ms at frequencies in Hz, which are above 0."""
        omega = 2 * np.pi * np.asarray(frequency_hz, float)
        return 1e3 * (_known_delay(self.known, omega) + _delay(omega, self.delay, self.lag))

    @property
    def description(self) -> str:
        """In one line, with the delay at 10 Hz."""
        omega = 2 * np.pi * np.array([_SHOWN])
        late = float(self.delay_ms(np.array([_SHOWN]))[0])
        before = 1e3 * float(_known_delay(self.known, omega)[0])
        unfiltered, filtered = self.names
        aside = f" (by the parameters {before:.2g} ms)" if self.known else ""
        return f"measured: {filtered} over {unfiltered}, {late:.2g} ms at {_SHOWN:g} Hz{aside}"

    def __str__(self) -> str:
        return self.description


def measured_chain(
    unfiltered: Samples,
    filtered: Samples,
    dt: float,
    *,
    known: tuple[KnownFilter, ...] = (),
    reference: Samples | None = None,
    names: tuple[str, str] = ("the unfiltered rate", "the filtered rate"),
) -> MeasuredChain:
    """Measure the filters between two signals of one gyro, of the flown part of a log.

    A filter is driven by the unfiltered signal, so that the ratio of cross and auto spectrum has no
    bias by noise before the filter. A log at a fraction of the gyro's rate folds noise from above
    half of its rate into both signals: with a `reference`, such as the set-point, the ratio is that
    of what follows it, where noise has no part; without one, frequencies are used at which the
    motion stands far above the noise. Of the ratio over the known filters a delay and a first-order
    lag are fitted: far above the loop a notch is the latter to second order.
    Source: Bendat and Piersol, "Random Data", 4th ed., ch. 6; Pintelon and Schoukens, "System
    Identification: A Frequency Domain Approach", 2nd ed., sec. 2.6 (instrumental variables).

    **Arguments:**

    - `unfiltered`, `filtered`: of the same instants, in the same unit.
    - `dt`: of their samples, in s.
    - `known`: filters that parameters describe.
    - `reference`: a signal that moves the vehicle and that no noise of the gyro reaches.
    - `names`: of both signals, for print.

    **Returns:** a `MeasuredChain`.

    **Raises:** ValueError for signals of other lengths, and for those that show no ratio.
    """
    size = int(round(_SECONDS / dt))
    lengths = {len(x) for x in (unfiltered, filtered, *([] if reference is None else [reference]))}
    if len(lengths) > 1 or min(lengths) < 4 * size:
        raise ValueError(
            f"the signals have {', '.join(map(str, sorted(lengths)))} samples: give as many of "
            f"each, {4 * size} ({4 * _SECONDS:g} s) or more"
        )
    ratio = _ratio(unfiltered, filtered, reference, size, dt)
    if ratio.hertz.size < _FEWEST:
        raise ValueError(
            f"{names[1]} over {names[0]} is clear at {ratio.hertz.size} frequencies, and {_FEWEST} "
            "are needed: give a part of the log with more motion"
        )
    omega = 2 * np.pi * ratio.hertz
    left = ratio.response / filter_response(known, omega)
    phase = np.angle(left)
    level, weight = np.log(np.abs(left)), 1 / ratio.error**2
    lag = _best_lag(omega, level, phase, weight)
    delay = _best_delay(omega, phase, weight, lag)
    rest = left / _correction(omega, delay, lag) - 1
    misfit = float(np.sqrt(np.sum(weight * np.abs(rest) ** 2) / (2 * omega.size - 2)))
    slopes = _slopes(omega, lag)
    both = np.concatenate([np.real(slopes), np.imag(slopes)]) * np.tile(np.sqrt(weight), 2)[:, None]
    covariance = np.linalg.pinv(both.T @ both) * max(1.0, misfit) ** 2
    return MeasuredChain(tuple(known), delay, lag, covariance, misfit, *ratio, names)


def _ratio(
    unfiltered: Samples, filtered: Samples, reference: Samples | None, size: int, dt: float
) -> _Ratio:
    """Over windows of half overlap and neighbouring frequencies, with the error of what is left.

    A sweep is at a frequency in one or two windows, which by themselves leave nothing.
    """
    hertz = np.fft.rfftfreq(size, dt)
    x, y = (_spectra(each, size) for each in (unfiltered, filtered))
    r = x if reference is None else _spectra(reference, size)
    power = np.mean(np.abs(x) ** 2, axis=0)
    folded = np.median(power[hertz > _HIGHEST / dt]) if reference is None else 0.0
    rows = [_band_ratio(hertz, x, y, r, band) for band in _bands(hertz, _HIGHEST / dt)]
    centre, response, error, level = np.array(rows, complex).reshape(-1, 4).T
    share = folded / np.maximum(np.real(level), 1e-300)  # of noise folded into the band, perhaps
    error = np.real(error) + share
    used = (error < _CLEAR) & (share < _FOLDED) & (response != 0)
    return _Ratio(np.real(centre)[used], response[used], error[used])


def _bands(hertz: Frequencies, highest: float) -> list[slice]:
    """Neighbouring frequencies that are averaged."""
    bands, first = [], int(np.searchsorted(hertz, _LOWEST))
    while first < hertz.size and hertz[first] < highest:
        last = max(first + _NEIGHBOURS, int(first * _WIDER))
        bands.append(slice(first, last))
        first = last
    return bands


def _band_ratio(
    hertz: Frequencies, x: _Spectra, y: _Spectra, r: _Spectra, band: slice
) -> tuple[float, complex, float, float]:
    """Centre in Hz, ratio, its relative random error, and the mean power of x."""
    x, y, r = x[:, band], y[:, band], r[:, band]
    shares = np.conj(r) * x
    cross = np.sum(shares)
    size = max(float(np.abs(cross)), 1e-150)
    ratio = complex(np.sum(np.conj(r) * y) / size * (np.conj(cross) / size))
    left = np.conj(r) * (y - ratio * x)
    error = np.sqrt(np.sum(np.abs(left) ** 2) / _SHARED / 2) / size / max(abs(ratio), 1e-150)
    weight = np.sum(np.abs(shares), axis=0)
    centre = float(np.sum(weight * hertz[band]) / max(float(np.sum(weight)), 1e-150))
    error = max(float(error), float(np.finfo(float).eps))  # of signals without noise
    return centre, ratio, error, float(np.mean(np.abs(x) ** 2))


def _spectra(values: Samples, size: int) -> _Spectra:
    starts = np.arange(0, values.size - size + 1, size // 2)
    parts = values[starts[:, None] + np.arange(size)]
    return np.fft.rfft(np.hanning(size) * (parts - parts.mean(axis=1, keepdims=True)), axis=1)


def _correction(
    omega: Frequencies, delay: float, lag: float
) -> Complex[np.ndarray, " frequencies"]:
    return np.exp(-1j * omega * delay) / (1 + 1j * omega * lag)


def _delay(omega: Frequencies, delay: float, lag: float) -> Frequencies:
    """In s, of the correction's phase."""
    return delay + np.arctan(omega * lag) / omega


def _known_delay(known: tuple[KnownFilter, ...], omega: Frequencies) -> Frequencies:
    """In s, of the phase of filters one by one: that of each stays within half a turn."""
    phase = sum((np.angle(filter_response([each], omega)) for each in known), np.zeros(omega.size))
    return -phase / omega


def _slopes(omega: Frequencies, lag: float) -> Complex[np.ndarray, "frequencies 2"]:
    """Derivatives of the logarithm of the correction by delay and lag."""
    return np.stack([-1j * omega, -1j * omega / (1 + 1j * omega * lag)], axis=1)


def _best_delay(omega: Frequencies, phase: Frequencies, weight: Frequencies, lag: float) -> float:
    """By linear least squares of the phase."""
    seen = phase + np.arctan(omega * lag)
    return -float(np.sum(weight * omega * seen) / np.sum(weight * omega**2))


def _best_lag(
    omega: Frequencies, level: Frequencies, phase: Frequencies, weight: Frequencies
) -> float:
    """With the best delay for each, on a grid that is refined once; 0 where none shows."""

    def cost(lag: float) -> float:
        rest = phase + np.arctan(omega * lag) + omega * _best_delay(omega, phase, weight, lag)
        return float(np.sum(weight * (rest**2 + (level + np.log1p((omega * lag) ** 2) / 2) ** 2)))

    trials = np.linspace(0.0, _LONGEST, _FINEST)
    best = trials[int(np.argmin([cost(x) for x in trials]))]
    near = np.linspace(max(best - trials[1], 0.0), best + trials[1], 201)
    best = near[int(np.argmin([cost(x) for x in near]))]
    return float(best) if cost(0.0) - cost(best) > _SEEN else 0.0
