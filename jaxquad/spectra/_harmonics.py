"""Harmonics of a sweep in the residual: a sign of a deadband, a saturation or another nonlinearity.

While a sweep passes w(t), a linear plant answers at w(t) only; a static nonlinearity also at 2 w(t)
and 3 w(t). These harmonics have the phase of the input, multiplied, so they are looked for in the
residual as known signals with an unknown factor, which noise seldom imitates.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Complex, Float

from jaxquad.records import Record

from ._remarks import Remark


_HARMONICS = (2, 3)
_CHANCE = 5e-3  # of a remark on a linear record
_SMALLEST = 0.02  # bias of the gain from which a remark is made
# Change of the gain over the third harmonic, by Fourier series: 2.4 to 2.9 for a deadband of 5 to
# 20 %, 3 for friction and for a cubic; 1.1 to 1.4 where the peaks are cut off by 5 to 30 %.
_BROKEN, _CLIPPED = 2.8, 1.3
_COHERENT = 0.6  # of points between which the response is interpolated
_CONCENTRATED = 0.9  # share of a sweep's power at its own frequency
_FEWEST = 6.0  # cycles of a sweep
_ACTIVE = 0.1  # of the largest amplitude
_TRANSIENT = 21  # bins over which a transient of the record's ends is smooth
_NEAR, _NEAREST = 0.1, 10  # bins on either side over which the noise is averaged: share, at least
_BEYOND = 1.0  # neper, of the points between which a response is interpolated

Method = Literal["direct", "joint"]
Signal = Float[np.ndarray, " samples"]
Tone = Complex[np.ndarray, " samples"]
Tones = Sequence[Complex[np.ndarray, " _samples"]]
Grid = Float[np.ndarray, " frequencies"]
Bins = Float[np.ndarray, " bins"]


def remarks_on_harmonics(
    records: Sequence[Record],
    tones: Tones,
    i: int,
    omega: Grid,
    response: Complex[np.ndarray, "frequencies outputs inputs"],
    coherence: Float[np.ndarray, "frequencies outputs inputs"],
) -> tuple[Remark, ...]:
    """Remarks on outputs whose residual holds harmonics of input `i`, whose parts are `tones`."""
    from scipy.special import gammainccinv

    first, remarks = records[0], []
    chance = _CHANCE / (len(_HARMONICS) * response.shape[1] * response.shape[2])
    for o, output in enumerate(first.output_names):
        used = np.isfinite(response[:, o]).all(axis=1) & (coherence[:, o, i] >= _COHERENT)
        if np.sum(used) < 8:
            continue
        pairs = zip(records, tones, strict=True)
        fits = (_harmonics(*pair, omega[used], response[used][:, o], (o, i)) for pair in pairs)
        parts = [fit for fit in fits if fit is not None]
        if not parts:
            continue
        weight = np.sum([weight for _, weight in parts], axis=0)
        factor = np.sum([weight * factor for factor, weight in parts], axis=0) / weight
        evidence = np.sum([weight * np.abs(factor) ** 2 for factor, weight in parts], axis=0)
        size = np.where(evidence > gammainccinv(len(parts), chance), np.abs(factor), 0.0)
        text = _describe(factor, size)
        if text:
            pair = output, first.input_names[i]
            remarks.append(Remark(text, omega[used], pair, "nonlinear"))
    return tuple(remarks)


def _describe(
    factor: Complex[np.ndarray, " harmonics"], size: Float[np.ndarray, " harmonics"]
) -> str:
    """What the harmonics of all records together say, of the `size` that noise does not explain."""
    flattened = factor[1].real < -0.5 * np.abs(factor[1])
    bias = max((_CLIPPED if flattened else _BROKEN) * size[1], size[0])
    if not bias > _SMALLEST:
        return ""
    harmonics = [
        f"{100 * share:.2g} % at {name} its frequency"
        for share, name in zip(size, ("twice", "three times"), strict=True)
        if share
    ]
    kind = "a saturation" if flattened else "a deadband or friction"
    kind = kind if size[1] else "an unsymmetric actuator"
    return (
        "the plant is not linear: the residual holds harmonics of the sweep, "
        f"{' and '.join(harmonics)}, as {kind} causes. The gain is biased by about "
        f"{100 * bias:.2g} %, which the error bars do not include, and differs at other "
        "amplitudes. Repeat the sweep at another amplitude, or record what the actuator does (its "
        "position or rpm) as the input"
    )


def tones_of(records: Sequence[Record], i: int, method: Method) -> Tones | None:
    """Of each record, the input's part at the frequency of a sweep, with its phase.

    `None` unless all inputs, or in the joint estimate all references, sweep.
    """
    tones = []
    for record in records:
        count = fast_length(record.samples)
        source = record.inputs[:count, i] if method == "direct" else record.references[:count, i]
        swept = phase_of_sweep(source)
        if swept is None:
            return None
        phase, tone = swept
        tones.append(tone if method == "direct" else _at_phase(record.inputs[:count, i], phase))
    return tones


def phase_of_sweep(signal: Signal) -> tuple[Signal, Tone] | None:
    """The phase in rad, rising, and the part that turns with it, of a tone of slow frequency.

    `None` for other signals: noise, multisines and steps have much power beside such a tone.
    """
    centred = signal - np.mean(signal)
    # The signal without its negative frequencies, doubled; scipy.signal takes 0.4 s to import.
    share = np.zeros(signal.size)
    share[: (signal.size + 1) // 2] = 2.0
    share[0] = 1.0
    if signal.size % 2 == 0:
        share[signal.size // 2] = 1.0
    analytic = np.fft.ifft(share * np.fft.fft(centred))
    size = np.abs(analytic)
    active = np.flatnonzero(size > _ACTIVE * np.max(size))
    first, last = active[0], active[-1] + 1
    turned = np.maximum.accumulate(np.unwrap(np.angle(analytic[first:last])))
    turned = turned + 1e-6 * np.arange(turned.size)  # so that it can be inverted
    if turned[-1] - turned[0] < 2 * np.pi * _FEWEST:
        return None
    # A phase in which the time at each value is the mean over a cycle around it.
    time = np.arange(float(turned.size))
    inner = (turned > turned[0] + np.pi) & (turned < turned[-1] - np.pi)
    smooth = np.interp(time, np.where(inner, _mean_of_cycles(turned, time), time), turned)
    phase = np.pad(smooth, (first, signal.size - last), mode="edge")
    tone = _at_phase(centred, phase)
    left = (centred - np.real(tone))[first:last]
    power = np.sum(centred[first:last] ** 2)
    return (phase, tone) if np.sum(left**2) < (1 - _CONCENTRATED) * power else None


def _at_phase(signal: Signal, phase: Signal) -> Tone:
    """The part of a signal that turns with `phase`: analytic, over two cycles.

    Averages over whole cycles have no response to its harmonics.
    """
    rising = phase + 1e-9 * np.arange(phase.size)
    wave = np.cos(rising) + 1j * np.sin(rising)
    turned = 2 * (signal - np.mean(signal)) * np.conj(wave)
    return _mean_of_cycles(rising, turned, twice=True) * wave


def _mean_of_cycles(phase: Signal, values: Tone | Signal, *, twice: bool = False) -> Tone | Signal:
    """Mean of the values over the cycle around each sample of a rising phase, linear between."""
    step, samples = np.diff(phase), np.arange(float(phase.size))
    low, high = np.maximum(phase - np.pi, phase[0]), np.minimum(phase + np.pi, phase[-1])
    edges = []
    for edge in (low, high):
        before = np.minimum(np.interp(edge, phase, samples).astype(int), step.size - 1)
        edges.append((before, (edge - phase[before]) / step[before]))
    (begin, after_begin), (end, after_end) = edges
    for _ in range(2 if twice else 1):
        area = 0.5 * (values[1:] + values[:-1]) * step
        total = np.concatenate([[0.0], np.cumsum(area)])
        last, first = total[end] + after_end * area[end], total[begin] + after_begin * area[begin]
        values = (last - first) / (high - low)
    return values


def _harmonics(
    record: Record,
    tone: Tone,
    omega: Grid,
    response: Complex[np.ndarray, "frequencies inputs"],
    pair: tuple[int, int],
) -> tuple[Complex[np.ndarray, " harmonics"], Float[np.ndarray, " harmonics"]] | None:
    """The harmonics at the plant's input, relative to its fundamental, and their inverse variance.

    Least squares of the residual's bins on harmonics that have passed the plant; `None` where the
    band holds too few bins.
    """
    output, source = pair
    count = tone.size
    grid = 2 * np.pi / (count * record.dt) * np.arange(count // 2 + 1)
    band = slice(*np.searchsorted(grid, [omega[0], omega[-1]]).tolist())
    if band.stop - band.start < 3 * _TRANSIENT:
        return None
    plant = interpolated(grid[band], omega, response)
    u, y = (
        np.fft.rfft(x[:count], axis=0)[band] for x in (record.inputs, record.outputs[:, output])
    )
    turn = tone / np.maximum(np.abs(tone), 1e-300)
    waves = [np.fft.fft(tone * turn ** (k - 1))[band] / 2 for k in _HARMONICS]
    columns = np.stack([y - np.sum(plant * u, axis=1), *(plant[:, source] * w for w in waves)])
    # Less parabolas through the bins around each (Savitzky, Golay 1964), at the ends the last one.
    half = _TRANSIENT // 2
    powers = np.linspace(-1, 1, _TRANSIENT)[:, None] ** np.arange(3)
    fitted = powers @ np.linalg.pinv(powers)  # from the values in a window to those of its parabola
    windows = np.lib.stride_tricks.sliding_window_view(columns, _TRANSIENT, axis=1)
    first, last = windows[:, 0] @ fitted[:half].T, windows[:, -1] @ fitted[half + 1 :].T
    sharp = columns - np.concatenate([first, windows @ fitted[half], last], axis=1)
    left, harmonics = sharp[0], sharp[1:]
    noise = np.maximum(local_mean(np.abs(left) ** 2, band.start), 1e-300)
    weight = np.maximum(np.sum(np.abs(harmonics) ** 2 / noise, axis=1), 1e-300)
    return np.sum(np.conj(harmonics) * left / noise, axis=1) / weight, weight


def fast_length(samples: int) -> int:
    """The longest length of at most `samples` with a fast Fourier transform."""
    from scipy.fft import next_fast_len

    return next(n for n in range(samples, 0, -1) if next_fast_len(n, real=True) == n)


def interpolated(
    grid: Bins, omega: Grid, response: Complex[np.ndarray, "frequencies inputs"]
) -> Complex[np.ndarray, "bins inputs"]:
    """Smooth in magnitude and phase along log frequency.

    Across a wide gap a spline may leave its points by hundreds of nepers, so it is limited to the
    neighbourhood of these.
    """
    from scipy.interpolate import CubicSpline

    size, angle = np.log(np.abs(response)), np.unwrap(np.angle(response), axis=0)
    spline = CubicSpline(np.log(omega), size + 1j * angle)(np.log(grid))
    low, high = np.min(size, axis=0) - _BEYOND, np.max(size, axis=0) + _BEYOND
    spline.real = np.clip(spline.real, low, high)
    return np.exp(spline)


def local_mean(power: Bins, first: int) -> Bins:
    """Over the bins within a tenth of their number on either side."""
    place = np.arange(power.size)
    reach = np.maximum(_NEAREST, (_NEAR * (first + place)).astype(int))
    low, high = np.maximum(place - reach, 0), np.minimum(place + reach + 1, power.size)
    total = np.concatenate([[0.0], np.cumsum(power)])
    return (total[high] - total[low]) / (high - low)
