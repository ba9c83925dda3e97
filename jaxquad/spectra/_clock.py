"""Whether the outputs' time stamps run at another rate than those of the other signals; and when a
sweep has each of its frequencies.

A controller makes the inputs of the references and the outputs, with hardly any noise of its own:
u = A r + C y. Where the outputs' stamps gain a share e of the time, u keeps e C (t dy/dt). A sweep
alone cannot tell this from a delay; what else moves the loop excites C all the time.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float

from jaxquad.records import Record

from ._estimators import COHERENT, Grid, Method, power_of, Remark, sums_between
from ._frequency_response import Estimate
from ._linearity import fast_length


_CLEAR = 6.0  # standard errors from which a remark is made
_OTHER = 3.0  # times what is found in quadrature, as a controller leaves whose gain changes
_BLOCK, _POWERS = 24, 3  # bins for each signal, over which A and C are smooth; their coefficients
_DISTINCT = 1e-5  # share of the signal looked for that no controller explains
_MOST = 0.01  # drift of a clock, as a share of the time
_FEWEST = 8  # points of the response
_NEAR = 0.05  # of a frequency, over which the time of its power is averaged
_BRIEF = 0.2  # of a sweep's length, within which it passes a frequency
_FLOOR = 1e-20  # of the input's power: below it lies rounding

Columns = Complex[np.ndarray, "bins columns"]


def remarks_on_clock(records: Sequence[Record], estimate: Estimate) -> tuple[Remark, ...]:
    """A remark on outputs whose stamps drift by more than the random error of a delay."""
    usable = np.isfinite(estimate.response) & (estimate.coherence >= COHERENT)
    omega = estimate.omega[np.any(usable, axis=(1, 2))]
    if omega.size < _FEWEST:
        return ()
    rate, clear = _clock_drift(records, omega)
    error = np.where(usable, estimate.random_error, np.inf)
    precision = np.sum((estimate.omega[:, None, None] / error) ** 2, axis=0)  # inverse variances
    seconds = max(record.samples for record in records) * records[0].dt
    late = rate * seconds
    if not (clear > _CLEAR and abs(rate) < _MOST and (0.5 * late) ** 2 * np.max(precision) > 1):
        return ()
    text = (
        f"the output's time stamps drift against the input's by {1e6 * rate:+.2g} ppm, "
        f"{1e3 * late:+.2g} ms in {seconds:.3g} s: so the controller's answer to the output says. "
        "The delay is wrong by up to as much, which the error bars do not include. Stamp both by "
        f"one clock, or divide the output's times by {1 + rate:.7g}"
    )
    return (Remark(text, kind="clock"),)


def _clock_drift(records: Sequence[Record], omega: Grid) -> tuple[float, float]:
    """The rate at which the outputs' stamps gain, and how clear it is, in standard errors."""
    parts = [part for record in records for part in _compare(record, omega[0], omega[-1])]
    if not parts:
        return 0.0, 0.0
    left, drift, power, leverage = (np.concatenate(part) for part in zip(*parts, strict=True))
    size = np.sum(np.abs(drift) ** 2)
    if not size > _DISTINCT * np.sum(power):
        return 0.0, 0.0
    value = np.sum(np.conj(drift) * left) / size
    # Of residuals of any variance (MacKinnon and White, 1985, HC3).
    scores = np.real(np.conj(drift) * (left - value * drift)) / (1 - leverage)
    error = max(float(np.sqrt(np.sum(scores**2)) / size), 1e-300)
    alone = abs(value.real) > _OTHER * abs(value.imag)
    return float(value.real), abs(float(value.real)) / error if alone else 0.0


def _compare(record: Record, low: float, high: float) -> list[tuple[np.ndarray, ...]]:
    """By blocks of bins: what no controller explains of the inputs, and of what a drift of 1 adds
    to them; the power of this, before; the leverage. All relative to the noise of the block."""
    count, parts = fast_length(record.samples), []
    grid = 2 * np.pi / (count * record.dt) * np.arange(count // 2 + 1)
    first, last = np.searchsorted(grid, [low, high])
    band, y = slice(max(int(first), 1), int(last)), record.outputs[:count]
    time = np.linspace(-0.5, 0.5, count)[:, None] * count  # in samples
    commands, moving, gained = (
        _transform(x)[band]
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
    moments = np.zeros((3, omega.size, records[0].inputs.shape[1]))
    for record in records:
        count = fast_length(record.samples)
        moving = (record.inputs if method == "direct" else record.references)[:count]
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
    power = np.maximum(power, 1e-300)
    times = first / power
    spread = np.sqrt(np.median(np.maximum(second / power - times**2, 0.0), axis=0))
    return times if np.all(spread < _BRIEF * np.ptp(times, axis=0)) else None


def _transform(columns: Float[np.ndarray, "samples columns"]) -> Columns:
    return np.fft.rfft((columns - np.mean(columns, axis=0)).T).T / np.sqrt(len(columns))
