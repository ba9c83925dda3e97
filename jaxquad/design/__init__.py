"""Predicted accuracy of a test, and multisines optimised for it: powers and phases in turn, for
powers depend on crest factors.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int, PyTree

from jaxquad._core import require_all_positive, require_x64, whole_samples
from jaxquad.excitation import check_lines, Excitation, harmonics
from jaxquad.identify import Free, select_parameters

from ._information import (
    AOptimal,
    certify_powers,
    check_distinct,
    Criterion,
    DOptimal,
    information_per_energy,
    LargestError,
    MeasuredNoise,
    Noise,
    noise_covariance,
    optimal_powers,
    PowerProblem,
    Powers,
    predict_accuracy,
    Prediction,
    unit_information,
)


__all__ = [
    "AOptimal",
    "certify_powers",
    "Criterion",
    "Design",
    "DOptimal",
    "information_per_energy",
    "LargestError",
    "least_peak_phases",
    "MeasuredNoise",
    "multisine_peaks",
    "multisine_signals",
    "noise_covariance",
    "optimal_multisine",
    "optimal_powers",
    "PowerProblem",
    "Powers",
    "predict_accuracy",
    "Prediction",
]
_NORMS = (4, 16, 64, 256)  # one the start of the next; the last is almost the peak
_PHASE_STEPS = 60  # of each
_STARTS = 4
_COARSE, _FINE = 8, 64  # least points to a cycle of the highest line: to search, and to judge
_CREST = 1.5  # before phases are known
_ROUNDS = 2  # of powers, phases, and the crest factors that they have
_FAINT = 3e-3  # power, to that of the strongest line in its share of the limits, that is left out
_LINES = (2, 4, 8)  # least lines to a parameter that are tried

Orders = Int[np.ndarray, " frequencies"]
Lines = Float[np.ndarray, " frequencies"]
Amplitudes = Complex[np.ndarray, "signals frequencies"]
Number = float | int


_D_OPTIMAL = DOptimal()


class Design(eqx.Module):
    """The most informative multisine within limits, and the accuracy to expect of it.

    `dispersion` is, for each line offered, the information that power there would add for its share
    of the limits, scaled as in the equivalence theorem: without a cap on the lines it nowhere
    exceeds the number of parameters, and equals it at the lines of the best design. `efficiency` is
    a lower bound on the flight time of the best spectrum with these limits, cap and crest factors,
    over that of this one, for the same information.
    """

    excitation: Excitation
    power: Float[np.ndarray, " frequencies"]  # mean square of each line of the excitation
    predictions: tuple[Prediction, ...]  # one for each model of an ensemble
    offered: Float[np.ndarray, " offered"]  # rad/s
    dispersion: Float[np.ndarray, " offered"]
    efficiency: float = eqx.field(static=True)
    limits: dict[str, tuple[float, float]]  # peak, and its limit
    crest_factor: float = eqx.field(static=True)  # peak over root mean square
    criterion: Criterion
    lines: int = eqx.field(static=True)  # none takes more than 1/lines of the limits

    @property
    def prediction(self) -> Prediction:
        """For the first model."""
        return self.predictions[0]

    @property
    def omega(self) -> Float[np.ndarray, " frequencies"]:
        """The lines in rad/s."""
        return self.excitation.lines

    @property
    def standard_errors(self) -> Float[np.ndarray, " parameters"]:
        """Predicted, relative, for the first model."""
        return self.prediction.standard_errors

    @property
    def cramer_rao(self) -> Float[np.ndarray, " parameters"]:
        """Predicted, as CIFER's, in per cent, for the first model."""
        return self.prediction.cramer_rao

    @property
    def log_determinant(self) -> float:
        """Of the information of relative changes, for the first model."""
        return self.prediction.log_determinant

    def __str__(self) -> str:
        share = np.sort(self.power)[::-1].cumsum() / self.power.sum()
        most = int(np.searchsorted(share, 0.9) + 1)
        peaks = ", ".join(f"{n} {p:.4g} of {limit:.4g}" for n, (p, limit) in self.limits.items())
        models = f", averaged over {len(self.predictions)} models" * (len(self.predictions) > 1)
        return "\n".join(
            [
                f"{type(self.criterion).__name__} multisine{models}: {self.omega.size} of "
                f"{self.offered.size} lines, {most} with 90 % of the power (lines={self.lines})",
                str(self.excitation),
                f"peaks: {peaks}; crest factor {self.crest_factor:.3f}",
                f"dispersion at most {self.dispersion.max():.4f} for {len(self.prediction.names)} "
                f"parameters; efficiency at least {np.floor(1000 * self.efficiency) / 10:.1f} % "
                "of the best with these limits, cap and crest factors",
                str(self.prediction),
            ]
        )


def optimal_multisine(
    model: PyTree | Sequence[PyTree], *, noise: Noise, amplitude: Number, period: Number,
    sample_rate: Number, periods: int = 4, free: Free = None,
    band: tuple[Number, Number] | None = None, omega: Lines | None = None,
    rate: Number | None = None, output_amplitude: Number | Sequence[float] | None = None,
    criterion: Criterion = _D_OPTIMAL, lines: int | None = None, input: int = 0, seed: int = 0,
) -> Design:  # fmt: skip
    """The multisine that is most informative about a model's `free` parameters, within limits.

    Information is that of `periods` settled periods: fly one more before them, or estimate the
    transient.

    **Arguments:**

    - `model`: as for `jq.fit`; its values are the best guess. A list of models stands for what is
        not known yet: the mean of their log information counts.
    - `noise`: one-sided spectral density of the outputs in units^2/Hz: a number, one for each
        output, a function of omega in rad/s, or a `jq.design.MeasuredNoise`.
    - `amplitude`: limit of the signal's peak, in the unit of the input.
    - `period`: in s. `periods`: how many are flown. `sample_rate`: in Hz.
    - `free`: as in `jq.fit`.
    - `band`: (low, high) in rad/s; all harmonics of the period within it may be used.
    - `omega`: the lines that may be used, in rad/s, instead of `band`.
    - `rate`: limit of the peak of the signal's derivative, per s.
    - `output_amplitude`: limit of the peak of each settled output.
    - `criterion`: `DOptimal()`, `AOptimal(...)`, `LargestError()`, or an object like them.
    - `lines`: no line takes more than 1/`lines` of what the limits leave it alone, so at least so
        many are used. With 1, p parameters may get as few as p/2 lines, which leave none to judge
        the model by. By default two, four and eight for each parameter are tried.
    - `input`: which input of the model is excited.
    - `seed`: of the random starts of the phases.

    **Returns:**

    `jq.design.Design`.

    **Raises:**

    - `ValueError`: limits, lines or parameters that allow no design.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits.
    """
    require_x64("a design")
    models = list(model) if isinstance(model, list | tuple) else [model]
    if not models:
        raise ValueError("the list of models is empty: give one, or several that may be true")
    require_all_positive(amplitude=amplitude, period=period, sample_rate=sample_rate)
    if periods < 1 or periods != int(periods):
        raise ValueError(f"periods is {periods}: give a whole number, 1 or more")
    samples = whole_samples("period", period, sample_rate)
    if (band is None) == (omega is None):
        raise ValueError(
            "give either band=(low, high) or omega=, the lines to choose from, in rad/s"
        )
    offered = np.asarray(omega, float) if band is None else harmonics(*band, period=period)
    check_lines(offered, period, sample_rate)
    parameters = [select_parameters(one, free) for one in models]
    names, seconds = parameters[0].names, float(period * periods)
    if any(one.names != names for one in parameters):
        sets = "; ".join(", ".join(one.names) for one in parameters)
        raise ValueError(
            f"the models have different free parameters: {sets}; give models of one form"
        )
    pairs = zip(models, parameters, strict=True)
    parts = [unit_information(*pair, offered, noise, input) for pair in pairs]
    responses, units = zip(*parts, strict=True)
    for unit in units:
        check_distinct(unit.sum(axis=0), names)
    per_power = seconds * np.stack(units)
    limits = _gather_limits(offered, responses, amplitude, rate, output_amplitude)
    orders = np.round(offered * period / (2 * np.pi)).astype(int)
    if lines is None:
        least = [k * len(names) for k in _LINES if k * len(names) <= offered.size // 2]
        least = least or [max(1, offered.size // 2)]
    elif 1 <= lines <= offered.size:
        least = [int(lines)]
    else:
        raise ValueError(
            f"lines is {lines}, but {offered.size} lines are offered: give 1 to {offered.size}"
        )

    def try_lines(lines: int, crest: Float[np.ndarray, " limits"]) -> _Trial:
        """One design for these crest factors, scaled to the limits by the actual peaks."""
        costs, informations = limits.costs(crest), jnp.asarray(per_power)
        share = jnp.asarray(1 / lines, dtype=informations.dtype)

        def signals(power: Lines) -> Complex[np.ndarray, "limits frequencies"]:
            """Complex amplitudes of the limited signals, in units of their limits."""
            return limits.filters * np.sqrt(2 * power) / limits.peaks[:, None]

        problem = PowerProblem(informations, jnp.asarray(costs), criterion, names, share)
        best = optimal_powers(problem)
        power = np.asarray(best.power)
        used = costs.max(axis=0) * power
        power = np.where(used > _FAINT * used.max(), power, 0.0)
        phase = least_peak_phases(orders, signals(power), seed=seed)
        reached = multisine_peaks(orders, phase, signals(power))
        power, reached = power / reached.max() ** 2, reached / reached.max()
        crest = reached / np.sqrt(0.5 * np.sum(np.abs(signals(power)) ** 2, axis=1))
        problem = problem._replace(costs=jnp.asarray(limits.costs(crest)))
        proof = certify_powers(Powers(jnp.asarray(power), best.price), problem)
        dispersion = len(names) * np.asarray(proof.dispersion)
        efficiency = min(1.0, float(np.exp(-np.asarray(proof.gap))))
        totals = np.einsum("f,mfpq->mpq", power, per_power)
        values = [criterion.log_information(jnp.asarray(m), names) for m in totals]
        value = float(np.mean([float(value) for value in values]))
        return _Trial(power, phase, reached, dispersion, efficiency, value, lines, crest)

    trials = []
    for count in least:
        crest = np.full(limits.peaks.size, _CREST)
        for _ in range(_ROUNDS):
            trials.append(try_lines(count, crest))
            crest = trials[-1].crest
    best = max(trials, key=lambda trial: trial.value)
    amplitudes = np.sqrt(2 * best.power).astype(complex)[None, :]
    wave = multisine_signals(orders, best.phase, amplitudes, samples)[0]
    wave = np.roll(wave, -int(np.abs(wave).argmin()))  # from its sample nearest to zero on
    used, duration = offered[best.power > 0], samples * periods / float(sample_rate)
    excitation = Excitation(
        np.arange(samples * periods) / float(sample_rate),
        np.tile(wave, periods),
        used,
        kind="multisine",
        omega_min=float(used[0]),
        omega_max=float(used[-1]),
        amplitude=float(np.abs(wave).max()),
        sample_rate=float(sample_rate),
        duration=float(duration),
    )
    totals = np.einsum("f,mfpq->mpq", best.power, per_power)
    peaks = zip(limits.names, best.peaks, limits.peaks, strict=True)
    return Design(
        excitation=excitation,
        power=best.power[best.power > 0],
        predictions=tuple(Prediction(names, total, duration) for total in totals),
        offered=offered,
        dispersion=best.dispersion,
        efficiency=best.efficiency,
        limits={name: (float(share * limit), float(limit)) for name, share, limit in peaks},
        crest_factor=float(best.peaks[0] * limits.peaks[0] / np.sqrt(best.power.sum())),
        criterion=criterion,
        lines=best.lines,
    )


class _Trial(NamedTuple):
    """Lines scaled to the limits by their actual peaks."""

    power: Lines
    phase: Lines
    peaks: Float[np.ndarray, " limits"]  # to their limits
    dispersion: Lines
    efficiency: float
    value: float  # log information
    lines: int
    crest: Float[np.ndarray, " limits"]  # factors of the limited signals


class _Limits(NamedTuple):
    """Signals made from the input by a filter each, and the peaks that they may have."""

    names: tuple[str, ...]
    filters: Complex[np.ndarray, "limits frequencies"]
    peaks: Float[np.ndarray, " limits"]

    def costs(self, crest: Float[np.ndarray, " limits"]) -> Float[np.ndarray, "limits frequencies"]:
        """Share of each limit that unit mean square at a line takes, at these crest factors."""
        return np.abs(self.filters) ** 2 * (crest / self.peaks)[:, None] ** 2


def _gather_limits(
    omega: Float[np.ndarray, " frequencies"],
    responses: Sequence[Complex[np.ndarray, "frequencies outputs"]],
    amplitude: float | int,
    rate: float | int | None,
    output_amplitude: float | int | Sequence[float] | None,
) -> _Limits:
    """All limits of a design; an output's holds for every model of an ensemble."""
    names, filters, peaks = ["amplitude"], [np.ones(omega.size, complex)], [amplitude]
    if rate is not None:
        names, filters, peaks = [*names, "rate"], [*filters, 1j * omega], [*peaks, rate]
    outputs = responses[0].shape[1]
    if output_amplitude is None or isinstance(output_amplitude, int | float):
        output_peaks = [np.inf if output_amplitude is None else float(output_amplitude)] * outputs
    else:
        output_peaks = list(output_amplitude)
    if len(output_peaks) != outputs:
        raise ValueError(
            f"output_amplitude has {len(output_peaks)} values for {outputs} outputs: give one for "
            "each, inf where there is no limit"
        )
    for o, peak in enumerate(output_peaks):
        for m, response in enumerate(responses):
            if peak < np.inf:
                which = f" {o}" if outputs > 1 else ""
                names.append(f"output{which}" + (f", model {m}" if len(responses) > 1 else ""))
                filters.append(response[:, o])
                peaks.append(peak)
    for name, peak in zip(names, peaks, strict=True):
        if not 0 < peak < np.inf:
            raise ValueError(f"the limit of {name} is {peak}: it has to be positive and finite")
    return _Limits(tuple(names), np.array(filters), np.array(peaks, float))


def least_peak_phases(orders: Orders, amplitudes: Amplitudes, *, seed: int) -> Lines:
    """Phases of the lines under which several signals peak least, relative to their limits.

    The signals are sums of `amplitudes` times cos(order 2 pi t + phase), `orders` per period, in
    units of their limits. The p-norm over all of them is lowered for a rising p, from several
    starts. Source: Guillaume, Schoukens, Pintelon and Kollar (1991), for one signal.
    """
    from scipy.optimize import minimize

    used = np.flatnonzero(amplitudes[0])
    few, heights = orders[used], amplitudes[:, used]
    # Delays in proportion to the power of the lines below (Schroeder, 1970), and random starts.
    power, rng = np.abs(heights[0]) ** 2, np.random.default_rng(seed)
    below = np.concatenate([[0.0], np.cumsum(power)[:-1]]) / power.sum()
    starts = [-2 * np.pi * np.concatenate([[0.0], np.cumsum(below[1:] * np.diff(few))])]
    starts += [rng.uniform(-np.pi, np.pi, used.size) for _ in range(_STARTS - 1)]
    points, ends = 1 << int(np.ceil(np.log2(_COARSE * few.max()))), []
    for phase in starts:
        for norm in _NORMS:
            phase = minimize(
                _log_norm, phase, (few, heights, points, norm),
                jac=True, method="CG", options=dict(maxiter=_PHASE_STEPS),
            ).x  # fmt: skip
        ends.append(phase)
    highest = [multisine_peaks(few, phase, heights).max() for phase in ends]
    phase = np.zeros(orders.size)
    phase[used] = ends[int(np.argmin(highest))]
    return phase


def multisine_peaks(
    orders: Orders, phase: Lines, amplitudes: Amplitudes
) -> Float[np.ndarray, " signals"]:
    """A bound on each signal's peak at any time, from its values at many points.

    Between N points, a signal of order n exceeds them by 1 / cos(pi n / N) at most (Ehlich and
    Zeller, 1964): 0.1 %.
    """
    points = 1 << int(np.ceil(np.log2(_FINE * orders.max())))
    levels = np.abs(multisine_signals(orders, phase, amplitudes, points))
    return levels.max(axis=1) / np.cos(np.pi * orders.max() / points)


def multisine_signals(
    orders: Orders, phase: Lines, amplitudes: Amplitudes, points: int
) -> Float[np.ndarray, "signals points"]:
    """One period of each multisine, at evenly spaced points; `phase` in rad."""
    spectrum = np.zeros((len(amplitudes), points // 2 + 1), complex)
    spectrum[:, orders] = 0.5 * points * (amplitudes * np.exp(1j * phase))
    return np.fft.irfft(spectrum, points, axis=1)


def _log_norm(
    phase: Lines, orders: Orders, amplitudes: Amplitudes, points: int, norm: int
) -> tuple[float, Lines]:
    """Logarithm of the norm over all signals and points, and its gradient."""
    turned = amplitudes * np.exp(1j * phase)
    signals = multisine_signals(orders, phase, amplitudes, points)
    top = np.abs(signals).max()
    unit = signals / top
    powers = unit ** (norm - 2)
    total = np.sum(powers * unit**2)
    through = np.fft.rfft(powers * unit / (top * total), axis=1)[:, orders]
    slope = np.real(1j * turned * np.conj(through)).sum(axis=0)
    return float(np.log(total / unit.size) / norm + np.log(top)), slope
