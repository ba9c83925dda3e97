"""What a reader has to know about a fit before using its numbers."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxquad.spectra import FrequencyResponse

from ._problem import Problem
from ._solve import Solution
from ._verdict import Verdict


MISFIT = 1.5  # ratio of misfit to random error from which the model's structure is in doubt
FAILED = 1e-2  # share of the cost that a step would still save, from which nothing is a result
_POOR = 10.0  # ratio from which a wrong minimum is likely
_LOCAL = ", or this is a local minimum: try other starting values"
_FAR = 7.0  # in ln: a parameter that moved by a factor of 1000 ran for zero or infinity


def remarks_on_fit(
    problem: Problem, solution: Solution, cost: float, decrement: float, chi_squared: float
) -> list[str]:
    """Runaway parameters, missing convergence, misfit beyond the noise."""
    remarks, no_minimum = runaways(problem, solution), decrement > 1e-3 * max(cost, 1e-9)
    if not solution.converged and (no_minimum or not remarks):
        remarks.append(f"the solver stopped early: {solution.message}")
    if no_minimum:
        remarks.append(
            f"no minimum: one more Gauss-Newton step would lower the cost by {decrement:.3g} of "
            f"{cost:.4g}; try other starting values{_opposite(problem, solution)}"
        )
    if chi_squared > MISFIT**2:
        ratio = np.sqrt(chi_squared)
        remarks.append(
            f"the misfit is {ratio:.1f} times the random error: the model's structure does not "
            f"explain the whole response{_LOCAL if ratio > _POOR else ''}; standard errors are "
            f"widened by {ratio:.1f}"
        )
    return remarks


def _opposite(problem: Problem, solution: Solution) -> str:
    """A hint where the model turns the wrong way at the lowest frequencies."""
    for weights, misfit in zip(problem.weights, solution.sensitivity.misfits, strict=True):
        used = np.asarray(weights)[..., 0] > 0
        phases = np.abs(np.asarray(misfit)[..., 1][used])
        if phases.size and np.median(phases[: max(phases.size // 4, 1)]) > 2.5:
            return "; the phase is off by about 180 deg: try the other sign of the gain"
    return ""


def remarks_on_priors(
    pulls: Float[np.ndarray, " priors"], verdict: Verdict, by_data: Verdict
) -> list[str]:
    """What rests on the priors alone, and which of them the data contradict."""
    remarks = [
        f"prior {k + 1} is {abs(pull):.1f} of its standard errors away from the fit: data and "
        "prior contradict each other"
        for k, pull in enumerate(pulls)
        if abs(pull) > 3
    ]
    resolved = [name for name in by_data.undetermined if name not in verdict.undetermined]
    if resolved:
        known = ", ".join(combination.name for combination in by_data.combinations)
        remarks.append(
            f"{' and '.join(resolved)}: told apart by the prior alone; the record by itself "
            f"determines only {known or 'none of them'}"
        )
    return remarks


def remarks_on_leakage(
    problem: Problem, frfs: Sequence[FrequencyResponse], solution: Solution
) -> list[str]:
    """Responses of integrating plants that were estimated as if there were no integrator."""
    misfits = solution.sensitivity.misfits
    for frf, weights, misfit in zip(frfs, problem.weights, misfits, strict=True):
        level = np.log(np.abs(np.asarray(frf.response))) + np.asarray(misfit)[..., 0]
        for o, i in np.ndindex(level.shape[1:]):
            used = np.flatnonzero(np.asarray(weights)[:, o, i, 0] > 0)[:3]
            if len(used) < 3:
                continue
            omega, error = np.asarray(frf.omega)[used], np.asarray(frf.random_error)[used[0], o, i]
            steepness = round(-np.polyfit(np.log(omega), level[used, o, i], 1)[0])
            leak = _leakage(steepness - frf.integrators, frf.resolution / omega[0])
            if leak > error:
                return [
                    f"the response falls as 1/s^{steepness} at its lowest frequencies and leaks "
                    f"through the window, by up to {100 * leak:.2g} % at {omega[0]:.3g} rad/s: "
                    f"estimate it with jq.spectra.Welch(integrators={min(steepness, 3)})"
                ]
    return []


def _leakage(integrators: int, resolution: float) -> float:
    """Relative error of 1/s^n behind a Hann window of 1 / resolution cycles, to second order."""
    return max(integrators, 0) * (integrators + 1) / 6 * resolution**2


def ran_to_zero(problem: Problem, solution: Solution) -> list[int]:
    """Which of the parameters that keep their sign ran towards zero."""
    logarithmic = np.array(problem.parameters.logarithmic[: problem.parameters.count])
    return np.flatnonzero(logarithmic & (_moved(problem, solution) < -_FAR)).tolist()


def _moved(problem: Problem, solution: Solution) -> Float[np.ndarray, " parameters"]:
    return np.asarray(solution.z) - np.asarray(problem.parameters.start)[: solution.z.size]


def runaways(problem: Problem, solution: Solution) -> list[str]:
    names, low = problem.parameters.names, ran_to_zero(problem, solution)
    remarks = [
        f"{names[k]} ran to zero: leave it out, or let its sign change with jq.identify.Real({names[k]!r})"
        for k in low
    ]
    for k in np.flatnonzero(_moved(problem, solution) > 2 * _FAR):
        if problem.parameters.logarithmic[k]:
            remarks.append(f"{names[k]} ran to infinity: start elsewhere, or leave it out")
    return remarks
