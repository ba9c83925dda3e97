"""What a flown loop does: its response broken at the error, and the step response of an output."""

from typing import get_args, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from jaxquad._core import Message
from jaxquad.records import Record

from ._estimators import COHERENT, Grid, Response


_LINES = 40  # frequencies, log-spaced
_CYCLES = 4  # of the lowest frequency in a window
_PARTS = 10  # windows that a record is cut into, about
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

Entry = Literal["set-point", "plant input"]
Samples = Float[np.ndarray, " samples"]
_Spectra = Complex[np.ndarray, "windows frequencies"]


class BrokenLoop(NamedTuple):
    """The response of a loop L broken at its error, as `estimate_broken_loop` estimates it."""

    omega: Grid  # rad/s
    response: Response  # L, with negative feedback: closed as 1 + L = 0
    error: Grid  # standard error, relative and in rad
    coherence: Grid  # of the reference with what it was estimated from

    @property
    def crossover(self) -> float:
        """Where |L| falls through 1 for the last time, in rad/s; nan if not in the band."""
        falls = self._falls(np.log(np.abs(self.response)))
        return falls[-1][0] if falls else float("nan")

    @property
    def phase_margin(self) -> tuple[float, float]:
        """At the crossover, with its standard error, in rad."""
        falls = self._falls(np.log(np.abs(self.response)))
        if not falls:
            return float("nan"), float("nan")
        _, k, share = falls[-1]
        phase = np.unwrap(np.angle(-self.response))
        margin = phase[k] + share * (phase[k + 1] - phase[k])
        turn = 2 * np.pi
        return float((margin + np.pi) % turn - np.pi), float(self.error[k : k + 2].max())

    @property
    def gain_margin(self) -> tuple[float, float]:
        """Factor at the first crossing of -180 deg beyond the crossover, and where in rad/s."""
        phase = np.unwrap(np.angle(-self.response))
        start = np.searchsorted(self.omega, self.crossover) if self.crossover > 0 else 0
        phase = phase - 2 * np.pi * np.round(phase[min(start, phase.size - 1)] / (2 * np.pi))
        falls = [fall for fall in self._falls(phase) if fall[1] + 1 >= start]
        if not falls:
            return float("nan"), float("nan")
        (omega, k, share), level = falls[0], np.log(np.abs(self.response))
        return float(np.exp(-(level[k] + share * (level[k + 1] - level[k])))), omega

    def _falls(self, level: Grid) -> list[tuple[float, int, float]]:
        """Where a level falls through 0 in rad/s, the point before it, and how far behind that."""
        place, falls = np.log(self.omega), []
        for k in np.flatnonzero((level[:-1] > 0) & (level[1:] <= 0)).tolist():
            share = float(level[k] / (level[k] - level[k + 1]))
            falls.append((float(np.exp(place[k] + share * (place[k + 1] - place[k]))), k, share))
        return falls


def estimate_broken_loop(
    record: Record,
    *,
    entry: Entry,
    reference: str | None = None,
    output: str | None = None,
    input: str | None = None,
    band: tuple[float, float] | None = None,
) -> BrokenLoop:
    """Estimate the broken loop L of a flight, without knowing plant or controller.

    A reference that is compared with the output closes as y = T r, T = L / (1 + L), so that
    L = T / (1 - T). One that is added to the plant's input closes as u = S r, S = 1 / (1 + L), so
    that L = 1 / S - 1. T and S are averages over tapered windows and neighbouring frequencies, and
    their errors are propagated to first order.
    Source: Tischler and Remple, "Aircraft and Rotorcraft System Identification", 2nd ed., sec. 5.7
    and 9.2 (the random error of an average).

    **Arguments:**

    - `record`: with a reference.
    - `entry`: where the reference enters, "set-point" or "plant input".
    - `reference`, `output`, `input`: channels, by default the first of each.
    - `band`: in rad/s; by default from four cycles in a window to a fifth of the sample rate.

    **Returns:** a `BrokenLoop` of the frequencies with a coherence of 0.6 or more; it may be empty.

    **Raises:** ValueError for a record without a reference, and for another entry.
    """
    if entry not in get_args(Entry):
        entries = " or ".join(map(repr, get_args(Entry)))
        raise ValueError(f"entry is {entry!r}: say where the reference enters, {entries}")
    if reference is None and not record.reference_names:
        raise ValueError(
            Message(
                "the record has no reference, so its loop is not known: name one («reference=»)"
            )
        )
    source = reference or record.reference_names[0]
    answer = output or record.output_names[0]
    answer = answer if entry == "set-point" else input or record.input_names[0]
    size = 2 * (record.samples // (_PARTS + 1))
    one, other = (_spectra(_windows(record.channel(name), size)) for name in (source, answer))
    fine = 2 * np.pi * np.fft.rfftfreq(size, record.dt)
    low, high = band or (_CYCLES * fine[1], 0.2 * 2 * np.pi * record.sample_rate)
    edges = np.geomspace(max(low, 2 * fine[1]), min(high, fine[-2]), _LINES + 1)
    parts = []
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        bins = np.flatnonzero((fine >= begin) & (fine < end))
        if not bins.size:
            continue
        # Over windows and neighbours, at the frequency where the reference has its power.
        x, y, powers = one[:, bins], other[:, bins], np.abs(one[:, bins]) ** 2
        power, cross = np.maximum(np.sum(powers), 1e-150), np.sum(np.conj(x) * y)
        total = np.maximum(np.sum(np.abs(y) ** 2), 1e-150)
        # Windows that overlap, and neighbours of tapered spectra, are half as many as they seem.
        count = max(power**2 / np.maximum(np.sum(powers**2), 1e-300) / 2, 1.0)
        raw = np.abs(cross) ** 2 / (power * total)
        coherence = float(np.clip((count * raw - 1) / max(count - 1, 1e-3), 0.0, 1.0))
        error = np.sqrt((1 - coherence) / max(2 * count * coherence, 1e-9))
        parts.append((powers.sum(axis=0) @ fine[bins] / power, cross / power, error, coherence))
    table = np.array(parts, complex).reshape(-1, 4).T
    omega, closed, error, coherence = table[0].real, table[1], table[2].real, table[3].real
    kept = (coherence >= COHERENT) & (closed != 0) & (closed != 1)
    omega, closed, error, coherence = (x[kept] for x in (omega, closed, error, coherence))
    loop = closed / (1 - closed) if entry == "set-point" else 1 / closed - 1
    return BrokenLoop(omega, loop, error / np.abs(1 - closed), coherence)


class StepResponse(NamedTuple):
    """What an output does after a step of 1 in a reference, as `estimate_step` estimates it."""

    time: Samples  # s after the step, from a quarter of the length before it
    mean: Samples  # over all windows, in output units per reference unit
    standard_error: Samples  # of the mean, from the scatter between windows
    windows: Float[np.ndarray, "windows samples"]  # the response in each active one by itself
    # What the estimator would make of a perfect step: how the reference's lack of power at some
    # frequencies blurs and tilts the mean.
    resolution: Samples
    total: int  # windows of the record; `windows` are those in which the reference is active
    names: tuple[str, str]  # reference and output
    simulated: Samples | None = None  # the mean of a simulated output, where one was given
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
    usual = min(_LONGEST, 2 * record.duration / ((_WINDOWS + 1) * _LENGTHS))
    length, dt = usual if length is None else float(length), record.dt
    size = int(round(_LENGTHS * length / dt))
    if size < 32 or size > record.samples:
        raise ValueError(
            f"windows of {_LENGTHS} times {length:.3g} s do not fit a record of "
            f"{record.duration:.4g} s at {record.sample_rate:.4g} Hz: choose another length"
        )
    moves = _moves(record.channel(names[0]), size, _RESTS)[:, None]
    source, answer = (_spectra(_windows(record.channel(name), size)) * moves for name in names)
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
        answers.append(_spectra(windows) * moves)
    before, after = int(round(length / 4 / dt)), int(round(length / dt))

    def integrate(transfer: _Spectra) -> Float[np.ndarray, "windows samples"]:
        """Step responses from a quarter of the length before the step."""
        impulse = np.roll(np.fft.irfft(transfer, size, axis=-1), before, axis=-1)
        return np.cumsum(impulse[..., : before + after + 1], axis=-1)

    transfers = [np.sum(np.conj(source) * one, axis=0) / bottom for one in answers]
    steps = integrate(np.stack([power / bottom + 0j, *transfers]))
    # What each window's rest adds to the transfer function: the infinitesimal jackknife.
    near = _smooth(np.abs(source) ** 2)
    leverage = np.minimum(near / np.maximum(np.sum(near, axis=0), 1e-300), 0.9)
    scatter = []
    for one, transfer in zip(answers, transfers, strict=True):
        error = np.conj(source) * (one - transfer * source) / bottom / (1 - leverage)
        added = integrate(error)
        # Windows that overlap share half of their samples.
        alone, shared = np.sum(added**2, axis=0), np.sum(added[1:] * added[:-1], axis=0)
        scatter.append(np.sqrt(alone + np.maximum(2 * shared, 0.0)))
    single = np.conj(source) * answer / np.maximum(np.abs(source) ** 2 + noise, 1e-300)
    active = _moves(record.channel(names[0]), size, _ACTIVE)
    time, windows = dt * np.arange(-before, after + 1), integrate(single[active])
    model = (steps[2], scatter[1]) if simulated is not None else (None, None)
    fields = time, steps[1], scatter[0], windows, steps[0], len(source), names
    return StepResponse(*fields, *model)


def _windows(values: Samples, size: int) -> Float[np.ndarray, "windows size"]:
    """Windows that overlap by half, of the channel less its mean."""
    starts = np.arange(0, values.size - size + 1, size // 2)
    return (values - values.mean())[starts[:, None] + np.arange(size)]


def _spectra(windows: Float[np.ndarray, "windows size"]) -> _Spectra:
    size = windows.shape[1]
    return np.fft.rfft(np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2 * windows, axis=1)


def _moves(values: Samples, size: int, share: float) -> Bool[np.ndarray, " windows"]:
    """Whether each window moves by at least this share of the window that moves most."""
    swing = np.std(_windows(values, size), axis=1)
    return (swing > 0) & (swing >= share * np.max(swing))


def _smooth(values: Float[np.ndarray, "*windows frequencies"]) -> Float[np.ndarray, "..."]:
    """Sums over neighbouring frequencies; at 0 the spectrum goes on as its mirror image."""
    padded = np.concatenate([values[..., _NEAR:0:-1], values, values[..., : -_NEAR - 1 : -1]], -1)
    count = values.shape[-1]
    return sum(padded[..., k : k + count] for k in range(1, _WIDTH)) + padded[..., :count]


def _noise_over_response(source: _Spectra, answer: _Spectra) -> Float[np.ndarray, " frequencies"]:
    """The power of noise over that of the response, in units of the reference's power."""

    def above_rounding(power: np.ndarray) -> np.ndarray:
        """Sums over neighbours, no smaller than what rounding makes of the largest."""
        near = _smooth(power)
        return np.maximum(near, max(np.finfo(float).eps * float(np.max(near)), 1e-150))

    powers, total = np.abs(source) ** 2, np.sum(np.abs(answer) ** 2, axis=0)
    cross = np.sum(np.conj(source) * answer, axis=0)
    near_cross = _smooth(cross.real) + 1j * _smooth(cross.imag)
    near_power, near_total = above_rounding(np.sum(powers, axis=0)), above_rounding(total)
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


def _rise(time: Samples, level: Samples) -> float:
    """From the last time below 10 % before the first above 90 %, in s."""
    high = np.flatnonzero(level >= 0.9)
    low = np.flatnonzero(level[: high[0]] < 0.1) if high.size else high
    if not low.size:
        return float("nan")
    begin, end = (
        time[k] + (bound - level[k]) / (level[k + 1] - level[k]) * (time[k + 1] - time[k])
        for k, bound in ((low[-1], 0.1), (high[0] - 1, 0.9))
    )
    return float(end - begin)
