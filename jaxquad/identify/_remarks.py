"""What a reader has to know about a fit before using its numbers."""

import numpy as np

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


def _runaways(problem: Problem, solution: Solution) -> list[str]:
    parameters = problem.parameters
    moved = np.asarray(solution.z) - np.asarray(parameters.start)[: parameters.count]
    remarks = []
    for name, far, log in zip(parameters.names, moved, parameters.logarithmic, strict=False):
        if log and abs(far) > _FAR:
            end, remedy = ("zero", "leave it out") if far < 0 else ("infinity", "start elsewhere")
            remarks.append(
                f"{name} ran to {end}: {remedy}, or let its sign change with jq.Real({name!r})"
            )
    return remarks
