"""Harmonics of a sweep in the residual: a sign of a deadband, a saturation or another nonlinearity.

While a sweep passes w(t), a linear plant answers at w(t) only; a static nonlinearity also at 2 w(t)
and 3 w(t). These harmonics have the phase of the input, multiplied, so they are looked for in the
residual as known signals with an unknown factor, which noise seldom imitates.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from jaxquad.records import Record

from ._remarks import Remark


_HARMONICS = (2, 3)
_CHANCE = 5e-3  # of a remark on a linear record
_SMALLEST = 0.02  # bias of the gain from which a remark is made
# Change of the gain over the third harmonic, by Fourier series: 2.4 to 2.9 for a deadband of 5 to
# 20 %, 3 for friction and for a cubic; 1.1 to 1.4 where the peaks are cut off by 5 to 30 %.
_BROKEN, _CLIPPED = 2.8, 1.3
_COHERENT = 0.6  # of points between which the response is interpolated

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
    first, remarks = records[0], []
    chance = _CHANCE / (len(_HARMONICS) * response.shape[1] * response.shape[2])
    for o, output in enumerate(first.output_names):
        used = np.isfinite(response[:, o]).all(axis=1) & (coherence[:, o, i] >= _COHERENT)
        if np.sum(used) < 8:
            continue
        found = [
            _harmonics(record, tone, omega[used], response[used][:, o], (o, i))
            for record, tone in zip(records, tones, strict=True)
        ]
        text = _describe([part for part in found if part is not None], chance)
        remarks += [Remark(text, omega[used], (output, first.input_names[i]))] if text else []
    return tuple(remarks)


def _describe(parts: Sequence["Harmonics"], chance: float) -> str | None:
    """What the harmonics of all records together say; `None` where noise explains them."""
    from scipy.special import gammainccinv

    if not parts:
        return None
    weight = np.sum([part.weight for part in parts], axis=0)
    factor = np.sum([part.weight * part.factor for part in parts], axis=0) / weight
    evidence = np.sum([part.weight * np.abs(part.factor) ** 2 for part in parts], axis=0)
    clear = evidence > gammainccinv(len(parts), chance)
    size = np.where(clear, np.abs(factor), 0.0)
    flattened = factor[1].real < -0.5 * np.abs(factor[1])
    bias = max((_CLIPPED if flattened else _BROKEN) * size[1], size[0])
    if not bias > _SMALLEST:
        return None
    found = [
        f"{100 * share:.2g} % at {name} its frequency"
        for share, name in zip(size, ("twice", "three times"), strict=True)
        if share
    ]
    kind = "a saturation" if flattened else "a deadband or friction"
    kind = kind if size[1] else "an unsymmetric actuator"
    return (
        "the plant is not linear: the residual holds harmonics of the sweep, "
        f"{' and '.join(found)}, as {kind} causes. The gain is biased by about {100 * bias:.2g} %, "
        "which the error bars do not include, and differs at other amplitudes. Repeat the sweep at "
        "another amplitude, or record what the actuator does (its position or rpm) as the input"
    )


_CONCENTRATED = 0.9  # share of a sweep's power at its own frequency
_FEWEST = 6.0  # cycles of a sweep
_ACTIVE = 0.1  # of the largest amplitude


def tones_of(records: Sequence[Record], i: int, method: Literal["direct", "joint"]) -> Tones | None:
    """Of each record, the input's part at the frequency of a sweep, with its phase.

    `None` unless all inputs, or in the joint estimate all references, sweep.
    """
    tones = [_tone_of(record, i, method) for record in records]
    found = [tone for tone in tones if tone is not None]
    return found if len(found) == len(tones) else None


def _tone_of(record: Record, i: int, method: Literal["direct", "joint"]) -> Tone | None:
    count = fast_length(record.samples)
    source = record.inputs[:count, i] if method == "direct" else record.references[:count, i]
    swept = phase_of_sweep(source)
    if swept is None:
        return None
    return swept.tone if method == "direct" else _at_phase(record.inputs[:count, i], swept.phase)


class Swept(NamedTuple):
    """A signal that is a tone of slowly changing frequency, and its phase in rad, rising."""

    phase: Signal
    tone: Tone


def phase_of_sweep(signal: Signal) -> Swept | None:
    """`None` for other signals: noise, multisines and steps have much power beside such a tone."""
    centred = signal - np.mean(signal)
    analytic = _analytic(centred)
    size = np.abs(analytic)
    active = np.flatnonzero(size > _ACTIVE * np.max(size))
    first, last = active[0], active[-1] + 1
    turned = np.maximum.accumulate(np.unwrap(np.angle(analytic[first:last])))
    turned = turned + 1e-6 * np.arange(turned.size)  # so that it can be inverted
    if turned[-1] - turned[0] < 2 * np.pi * _FEWEST:
        return None
    phase = np.pad(_smooth_phase(turned), (first, signal.size - last), mode="edge")
    tone = _at_phase(centred, phase)
    left = (centred - np.real(tone))[first:last]
    power = np.sum(centred[first:last] ** 2)
    return Swept(phase, tone) if np.sum(left**2) < (1 - _CONCENTRATED) * power else None


def _analytic(signal: Signal) -> Tone:
    """The signal without its negative frequencies, doubled; scipy.signal takes 0.4 s to import."""
    share = np.zeros(signal.size)
    share[: (signal.size + 1) // 2] = 2.0
    share[0] = 1.0
    if signal.size % 2 == 0:
        share[signal.size // 2] = 1.0
    return np.fft.ifft(share * np.fft.fft(signal))


def _smooth_phase(phase: Signal) -> Signal:
    """A phase in which the time at each value is the mean over a cycle around it."""
    time = np.arange(float(phase.size))
    mean = _Cycles.around(phase).mean(time)
    inner = (phase > phase[0] + np.pi) & (phase < phase[-1] - np.pi)
    return np.interp(time, np.where(inner, mean, time), phase)


def _at_phase(signal: Signal, phase: Signal) -> Tone:
    """The part of a signal that turns with `phase`: analytic, over two cycles.

    Averages over whole cycles have no response to its harmonics.
    """
    rising = phase + 1e-9 * np.arange(phase.size)
    wave, cycles = np.cos(rising) + 1j * np.sin(rising), _Cycles.around(rising)
    turned = 2 * (signal - np.mean(signal)) * np.conj(wave)
    return cycles.mean(cycles.mean(turned)) * wave


class _Cycles(NamedTuple):
    """The cycle around each sample of a rising phase: where it begins and ends, linearly between.

    `low` and `high` are samples, `rest_low` and `rest_high` the shares of a step beyond them.
    """

    step: Signal  # rad
    width: Signal  # rad; less than a cycle at the ends
    low: Int[np.ndarray, " samples"]
    rest_low: Signal
    high: Int[np.ndarray, " samples"]
    rest_high: Signal

    @classmethod
    def around(cls, phase: Signal) -> "_Cycles":
        step = np.diff(phase)
        low, high = np.maximum(phase - np.pi, phase[0]), np.minimum(phase + np.pi, phase[-1])
        samples = np.arange(float(phase.size))
        places = []
        for edge in (low, high):
            place = np.interp(edge, phase, samples)
            whole = np.minimum(place.astype(int), step.size - 1)
            places += [whole, (edge - phase[whole]) / step[whole]]
        return cls(step, high - low, *places)

    def mean(self, values: Tone | Signal) -> Tone | Signal:
        area = 0.5 * (values[1:] + values[:-1]) * self.step
        total = np.concatenate([[0.0], np.cumsum(area)])
        end = total[self.high] + self.rest_high * area[self.high]
        begin = total[self.low] + self.rest_low * area[self.low]
        return (end - begin) / self.width


_TRANSIENT = 21  # bins over which a transient of the record's ends is smooth
_NEAR, _NEAREST = 0.1, 10  # bins on either side over which the noise is averaged: share, at least


class Harmonics(NamedTuple):
    """What one record says of the harmonics at the plant's input, relative to its fundamental."""

    factor: Complex[np.ndarray, " harmonics"]
    weight: Float[np.ndarray, " harmonics"]  # inverse variance


def _harmonics(
    record: Record,
    tone: Tone,
    omega: Grid,
    response: Complex[np.ndarray, "frequencies inputs"],
    pair: tuple[int, int],
) -> Harmonics | None:
    """Least squares of the residual's bins on harmonics that have passed the plant.

    `None` where the band holds too few bins.
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
    sharp = columns - _smooth(columns)
    left, seen = sharp[0], sharp[1:]
    noise = np.maximum(local_mean(np.abs(left) ** 2, band.start), 1e-300)
    weight = np.maximum(np.sum(np.abs(seen) ** 2 / noise, axis=1), 1e-300)
    return Harmonics(np.sum(np.conj(seen) * left / noise, axis=1) / weight, weight)


def _smooth(
    columns: Complex[np.ndarray, "columns bins"],
) -> Complex[np.ndarray, "columns bins"]:
    """Parabolas through the bins around each (Savitzky, Golay 1964), at the ends the last one."""
    half = _TRANSIENT // 2
    powers = np.linspace(-1, 1, _TRANSIENT)[:, None] ** np.arange(3)
    fitted = powers @ np.linalg.pinv(powers)  # from the values in a window to those of its parabola
    windows = np.lib.stride_tricks.sliding_window_view(columns, _TRANSIENT, axis=1)
    inner = windows @ fitted[half]
    first, last = windows[:, 0] @ fitted[:half].T, windows[:, -1] @ fitted[half + 1 :].T
    return np.concatenate([first, inner, last], axis=1)


def fast_length(samples: int) -> int:
    """The longest length of at most `samples` with a fast Fourier transform."""
    from scipy.fft import next_fast_len

    return next(n for n in range(samples, 0, -1) if next_fast_len(n, real=True) == n)


_BEYOND = 1.0  # neper, of the points between which a response is interpolated


def interpolated(
    grid: Bins, omega: Grid, response: Complex[np.ndarray, "frequencies inputs"]
) -> Complex[np.ndarray, "bins inputs"]:
    """Smooth in magnitude and phase along log frequency.

    Across a wide gap a spline may leave its points by hundreds of nepers, so it is held near them.
    """
    from scipy.interpolate import CubicSpline

    size, angle = np.log(np.abs(response)), np.unwrap(np.angle(response), axis=0)
    found = CubicSpline(np.log(omega), size + 1j * angle)(np.log(grid))
    low, high = np.min(size, axis=0) - _BEYOND, np.max(size, axis=0) + _BEYOND
    found.real = np.clip(found.real, low, high)
    return np.exp(found)


def local_mean(power: Bins, first: int) -> Bins:
    place = np.arange(power.size)
    reach = np.maximum(_NEAREST, (_NEAR * (first + place)).astype(int))
    low, high = np.maximum(place - reach, 0), np.minimum(place + reach + 1, power.size)
    total = np.concatenate([[0.0], np.cumsum(power)])
    return (total[high] - total[low]) / (high - low)
