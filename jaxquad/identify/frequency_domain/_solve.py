"""The least-squares solvers of fits, and all derivatives where they stop."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxquad._compile import hasty_options, KeptPrograms
from jaxquad._core import Normal, RUNNING, STALLED, TOLERANCE

from ._aside import costs_aside
from ._evaluate import (
    evaluate,
    Evaluation,
    Frame,
    has_few_slopes,
    misfits_and_slopes,
    take_apart,
)
from ._parameters import Numbers
from ._problem import Problem, problem_normal, residuals


_SHORT = 3e4  # residuals times parameters squared: a few ms for a whole descent


class Sensitivity(NamedTuple):
    """Misfits and their derivatives with respect to free and then fixed parameters."""

    misfits: list[Float[np.ndarray, "frequencies outputs inputs 2"]]  # magnitude and phase
    slopes: list[Float[np.ndarray, "frequencies outputs inputs 2 all"]]  # of the misfits
    prior_misfits: Float[np.ndarray, " priors"]
    prior_slopes: Float[np.ndarray, "priors all"]


class Solution(NamedTuple):
    """Where the solver stopped, why, and the derivatives there."""

    z: Float[np.ndarray, " parameters"]
    model: PyTree  # with arrays of NumPy or of JAX
    values: Float[np.ndarray, " all"]  # physical, of free and then fixed parameters
    slopes: Float[np.ndarray, " all"]  # of the physical values with respect to z
    message: str
    converged: bool
    steps: int
    sensitivity: Sensitivity
    at_zero: tuple[int, ...] = ()  # parameters at their bound, where z stands for next to nothing
    units_at_zero: tuple[float, ...] = ()  # changes of them that show
    aside: Float[np.ndarray, " sides"] | None = None  # costs to either side, if they are known


class Stop(NamedTuple):
    """Where and how a solver stopped; `reason` indexes the messages of that solver."""

    z: Float[Array, " parameters"]
    converged: Bool[Array, ""]
    reason: PyTree
    steps: Int[Array, ""]


Evaluate = Callable[[Float[Array, " parameters"], PyTree], Normal]
Residual = Callable[[Float[Array, " parameters"], PyTree], Float[Array, " residuals"]]

_MESSAGES = {
    RUNNING: "The maximum number of steps was reached",
    STALLED: "No shorter step lowers the cost: the model is not finite or not smooth nearby",
}


def solve(
    problem: Problem,
    z0: Float[np.ndarray, " parameters"],
    solver: eqx.Module | None,
    max_steps: int,
) -> Solution:
    """Lower the sum of squares from `z0`: damped Gauss-Newton (Levenberg-Marquardt) by default."""
    if sum(each.size for each in problem.weights) * z0.size**2 < _SHORT:
        if solver is None and problem.is_single and has_few_slopes(problem):
            return _solve_at_once(problem.mixed(), z0, max_steps)
        stop = _descend_from(problem.mixed(), z0, solver, max_steps, short=True)
    else:
        stop = _descend_from(problem, z0, solver, max_steps, short=False)
    return solution_at(problem, np.asarray(stop.z), *_message_and_steps(stop))


def _message_and_steps(stop: Stop) -> tuple[str, int]:
    """Why the solver stopped before a minimum, if it did, and after how many steps."""
    converged, steps = bool(np.asarray(stop.converged)), int(np.asarray(stop.steps))
    return "" if converged else f"{_reason(stop.reason)} (after {steps} steps)", steps


def stopped_early(status: int, steps: int) -> str:
    """Why the default solver stopped before a minimum."""
    return f"{_MESSAGES[status]} (after {steps} steps)"


def solution_at(
    problem: Problem, z: Float[np.ndarray, " parameters"], message: str = "", steps: int = 0
) -> Solution:
    """The model and all derivatives at `z`; the `message` says why it is no minimum."""
    found, parameters = evaluate(problem, np.asarray(z)), problem.parameters
    z_all = np.array(parameters.start)
    z_all[: z.size] = z
    values, slopes = np.asarray(parameters.values(z_all)), np.asarray(parameters.slopes(z_all))
    model = parameters.replace(problem.model, values[: z.size])
    derivatives = _sensitivity(problem, found)
    return Solution(z, model, values, slopes, message, not message, steps, derivatives)


def _sensitivity(problem: Problem, found: Evaluation) -> Sensitivity:
    misfits, slopes, start = [], [], 0
    for measured in problem.measured:
        shape, size = (2, *measured.shape[1:], len(measured)), 2 * measured.size
        mine = slice(start, start + size)
        misfits.append(found.misfits[mine].reshape(shape).transpose(3, 1, 2, 0))
        slopes.append(found.slopes[:, mine].reshape(-1, *shape).transpose(4, 2, 3, 1, 0))
        start += size
    return Sensitivity(misfits, slopes, found.misfits[start:], found.slopes[:, start:].T)


def _descend(
    problem: Problem,
    z0: Float[Array, " parameters"],
    solver: eqx.Module | None,
    max_steps: int,
) -> Stop:
    return least_squares(
        residuals, z0, problem, solver=solver, max_steps=max_steps, normal=problem_normal
    )


@ft.cache
def _descend_by_solver(*, short: bool) -> Callable[..., Stop]:
    given: dict[str, Any] = {"compiler_options": hasty_options()} if short else {}
    return eqx.filter_jit(_descend, **given)


def _descend_from(
    problem: Problem,
    z0: Float[np.ndarray, " parameters"],
    solver: eqx.Module | None,
    max_steps: int,
    *,
    short: bool,
) -> Stop:
    """A `short` descent takes less time than the optimisation of its program would."""
    if solver is not None:
        return _descend_by_solver(short=short)(problem, jax.device_put(z0), solver, max_steps)
    # `eqx.filter_jit` sorts the problem into arrays and others for half the time of the descent.
    frame, arrays = take_apart(problem)
    return _descent(frame, max_steps, short)([z0, *arrays])


@ft.lru_cache(maxsize=128)
def _descent(frame: Frame, max_steps: int, short: bool) -> Callable[[list[Numbers]], Stop]:
    kept = _SHORT_DESCENTS if short else _LONG_DESCENTS
    return kept.of_arrays(lambda arrays: (arrays[0], frame.filled(arrays[1:]), max_steps))


def _descend_by_default(z0: Float[Array, " parameters"], problem: Problem, max_steps: int) -> Stop:
    return _descend(problem, z0, None, max_steps)


_SHORT_DESCENTS = KeptPrograms(_descend_by_default, hasty_options)
_LONG_DESCENTS = KeptPrograms(_descend_by_default, dict)


class _Found(NamedTuple):
    """Where a descent stopped, and what a `Solution` says of that point."""

    stop: Stop
    model: list[Numbers]  # its arrays
    values: Float[Numbers, " all"]
    slopes: Float[Numbers, " all"]  # of the values
    misfits: Float[Numbers, " residuals"]
    sensitivity: Float[Numbers, "all residuals"]
    aside: Float[Numbers, " sides"]  # costs


def _solve_at_once(
    problem: Problem, z0: Float[np.ndarray, " parameters"], max_steps: int
) -> Solution:
    """All of a solution by one program: to run one more takes as long as what it computes."""
    frame, arrays = take_apart(problem)
    stop, leaves, *rest = _whole_program(frame, max_steps)([z0, *arrays])
    model = take_apart(problem.model)[0].filled(leaves)  # while the program runs
    message, steps = _message_and_steps(stop)
    z, values, slopes, *found, aside = map(np.asarray, (stop.z, *rest))
    derivatives = _sensitivity(problem, Evaluation(*found))
    solution = Solution(z, model, values, slopes, message, not message, steps, derivatives)
    return solution._replace(aside=aside)


@ft.lru_cache(maxsize=128)
def _whole_program(frame: Frame, max_steps: int) -> Callable[[list[Numbers]], _Found]:
    return _SOLUTIONS.of_arrays(lambda arrays: (arrays[0], frame.filled(arrays[1:]), max_steps))


def _find_by_default(z0: Float[Array, " parameters"], problem: Problem, max_steps: int) -> _Found:
    """For problems of a single record."""
    stop, parameters = _descend(problem, z0, None, max_steps), problem.parameters
    z = jnp.concatenate([stop.z, parameters.start[z0.size :]])
    values = parameters.values(z)
    model = parameters.replace(problem.model, values[: z0.size])
    found = misfits_and_slopes(z, problem)
    aside = costs_aside(stop.z, problem, *found)
    return _Found(stop, take_apart(model)[1], values, parameters.slopes(z), *found, aside)


_SOLUTIONS = KeptPrograms(_find_by_default, hasty_options)


def least_squares(
    residual: Residual,
    z0: Float[Array, " parameters"],
    args: PyTree,
    *,
    solver: eqx.Module | None = None,
    max_steps: int,
    tolerance: float = TOLERANCE,
    normal: Evaluate | None = None,
) -> Stop:
    """Minimise a sum of squares as every fit does.

    **Arguments:**

    - `residual`: a function of `z` and `args` that returns a vector.
    - `z0`: where to start. `z` should be relative or logarithmic, so that one unit means the same
        for all elements.
    - `args`: passed on to `residual`.
    - `solver`: any optimistix least-squares solver, with its own tolerance; `None` for damped
        Gauss-Newton (Levenberg-Marquardt) on the normal equations.
    - `max_steps`: of the solver.
    - `tolerance`: of the default solver, for steps relative to 1 + |z|.
    - `normal`: a faster way to the normal equations of the same residuals, for the default solver.

    **Returns:**

    `z` where the solver stopped, whether it converged, the reason and the number of steps.
    """
    # Imported late: optimistix doubles the time of `import jaxquad`.
    import optimistix as optx

    from ._gauss_newton import DampedGaussNewton

    ours = solver is None
    chosen = DampedGaussNewton(tolerance, normal) if solver is None else solver
    if not isinstance(chosen, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        raise ValueError(
            f"solver is a {type(chosen).__name__}: give an optimistix least-squares solver, for "
            "instance optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)"
        )
    function = residual if ours else _without_nan(residual)
    found = optx.least_squares(function, chosen, z0, args=args, max_steps=max_steps, throw=False)
    converged = found.result == optx.RESULTS.successful
    reason = found.state.status if ours else found.result
    return Stop(found.value, converged, reason, found.stats["num_steps"])


def _without_nan(residual: Residual) -> Residual:
    def finite(z, args):
        # A wall of NaN would look like a minimum to the solver: make it a high one instead.
        r = residual(z, args)
        return jnp.where(jnp.isfinite(r), r, 1e6)

    return finite


def _reason(reason: PyTree) -> str:
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
    if np.any(logarithmic & (ratio < 0)):
        return False
    z = np.where(logarithmic, np.log(np.where(logarithmic, np.maximum(ratio, 1e-300), 1.0)), ratio)
    moved, start = evaluate(problem, z).misfits, 0
    for old in solution.sensitivity.misfits:
        new = moved[start : start + old.size]
        lined_up = np.moveaxis(old, (3, 0), (0, 3)).reshape(-1)
        if not np.allclose(new, lined_up, atol=1e-6, rtol=0, equal_nan=True):
            return False
        start += old.size
    return True
