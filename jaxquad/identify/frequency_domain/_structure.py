"""Structure of a model: parameters that responses do not need, and what they show beside it.

That is a damping, and an actuator of two lags. What the response of this is relative to that of one
lag T depends on T, of which the remark on the response has a table: it is read where the model's
own lag is.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxquad.models import LaggedIntegrator
from jaxquad.spectra import FrequencyResponse, TwoLags

from ..uncertainty._error_budget import FOLLOWS
from ._cost import Band, Cost, MaximumLikelihood
from ._fit import fit_with
from ._fit_table import counted
from ._parameters import Free, Parameters, Positive, select_parameters, Tie
from ._refits import (
    Candidate,
    check_options,
    free_again,
    model_to_start_from,
    Options,
    Origin,
    require_origin,
    require_responses,
)
from ._result import Fit


class Step(NamedTuple):
    """A fit without one parameter, and the decision."""

    parameter: str
    reason: str
    average_cost: float  # without it
    rise: float  # of the average cost
    information: float  # without it
    change: float  # of the information criterion
    dropped: bool
    verdict: str


class Reduction(eqx.Module):
    """The smallest structure that explains the responses, and the steps that led to it."""

    fit: Fit
    first: Fit
    steps: tuple[Step, ...] = eqx.field(static=True)

    @property
    def dropped(self) -> tuple[str, ...]:
        """Parameters left out, in order."""
        return tuple(step.parameter for step in self.steps if step.dropped)

    def __str__(self) -> str:
        width = max([9, *(len(step.parameter) for step in self.steps)])
        lines = [
            f"start: {len(self.first.names)} parameters, J_ave {self.first.average_cost:.4g}, "
            f"information criterion {self.first.information:.5g}",
            f"{'parameter':<{width}}  {'why':<16}{'J_ave':>9}{'rise':>10}{'change':>12}  verdict",
        ]
        for step in self.steps:
            numbers = f"{step.average_cost:9.4g}{step.rise:+10.3g}{step.change:+12.4g}"
            lines.append(f"{step.parameter:<{width}}  {step.reason:<16}{numbers}  {step.verdict}")
        return "\n".join(
            [*lines, f"{counted(len(self.fit.names), 'parameter')} left:", str(self.fit)]
        )


def reduce_structure(
    model: PyTree,
    frf: FrequencyResponse | Sequence[FrequencyResponse],
    *,
    free: Free = None,
    tied: Mapping[str, Tie] | None = None,
    cost: Cost = MaximumLikelihood(),
    band: Band = None,
    min_coherence: float | None = None,
    null: Mapping[str, float] | None = None,
    insensitivity: float = 10.0,
    cramer_rao: float = 20.0,
    rise: float | None = None,
) -> Reduction:
    """Leave out, one after the other, the parameters that the responses do not need.

    Tried first is the parameter with the largest insensitivity above `insensitivity`, then the one
    with the largest Cramer-Rao bound above `cramer_rao`. It is set to its `null` value and the rest
    is fitted again. It stays out if Takeuchi's information criterion does not rise.

    **Arguments:**

    - `model`, `frf`, `free`, `tied`, `cost`, `band`, `min_coherence`: as in `jq.fit`.
    - `null`: values of parameters that are left out, by name; 0 by default.
    - `insensitivity`, `cramer_rao`: limits in per cent.
    - `rise`: leave out by the rise of the average cost instead, which is to be no more than this;
        1 to 2 is usual with CIFER.

    **Raises:** ValueError for a name in `null` that is not free, and for what `jq.fit` refuses.

    Source: Tischler & Remple, ch. 13, model structure determination.
    """
    check_options(cost, band, min_coherence, 1)
    parameters, null = select_parameters(model, free, tied), null or {}
    kinds = {parameter.name: parameter for parameter in free_again(parameters)}
    frfs = require_responses(frf)
    unknown = set(null) - set(parameters.names)
    if unknown:
        raise ValueError(
            f"null names {', '.join(sorted(unknown))}, which is not free; free are: "
            f"{', '.join(parameters.names)}"
        )

    def fit_free(model: PyTree, names: Sequence[str], rounds: int = 0) -> Fit:
        """Under the noise alone: a floor of each structure's error would hide its misfit."""
        chosen = [kinds[name] for name in names]
        options = Options(chosen, tied, cost, None, (), band, min_coherence, 1, None, 256)
        return fit_with(model, frfs, options, rounds=rounds)

    first = best = fit_free(model, parameters.names)
    steps: list[Step] = []
    while len(best.names) > 1 and best.verdict.fitted:
        # The parameter to try without, and why: insensitivity comes first.
        tried, worst = {step.parameter for step in steps}, None
        left = [k for k, name in enumerate(best.names) if name not in tried]
        bounds = np.where(best.determined, best.cramer_rao, np.inf)
        for label, values, limit in (
            ("I", best.insensitivity, insensitivity),
            ("CR", bounds, cramer_rao),
        ):
            if worst is None and left and values[k := max(left, key=lambda k: values[k])] > limit:
                shown = f"{values[k]:.3g} %" if np.isfinite(values[k]) else "unbounded"
                worst = best.names[k], f"{label} {shown}"
        if worst is None:
            break
        name, reason = worst
        place = best.parameters.places[best.names.index(name)]
        alone = Parameters((place,), (), (False,), 1, jnp.ones(1), jnp.zeros(1))
        without = alone.replace(best.model, jnp.asarray([null.get(name, 0.0)]))
        try:
            trial = fit_free(without, [other for other in best.names if other != name])
        except ValueError:  # the model has no response then
            trial = None
        if trial is None or not np.isfinite(trial.cost):
            numbers = (np.inf, np.inf, np.inf, np.inf)
            steps.append(Step(name, reason, *numbers, False, "kept: no fit without it"))
            continue
        higher = trial.average_cost - best.average_cost
        change = trial.information - best.information
        dropped = change <= 0 if rise is None else higher <= rise
        numbers = trial.average_cost, higher, trial.information, change
        steps.append(
            Step(name, reason, *numbers, dropped, "dropped" if dropped else "kept: needed")
        )
        best = trial if dropped else best
    if best.verdict.fitted:
        best = fit_free(model_to_start_from(best), best.names, rounds=3)
    return Reduction(best, first, tuple(steps))


# One-sided tests of 5 %: a damping too many only widens the intervals of the others, while one
# that is left out at 2 standard errors puts the gain 1.5 standard errors off.
_SIGNIFICANT = 1.645  # standard errors
_DROP = 2.71  # of the cost, of one parameter that may not be negative
_LOWEST = 0.1  # of the lowest frequency: a smaller start has no slope
_SLOW = 4.0  # times the lowest frequency: up to there damping turns the phase most
_REACH = 1.96  # standard errors from the middle of a 95 % interval to its end
_NAME = "damping"


def fit_damped(fit: Fit, *, unmodelled: float = 0.05) -> Fit:
    """Fit K e^(-delay s) / (s^(n-1) (s + damping) (lag s + 1)) where the response shows a damping.

    It does where the damping exceeds 1.645 of its standard errors, model error included, and lowers
    the cost of a maximum likelihood by 2.71 times the misfit (one-sided tests of 5 %). The start
    follows from the phase at the lowest frequencies; one or two further fits are made.

    **Arguments:**

    - `fit`: of a `jq.LaggedIntegrator` with one or more integrators.
    - `unmodelled`: what a model with damping still leaves out of the phase at the lowest frequency,
        in rad. The standard errors of the others count as much as they move when a damping of that
        effect is left out: it looks like other drag, coupling and thrust curves.

    **Returns:** the fit with a free `damping`; `fit` itself where the response shows none, where
    nothing was fitted, and where its damping is not 0 or free already.

    **Raises:** ValueError where the fit is one of another model, or none of `jq.fit`, and where
    `unmodelled` is negative.

    !!! example

        ```python
        fit = jq.identify.fit_damped(jq.fit(jq.LaggedIntegrator(400.0, 0.03, 0.01), frf))
        ```
    """
    model = fit.model
    if not isinstance(model, LaggedIntegrator) or model.integrators < 1:
        without = " without integrators" if isinstance(model, LaggedIntegrator) else ""
        raise ValueError(
            f"the fit is one of a {type(model).__name__}{without}: damping takes the "
            "place of an integrator of a jq.LaggedIntegrator"
        )
    if not unmodelled >= 0:
        raise ValueError(f"unmodelled is {unmodelled}: give an angle in rad, 0 for none")
    if not fit.verdict.fitted or _NAME in fit.names or np.any(model.damping):
        return fit
    origin, best = require_origin(fit), None
    low, high = origin.band
    # The phase at the lowest frequencies: s / (s + c) leads by c / w, which counts as the square of
    # what its error lets it.
    turned = weight = 0.0
    for points in origin.points:
        omega, used = np.asarray(points.frf.omega), np.asarray(points.used)[:, 0, 0]
        slow = used & (omega < _SLOW * low)
        some, response = omega[slow], np.asarray(points.frf.response)[slow, 0, 0]
        flat = response * (1j * some) ** fit.model.integrators / np.sign(float(fit.model.gain))
        late = float(fit.model.lag) + float(fit.model.delay)
        lead = np.angle(flat * np.exp(1j * late * some))
        share = (1 / (some * np.asarray(points.frf.random_error)[slow, 0, 0])) ** 2
        turned, weight = turned + float(share @ (some * lead)), weight + float(np.sum(share))
    by_phase = turned / weight if weight else 0.0
    by_phase = float(np.clip(by_phase, _LOWEST * low, high))
    for start in (by_phase, float(np.sqrt(low * high))):
        start_model = dataclasses.replace(model_to_start_from(fit), damping=start)
        free = [*free_again(fit.parameters), Positive(_NAME)]
        damped = origin.fit_again(start_model, origin.options._replace(free=free, starts=1))
        if damped is not None and damped.verdict.fitted:
            best = damped if best is None or damped.cost < best.cost else best
        if best is not None and best.cost <= fit.cost and best.verdict.kind != "no minimum":
            break
    if best is None:
        return fit
    # Whether the damping is more than the noise, and the misfit, make of none.
    k = best.names.index(_NAME)
    error = best.standard_errors[k] if best.determined[k] else np.inf
    shows = best.values[k] > max(_SIGNIFICANT * error, 0.0)
    shows = shows and not any(bound.name == _NAME for bound in best.verdict.bounds)
    if isinstance(origin.options.cost, MaximumLikelihood):
        shows = shows and (fit.cost - best.cost) / max(1.0, best.chi_squared) > _DROP
    if not shows:
        return fit
    best = _with_unmodelled(best, fit, unmodelled * low)
    units = dict(zip(fit.names, fit.parameter_units, strict=False)) | {_NAME: "1/s"}
    units = tuple(units[name] for name in best.names) if fit.parameter_units else ()
    return dataclasses.replace(best, parameter_units=units)


def _with_unmodelled(damped: Fit, plain: Fit, damping: float) -> Fit:
    """The fit whose errors count what an unmodelled `damping` in 1/s moves at most, as 95 %."""
    if damped.discrepancy is None:
        return damped
    share = min(1.0, damping / float(damped.values[damped.names.index(_NAME)]))
    bounded = {bound.name for bound in damped.verdict.bounds}
    moved = np.zeros(len(damped.names))
    for k, name in enumerate(damped.names):
        if name != _NAME and name not in bounded:
            moved[k] = share * (damped.values[k] - plain.values[plain.names.index(name)]) / _REACH
    errors = np.sqrt(damped.standard_errors**2 + moved**2)
    relative = moved / damped.units
    pairs = zip(damped.discrepancy.widths, errors > FOLLOWS * damped.standard_errors, strict=True)
    widths = tuple("prior" if wider else width for width, wider in pairs)
    return dataclasses.replace(
        damped,
        covariance=damped.covariance + np.outer(moved, moved),
        standard_errors=errors,
        relative_covariance=damped.relative_covariance + np.outer(relative, relative),
        discrepancy=dataclasses.replace(damped.discrepancy, widths=widths),
    )


_ROUNDS, _SETTLED = 6, 1e-3  # fits behind two lags; relative change of their mean
_LEAST = 0.2  # of 1 less what a lag moves itself


def _two_lags(frf: FrequencyResponse) -> TwoLags | None:
    """What the response to a single input says of its actuator."""
    remark = next((one for one in frf.remarks if isinstance(one, TwoLags)), None)
    fits = remark is not None and remark.changes.shape[1] == np.size(frf.omega)
    return remark if fits and len(frf.input_names) == 1 else None


def fit_behind_lags(fit: PyTree, origin: Origin) -> tuple[Candidate, str] | None:
    """The fit to the responses behind an actuator of two lags, whose mean is the model's lag if it
    has one; and a sentence about them. None where no actuator has two, or the solver diverged."""
    remarks = [_two_lags(frf) for frf in origin.frfs]
    if not any(remarks):
        return None
    options = origin.options._replace(free=free_again(fit.parameters), starts=1)

    def lag_of(model: PyTree) -> float | None:
        lag = getattr(model, "lag", None)
        return float(np.asarray(lag)) if lag is not None and np.ndim(lag) == 0 else None

    def fit_behind(model: PyTree, lag: float | None, *, further: bool = False) -> PyTree:
        frfs = []
        for frf, remark in zip(origin.frfs, remarks, strict=True):
            if remark is not None:
                here = remark.at(lag)
                change = here.further if further else here.change
                frf = dataclasses.replace(
                    frf, response=frf.response / change[:, None, None],
                    errors=frf.errors.scaled(1 / change),
                    remarks=tuple(one for one in frf.remarks if one is not remark),
                )  # fmt: skip
            frfs.append(frf)
        try:
            return origin.run(model, frfs, options)
        except ValueError:
            return None

    behind, lag = fit, lag_of(fit.model)
    for _ in range(_ROUNDS):  # the tables are read at the lag that is fitted
        behind = fit_behind(model_to_start_from(behind), lag)
        if behind is None or not behind.verdict.fitted:
            return None
        lag, before = lag_of(behind.model), lag
        if lag is None or before is None or abs(lag - before) <= _SETTLED * abs(lag):
            break
    # The doubt about b moves all parameters, and a lag that is off moves b.
    clearest = max((one for one in remarks if one is not None), key=lambda one: one.clear)
    middle = float(clearest.lags[clearest.lags.size // 2]) if lag is None else lag
    here, count = clearest.at(middle), len(fit.names)
    other = fit_behind(model_to_start_from(behind), lag, further=True)
    moved = np.zeros(count) if other is None else np.asarray(other.values - behind.values)
    of_lag, slope = np.zeros(count), 0.0
    if "lag" in fit.names:
        of_lag[fit.names.index("lag")] = 1.0
        ends = [clearest.at(middle * factor).difference for factor in (1.1, 1 / 1.1)]
        slope = (ends[0] - ends[1]) / (2 * np.log(1.1)) / middle
    itself = slope * float(of_lag @ moved) / here.error
    amplified = np.eye(count) + np.outer(moved, of_lag) * slope / here.error / max(
        1 - itself, _LEAST
    )
    settled = bool(np.all(np.isfinite(fit.covariance)) and np.all(np.isfinite(behind.covariance)))
    if settled:
        behind = _with_doubt(behind, moved, amplified)
    lags, relative = [], []
    for side in (1, -1):  # of T / (1 + b) and of T / (1 - b)
        lags.append(middle / (1 + side * here.difference))
        direct = -side / (1 + side * here.difference)
        by_lag = amplified.T @ of_lag * (1 / middle + direct * slope)
        doubt = direct * here.error + float(by_lag @ moved)
        by_noise = by_lag @ fit.covariance @ by_lag if settled else np.inf
        relative.append(np.sqrt(by_noise + doubt**2))
    up, down = (f"{x:.3g} +- {x * e:.2g} s" for x, e in zip(lags, relative, strict=True))
    price = 2 * np.log(2 * origin.independent_points)
    title = "an actuator of two lags"
    candidate = Candidate(title, "m' = (u - m) / T", behind, clearest.clear**2 - float(price))
    rest = "" if "lag" in fit.names else ", where their difference is clearest"
    return candidate, (
        f"The actuator has two lags: {up} while its command rises, {down} while it falls{rest}. "
        "The values below are those of the plant behind it, with the lag 2 / (1 / up + 1 / down)"
    )


def _with_doubt(fit: PyTree, moved: np.ndarray, amplified: np.ndarray) -> PyTree:
    """With a further error that moves all values together, and all errors `amplified`."""
    units = np.outer(fit.units[: moved.size], fit.units[: moved.size])

    def doubted(covariance: np.ndarray) -> np.ndarray:
        return amplified @ (covariance + np.outer(moved, moved)) @ amplified.T

    covariance, by_noise = doubted(fit.covariance), doubted(fit.noise_covariance)
    return dataclasses.replace(
        fit,
        covariance=covariance,
        noise_covariance=by_noise,
        standard_errors=np.sqrt(np.diagonal(covariance)),
        relative_covariance=covariance / units,
        relative_noise_covariance=by_noise / units,
    )
