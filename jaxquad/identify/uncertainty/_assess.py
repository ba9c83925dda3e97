"""From a solver's stop to a result that states what it is worth, in numbers and in remarks."""

import dataclasses
import functools as ft
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, PyTree

from jaxquad._core import as_messages, Message
from jaxquad.models import LaggedIntegrator
from jaxquad.spectra import FrequencyResponse

from ..frequency_domain._cost import Mask, widen_band
from ..frequency_domain._feedthrough import DirectDelay
from ..frequency_domain._parameters import Parameters
from ..frequency_domain._problem import on_device, Problem
from ..frequency_domain._refits import Origin
from ..frequency_domain._result import Fit
from ..frequency_domain._sampled import remarks_on_hold
from ..frequency_domain._solve import (
    is_saddle,
    Minimum,
    same_responses,
    Solution,
    solution_at,
)
from ..output_error._noise import NoiseModel
from ..output_error._simulated import Linear, linear_model
from ._discrepancy import Discrepancy
from ._error_budget import error_budget, ErrorBudget, Matrix, scaled_inverse, Weighting
from ._log_density import Evidence, evidence_of
from ._misfit import DOUBT, find_drift, local_misfits, MISFIT
from ._profiles import Profile, profiles
from ._resonance import likely_resonance, with_resonance
from ._response_term import Units, units_of
from ._verdict import (
    identifiability_of,
    Information,
    LIMIT,
    NO_MINIMUM,
    pooled_freedom,
    Verdict,
    without_numbers,
)
from ._zero_bounds import bounds_among, near_zeros, one_sided, without_bounds


UNFINISHED = 1e-2  # Newton decrement over cost, above which no number counts as determined
NO_MODEL = 0.5  # discrepancy in rad, above which nothing counts as determined
_STILL = 0.25  # standard errors: a bias of that size leaves a 95 % interval at 94.3 %
_ROUNDING = 1e-4  # relative change that nobody looks for, where there is no noise
_LARGE = 0.3  # discrepancy in neper, above which intervals by small changes are rough
_MANY = 0.8  # share of the parameters, undetermined: the model is too large
_POOR = 10.0  # ratio above which a local minimum is likely
_EXACT = 1e-9  # cost of a response without noise: no step lowers what rounding has left
_FAR = 7.0  # in ln: a parameter that moved by a factor of 1000 ran for zero or infinity
_BEYOND = 4.0  # random errors that a parameter at zero is pulled beyond it
_RIVAL = 1.5  # ratio of costs within which another minimum is a rival
_FEEDBACK = "feedback"  # kind of a reason

Vector = Float[np.ndarray, " parameters"]


def assess(
    problem: Problem,
    weighting: Weighting,
    solution: Solution,
    minima: tuple[Minimum, ...] = (),
    *,
    further: Sequence[str] = (),
    origin: Origin | None = None,
    by_slopes: bool = False,
) -> Fit:
    """Costs, bounds, calibrated covariance and identifiability at the solution. The fit gets the
    `further` remarks and its `origin`; `by_slopes` follows no parameter along the cost."""
    parameters, budget, bounds = problem.parameters, weighting.budget, ()
    names, count, start = parameters.names, parameters.count, units_of(solution)
    bread, gradient, units = budget.bread, budget.gradient, start  # by slopes at the solution
    local, beyond = local_misfits(budget, weighting.points)
    budget = with_resonance(budget, certain=beyond is not None)
    near = [] if by_slopes else near_zeros(problem, solution, budget)
    changes = {one.k: one.changes for one in near if one.changes is not None}
    # The next Gauss-Newton step, downhill: parameters at zero do not become negative, and those so
    # near it that slopes there say nothing about a step stand still.
    still = [one.k for one in near if one.k in changes and one.bound.value]
    free = np.setdiff1d(
        np.arange(count), [*(k for k in solution.at_zero if gradient[k] > 0), *still]
    )
    step, some = np.zeros(count), bread[np.ix_(free, free)] if free.size < count else bread
    step[free] = scaled_inverse(some) @ gradient[free]
    decrement = 0.5 * float(gradient @ step)

    def up_to_limits(units: Units) -> ErrorBudget:
        """With slopes that hold up to the limits of parameters near zero."""
        again = error_budget(problem, weighting.points, solution, units, changes)
        again = dataclasses.replace(again, mixtures=weighting.budget.mixtures)
        return with_resonance(again, certain=beyond is not None)

    followed = () if by_slopes else profiles(problem, solution, budget, near)
    if near:
        budget = up_to_limits(units)
        reached = np.max([np.zeros(count), *(one.reached() for one in followed)], axis=0)
        bounds, mixed = bounds_among(near, budget, solution, units, reached)
        if not np.array_equal(mixed, units):
            units, budget = mixed, up_to_limits(mixed)
    step = step * (start / units)[:count]
    # What compares fits of other structures is under weights by the noise alone.
    alone = budget
    if weighting.by_noise is not None:
        alone = error_budget(weighting.by_noise, weighting.points, solution, units)
    cost, misfit = float(alone.cost), float(alone.misfit_ratio)
    # A misfit beyond the noise is in no covariance of the noise.
    inflation = misfit if misfit > MISFIT**2 else 1.0
    zeros = [names.index(bound.name) for bound in bounds if not bound.value]

    def cut(covariance: Matrix) -> Matrix:
        """Without what the bounds of parameters at zero cut off."""
        covariance, steps = without_bounds(covariance, budget, zeros)
        for k, optimum in steps.items():
            covariance = one_sided(covariance, k, optimum)
        return covariance

    by_noise, covariance = cut(budget.by_noise), cut(budget.covariance)
    frfs, used = zip(*((record.frf, record.used) for record in budget.records), strict=True)
    controller = [mine & frf.of_controller for frf, mine in zip(frfs, used, strict=True)]
    dominated, points = (int(sum(map(np.count_nonzero, masks))) for masks in (controller, used))
    amplitude = budget.discrepancy.amplitude
    unfinished = decrement > UNFINISHED * max(cost, 1e-9)
    fed_back = 2 * dominated > points
    if fed_back:
        reason = Message(
            f"feedback dominates {dominated} of the {points} points in use: they show -1/C, the "
            "inverse of the controller, and not the plant",
            _FEEDBACK,
        )
        remedies = (
            "name the external reference («references=»)",
            "excite the axis («jq.sweep»), and record what excites it as the reference",
        )
        verdict = by_data = without_numbers("no model", names, reason, *remedies)
    elif unfinished or is_unfinished(solution, step, budget.by_noise):
        remedies = ("«start from other values»", "try many starts at once (starts=20)")
        verdict = by_data = no_minimum(names, decrement, cost, *remedies, message=solution.message)
    elif amplitude > NO_MODEL:
        verdict = by_data = no_model(names, amplitude)
    else:
        information = Information(
            root=budget.root,
            covariance=covariance,
            without=cut(budget.without_resonance),
            by_noise=by_noise,
            places=parameters.places,
            values=np.asarray(solution.values),
            units=units,
            same=ft.partial(same_responses, problem, solution),
            profiles=followed,
        )
        verdict, by_data = identifiability_of(information, budget.prior, bounds)
        indefinite = not verdict.identifiable and not len(verdict.exact)
        if indefinite and (wider := widen_band(frfs, used)):  # may tell parameters apart
            verdict = dataclasses.replace(verdict, remedies=(wider, *verdict.remedies))
    # Those of the responses' remarks that concern the points in use, each once.
    parts = [frf.remarks_about(mine) for frf, mine in zip(frfs, used, strict=True) if frf.remarks]
    remarks = list(dict.fromkeys(remark for part in parts for remark in part))
    remarks += remarks_on_hold(problem.model, frfs, used)
    # Few points of independent noise reach a large misfit by chance: the discrepancy, or the search
    # for a local misfit, has to say so, too.
    doubted = misfit if local or budget.discrepancy.none < DOUBT else min(misfit, 1.0)

    def remark(kind: str, text: str) -> None:
        remarks.append(Message(text, kind))

    if not fed_back:
        ran = runaways(problem, solution, verdict)
        remarks += ran
        stopped = decrement > 1e-3 * max(cost, _EXACT)
        if not solution.converged and (stopped or not (ran or cost < _EXACT)):
            remark("stopped early", f"the solver stopped early: {solution.message}")
        if stopped:
            more = "take more steps (max_steps=), or " if solution.message else ""
            turned = "; the phase is off by about 180 deg: try the other sign of the gain"
            remark(
                NO_MINIMUM,
                f"no minimum: one more Gauss-Newton step would lower the cost, {cost:.4g}, by "
                f"{2 * decrement:.3g}; {more}«try other starting values»"
                f"{turned if _is_opposite(problem, solution) else ''}",
            )
        if doubted > MISFIT**2 or local:
            ratio, where = np.sqrt(doubted), f", and {local}" if local and local.within else ""
            minimum = ", or this is a local minimum: «try other starting values»"
            remark(
                "misfit",
                f"the misfit is {ratio:.1f} times the random error{where}: the model's structure "
                f"does not explain the whole response{minimum if ratio > _POOR else ''}",
            )
        elif text := likely_resonance(budget):
            remark("resonance", text)
        drift = None if stopped or near else find_drift(alone)
        if drift and drift.is_clear(misfit) and all(one.kind != drift.kind for one in remarks):
            remark(drift.kind, str(drift))
        # Parameters at zero that the data want to have the other sign, by random errors.
        unbounded, steps = without_bounds(budget.by_noise, budget, zeros)
        pulls = {k: -x / float(np.sqrt(max(unbounded[k, k], 1e-300))) for k, x in steps.items()}
        lost = verdict.undetermined
        far = {names[k]: x for k, x in pulls.items() if names[k] not in lost and x > _BEYOND}
        if far:
            both, real = " and ".join(far), ", ".join(f"jq.identify.Real({name!r})" for name in far)
            remark(
                "sign",
                f"{both} came out as 0, and the data pull {'it' if len(far) == 1 else 'them'} "
                f"beyond by {max(far.values()):.0f} random errors«other sign|: start with the "
                f"other sign, or let the sign change with {real}; where that cannot be, the model» "
                "lacks something, or the time stamps of input and output are shifted",
            )
        structural = len(verdict.exact) and verdict.combinations  # the model's, at any noise
        if len(lost) >= max(_MANY * len(names), 4) and not structural:
            text = f"{len(lost)} of {len(names)} parameters are not determined, others rest on them"
            remark("too many parameters", f"{text}: fit a model with fewer poles and zeros")
        remarks += _remarks_on_model(solution.model, frfs, used)
        if solution.converged and is_saddle(problem, solution, float(budget.cost), bread):
            remark(
                "saddle",
                "stationary, but no minimum: the cost falls to one side; «start from other values»"
                "«, or give starts=20»",
            )
        true = [point for point in minima if point.is_minimum]
        rivals = [point for point in true[1:] if point.cost <= _RIVAL * true[0].cost]
        if rivals:
            values = ", ".join(f"{x:.4g}" for x in rivals[0].values)
            remark(
                "other minima",
                f"{len(rivals)} other minima cost less than {_RIVAL:g} times the best; the next "
                f"costs {rivals[0].cost:.4g} at {', '.join(names)} = {values}: record more, or "
                "over a wider band, to know which is right",
            )
        by_user = sum(not isinstance(q, DirectDelay) for q in problem.quantities)
        if by_user:
            pulls = budget.prior.misfit[:by_user]
            remarks += remarks_on_priors(pulls, verdict, by_data, chi_squared=doubted)
        if _LARGE < amplitude <= NO_MODEL:
            remark(
                "discrepancy",
                f"the model leaves {100 * amplitude:.0f} % of the response unexplained: the "
                "intervals are rough; fit the part of the band where it holds («band=»), or a "
                "model that explains more («Fit.explain()» names terms)",
            )
    return make_fit(
        problem,
        solution,
        bread=budget.bread,
        covariance=covariance,
        by_noise=by_noise,
        units=units[:count],
        verdict=verdict,
        decrement=decrement,
        cost=cost,
        average_cost=cost / sum(len(record.pairs) for record in budget.records),
        information=cost + 2 * inflation * float(alone.fitted_noise),
        chi_squared=misfit,
        points=points,
        freedom=budget.degrees_of_freedom,
        remarks=(*remarks, *further),
        minima=minima,
        discrepancy=budget.discrepancy,
        origin=origin,
        profiles=followed if verdict.fitted else (),
        evidence=evidence_of(problem, budget),
    )


def is_unfinished(solution: Solution, step: Vector, covariance: Matrix) -> bool:
    """Whether the solver stopped early, where the next `step` still moves an estimate. Step and
    covariance, that of the noise, are those of relative changes."""
    limit = _STILL * np.sqrt(np.maximum(np.diagonal(covariance), 0.0)) + _ROUNDING
    return not solution.converged and bool(np.any(np.abs(step) > limit))


def no_minimum(
    names: tuple[str, ...], decrement: float, cost: float, *remedies: str, message: str = ""
) -> Verdict:
    """The verdict on a stop from which a step would still lower the cost. The `message` says why
    the solver stopped early, and is empty where it did not."""
    reason = f"one more Gauss-Newton step would lower the cost, {cost:.4g}, by {2 * decrement:.3g}"
    if message:
        reason = f"the fit has not converged: {message[:1].lower()}{message[1:]}; {reason}"
        remedies = ("take more steps (max_steps=)", *remedies)
    return without_numbers("no minimum", names, reason, *remedies)


def no_model(names: tuple[str, ...], unexplained: float) -> Verdict:
    """The verdict on a fit that leaves more than half of the response `unexplained`."""
    reason = f"it leaves {100 * min(unexplained, 1.0):.0f} % of the response unexplained"
    remedies = (
        "fit the part of the band where it holds («band=»)",
        "fit a model that explains more («Fit.explain()» names terms)",
        "«start from other values»: this may be a local minimum",
    )
    return without_numbers("no model", names, reason, *remedies)


def runaways(problem: Problem, solution: Solution, verdict: Verdict) -> list[Message]:
    """Remarks on parameters that ran to zero or to infinity, as far as nothing bounds them."""
    names, lost = problem.parameters.names, verdict.undetermined
    start = np.asarray(problem.parameters.start)[: solution.z.size]
    if verdict.kind == "no model" and _is_opposite(problem, solution_at(problem, start)):
        text = "the phase at the start is off by about 180 deg: start with the other sign of the "
        return [Message(f"{text}gain", "sign")]
    texts = [
        f"{names[k]} ran to zero: leave it out«sign|, or let its sign change with "
        f"jq.identify.Real({names[k]!r})»"
        for k in solution.at_zero
        if names[k] in lost
    ]
    rose = np.flatnonzero(np.asarray(solution.z) - start > _FAR)
    if far := [names[k] for k in rose if problem.parameters.logarithmic[k] and names[k] in lost]:
        other = "«start from other values», or fit a simpler model"
        texts.append(f"{', '.join(far)} ran to infinity: {other}")
    return [Message(text, "runaway") for text in texts]


def _is_opposite(problem: Problem, solution: Solution) -> bool:
    """Whether the model turns the wrong way at the lowest frequencies."""
    for weights, misfit in zip(problem.weights, solution.sensitivity.misfits, strict=True):
        used = np.asarray(weights)[..., 0] > 0
        phases = np.abs(np.asarray(misfit)[..., 1][used])
        if phases.size and np.median(phases[: max(phases.size // 4, 1)]) > 2.5:
            return True
    return False


def _remarks_on_model(
    model: PyTree, frfs: Sequence[FrequencyResponse], used: Sequence[Mask]
) -> list[Message]:
    """Remark on a model that grows within the band of a direct estimate: no open loop does."""
    lags = isinstance(model, LaggedIntegrator) and not np.asarray(model.lag) < 0
    if lags or not any(frf.method == "direct" for frf in frfs):
        return []
    if not isinstance(model, Linear):
        return []
    pairs = zip(frfs, used, strict=True)
    omega = np.concatenate([np.asarray(f.omega)[np.any(mine, axis=(1, 2))] for f, mine in pairs])
    lowest, highest = float(np.min(omega)), float(np.max(omega))
    poles = linear_model(on_device(model)).poles
    growth = float(np.max(np.real(poles[np.abs(poles) < highest]), initial=0.0))
    if not growth > lowest:
        return []
    text = (
        f"the model grows by e in {1 / growth:.2g} s (a pole at +{growth:.3g} rad/s), which no "
        "record in open loop can do: a controller flew, and the direct estimate is biased towards "
        "its -1/C; name an external reference («references=»)"
    )
    return [Message(text, "growth")]


def remarks_on_priors(
    pulls: Float[np.ndarray, " priors"],
    verdict: Verdict,
    by_data: Verdict,
    *,
    chi_squared: float = 1.0,
) -> list[Message]:
    """Parameters that only a prior determines, and priors that the data contradict."""
    texts = [
        f"prior {k + 1} is {abs(pull):.1f} of its standard errors away from the fit: data and "
        "prior contradict each other; check both"
        for k, pull in enumerate(pulls)
        if abs(pull) > 3
    ]
    if pulls.size and not texts and chi_squared > MISFIT**2:
        texts.append(
            "the misfit may be that of a prior which the record contradicts: compare the fit "
            "without priors="
        )
    resolved = [name for name in by_data.undetermined if name not in verdict.undetermined]
    if resolved:
        alone = ", ".join(combination.name for combination in by_data.combinations)
        texts.append(
            f"{' and '.join(resolved)}: determined by the prior alone; the record by itself "
            f"determines {'only ' + alone if alone else 'none of them'}"
        )
    return [Message(text, "prior") for text in texts]


def make_fit(
    problem: Problem,
    solution: Solution,
    *,
    bread: Matrix,
    covariance: Matrix,
    by_noise: Matrix,
    units: Vector,
    verdict: Verdict,
    decrement: float,
    cost: float,
    average_cost: float,
    information: float,
    chi_squared: float,
    points: int,
    remarks: tuple[str, ...],
    minima: tuple[Minimum, ...] = (),
    freedom: Vector | None = None,
    discrepancy: Discrepancy | None = None,
    noise_models: tuple[tuple[NoiseModel, ...], ...] = (),
    origin: Origin | None = None,
    profiles: tuple[Profile, ...] = (),
    evidence: Evidence | None = None,
) -> Fit:
    """A result in physical units; both covariances are those of changes relative to `units`.
    `freedom` is that of the noise estimate, infinite without."""
    names, values = problem.parameters.names, np.asarray(solution.values)[: units.size]
    freedom = np.full(units.size, np.inf) if freedom is None else freedom
    pooled = pooled_freedom(freedom, np.ones(units.size))
    combinations = (one._replace(degrees_of_freedom=pooled) for one in verdict.combinations)
    verdict = dataclasses.replace(verdict, combinations=tuple(combinations))
    fed_back = any(reason.kind == _FEEDBACK for reason in verdict.reasons)
    if runaways(problem, solution, verdict) and not fed_back:
        verdict = dataclasses.replace(verdict, remedies=())  # the remarks say what to do
    unbounded = np.zeros(len(names), dtype=bool)
    if verdict.undetermined:
        # A pseudo-inverse shows no variance along a null direction: there it is unbounded.
        rows = [[row.get(name, 0.0) for name in names] for row in verdict.null_directions]
        hidden = [row for row in np.array(rows) if row @ covariance @ row < (0.5 * LIMIT) ** 2]
        null = np.reshape([*hidden, *verdict.exact], (-1, len(names)))
        lost = np.array([name in verdict.undetermined for name in names])
        unbounded = lost & np.any(np.abs(null) > 1e-6, axis=0)

    def in_units(relative: Matrix) -> Matrix:
        physical = relative * np.outer(units, units)
        if unbounded.any():
            physical[unbounded, :] = physical[:, unbounded] = np.nan
        return physical

    physical = in_units(covariance)
    with np.errstate(divide="ignore"):
        percent = np.where(values == 0, np.nan, 100 * np.abs(units / values))
    # CIFER's, with H = d2J/dz2 = 2 J'J: Cramer-Rao bounds 2 sqrt((H^-1)_ii), and 1 / sqrt(H_ii).
    bounds = np.sqrt(2 * np.diagonal(scaled_inverse(bread)))
    insensitivity = 1 / np.sqrt(np.maximum(2 * np.diagonal(bread), 1e-300))
    scale = np.sqrt(np.maximum(np.diagonal(bread), 1e-300))
    spread = np.linalg.eigvalsh(bread / np.outer(scale, scale))
    return Fit(
        model=on_device(solution.model),
        names=names,
        values=values,
        standard_errors=np.where(unbounded, np.inf, np.sqrt(np.diagonal(physical))),
        covariance=physical,
        noise_covariance=in_units(by_noise),
        cramer_rao=np.where(unbounded, np.inf, bounds * percent),
        insensitivity=insensitivity * percent,
        cost=cost,
        average_cost=average_cost,
        information=information,
        chi_squared=chi_squared,
        newton_decrement=decrement,
        condition=float(np.sqrt(spread[-1] / max(spread[0], 1e-30 * spread[-1], 1e-300))),
        points=points,
        steps=solution.steps,
        verdict=verdict,
        remarks=as_messages(remarks),
        parameters=problem.parameters,
        units=units,
        relative_covariance=covariance,
        relative_noise_covariance=by_noise,
        minima=minima,
        degrees_of_freedom=freedom,
        discrepancy=discrepancy,
        noise_models=noise_models,
        origin=origin,
        profiles=profiles,
        evidence=evidence,
    )


def unfitted(
    model: PyTree, parameters: Parameters, verdict: Verdict, remarks: tuple[str, ...] = ()
) -> Fit:
    """What a fit returns where there is nothing to fit: the starting values, all marked."""
    count = parameters.count
    infinite, unknown = np.full(count, np.inf), np.full((count, count), np.nan)
    numbers = ("cost", "average_cost", "information", "chi_squared", "newton_decrement")
    matrices = ("covariance", "noise_covariance", "relative_covariance")
    return Fit(
        model=model,
        names=parameters.names,
        values=np.asarray(parameters.values(parameters.start[:count])),
        standard_errors=infinite,
        cramer_rao=infinite,
        insensitivity=infinite,
        degrees_of_freedom=infinite,
        condition=np.inf,
        points=0,
        steps=0,
        verdict=verdict,
        remarks=as_messages(remarks),
        parameters=parameters,
        units=np.asarray(parameters.slopes(parameters.start[:count])),
        **dict.fromkeys(numbers, np.nan),
        **dict.fromkeys((*matrices, "relative_noise_covariance"), unknown),
    )
