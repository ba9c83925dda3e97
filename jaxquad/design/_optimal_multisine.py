from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float, PyTree

from jaxquad._core import require_all_positive, require_x64, whole_samples
from jaxquad.excitation import check_lines, Excitation, harmonics
from jaxquad.identify import Free, select_parameters

from ._criteria import Criterion, DOptimal
from ._prediction import check_distinct, Noise, Prediction, unit_information
from ._search import gather_limits, multisine_signals, Plan, search, Trial


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


_LINES = (2, 4, 8)  # least lines to a parameter that are tried
_D_OPTIMAL = DOptimal()

Number = float | int
Lines = Float[np.ndarray, " frequencies"]


def optimal_multisine(
    model: PyTree | Sequence[PyTree],
    *,
    noise: Noise,
    amplitude: Number,
    period: Number,
    sample_rate: Number,
    periods: int = 4,
    free: Free = None,
    band: tuple[Number, Number] | None = None,
    omega: Lines | None = None,
    rate: Number | None = None,
    output_amplitude: Number | Sequence[float] | None = None,
    criterion: Criterion = _D_OPTIMAL,
    lines: int | None = None,
    input: int = 0,
    seed: int = 0,
) -> Design:
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
    samples = _whole_period(models, amplitude, period, periods, sample_rate)
    offered = _offered(band, omega, period, sample_rate)
    parameters = [select_parameters(each, free) for each in models]
    if len({each.names for each in parameters}) > 1:
        sets = "; ".join(", ".join(each.names) for each in parameters)
        raise ValueError(
            f"the models have different free parameters: {sets}; give models of one form"
        )
    names, seconds = parameters[0].names, float(period * periods)
    found = [
        unit_information(m, p, offered, noise, input)
        for m, p in zip(models, parameters, strict=True)
    ]
    for _, unit in found:
        check_distinct(unit.sum(axis=0), names)
    limits = gather_limits(offered, [r for r, _ in found], amplitude, rate, output_amplitude)
    per_power = seconds * np.stack([unit for _, unit in found])
    orders = np.round(offered * period / (2 * np.pi)).astype(int)
    plan = Plan(offered, orders, samples, names, per_power, limits, criterion)
    best = search(plan, _least_lines(lines, len(names), offered.size), seed)
    return _design(plan, best, periods, float(sample_rate))


def _whole_period(
    models: list[PyTree], amplitude: Number, period: Number, periods: int, sample_rate: Number
) -> int:
    """Samples of a period."""
    if not models:
        raise ValueError("the list of models is empty: give one, or several that may be true")
    require_all_positive(amplitude=amplitude, period=period, sample_rate=sample_rate)
    if periods < 1 or periods != int(periods):
        raise ValueError(f"periods is {periods}: give a whole number, 1 or more")
    return whole_samples("period", period, sample_rate)


def _offered(
    band: tuple[Number, Number] | None, omega: Lines | None, period: Number, sample_rate: Number
) -> Lines:
    if (band is None) == (omega is None):
        raise ValueError(
            "give either band=(low, high) or omega=, the lines to choose from, in rad/s"
        )
    omega = np.asarray(omega, float) if band is None else harmonics(*band, period=period)
    check_lines(omega, period, sample_rate)
    return omega


def _least_lines(lines: int | None, parameters: int, offered: int) -> tuple[int, ...]:
    """The least numbers of lines to try."""
    if lines is None:
        tried = [each * parameters for each in _LINES if each * parameters <= offered // 2]
        return tuple(tried) or (max(1, offered // 2),)
    if not 1 <= lines <= offered:
        raise ValueError(f"lines is {lines}, but {offered} lines are offered: give 1 to {offered}")
    return (int(lines),)


def _design(plan: Plan, best: Trial, periods: int, sample_rate: float) -> Design:
    totals = np.einsum("f,mfpq->mpq", best.power, plan.per_power)
    names, peaks = plan.limits.names, plan.limits.peaks
    seconds = plan.samples * periods / sample_rate
    return Design(
        excitation=_excitation(plan, best, periods, sample_rate),
        power=best.power[best.power > 0],
        predictions=tuple(Prediction(plan.names, total, seconds) for total in totals),
        offered=plan.omega,
        dispersion=best.dispersion,
        efficiency=best.efficiency,
        limits={
            name: (float(share * limit), float(limit))
            for name, share, limit in zip(names, best.peaks, peaks, strict=True)
        },
        crest_factor=float(best.peaks[0] * peaks[0] / np.sqrt(best.power.sum())),
        criterion=plan.criterion,
        lines=best.lines,
    )


def _excitation(plan: Plan, best: Trial, periods: int, sample_rate: float) -> Excitation:
    """The signal from its sample nearest to zero on."""
    amplitudes = np.sqrt(2 * best.power).astype(complex)[None, :]
    wave = multisine_signals(plan.orders, best.phase, amplitudes, plan.samples)[0]
    wave = np.roll(wave, -int(np.abs(wave).argmin()))
    lines = plan.omega[best.power > 0]
    return Excitation(
        np.arange(plan.samples * periods) / sample_rate,
        np.tile(wave, periods),
        lines,
        kind="multisine",
        omega_min=float(lines[0]),
        omega_max=float(lines[-1]),
        amplitude=float(np.abs(wave).max()),
        sample_rate=float(sample_rate),
        duration=float(plan.samples * periods / sample_rate),
    )
