"""What a fit says about itself: runaway parameters, misfit, no minimum, no model."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from jaxquad._core import Message

from ..frequency_domain._problem import Problem
from ..frequency_domain._solve import Solution, solution_at
from ._accuracy import Matrix
from ._error_budget import Discrepancy
from ._verdict import NO_MINIMUM, Verdict, without_numbers


_STILL = 0.25  # standard errors: a bias of that size leaves a 95 % interval at 94.3 %
_ROUNDING = 1e-4  # relative change that nobody looks for, where there is no noise
MISFIT = 1.5  # ratio of misfit to random error from which the model's structure is in doubt
DOUBT = 0.05  # probability that the model is right, below which a misfit is remarked
NO_MODEL = 0.5  # discrepancy in rad, above which nothing counts as determined
_LARGE = 0.3  # discrepancy in neper, above which intervals by small changes are rough
_POOR = 10.0  # ratio above which a local minimum is likely
_EXACT = 1e-9  # cost of a response without noise: no step lowers what rounding has left
_LOCAL = ", or this is a local minimum: «try other starting values»"
_FAR = 7.0  # in ln: a parameter that moved by a factor of 1000 ran for zero or infinity
_BEYOND = 4.0  # random errors that a parameter at zero is pulled beyond it
_FEEDBACK = "feedback"  # kind of a reason


def no_minimum(
    names: tuple[str, ...], decrement: float, cost: float, *remedies: str, message: str = ""
) -> Verdict:
    """The verdict on a stop from which a step would still lower the cost.

    The `message` says why the solver stopped early, and is empty where it did not.
    """
    reason = f"one more Gauss-Newton step would lower the cost, {cost:.4g}, by {2 * decrement:.3g}"
    if message:
        reason = f"the fit has not converged: {message[:1].lower()}{message[1:]}; {reason}"
        remedies = ("take more steps (max_steps=)", *remedies)
    return without_numbers("no minimum", names, reason, *remedies)


def is_unfinished(
    solution: Solution, step: Float[np.ndarray, " parameters"], covariance: Matrix
) -> bool:
    """Whether the solver stopped early, where the next `step` still moves an estimate.

    Step and covariance, that of the noise, are those of relative changes.
    """
    limit = _STILL * np.sqrt(np.maximum(np.diagonal(covariance), 0.0)) + _ROUNDING
    return not solution.converged and bool(np.any(np.abs(step) > limit))


def remarks_on_fit(
    problem: Problem,
    solution: Solution,
    cost: float,
    decrement: float,
    chi_squared: float,
    verdict: Verdict,
) -> list[Message]:
    """Runaway parameters, missing convergence, misfit beyond the noise."""
    remarks = runaways(problem, solution, verdict)
    no_minimum = decrement > 1e-3 * max(cost, _EXACT)
    if not solution.converged and (no_minimum or not (remarks or cost < _EXACT)):
        remarks.append(Message(f"the solver stopped early: {solution.message}", "stopped early"))
    if no_minimum:
        more = "take more steps (max_steps=), or " if solution.message else ""
        turned = "; the phase is off by about 180 deg: try the other sign of the gain"
        remarks.append(
            Message(
                f"no minimum: one more Gauss-Newton step would lower the cost, {cost:.4g}, by "
                f"{2 * decrement:.3g}; {more}«try other starting values»"
                f"{turned if _is_opposite(problem, solution) else ''}",
                NO_MINIMUM,
            )
        )
    if chi_squared > MISFIT**2:
        ratio = np.sqrt(chi_squared)
        remarks.append(
            Message(
                f"the misfit is {ratio:.1f} times the random error: the model's structure does not "
                f"explain the whole response{_LOCAL if ratio > _POOR else ''}",
                "misfit",
            )
        )
    return remarks


def no_model(names: tuple[str, ...], unexplained: float) -> Verdict:
    """The verdict on a fit that leaves more than half of the response `unexplained`."""
    reason = f"it leaves {100 * min(unexplained, 1.0):.0f} % of the response unexplained"
    remedies = (
        "fit the part of the band where it holds («band=»)",
        "fit a model that explains more («Fit.explain()» names terms)",
        "«start from other values»: this may be a local minimum",
    )
    return without_numbers("no model", names, reason, *remedies)


def remarks_on_bounds(pulled: Mapping[str, float], verdict: Verdict) -> list[Message]:
    """Remark on parameters at zero that the data want to have the other sign."""
    lost = verdict.undetermined
    far = {name: pull for name, pull in pulled.items() if name not in lost and pull > _BEYOND}
    if not far:
        return []
    names, free = " and ".join(far), ", ".join(f"jq.identify.Real({name!r})" for name in far)
    text = (
        f"{names} came out as 0, and the data pull {'it' if len(far) == 1 else 'them'} beyond by "
        f"{max(far.values()):.0f} random errors«other sign|: start with the other sign, or let the "
        f"sign change with {free}; where that cannot be, the model» lacks something, or the time "
        "stamps of input and output are shifted"
    )
    return [Message(text, "sign")]


def remarks_on_growth(growth: float) -> list[Message]:
    """Remark on a pole of `growth` 1/s in the model of a direct estimate."""
    text = (
        f"the model grows by e in {1 / growth:.2g} s (a pole at +{growth:.3g} rad/s), which no "
        "record in open loop can do: a controller flew, and the direct estimate is biased towards "
        "its -1/C; name an external reference («references=»)"
    )
    return [Message(text, "growth")]


def fed_back(names: tuple[str, ...], dominated: int, used: int) -> Verdict:
    """The verdict on a fit most of whose points show the controller."""
    reason = Message(
        f"feedback dominates {dominated} of the {used} points in use: they show -1/C, the inverse "
        "of the controller, and not the plant",
        _FEEDBACK,
    )
    remedies = (
        "name the external reference («references=»)",
        "excite the axis («jq.sweep»), and record what excites it as the reference",
    )
    return without_numbers("no model", names, reason, *remedies)


def is_fed_back(verdict: Verdict) -> bool:
    """Whether feedback is why no model holds."""
    return any(reason.kind == _FEEDBACK for reason in verdict.reasons)


def remarks_on_discrepancy(discrepancy: Discrepancy) -> list[Message]:
    """Remark on a model that explains too little of the response for its intervals to be exact."""
    if not _LARGE < discrepancy.amplitude <= NO_MODEL:
        return []
    text = (
        f"the model leaves {100 * discrepancy.amplitude:.0f} % of the response unexplained: the "
        "intervals are rough; fit the part of the band where it holds («band=»), or a model that "
        "explains more («Fit.explain()» names terms)"
    )
    return [Message(text, "discrepancy")]


def _is_opposite(problem: Problem, solution: Solution) -> bool:
    """Whether the model turns the wrong way at the lowest frequencies."""
    for weights, misfit in zip(problem.weights, solution.sensitivity.misfits, strict=True):
        used = np.asarray(weights)[..., 0] > 0
        phases = np.abs(np.asarray(misfit)[..., 1][used])
        if phases.size and np.median(phases[: max(phases.size // 4, 1)]) > 2.5:
            return True
    return False


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
    for k in np.flatnonzero(np.asarray(solution.z) - start > 2 * _FAR):
        if problem.parameters.logarithmic[k] and names[k] in lost:
            texts.append(f"{names[k]} ran to infinity: «start from other values», or leave it out")
    return [Message(text, "runaway") for text in texts]
