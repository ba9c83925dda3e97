"""What takes part in a record beside its input: another clock, another signal; and when a sweep has
each of its frequencies.

**Clocks**: whether the outputs' time stamps run at another rate than those of the other signals. A
controller makes the inputs of the references and the outputs, with hardly any noise of its own:
u = A r + C y. Where the outputs' stamps gain a share e of the time, u keeps e C (t dy/dt). A sweep
alone cannot tell this from a delay; what else moves the loop excites C all the time.

**Signals**, such as another axis' command. At the plant's input, the residual of the local linear
model holds h W, where W is what that model does not explain of the other signal: so far as it moves
with the input, both are one. h is smooth: complex, and linear in the logarithm of frequency. Its
four factors are tested together.
Source: Bendat and Piersol, "Random Data", 4th ed., ch. 7 (partial coherence).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad.records import Record

from ._estimators import COHERENT, Grid, Method, power_of, Remark, sums_between
from ._frequency_response import Estimate, FrequencyResponse
from ._linearity import factors_of, fast_length, FEWEST, left_over, Spectra, transform_bins


_CLEAR = 6.0  # standard errors from which a remark is made
_OTHER = 3.0  # times what is found in quadrature, as a controller leaves whose gain changes
_BLOCK, _POWERS = 24, 3  # bins for each signal, over which A and C are smooth; their coefficients
_DISTINCT = 1e-5  # share of the signal looked for that no controller explains
_MOST = 0.01  # drift of a clock, as a share of the time
_NEAR = 0.05  # of a frequency, over which the time of its power is averaged
_BRIEF = 0.2  # of a sweep's length, within which it passes a frequency
_NOTHING = 1e-12  # of the largest power: between the lines of an excitation that repeats
_FLOOR = 1e-20  # of the input's power: below it lies rounding


def remarks_on_clock(records: Sequence[Record], estimate: Estimate) -> tuple[Remark, ...]:
    """A remark on outputs whose stamps drift by more than the random error of a delay."""
    usable = np.isfinite(estimate.response) & (estimate.coherence >= COHERENT)
    omega = estimate.omega[np.any(usable, axis=(1, 2))]
    if omega.size < FEWEST:
        return ()
    parts = [part for record in records for part in _compare(record, omega[0], omega[-1])]
    if not parts:
        return ()
    left, drift, power, leverage = (np.concatenate(part) for part in zip(*parts, strict=True))
    size = np.sum(np.abs(drift) ** 2)
    if not size > _DISTINCT * np.sum(power):
        return ()
    value = complex(np.sum(np.conj(drift) * left) / size)
    rate, seconds = value.real, max(record.samples for record in records) * records[0].dt
    # Of residuals of any variance (MacKinnon and White, 1985, HC3).
    scores = np.real(np.conj(drift) * (left - value * drift)) / (1 - leverage)
    clear = abs(rate) * size > _CLEAR * max(float(np.sqrt(np.sum(scores**2))), 1e-300)
    error = np.where(usable, estimate.random_error, np.inf)
    precision = np.sum((estimate.omega[:, None, None] / error) ** 2, axis=0)  # inverse variances
    late = rate * seconds
    if not (clear and _OTHER * abs(value.imag) < abs(rate) < _MOST):
        return ()
    if not (0.5 * late) ** 2 * np.max(precision) > 1:
        return ()
    text = (
        f"the output's time stamps drift against the input's by {1e6 * rate:+.2g} ppm, "
        f"{1e3 * late:+.2g} ms in {seconds:.3g} s: so the controller's answer to the output says. "
        "The delay is wrong by up to as much, which the error bars do not include. Stamp both by "
        f"one clock, or divide the output's times by {1 + rate:.7g}"
    )
    return (Remark(text, kind="clock"),)


def _compare(record: Record, low: float, high: float) -> list[tuple[np.ndarray, ...]]:
    """By blocks of bins: what no controller explains of the inputs, and of what a drift of 1 adds
    to them; the power of this, before; the leverage. All relative to the noise of the block."""
    count, parts = fast_length(record.samples), []
    grid = 2 * np.pi / (count * record.dt) * np.arange(count // 2 + 1)
    first, last = np.searchsorted(grid, [low, high])
    band, y = slice(max(int(first), 1), int(last)), record.outputs[:count]
    time = np.linspace(-0.5, 0.5, count)[:, None] * count  # in samples
    commands, moving, gained = (
        transform_bins(x)[band]
        for x in (
            record.inputs[:count],
            np.hstack([y, record.references[:count]]),
            time * np.gradient(y, axis=0),
        )
    )
    columns = moving.shape[1] + 1  # with a transient
    for block in np.array_split(
        np.arange(len(commands)), max(len(commands) // (_BLOCK * columns), 1)
    ):
        if block.size < 2 * _POWERS * columns:
            continue
        smooth = np.linspace(-1, 1, block.size)[:, None] ** np.arange(_POWERS)
        signals = np.hstack([moving[block], np.ones((block.size, 1))])
        basis = (signals[:, :, None] * smooth[:, None, :]).reshape(block.size, -1)
        scale = np.maximum(np.linalg.norm(basis, axis=0), 1e-300)
        basis, inputs = basis / scale, commands[block]
        factors = np.linalg.lstsq(basis, inputs, rcond=None)[0] / scale[:, None]
        factors = factors.reshape(columns, _POWERS, -1)[: y.shape[1]]
        added = np.einsum("bo,bp,opi->bi", gained[block], smooth, factors)
        q = np.linalg.qr(basis)[0]
        left, drift = (x - q @ (np.conj(q.T) @ x) for x in (inputs, added))
        floor = _FLOOR * np.mean(np.abs(inputs) ** 2, axis=0) + 1e-280
        noise = np.sqrt(np.mean(np.abs(left) ** 2, axis=0) + floor)
        leverage = np.minimum(np.sum(np.abs(q) ** 2, axis=1), 0.9)
        columns_of = left / noise, drift / noise, np.abs(added / noise) ** 2
        parts.append((*map(np.ravel, columns_of), np.repeat(leverage, inputs.shape[1])))
    return parts


def sweep_times(
    records: Sequence[Record], method: Method, omega: Grid
) -> Float[np.ndarray, "frequencies inputs"] | None:
    """When each input sweeps each frequency, in s from the middle of its record, by power; None
    where another excitation moves an input."""
    inputs = records[0].inputs.shape[1]  # references beyond theirs are other signals
    moments = np.zeros((3, omega.size, inputs))
    for record in records:
        count = fast_length(record.samples)
        moving = (record.inputs if method == "direct" else record.references)[:count, :inputs]
        moving = moving - np.mean(moving, axis=0)
        time = np.linspace(-0.5, 0.5, count)[:, None] * count * record.dt
        plain, later = (np.fft.rfft(x.T).T for x in (moving, time * moving))
        place = omega * count * record.dt / (2 * np.pi)
        reach = np.maximum(_NEAR * place, 1.0)
        low = np.clip(np.rint(place - reach).astype(int), 0, len(plain) - 1)
        high = np.clip(np.rint(place + reach).astype(int) + 1, low + 1, len(plain))
        parts = power_of(plain), np.real(later * np.conj(plain)), power_of(later)
        moments += [sums_between(part, low, high) for part in parts]
    power, first, second = moments
    power = np.maximum(power, _NOTHING * np.max(power, axis=0) + 1e-280)
    times = first / power
    spread = np.sqrt(np.median(np.maximum(second / power - times**2, 0.0), axis=0))
    return times if np.all(spread < _BRIEF * np.ptp(times, axis=0)) else None


Samples = Float[np.ndarray, " _samples"]
_FACTORS = 4  # of h
_ROUNDING = 1e-6  # of the power of a signal


class OtherInput(NamedTuple):
    """What a record tells of another signal."""

    chance: float  # that noise explains as much of the output as the signal does
    alone: float  # share of the signal's power that does not move with the input


def compare_with_input(
    records: Sequence[Record], frf: FrequencyResponse, signals: Sequence[Samples]
) -> OtherInput | None:
    """Compare another signal, sampled as each record is, with the first input of a response.

    None where the response has too few coherent points, or the records too few bins.
    """
    omega, method = np.asarray(frf.omega), frf.method
    response, coherence = (np.asarray(x)[:, 0, :1] for x in (frf.response, frf.coherence))
    used = (np.isfinite(response) & (coherence >= COHERENT))[:, 0]
    if np.sum(used) < FEWEST:
        return None
    low, high = omega[used][[0, -1]]
    spectra = [
        _spectra(record, method, signal, low, high)
        for record, signal in zip(records, signals, strict=True)
    ]
    left = left_over(spectra, omega[used], response[used], (0, 0))
    if left is None:
        return None
    from scipy.special import chdtrc

    added = left.added[:, :2]
    if not left.share[0] > _ROUNDING:
        return OtherInput(1.0, 0.0)
    clear = factors_of(left, np.hstack([added, 1j * added]))[2]
    alone = left.share[0] / np.mean(1 - left.leverage)  # the model takes its share of any signal
    return OtherInput(float(chdtrc(_FACTORS, clear**2)), float(min(alone, 1.0)))


def _spectra(record: Record, method: Method, signal: Samples, low: float, high: float) -> Spectra:
    count = fast_length(record.samples)
    inputs, outputs, other = (
        transform_bins(x[:count]) for x in (record.inputs, record.outputs, signal[:, None])
    )
    moving = inputs if method == "direct" else transform_bins(record.references[:count])
    grid = 2 * np.pi / (count * record.dt) * np.arange(len(inputs))
    slope = np.log(np.maximum(grid, grid[1]) ** 2 / (low * high))[:, None] / np.log(high / low)
    added = np.hstack([other, slope * other])
    return Spectra(grid, moving, inputs[:, :1], outputs[:, :1], added, record.inputs[:0, 0])
