from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float, PyTree

from jaxquad._core import require_all_positive, require_x64, whole_samples
from jaxquad.excitation import check_lines, Excitation, harmonics
from jaxquad.identify import Free, select_parameters

from ._prediction import check_distinct, Noise, Prediction, unit_information
from ._search import Criterion, DOptimal, gather_limits, multisine_signals, Plan, search, Trial


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
    limits = gather_limits(offered, responses, amplitude, rate, output_amplitude)
    orders = np.round(offered * period / (2 * np.pi)).astype(int)
    plan = Plan(offered, orders, samples, names, seconds * np.stack(units), limits, criterion)
    if lines is None:
        least = [k * len(names) for k in _LINES if k * len(names) <= offered.size // 2]
        least = least or [max(1, offered.size // 2)]
    elif 1 <= lines <= offered.size:
        least = [int(lines)]
    else:
        raise ValueError(
            f"lines is {lines}, but {offered.size} lines are offered: give 1 to {offered.size}"
        )
    return _design(plan, search(plan, tuple(least), seed), periods, float(sample_rate))


def _design(plan: Plan, best: Trial, periods: int, sample_rate: float) -> Design:
    amplitudes = np.sqrt(2 * best.power).astype(complex)[None, :]
    wave = multisine_signals(plan.orders, best.phase, amplitudes, plan.samples)[0]
    wave = np.roll(wave, -int(np.abs(wave).argmin()))  # from its sample nearest to zero on
    lines, duration = plan.omega[best.power > 0], plan.samples * periods / sample_rate
    excitation = Excitation(
        np.arange(plan.samples * periods) / sample_rate,
        np.tile(wave, periods),
        lines,
        kind="multisine",
        omega_min=float(lines[0]),
        omega_max=float(lines[-1]),
        amplitude=float(np.abs(wave).max()),
        sample_rate=sample_rate,
        duration=float(duration),
    )
    totals = np.einsum("f,mfpq->mpq", best.power, plan.per_power)
    peaks = zip(plan.limits.names, best.peaks, plan.limits.peaks, strict=True)
    return Design(
        excitation=excitation,
        power=best.power[best.power > 0],
        predictions=tuple(Prediction(plan.names, total, duration) for total in totals),
        offered=plan.omega,
        dispersion=best.dispersion,
        efficiency=best.efficiency,
        limits={name: (float(share * limit), float(limit)) for name, share, limit in peaks},
        crest_factor=float(best.peaks[0] * plan.limits.peaks[0] / np.sqrt(best.power.sum())),
        criterion=plan.criterion,
        lines=best.lines,
    )
