"""What a reader has to know about a fit before using its numbers."""

import numpy as np
from jaxtyping import Float

from ._problem import Problem
from ._solve import Solution


MISFIT = 1.5  # ratio of misfit to random error from which the model's structure is in doubt
_FAR = 7.0  # in ln: a parameter that moved by a factor of 1000 ran for zero or infinity


def remarks_on_fit(
    problem: Problem, solution: Solution, cost: float, decrement: float, chi_squared: float
) -> list[str]:
    """Runaway parameters, missing convergence, misfit beyond the noise."""
    runaways = _runaways(problem, solution)
    remarks = list(runaways)
    if not runaways and not solution.converged:
        remarks.append(f"the solver stopped early: {solution.message}")
    if not runaways and not decrement <= 1e-3 * max(cost, 1e-9):
        remarks.append(
            f"no minimum: one more Gauss-Newton step would lower the cost by {decrement:.3g} of "
            f"{cost:.4g}; try other starting values"
        )
    if chi_squared > MISFIT**2:
        ratio = np.sqrt(chi_squared)
        remarks.append(
            f"the misfit is {ratio:.1f} times the random error: the model's structure does not "
            f"explain the whole response; standard errors are widened by {ratio:.1f}"
        )
    return remarks


def ran_to_zero(problem: Problem, solution: Solution) -> list[int]:
    """Which of the parameters that keep their sign ran towards zero."""
    logarithmic = np.array(problem.parameters.logarithmic[: problem.parameters.count])
    return np.flatnonzero(logarithmic & (_moved(problem, solution) < -_FAR)).tolist()


def _moved(problem: Problem, solution: Solution) -> Float[np.ndarray, " parameters"]:
    return np.asarray(solution.z) - np.asarray(problem.parameters.start)[: solution.z.size]


def _runaways(problem: Problem, solution: Solution) -> list[str]:
    names, low = problem.parameters.names, ran_to_zero(problem, solution)
    remarks = [
        f"{names[k]} ran to zero: leave it out, or let its sign change with jq.Real({names[k]!r})"
        for k in low
    ]
    for k in np.flatnonzero(_moved(problem, solution) > _FAR):
        if problem.parameters.logarithmic[k]:
            remarks.append(f"{names[k]} ran to infinity: start elsewhere, or leave it out")
    return remarks
