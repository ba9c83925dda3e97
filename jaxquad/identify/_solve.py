from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ._levenberg import Normal, RUNNING, STALLED, TOLERANCE
from ._problem import misfits, Problem, residuals, Sensitivity, sensitivity
from ._structured import problem_normal


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


class Stop(NamedTuple):
    """Where and how a solver stopped; `reason` indexes the messages of that solver."""

    z: Float[Array, " parameters"]
    converged: Bool[Array, ""]
    reason: Any
    steps: Int[Array, ""]


Residual = Callable[[Float[Array, " parameters"], Any], Float[Array, " residuals"]]

_MESSAGES = {
    RUNNING: "The maximum number of steps was reached",
    STALLED: "Every shorter step fails too: the model is not finite nearby, or not smooth",
}


def solve(
    problem: Problem,
    z0: Float[Array, " parameters"],
    solver: Any,
    max_steps: int,
) -> Solution:
    """Lower the sum of squares from `z0`: damped Gauss-Newton (Levenberg-Marquardt) by default."""
    stop = descend(problem, z0, solver, max_steps)
    return solution_at(stop, *_describe(stop.z, problem))


def solution_at(stop: Stop, facts: tuple, derivatives: Sensitivity) -> Solution:
    """A stop with its reason in words, on the host."""
    converged, steps = bool(stop.converged), int(stop.steps)
    message = "" if converged else f"{_reason(stop.reason)} (after {steps} steps)"
    model, values, slopes = facts
    return Solution(stop.z, model, values, slopes, message, converged, steps, derivatives)


@eqx.filter_jit
def descend(problem: Problem, z0: Float[Array, " parameters"], solver: Any, max_steps: int) -> Stop:
    """The minimisation alone, in one compiled call."""
    return least_squares(
        residuals, z0, problem, solver=solver, max_steps=max_steps, normal=problem_normal
    )


def describe(z: Float[Array, " parameters"], problem: Problem) -> tuple[tuple, Sensitivity]:
    """Model, values and slopes at `z`, and the derivatives by all parameters."""
    parameters = problem.parameters
    z_all = parameters.start.at[: z.size].set(z)
    model = parameters.insert(problem.model, z)
    facts = (model, parameters.values(z_all), parameters.slopes(z_all))
    return facts, sensitivity(z_all, problem)


_describe = eqx.filter_jit(describe)


def least_squares(
    residual: Residual,
    z0: Float[Array, " parameters"],
    args: Any,
    *,
    solver: Any = None,
    max_steps: int,
    tolerance: float = TOLERANCE,
    normal: Callable[[Any, Any], Normal] | None = None,
) -> Stop:
    """The solver set-up of every fit; `None` is `DampedGaussNewton`, on the normal equations.

    `z` should be relative or logarithmic, so that one unit means the same for all elements. Any
    optimistix least-squares solver can take its place, with a tolerance of its own. `normal` is a
    faster way to the normal equations of the same residuals, for the default solver.
    """
    # Imported late: optimistix doubles the time of `import jaxquad`.
    import optimistix as optx

    from ._gauss_newton import DampedGaussNewton

    ours = solver is None
    if ours:
        solver = DampedGaussNewton(tolerance, normal)
    function = residual if ours else _walled(residual)
    found = optx.least_squares(function, solver, z0, args=args, max_steps=max_steps, throw=False)
    converged = found.result == optx.RESULTS.successful
    reason = found.state.status if ours else found.result
    return Stop(found.value, converged, reason, found.stats["num_steps"])


def _walled(residual: Residual) -> Residual:
    def walled(z, args):
        # A wall of NaN would look like a minimum to the solver: make it a high one instead.
        r = residual(z, args)
        return jnp.where(jnp.isfinite(r), r, 1e6)

    return walled


def _reason(reason: Any) -> str:
    """The first sentence of why a solver stopped."""
    if isinstance(reason, jax.Array):
        return _MESSAGES[int(reason)]
    import optimistix as optx

    return str(optx.RESULTS[reason]).strip().split(".")[0].rstrip()


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
