"""The step response of a flown loop, by deconvolution of its output from its reference."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from jaxquad._core import Message
from jaxquad.records import Record

from ._estimators import Grid


_LENGTHS = 4  # lengths of the response in a window: what precedes a window then hardly reaches in
_WINDOWS = 12  # that a record is cut into, at least, for the default length
_LONGEST = 3.0  # s, of the default length
_FEWEST = 5  # windows, with which coherence says something
_NEAR = 3  # neighbours to either side over which coherence is averaged
_WIDTH = 2 * _NEAR + 1
_CHANCE = 1e-4  # that noise alone is called coherent at a frequency
_LEAKED = 1e-6  # of the largest power: what leaks that far through the taper
_ACTIVE = 0.2  # of the most active window's reference, by rms, from which a window counts
_RESTS = 0.01  # of that, below which a reference rests, as on the ground: such a window is left out
_END = 0.2  # of the length, over which the final value is taken
_SETTLED = 0.05  # of the final value
_DOUBT = 0.1  # of the final value, by which error, drift and blur may change it
_RESOLVED = 1.5  # times the estimator's own rise time, that a rise has to take

Samples = Float[np.ndarray, " samples"]
_Spectra = Complex[np.ndarray, "windows frequencies"]


class StepResponse(NamedTuple):
    """What an output does after a step of 1 in a reference, as `estimate_step` estimates it.

    **Attributes:**

    - `time`: s after the step, from a quarter of the length before it.
    - `mean`: the response, over all windows, in output units per reference unit.
    - `standard_error`: of the mean, from the scatter between windows.
    - `windows`: the response in each active window by itself.
    - `resolution`: what the estimator would make of a perfect step: how the reference's lack of
      power at some frequencies blurs and tilts the mean.
    - `total`: windows of the record; `windows` are those in which the reference is active.
    - `names`: reference and output.
    - `simulated`, `simulated_error`: the same of a simulated output, where one was given.
    """

    time: Samples  # s
    mean: Samples
    standard_error: Samples
    windows: Float[np.ndarray, "windows samples"]
    resolution: Samples
    total: int
    names: tuple[str, str]
    simulated: Samples | None = None
    simulated_error: Samples | None = None

    @property
    def final(self) -> float:
        """The mean over the last fifth."""
        return float(np.mean(self.mean[self._end]))

    @property
    def rise_time(self) -> float:
        """From 10 to 90 % of the final value, in s; nan where it does not get there."""
        return _rise(self.time, self.mean / self.final)

    @property
    def overshoot(self) -> float:
        """How far the response goes beyond its final value, relative to it."""
        return max(0.0, float(np.max(self.mean / self.final)) - 1)

    @property
    def settling_time(self) -> float:
        """When the response stays within 5 % of its final value, in s; nan if only at the end."""
        outside = np.flatnonzero(np.abs(self.mean / self.final - 1) > _SETTLED)
        last = int(outside[-1]) + 1 if outside.size else 0
        return float(self.time[last]) if last < np.flatnonzero(self._end)[0] else float("nan")

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why the log cannot tell the step response, or a part of it; none if it can."""
        doubts = []
        count, end = len(self.windows), self._end
        if self.final == 0:
            return (f"{self.names[0]} or {self.names[1]} rests: fly steps of it, or a sweep",)
        if count < _FEWEST:
            doubts.append(
                f"the reference is active in {count} of {self.total} windows, and {_FEWEST} are "
                "needed: fly more steps, or a sweep"
            )
        late = (self.time > self.time[-1] / 4) & (self.time <= self.time[-1])
        tilt = float(np.max(np.abs(self.resolution[late] - 1)))
        if tilt > _DOUBT:
            doubts.append(
                "the reference has too little power at low frequencies: even a perfect step would "
                f"come out {100 * tilt:.0f} % wrong in the end. Hold steps for "
                f"{self.time[-1]:.2g} s or longer"
            )
        error = float(np.max(self.standard_error[end])) / max(abs(self.final), 1e-300)
        if error > _DOUBT:
            doubts.append(
                f"noise and gusts leave a standard error of {100 * error:.0f} % in the end: fly "
                "larger or more steps"
            )
        return tuple(doubts)

    @property
    def blur(self) -> float:
        """The rise time in s that the estimator makes of a perfect step; nan if it makes none."""
        return _rise(self.time, self.resolution)

    @property
    def is_resolved(self) -> bool:
        """Whether the rise is slow enough for its time and the overshoot not to be blurred."""
        return self.rise_time > _RESOLVED * self.blur

    @property
    def is_conclusive(self) -> bool:
        """Whether the data suffice."""
        return not self.doubts

    @property
    def _end(self) -> Bool[np.ndarray, " samples"]:
        return self.time >= (1 - _END) * self.time[-1]

    def __str__(self) -> str:
        reference, output = self.names
        head = f"step response {reference} -> {output}, {len(self.windows)} of {self.total} windows"
        if self.doubts:
            return "\n  ".join([f"{head}: this log cannot tell it", *self.doubts])
        most = "" if self.is_resolved else "at most "
        return (
            f"{head}: rise time {most}{1e3 * self.rise_time:.3g} ms, overshoot "
            f"{100 * self.overshoot:.2g} %, settling time (5 %) {1e3 * self.settling_time:.3g} ms, "
            f"final value {self.final:.3g} +- {float(self.standard_error[-1]):.1g} (std. error)"
        )


def estimate_step(
    record: Record,
    *,
    reference: str | None = None,
    output: str | None = None,
    length: float | int | None = None,
    simulated: Float[np.ndarray, " flight"] | None = None,
    drift: int = 1,
) -> StepResponse:
    """Estimate the response of an output to a step in a reference, from any flight.

    The step response is the integral of the impulse response, which is deconvolved in windows:
    with the spectra R and Y of each window, H = sum conj(R) Y / (N + sum |R|^2), Wiener's filter.
    N is the noise over the response, from the coherence: where the reference has no power, or noise
    drowns it, nothing is divided, and `StepResponse.resolution` shows what is lost by that. The
    reference may be steps of a pilot's stick, or any other signal that holds low frequencies.
    Source: Wiener, "Extrapolation, Interpolation, and Smoothing of Stationary Time Series", ch. 3;
    Bendat and Piersol, "Random Data", 4th ed., ch. 6 (coherence and its bias).

    **Arguments:**

    - `record`: with a reference, or any channel named instead.
    - `reference`, `output`: channels; by default the first reference and the first output.
    - `length`: of the response in s; by default 3, or what leaves 12 windows of four lengths.
    - `simulated`: what a model makes of the record's inputs, a value for each sample. So it is
        compared with the measured step without knowing the controller.
    - `drift`: the degree of the polynomial by which the simulation may leave the output within a
        window, for want of its initial state and of a bias: -1 for none, 1 for an integrator.

    **Returns:** a `StepResponse`, which says whether the data suffice.

    **Raises:** ValueError for a record without a reference, or too short for the length.
    """
    if reference is None and not record.reference_names:
        raise ValueError(
            Message(
                "the record has no reference, to which a step response could be found: name a "
                "channel, «reference=»"
            )
        )
    names = reference or record.reference_names[0], output or record.output_names[0]
    length, dt = default_length(record) if length is None else float(length), record.dt
    size = int(round(_LENGTHS * length / dt))
    if size < 32 or size > record.samples:
        raise ValueError(
            f"windows of {_LENGTHS} times {length:.3g} s do not fit a record of "
            f"{record.duration:.4g} s at {record.sample_rate:.4g} Hz: choose another length"
        )
    moves = _moves(record.channel(names[0]), size, _RESTS)[:, None]
    taper = np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2
    source, answer = (
        np.fft.rfft(taper * _windows(record.channel(name), size), axis=1) * moves for name in names
    )
    noise = _noise_over_response(source, answer)
    power = np.sum(np.abs(source) ** 2, axis=0)
    bottom = np.maximum(power + noise, 1e-300)
    answers = [answer]
    if simulated is not None:
        windows = _windows(simulated, size)
        if drift >= 0:  # less the polynomial by which it leaves the output in each window
            away = windows - _windows(record.channel(names[1]), size)
            basis = np.linalg.qr(np.vander(np.linspace(-1, 1, size), drift + 1))[0]
            windows = windows - away @ basis @ basis.T
        answers.append(np.fft.rfft(taper * windows, axis=1) * moves)
    transfers = [np.sum(np.conj(source) * one, axis=0) / bottom for one in answers]
    time, steps = _integrate(np.stack([power / bottom + 0j, *transfers]), size, dt, length)
    # What each window's rest adds to the transfer function: the infinitesimal jackknife.
    near = _smooth(np.abs(source) ** 2)
    leverage = np.minimum(near / np.maximum(np.sum(near, axis=0), 1e-300), 0.9)
    scatter = []
    for one, transfer in zip(answers, transfers, strict=True):
        error = np.conj(source) * (one - transfer * source) / bottom / (1 - leverage)
        _, added = _integrate(error, size, dt, length)
        # Windows that overlap share half of their samples.
        alone, shared = np.sum(added**2, axis=0), np.sum(added[1:] * added[:-1], axis=0)
        scatter.append(np.sqrt(alone + np.maximum(2 * shared, 0.0)))
    single = np.conj(source) * answer / np.maximum(np.abs(source) ** 2 + noise, 1e-300)
    active = _moves(record.channel(names[0]), size, _ACTIVE)
    _, windows = _integrate(single[active], size, dt, length)
    response = StepResponse(time, steps[1], scatter[0], windows, steps[0], len(source), names)
    if simulated is None:
        return response
    return response._replace(simulated=steps[2], simulated_error=scatter[1])


def default_length(record: Record) -> float:
    """Length in s of the response that `estimate_step` looks for."""
    return min(_LONGEST, 2 * record.duration / ((_WINDOWS + 1) * _LENGTHS))


def _windows(values: Samples, size: int) -> Float[np.ndarray, "windows size"]:
    """Windows that overlap by half, of the channel less its mean."""
    starts = np.arange(0, values.size - size + 1, size // 2)
    return (values - values.mean())[starts[:, None] + np.arange(size)]


def _moves(values: Samples, size: int, share: float) -> Bool[np.ndarray, " windows"]:
    """Whether each window moves by at least this share of the window that moves most."""
    swing = np.std(_windows(values, size), axis=1)
    return (swing > 0) & (swing >= share * np.max(swing))


def _smooth(values: Float[np.ndarray, "*windows frequencies"]) -> Float[np.ndarray, "..."]:
    """Sums over neighbouring frequencies; at 0 the spectrum goes on as its mirror image."""
    padded = np.concatenate([values[..., _NEAR:0:-1], values, values[..., : -_NEAR - 1 : -1]], -1)
    count = values.shape[-1]
    return sum(padded[..., k : k + count] for k in range(1, _WIDTH)) + padded[..., :count]


def _above_rounding(power: Grid) -> Grid:
    """Sums over neighbouring frequencies, no smaller than what rounding makes of the largest."""
    near = _smooth(power)
    return np.maximum(near, max(np.finfo(float).eps * float(np.max(near)), 1e-150))


def _noise_over_response(source: _Spectra, answer: _Spectra) -> Grid:
    """The power of noise over that of the response, in units of the reference's power."""
    powers, total = np.abs(source) ** 2, np.sum(np.abs(answer) ** 2, axis=0)
    cross = np.sum(np.conj(source) * answer, axis=0)
    near_cross = _smooth(cross.real) + 1j * _smooth(cross.imag)
    near_power, near_total = _above_rounding(np.sum(powers, axis=0)), _above_rounding(total)
    coherence = np.abs(near_cross) ** 2 / (near_power * near_total)
    # Windows and neighbours that count: one that holds all the power makes any pair coherent.
    # Neighbours of a tapered spectrum are half as many as they seem.
    most = _WIDTH * len(source)  # by Cauchy and Schwarz: rounding may make it more
    fourth = np.maximum(_smooth(np.sum(powers**2, axis=0)), near_power**2 / most)
    count = np.maximum(near_power**2 / fourth / 2, 1.0)
    unbiased = np.clip((count * coherence - 1) / np.maximum(count - 1, 1e-3), 1e-9, 1.0)
    unbiased[coherence < 1 - _CHANCE ** (1 / np.maximum(count - 1, 1e-3))] = 1e-9
    noise = near_power * (1 - unbiased) / (unbiased * count) + _LEAKED * np.max(near_power)
    return noise / _WIDTH


def _integrate(
    transfer: Complex[np.ndarray, "windows frequencies"], size: int, dt: float, length: float
) -> tuple[Samples, Float[np.ndarray, "windows samples"]]:
    """Step responses from a quarter of the length before the step, and their times."""
    impulse = np.fft.irfft(transfer, size, axis=-1)
    before, after = int(round(length / 4 / dt)), int(round(length / dt))
    around = np.roll(impulse, before, axis=-1)[..., : before + after + 1]
    time = dt * np.arange(-before, after + 1)
    return time, np.cumsum(around, axis=-1)


def _rise(time: Samples, level: Samples) -> float:
    """From the last time below 10 % before the first above 90 %, in s."""
    high = np.flatnonzero(level >= 0.9)
    if not high.size or high[0] == 0:
        return float("nan")
    low = np.flatnonzero(level[: high[0]] < 0.1)
    if not low.size:
        return float("nan")
    return float(
        _crossing(time, level, int(high[0]) - 1, 0.9) - _crossing(time, level, int(low[-1]), 0.1)
    )


def _crossing(time: Samples, level: Samples, k: int, bound: float) -> float:
    share = (bound - level[k]) / (level[k + 1] - level[k])
    return float(time[k] + share * (time[k + 1] - time[k]))
