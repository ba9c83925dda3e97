"""Signs in the residual of any excitation that a plant is not linear, or not constant.

A static nonlinearity in front of the plant adds f(u) to its input, a plant that changes adds
(t - mean) u. What the local linear model does not explain of these is looked for in the residual,
both taken back through the identified response to the plant's input.

While a sweep passes w(t), a linear plant answers at w(t) only; a static nonlinearity also at 2 w(t)
and 3 w(t). These harmonics have the phase of the input, multiplied, so they are looked for in the
residual as signals with an unknown factor, which noise seldom imitates.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int, Real

from jaxquad.records import Record

from ._estimators import COHERENT, Grid, in_hertz, Method, Remark, Response, sums_between
from ._frequency_response import Estimate


FEWEST = 8  # points between which the response is interpolated
_CLEAR = 6.0  # standard errors from which a remark is made; linear records reached 3.3 and 4.4
_SMALLEST = 0.05  # change of the gain from which a remark is made
_DISTINCT_STATIC, _DISTINCT_CHANGE = 0.005, 0.1  # share of a signal that no linear model explains
_POWERS = 3  # coefficients of what is smooth over a block
_MOVED = 32  # bins over which the response of an input to the references is smooth
_PER_COLUMN = 8  # excited bins of a block for each coefficient of the response
_SPARE = 6  # bins of a block beyond all coefficients
_EXCITED = 0.1  # of the mean power nearby
_FLOOR = 1e-20  # of the power of what is looked for: below it lies rounding
_SMOOTH, _ALONE = 0.1, 1e-6  # in ln(omega); of its square, to the scatter of points nearby
_MORE = 4.0  # standard errors by which a second signal must add to the first
_SMALL, _LARGE, _NEGATIVE = 20, 95, 5  # percentiles of the commands at which gains are compared
_POWER = 1, 2, 1  # of x in the gains of v |v|, v^3, v^2, with x = |v|, |v|, v
_DEPENDENT = 1e-3  # smallest singular value: dlnG/dln(omega) of an integrator is constant
_PLACES, _EXACT = 64, 1e-9  # samples compared first; of the largest value

_HARMONICS = (2, 3)
_CHANCE = 5e-3  # of a remark on a linear record
_SMALLEST_BIAS = 0.02  # bias of the gain from which a remark is made
# Change of the gain over the third harmonic, by Fourier series: 2.4 to 2.9 for a deadband of 5 to
# 20 %, 3 for friction and for a cubic.
_BROKEN = 2.8
# The third harmonic, and the loss of gain, where peaks are cut off at 1 to .4 of the amplitude.
_THIRDS = 0.0, 0.033, 0.082, 0.133, 0.182, 0.226, 0.264
_LOSSES = 0.0, 0.037, 0.104, 0.188, 0.285, 0.391, 0.505
_CONCENTRATED = 0.9  # share of a sweep's power at its own frequency
_CYCLES = 6.0  # cycles of a sweep
_ACTIVE = 0.1  # of the largest amplitude
_TRANSIENT = 21  # bins over which a transient of the record's ends is smooth
_NEAR, _NEAREST = 0.1, 10  # bins on either side over which the noise is averaged: share, at least
_BEYOND = 1.0  # neper, of the points between which a response is interpolated

Signal = Float[np.ndarray, " samples"]
Tone = Complex[np.ndarray, " samples"]
Bins = Float[np.ndarray, " bins"]
Columns = Complex[np.ndarray, "bins columns"]
OfInputs = Complex[np.ndarray, "frequencies inputs"]


def remarks_on_linearity(
    records: Sequence[Record], method: Method, estimate: Estimate
) -> tuple[Remark, ...]:
    """Remarks on pairs that are not linear, or not constant; of a sweep these are its harmonics."""
    remarks, first, omega = [], records[0], estimate.omega
    finite = np.isfinite(estimate.response).all(axis=2)
    for i, source in enumerate(first.input_names):
        usable = finite & (estimate.coherence[:, :, i] >= COHERENT)
        outputs = [o for o in range(usable.shape[1]) if np.sum(usable[:, o]) >= FEWEST]
        if not outputs:
            continue
        # The input's part at the frequency of a sweep, if all that moves it sweeps.
        tones = []
        for record in records:
            u = record.inputs[: fast_length(record.samples), i]
            swept = phase_of_sweep(u if method == "direct" else record.references[: u.size, i])
            if swept is None:
                tones = []
                break
            tones.append(swept[1] if method == "direct" else _at_phase(u, swept[0]))
        scale = float(np.sqrt(np.mean([np.var(record.inputs[:, i]) for record in records])))
        spectra = [] if tones else [Spectra.of(record, i, method, scale) for record in records]
        for o in outputs:
            pair, used = (first.output_names[o], source), usable[:, o]
            measured = omega[used], estimate.response[used, o], (o, i)
            if tones:
                chance = _CHANCE / (len(_HARMONICS) * estimate.response[0].size)
                texts = {"nonlinear": _say_harmonics(records, tones, *measured, chance)}
            elif left := left_over(spectra, *measured):
                v = np.concatenate([part.input for part in spectra]) / scale
                static = _say_static(left, v)
                # `Periodic` suits an excitation that repeats.
                moving = [x.inputs if method == "direct" else x.references for x in records]
                if static and (period := period_of(moving)):
                    few = min(record.samples for record in records) // period <= 2
                    settings = f"{period * first.dt:.8g}{', discard=0' if few else ''}"
                    static += (
                        f". The excitation repeats: jq.spectra.Periodic({settings}) tells noise "
                        "from distortion"
                    )
                texts = {"nonlinear": static, "changing": _say_change(left, omega[used], method)}
            else:
                continue
            remarks += [
                Remark(text, omega[used], pair, kind) for kind, text in texts.items() if text
            ]
    return tuple(remarks)


class Spectra(NamedTuple):
    """Transforms of one record, and the part of the input that moves it."""

    grid: Bins  # rad/s
    moving: Columns  # inputs, or references
    inputs: Columns
    outputs: Columns
    added: Columns  # u |u|, u^3, u^2, t u, each of the size of u
    input: Signal  # u, without what noise adds to it in a joint estimate

    @classmethod
    def of(cls, record: Record, i: int, method: Method, scale: float) -> "Spectra":
        count = fast_length(record.samples)
        inputs, outputs = (
            transform_bins(record.inputs[:count]),
            transform_bins(record.outputs[:count]),
        )
        moving = inputs if method == "direct" else transform_bins(record.references[:count])
        u = record.inputs[:count, i] - np.mean(record.inputs[:count, i])
        if method == "joint":  # less what neither the references nor a transient explain
            moved = np.empty_like(inputs[:, i])
            blocks = max(moved.size // (_MOVED * moving.shape[1]), 1)
            for block in np.array_split(np.arange(moved.size), blocks):
                basis = _basis(moving[block], np.zeros(block.size, int), block)
                moved[block] = basis @ (np.conj(basis.T) @ inputs[block, i])
            u = np.fft.irfft(moved, count) * np.sqrt(count)
        v, time = u / scale, np.linspace(-1.0, 1.0, count)
        added = np.stack([u * np.abs(v), u * v**2, u * v, u * time]).T
        grid = 2 * np.pi / (count * record.dt) * np.arange(len(inputs))
        return cls(grid, moving, inputs, outputs, transform_bins(added), u)


def transform_bins(columns: Float[np.ndarray, "samples columns"]) -> Columns:
    rows = np.ascontiguousarray(columns.T)
    rows = rows - np.mean(rows, axis=1, keepdims=True)
    return np.fft.rfft(rows).T / np.sqrt(len(columns))


def _basis(
    moving: Columns, record: Int[np.ndarray, " bins"], place: Real[np.ndarray, " bins"]
) -> Complex[np.ndarray, "bins functions"]:
    """Orthonormal columns: what moves, and a transient of each record, times smooth functions."""
    span = max(float(np.ptp(place)), 1e-300)
    smooth = (2 * (place - np.mean(place)) / span)[:, None] ** np.arange(_POWERS)
    owner = record[:, None] == np.unique(record)
    parts = [(factors[:, :, None] * smooth[:, None, :]) for factors in (moving, owner)]
    columns = np.concatenate([part.reshape(place.size, -1) for part in parts], axis=1)
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.linalg.qr(columns / size)[0]


class LeftOver(NamedTuple):
    """What the local linear model leaves, at the plant's input, of all records and blocks."""

    residual: Complex[np.ndarray, " bins"]
    added: Columns  # the signals looked for: u |u|, u^3, u^2, t u, t u dlnG/dln(omega)
    leverage: Bins  # of the local linear model
    weight: Bins  # inverse variance of the residual
    share: Float[np.ndarray, " columns"]  # of these signals' power
    slope: Response  # dlnG/dln(omega)


def left_over(
    spectra: Sequence[Spectra], omega: Grid, response: OfInputs, pair: tuple[int, int]
) -> LeftOver | None:
    """`None` where no block has more bins than the local linear model has coefficients."""
    # dlnG/dln(omega), by straight lines through the points nearby; 0 where there are none.
    place, one, parts = np.log(omega), response[:, pair[1]], []
    logs = np.log(np.abs(one)) + 1j * np.unwrap(np.angle(one))
    offset = place - place[:, None]
    kernel = np.exp(-0.5 * (offset / _SMOOTH) ** 2)
    m0, m1, m2 = (np.sum(kernel * offset**k, axis=1) for k in range(3))
    spread, pull = m0 * m2 - m1**2, m0 * ((kernel * offset) @ logs) - m1 * (kernel @ logs)
    alone = spread <= _ALONE * (m0 * _SMOOTH) ** 2
    slope = np.where(alone, 0.0, pull / np.where(alone, 1.0, spread))
    for index, part in enumerate(spectra):
        first, last = np.searchsorted(part.grid, [omega[0], omega[-1]])
        band = slice(max(int(first), 1), int(last))
        grid = part.grid[band]
        plant = interpolated(grid, omega, response)
        modelled = np.sum(plant * part.inputs[band], axis=1)
        residual = (part.outputs[band, pair[0]] - modelled) / plant[:, pair[1]]
        steep = np.interp(np.log(grid), place, slope)[:, None]
        added = np.hstack([part.added[band], part.added[band, -1:] * steep])
        owner = np.full(residual.size, index)
        parts.append((grid, owner, part.moving[band], residual, added))
    joined = [np.concatenate(part) for part in zip(*parts, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    grid, owner, moving, residual, added = (part[order] for part in joined)
    rests, both = [], np.column_stack([residual, added])
    if grid.size:  # blocks of neighbouring bins with about equally many that the input excites
        power = np.sum(np.abs(moving) ** 2 / np.mean(np.abs(moving) ** 2, axis=0), axis=1)
        excited = np.cumsum(power > _EXCITED * local_mean(power, 0))
        count = max(int(excited[-1]) // (_PER_COLUMN * _POWERS * moving.shape[1]), 1)
        ends = np.searchsorted(excited, np.linspace(0, excited[-1], count + 1)[1:-1])
        for block in np.split(np.arange(grid.size), ends):
            basis = _basis(moving[block], owner[block], grid[block])
            if block.size < basis.shape[1] + _SPARE:
                continue
            left = both[block] - basis @ (np.conj(basis.T) @ both[block])
            leverage = np.minimum(np.sum(np.abs(basis) ** 2, axis=1), 0.9)
            noise = np.mean(np.abs(left[:, 0]) ** 2 / (1 - leverage))
            noise += _FLOOR * np.mean(np.abs(added[block]) ** 2) + 1e-280
            rests.append((left, leverage, np.full(block.size, 1 / noise), added[block]))
    if not rests:
        return None
    left, leverage, weight, added = (np.concatenate(part) for part in zip(*rests, strict=True))
    powers = [np.sum(np.abs(part) ** 2, axis=0) for part in (left[:, 1:], added)]
    share = powers[0] / np.maximum(powers[1], 1e-300)
    return LeftOver(left[:, 0], left[:, 1:], leverage, weight, share, slope)


def factors_of(left: LeftOver, columns: Columns) -> tuple[np.ndarray, np.ndarray, float]:
    """Real factors of columns in the residual, their covariance, and their size in standard errors.

    The covariance is that of residuals of any variance (MacKinnon and White, 1985, HC3).
    """
    weighted = np.conj(columns) * left.weight[:, None]
    inverse = np.linalg.inv(np.real(weighted.T @ columns))
    value = inverse @ np.real(weighted.T @ left.residual)
    leverage = np.real(np.sum((weighted @ inverse) * columns, axis=1)) / 2
    rest = (left.residual - columns @ value) / (1 - np.minimum(left.leverage + leverage, 0.9))
    score = np.real(weighted * rest[:, None]) @ inverse
    covariance = score.T @ score
    return value, covariance, float(np.sqrt(value @ np.linalg.solve(covariance, value)))


def _say_static(left: LeftOver, v: Signal) -> str:
    """What functions of the command v, of unit size, say of the gain."""

    def gains(columns: list[int], x: Signal, low: int, high: int) -> tuple[float, float, float]:
        """At two percentiles of x, relative to the response, and how clear; 1 where it is not."""
        if np.min(left.share[columns]) < _DISTINCT_STATIC:
            return 1.0, 1.0, 0.0
        added = left.added[:, columns]
        value, _, clear = factors_of(left, added)
        if clear < _CLEAR or clear < 2 * factors_of(left, 1j * added)[2]:
            return 1.0, 1.0, 0.0
        powers = [_POWER[column] for column in columns]
        mean = [np.sum(x**power * v**2) / np.sum(v**2) for power in powers]
        ends = np.percentile(x, [low, high])[:, None] ** powers - mean
        low_gain, high_gain = np.maximum(1 + ends @ value, 0.0).tolist()
        return low_gain, high_gain, clear

    # By v |v|, v^3, or both where these explain more.
    first, second = (gains([column], np.abs(v), _SMALL, _LARGE) for column in (0, 1))
    odd, texts = first if first[2] > second[2] else second, []
    if odd[2]:
        both = gains([0, 1], np.abs(v), _SMALL, _LARGE)
        odd = both if both[2] ** 2 > odd[2] ** 2 + _MORE**2 else odd
    low, high, _ = odd
    if abs(high - low) / max(high, low) > _SMALLEST:
        where = "the largest commands to small ones, as a deadband or friction causes"
        if high < low:
            where = (
                "small commands to the largest, as a saturation causes, or noise in the measured "
                "input"
            )
        change = 100 * abs(high - low) / max(high, low)
        texts.append(f"falls by about {change:.2g} % from {where}")
    low, high, _ = gains([2], v, _NEGATIVE, _LARGE)
    if abs(high - low) / max(high, low) > _SMALLEST:
        side, change = "smaller" if high < low else "larger", 100 * abs(high - low) / max(high, low)
        texts.append(f"is about {change:.2g} % {side} for positive commands than for negative ones")
    if not texts:
        return ""
    return (
        f"the plant is not linear: its gain {' and '.join(texts)}. The error bars do not include "
        "this. Log what the actuator does (its position or rpm) as the input, or identify at the "
        "amplitudes of use"
    )


def period_of(signals: Sequence[Float[np.ndarray, "_samples sources"]]) -> int:
    """Samples of the shortest period, of two at least, of all signals; 0 without one."""
    most = min(len(signal) for signal in signals) // 2
    lags, first = np.arange(4, most + 1), signals[0]
    near = _EXACT * max(float(np.max(np.abs(signal))) for signal in signals)
    for place in np.linspace(0, len(first) - most - 1, _PLACES).astype(int):
        lags = lags[np.all(np.abs(first[place + lags] - first[place]) <= near, axis=1)]
    for lag in lags.tolist():
        if all(np.all(np.abs(x[lag:] - x[:-lag]) <= near) for x in signals):
            return lag
    return 0


def _say_change(left: LeftOver, omega: Grid, method: Method) -> str:
    """What the input times time says of the response, in magnitude and phase."""
    if left.share[3] < _DISTINCT_CHANGE:
        return ""
    columns = np.hstack([left.added[:, 3:], 1j * left.added[:, 3:]])
    # Combinations of the columns that differ, of equal size.
    weighted = columns * np.sqrt(left.weight)[:, None]
    real = np.concatenate([np.real(weighted), np.imag(weighted)])
    _, strength, turned = np.linalg.svd(real, full_matrices=False)
    distinct = strength > _DEPENDENT * strength[0]
    distinct = turned[distinct].T / strength[distinct]
    value, covariance, clear = factors_of(left, columns @ distinct)
    if not clear > _CLEAR:
        return ""
    # Of t, from -1 to 1, the mean in the second half is 1 more than that in the first.
    gains = np.stack([np.ones_like(left.slope), left.slope], axis=1)
    rows = np.hstack([gains, 1j * gains]) @ distinct
    change = np.abs(rows @ value)
    doubt = np.real(np.sum((rows @ covariance) * np.conj(rows), axis=1))
    at = int(np.argmax(change / np.sqrt(doubt)))
    if not change[at] > _SMALLEST:
        return ""
    loop = "; in a closed loop, name a reference («references=»)" if method == "direct" else ""
    return (
        f"the response changes during the record: by about {100 * change[at]:.2g} % "
        f"near {in_hertz(omega[[at]])} from its first half to its second, which the error bars "
        f"do not include. Identify the parts by themselves («start=», «stop=»){loop}"
    )


def _say_harmonics(
    records: Sequence[Record],
    tones: Sequence[np.ndarray],
    omega: Grid,
    response: OfInputs,
    pair: tuple[int, int],
    chance: float,
) -> str:
    """What the residual's harmonics of an input, whose parts are `tones`, say of the gain."""
    from scipy.special import gammainccinv

    parts, (output, source) = [], pair
    # The harmonics at the plant's input, relative to its fundamental, and their inverse variance:
    # least squares of the residual's bins on harmonics that have passed the plant.
    for record, tone in zip(records, tones, strict=True):
        count = tone.size
        grid = 2 * np.pi / (count * record.dt) * np.arange(count // 2 + 1)
        band = slice(*np.searchsorted(grid, [omega[0], omega[-1]]).tolist())
        if band.stop - band.start < 3 * _TRANSIENT:
            continue
        plant = interpolated(grid[band], omega, response)
        u, y = (
            np.fft.rfft(x[:count], axis=0)[band] for x in (record.inputs, record.outputs[:, output])
        )
        turn = tone / np.maximum(np.abs(tone), 1e-300)
        waves = [np.fft.fft(tone * turn ** (k - 1))[band] / 2 for k in _HARMONICS]
        columns = np.stack([y - np.sum(plant * u, axis=1), *(plant[:, source] * w for w in waves)])
        # Less parabolas through the bins around each (Savitzky, Golay 1964); at the ends the last.
        half = _TRANSIENT // 2
        powers = np.linspace(-1, 1, _TRANSIENT)[:, None] ** np.arange(3)
        fitted = powers @ np.linalg.pinv(powers)  # from a window's values to its parabola's
        windows = np.lib.stride_tricks.sliding_window_view(columns, _TRANSIENT, axis=1)
        first, last = windows[:, 0] @ fitted[:half].T, windows[:, -1] @ fitted[half + 1 :].T
        sharp = columns - np.concatenate([first, windows @ fitted[half], last], axis=1)
        left, harmonics = sharp[0], sharp[1:]
        noise = np.maximum(local_mean(np.abs(left) ** 2, band.start), 1e-300)
        weight = np.maximum(np.sum(np.abs(harmonics) ** 2 / noise, axis=1), 1e-300)
        factor = np.sum(np.conj(harmonics) * left / noise, axis=1) / weight
        parts.append((factor, weight))
    if not parts:
        return ""
    weight = np.sum([weight for _, weight in parts], axis=0)
    factor = np.sum([weight * factor for factor, weight in parts], axis=0) / weight
    evidence = np.sum([weight * np.abs(factor) ** 2 for factor, weight in parts], axis=0)
    size = np.where(evidence > gammainccinv(len(parts), chance), np.abs(factor), 0.0)
    flattened = factor[1].real < -0.5 * np.abs(factor[1])
    change = float(np.interp(size[1], _THIRDS, _LOSSES)) if flattened else _BROKEN * size[1]
    bias = max(change, size[0])
    if not bias > _SMALLEST_BIAS:
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


def phase_of_sweep(signal: Signal) -> tuple[Signal, Tone] | None:
    """The rising phase and the part of a tone of slow frequency; `None` of other signals."""
    centred = signal - np.mean(signal)
    # The signal without its negative frequencies, doubled; scipy.signal takes 0.4 s to import.
    share = np.where(np.arange(signal.size) < (signal.size + 1) // 2, 2.0, 0.0)
    share[[0, *([signal.size // 2] if signal.size % 2 == 0 else [])]] = 1.0
    analytic = np.fft.ifft(share * np.fft.fft(centred))
    size = np.abs(analytic)
    active = np.flatnonzero(size > _ACTIVE * np.max(size))
    first, last = active[0], active[-1] + 1
    turned = np.maximum.accumulate(np.unwrap(np.angle(analytic[first:last])))
    turned = turned + 1e-6 * np.arange(turned.size)  # so that it can be inverted
    if turned[-1] - turned[0] < 2 * np.pi * _CYCLES:
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
    """The analytic part that turns with `phase`: averages over whole cycles pass no harmonics."""
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


def fast_length(samples: int) -> int:
    """The longest length of at most `samples` with a fast Fourier transform."""
    from scipy.fft import next_fast_len

    return next(n for n in range(samples, 0, -1) if next_fast_len(n, real=True) == n)


def interpolated(grid: Bins, omega: Grid, response: OfInputs) -> Complex[np.ndarray, "bins inputs"]:
    """Smooth in magnitude and phase along log frequency, within limits of the points."""
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
    return sums_between(power, low, high) / (high - low)
