"""Filters of a log's output, as a gyro's: by their parameters, or measured between two signals.

What follows motors or spectrum, as notches by the motors' speed do, is in no parameter. Far above
the loop's frequencies it delays the rate, and that a log shows that holds both signals.
"""

import dataclasses
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Complex, Float

from jaxquad.records import Record
from jaxquad.spectra import FrequencyResponse


Frequencies = Float[np.ndarray, " frequencies"]
Samples = Float[np.ndarray, " samples"]
_SECONDS = 1.0  # of a window: far longer than any filter remembers, so that leakage is small
_LOWEST, _HIGHEST = 1.0, 0.3  # Hz, and of the sample rate: where the ratio is used
_CLEAR = 0.3  # relative random error, above which a frequency is left out
_FOLDED = 0.02  # of the power, that noise from above half the sample rate may have
_FEWEST = 4  # frequencies
_SHOWN = 10.0  # Hz, of the delay in print
_LONGEST, _FINEST = 5e-3, 501  # s, and trials, of the first-order lag
_SIGNIFICANT = 9.0  # by which chi squared falls with a lag that the ratio shows
_NEIGHBOURS, _WIDER = 3, 1.12  # of a band of frequencies: so many, or up to this ratio
_SHARED = 0.5  # of overlapping windows, that count as if they were independent


@runtime_checkable
class KnownFilter(Protocol):
    """A filter of the log's output, as `jq.autopilot.FilterChain` is one."""

    def response(self, frequency_hz: Frequencies) -> Complex[Array | np.ndarray, " frequencies"]:
        """At frequencies in Hz."""
        ...


def filter_response(
    filters: Sequence[KnownFilter], omega: Frequencies
) -> Complex[np.ndarray, " frequencies"]:
    """Of all filters, one after the other; frequencies in rad/s."""
    response = np.ones(omega.size, complex)
    for one in filters:
        response = response * np.asarray(one.response(omega / (2 * np.pi)))
    return response


def behind_filters(record: Record, filters: Sequence[KnownFilter]) -> Record:
    """The record with inputs that have passed the filters, which the outputs have.

    A model up to what the filters were given makes of these inputs what left the filters. Before
    the record the inputs are taken as constant.
    """
    if not filters:
        return record
    inputs, size = np.asarray(record.inputs), 2 * record.samples
    response = filter_response(filters, 2 * np.pi * np.fft.rfftfreq(size, record.dt))
    spectra = np.fft.rfft(inputs - inputs[0], size, axis=0) * response[:, None]
    filtered = inputs[0] + np.fft.irfft(spectra, size, axis=0)[: record.samples]
    return dataclasses.replace(record, inputs=filtered)


def without_filters(frf: FrequencyResponse, filters: Sequence[KnownFilter]) -> FrequencyResponse:
    """The response up to what the filters were given, its random errors with it.

    **Arguments:**

    - `frf`: up to what left the filters.
    - `filters`: those that all outputs passed, such as a gyro's.

    **Returns:** a `FrequencyResponse`; relative errors and coherence stay.
    """
    if not filters:
        return frf
    response = filter_response(filters, np.asarray(frf.omega))
    return dataclasses.replace(
        frf, response=frf.response / response[:, None, None], errors=frf.errors.scaled(1 / response)
    )


@dataclasses.dataclass(frozen=True)
class MeasuredChain:
    """Filters of a log's output as measured: those by parameters times e^(-delay s) / (lag s + 1).

    It is a `KnownFilter`. The correction is fitted to the ratio of both signals; it is smooth and
    goes on beyond the measured band, where filters that follow something else lie.

    **Attributes:**

    - `filters`: the filters that parameters describe.
    - `delay`, `lag`: of the correction, in s; what the `filters` delay too much is negative.
    - `covariance`: of these two, in s^2, random errors times the misfit where it is above 1.
    - `misfit`: rms of what the fit leaves, in random errors.
    - `hertz`, `ratio`, `ratio_error`: the measured response with its relative random error.
    - `names`: of the unfiltered and the filtered signal.
    """

    filters: tuple[KnownFilter, ...]
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
        return filter_response(self.filters, omega) * _correction(omega, self.delay, self.lag)

    def error(self, frequency_hz: Frequencies) -> Frequencies:
        """The standard error of the response at frequencies in Hz, relative and in rad."""
        omega = 2 * np.pi * np.asarray(frequency_hz, float)
        slopes, covariance = _slopes(omega, self.lag), self.covariance
        parts = (np.real(slopes), np.imag(slopes))
        variances = [np.einsum("fp,pq,fq->f", part, covariance, part) for part in parts]
        return np.sqrt(np.maximum(*variances))

    def delay_ms(self, frequency_hz: Frequencies) -> Frequencies:
        """The phase delay in ms at frequencies in Hz, which are above 0."""
        omega = 2 * np.pi * np.asarray(frequency_hz, float)
        return 1e3 * (
            _phase_delay(self.filters, omega) + (self.delay + np.arctan(omega * self.lag) / omega)
        )

    @property
    def description(self) -> str:
        """In one line, with the delay at 10 Hz."""
        omega = 2 * np.pi * np.array([_SHOWN])
        late = float(self.delay_ms(np.array([_SHOWN]))[0])
        before = 1e3 * float(_phase_delay(self.filters, omega)[0])
        unfiltered, filtered = self.names
        aside = f" (by the parameters {before:.2g} ms)" if self.filters else ""
        return f"measured: {filtered} over {unfiltered}, {late:.2g} ms at {_SHOWN:g} Hz{aside}"

    def __str__(self) -> str:
        return self.description


def measured_chain(
    unfiltered: Samples,
    filtered: Samples,
    dt: float,
    *,
    filters: tuple[KnownFilter, ...] = (),
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
    - `filters`: those that parameters describe.
    - `reference`: a signal that moves the vehicle and that no noise of the gyro reaches.
    - `names`: of both signals, for print.

    **Raises:** ValueError for signals of other lengths, and for those that show no ratio.
    """
    size = int(round(_SECONDS / dt))
    lengths = {len(x) for x in (unfiltered, filtered, *([] if reference is None else [reference]))}
    if len(lengths) > 1 or min(lengths) < 4 * size:
        raise ValueError(
            f"the signals have {', '.join(map(str, sorted(lengths)))} samples: give as many of "
            f"each, {4 * size} ({4 * _SECONDS:g} s) or more"
        )
    hertz, ratio, error = _clear_ratio(unfiltered, filtered, reference, size, dt)
    if hertz.size < _FEWEST:
        raise ValueError(
            f"{names[1]} over {names[0]} is clear at {hertz.size} frequencies, and {_FEWEST} "
            "are needed: give a part of the log with more motion"
        )
    omega, weight = 2 * np.pi * hertz, 1 / error**2
    left = ratio / filter_response(filters, omega)
    level, phase = np.log(np.abs(left)), np.angle(left)

    # Delay by linear least squares for each lag, and the lag on a grid that is refined once. The
    # lag is 0 where none shows.
    def delay_for(lag: float) -> float:
        late = phase + np.arctan(omega * lag)
        return -float(np.sum(weight * omega * late) / np.sum(weight * omega**2))

    def cost(lag: float) -> float:
        rest = phase + np.arctan(omega * lag) + omega * delay_for(lag)
        return float(np.sum(weight * (rest**2 + (level + np.log1p((omega * lag) ** 2) / 2) ** 2)))

    trials = np.linspace(0.0, _LONGEST, _FINEST)
    best = trials[int(np.argmin([cost(lag) for lag in trials]))]
    near = np.linspace(max(best - trials[1], 0.0), best + trials[1], 201)
    best = near[int(np.argmin([cost(lag) for lag in near]))]
    lag = float(best) if cost(0.0) - cost(best) > _SIGNIFICANT else 0.0
    delay = delay_for(lag)
    rest = left / _correction(omega, delay, lag) - 1
    misfit = float(np.sqrt(np.sum(weight * np.abs(rest) ** 2) / (2 * omega.size - 2)))
    slopes = _slopes(omega, lag)
    rows = np.concatenate([np.real(slopes), np.imag(slopes)]) * np.tile(np.sqrt(weight), 2)[:, None]
    covariance = np.linalg.pinv(rows.T @ rows) * max(1.0, misfit) ** 2
    return MeasuredChain(tuple(filters), delay, lag, covariance, misfit, hertz, ratio, error, names)


def _clear_ratio(
    unfiltered: Samples, filtered: Samples, reference: Samples | None, size: int, dt: float
) -> tuple[Frequencies, Complex[np.ndarray, " frequencies"], Frequencies]:
    """Frequencies in Hz, the ratio, and its relative random error, where it is clear.

    Over windows of half overlap and neighbouring frequencies, with the error of what is left: a
    sweep is at a frequency in one or two windows, which by themselves leave nothing.
    """
    hertz, highest = np.fft.rfftfreq(size, dt), _HIGHEST / dt
    starts = np.arange(0, unfiltered.size - size + 1, size // 2)

    def spectra(values: Samples) -> Complex[np.ndarray, "windows frequencies"]:
        parts = values[starts[:, None] + np.arange(size)]
        return np.fft.rfft(np.hanning(size) * (parts - parts.mean(axis=1, keepdims=True)), axis=1)

    x, y = spectra(unfiltered), spectra(filtered)
    r = x if reference is None else spectra(reference)
    power = np.mean(np.abs(x) ** 2, axis=0)
    folded = np.median(power[hertz > highest]) if reference is None else 0.0
    rows, first = [], int(np.searchsorted(hertz, _LOWEST))
    while first < hertz.size and hertz[first] < highest:
        band = slice(first, max(first + _NEIGHBOURS, int(first * _WIDER)))
        first = band.stop
        shares = np.conj(r[:, band]) * x[:, band]
        cross = np.sum(shares)
        scale = max(float(np.abs(cross)), 1e-150)
        ratio = complex(np.sum(np.conj(r[:, band]) * y[:, band]) / scale * (np.conj(cross) / scale))
        left = np.conj(r[:, band]) * (y[:, band] - ratio * x[:, band])
        error = np.sqrt(np.sum(np.abs(left) ** 2) / _SHARED / 2) / scale / max(abs(ratio), 1e-150)
        weight = np.sum(np.abs(shares), axis=0)
        centre = float(np.sum(weight * hertz[band]) / max(float(np.sum(weight)), 1e-150))
        error = max(float(error), float(np.finfo(float).eps))  # of signals without noise
        rows.append((centre, ratio, error, float(np.mean(np.abs(x[:, band]) ** 2))))
    centre, response, error, level = np.array(rows, complex).reshape(-1, 4).T
    share = folded / np.maximum(np.real(level), 1e-300)  # of noise folded into the band, perhaps
    error = np.real(error) + share
    used = (error < _CLEAR) & (share < _FOLDED) & (response != 0)
    return np.real(centre)[used], response[used], error[used]


def _correction(
    omega: Frequencies, delay: float, lag: float
) -> Complex[np.ndarray, " frequencies"]:
    return np.exp(-1j * omega * delay) / (1 + 1j * omega * lag)


def _slopes(omega: Frequencies, lag: float) -> Complex[np.ndarray, "frequencies 2"]:
    """Derivatives of the logarithm of the correction by delay and lag."""
    return np.stack([-1j * omega, -1j * omega / (1 + 1j * omega * lag)], axis=1)


def _phase_delay(filters: tuple[KnownFilter, ...], omega: Frequencies) -> Frequencies:
    """In s, of the phase of filters one by one: that of each stays within half a turn."""
    phases = (np.angle(filter_response([one], omega)) for one in filters)
    return -sum(phases, np.zeros(omega.size)) / omega
