from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ._problem import misfits, Problem, residuals, Sensitivity, sensitivity


class Solution(NamedTuple):
    """Where the solver stopped, why, and the derivatives there."""

    z: Float[Array, " parameters"]
    model: PyTree
    values: Float[Array, " all"]  # physical, of free and then fixed parameters
    slopes: Float[Array, " all"]  # of the physical values with respect to z
    message: str
    converged: bool
    steps: int
    sensitivity: Sensitivity


def solve(
    problem: Problem,
    z0: Float[Array, " parameters"],
    solver: Any,
    max_steps: int,
) -> Solution:
    """Lower the sum of squares from `z0`: damped Gauss-Newton (Levenberg-Marquardt) by default."""
    # Imported late: optimistix doubles the time of `import jaxquad`.
    import optimistix as optx

    solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6) if solver is None else solver
    z, facts, result, steps, derivatives = _solve(problem, z0, solver, max_steps)
    converged = bool(result == optx.RESULTS.successful)
    message = "" if converged else _reason(str(optx.RESULTS[result]), int(steps))
    return Solution(z, *facts, message, converged, int(steps), derivatives)


@eqx.filter_jit
def _solve(problem, z0, solver, max_steps):
    import optimistix as optx

    solution = optx.least_squares(
        _objective, solver, z0, args=problem, max_steps=max_steps, throw=False
    )
    z, parameters = solution.value, problem.parameters
    z_all = parameters.start.at[: z0.size].set(z)
    model = parameters.insert(problem.model, z)
    facts = (model, parameters.values(z_all), parameters.slopes(z_all))
    return z, facts, solution.result, solution.stats["num_steps"], sensitivity(z_all, problem)


def _objective(z: Float[Array, " parameters"], problem: Problem) -> Float[Array, " residuals"]:
    # A wall of NaN would look like a minimum to the solver: make it a high one instead.
    r = residuals(z, problem)
    return jnp.where(jnp.isfinite(r), r, 1e6)


def _reason(message: str, steps: int) -> str:
    """The first sentence of a solver's message."""
    return f"{message.strip().split('.')[0].rstrip()} (after {steps} steps)"


def same_responses(problem: Problem, solution: Solution, values: np.ndarray) -> bool:
    """Whether other values of the free parameters leave all responses as they are."""
    parameters, count = problem.parameters, problem.parameters.count
    ratio = values / np.asarray(parameters.scale)[:count]
    logarithmic = np.array(parameters.logarithmic[:count])
    if np.any(logarithmic & (ratio <= 0)):
        return False
    z = np.where(logarithmic, np.log(np.where(logarithmic, ratio, 1.0)), ratio)
    moved = _misfits(jnp.asarray(z), problem)
    return all(
        np.allclose(new, old, atol=1e-6, rtol=0, equal_nan=True)
        for new, old in zip(moved, solution.sensitivity.misfits, strict=True)
    )


_misfits = eqx.filter_jit(misfits)
