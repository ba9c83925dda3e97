import functools as ft
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int, PyTree

from jaxquad._core import (
    Normal,
    normal_equations,
    RUNNING,
    STALLED,
    TOLERANCE,
)
from jaxquad._xla import arctan2, hasty_options, KeptPrograms, no_fuse
from jaxquad.models import Entry, factor_slopes, matrices_of, Split, StateSpace

from ._evaluate import as_residuals, evaluate, Evaluation, Frame, start_each, take_apart
from ._mixing import mix_parts
from ._parameters import Numbers
from ._problem import prior_misfits, Problem, residuals, unchanged


def problem_normal(z: Float[Array, " parameters"], problem: Problem) -> Normal:
    """Cost, gradient and Gauss-Newton Hessian of the residuals of a fit.

    For a plain `jq.StateSpace` with nothing tied, slopes are products of the resolvent's columns
    and rows, at a quarter of the cost of differentiation; any other model is differentiated.

    **Arguments:**

    - `z`: the free parameters as the solver sees them.
    - `problem`: of `jq.identify.make_problem`.
    """
    if not _is_plain(problem):
        return normal_equations(residuals, z, problem)
    parts = [part for k in range(len(problem.omega)) for part in _record(z, problem, k)]
    if problem.quantities:
        parts.append(normal_equations(prior_misfits, z, problem))
    return ft.reduce(lambda a, b: jax.tree.map(jnp.add, a, b), parts)


def _is_plain(problem: Problem) -> bool:
    """Whether slopes are products of the resolvent's columns and rows."""
    plain = type(problem.model) is StateSpace and not problem.parameters.ties
    plain = plain and all(each is None for each in problem.aliases) and not any(problem.silent)
    return plain and all(condition is unchanged for condition in problem.conditions)


def _record(z: Float[Array, " parameters"], problem: Problem, k: int) -> list[Normal]:
    """Of one record, magnitude and phase apart: side by side they would have to be copied."""
    parameters, omega = problem.parameters, jnp.asarray(problem.omega[k])
    matrices = matrices_of(parameters.insert(problem.model, z))
    entries = [_entry(place.path) for place in parameters.places[: z.size]]
    value, slopes = factor_slopes(matrices, omega, entries, jnp.asarray(parameters.slopes(z)))
    misfit = no_fuse(_logarithm, value, jnp.asarray(problem.measured[k]))
    mixing = problem.mixings[k]
    weights = jnp.moveaxis(jnp.asarray(problem.weights[k]), (0, 3), (3, 0))
    if len(weights) == 1 and mixing is None and slopes.multiplies_sooner:
        square = sum(jnp.sum((part * weights[0]) ** 2) for part in misfit)
        return [Normal(0.5 * jnp.asarray(square), *slopes.normal_products(weights[0], misfit))]
    both = Split(weights[0], weights[-1])
    residual = [part * weight for part, weight in zip(misfit, both, strict=True)]
    mixed = mix_parts(mixing, *residual), mix_parts(mixing, *slopes.multiply_out(both))
    return [_products(*each) for each in zip(*mixed, strict=True)]


def _products(
    residual: Float[Array, "outputs inputs frequencies"],
    slopes: Float[Array, "parameters outputs inputs frequencies"],
) -> Normal:
    r, rows = residual.reshape(-1), slopes.reshape(len(slopes), -1)
    return Normal(0.5 * jnp.sum(r**2), rows @ r, rows @ rows.T)


def _logarithm(value: Split, measured: Complex[Array, "frequencies outputs inputs"]) -> Split:
    """`ln|T/T^|` and the wrapped phase of `T/T^` in rad."""
    there = jnp.moveaxis(measured, 0, -1)
    real, imag = jnp.real(there), jnp.imag(there)
    a = value.real * real + value.imag * imag
    b = value.imag * real - value.real * imag
    power = real * real + imag * imag
    size = (value.real * value.real + value.imag * value.imag) / power
    return Split(0.5 * jnp.log(size), jnp.asarray(arctan2(b, a)))


def _entry(name: str) -> Entry:
    field, *index = name.replace("]", "").split("[")
    row, column = (int(i) for i in (*index, "0")[:2])
    return Entry(field, row, column)


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
    model: PyTree  # with NumPy's arrays
    values: Float[np.ndarray, " all"]  # physical, of free and then fixed parameters
    slopes: Float[np.ndarray, " all"]  # of the physical values with respect to z
    message: str
    converged: bool
    steps: int
    sensitivity: Sensitivity
    at_zero: tuple[int, ...] = ()  # parameters at their bound, where z stands for next to nothing
    units_at_zero: tuple[float, ...] = ()  # changes of them that show


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
        stop = _descend_short(problem.mixed(), z0, solver, max_steps)
    else:
        stop = _descend_long(_with_one_weight(problem), jax.device_put(z0), solver, max_steps)
    steps = int(stop.steps)
    message = "" if stop.converged else f"{_reason(stop.reason)} (after {steps} steps)"
    return solution_at(problem, np.asarray(stop.z), message, steps)


def _with_one_weight(problem: Problem) -> Problem:
    """Weights of magnitude and phase once, where they are alike and that saves arithmetic."""
    if not _is_plain(problem) or any(each is not None for each in problem.mixings):
        return problem
    return problem.weighted([once_if_alike(np.asarray(each)) for each in problem.weights])


def once_if_alike(weights: Float[np.ndarray, "*points 2"]) -> Float[np.ndarray, "*points parts"]:
    """Weights of magnitude and phase, on a last axis of one where they are alike."""
    return weights[..., :1] if np.array_equal(weights[..., 0], weights[..., 1]) else weights


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
        misfits.append(np.moveaxis(found.misfits[mine].reshape(shape), (0, 3), (3, 0)))
        rows = found.slopes[:, mine].reshape(-1, *shape)
        slopes.append(np.moveaxis(rows, (0, 1, 4), (4, 3, 0)))
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


_descend_long = eqx.filter_jit(_descend)


@ft.cache
def _descend_by_solver() -> Callable[..., Stop]:
    given: dict[str, Any] = {"compiler_options": hasty_options()}
    return eqx.filter_jit(_descend, **given)


def _descend_short(
    problem: Problem,
    z0: Float[np.ndarray, " parameters"],
    solver: eqx.Module | None,
    max_steps: int,
) -> Stop:
    if solver is not None:
        return _descend_by_solver()(problem, jax.device_put(z0), solver, max_steps)
    # `eqx.filter_jit` sorts the problem into arrays and others for half the time of the descent.
    frame, arrays = take_apart(problem)
    return _short_program(frame, max_steps)([z0, *arrays])


@ft.lru_cache(maxsize=128)
def _short_program(frame: Frame, max_steps: int) -> Callable[[list[Numbers]], Stop]:
    return _DESCENTS.of_arrays(lambda arrays: (arrays[0], frame.filled(arrays[1:]), max_steps))


def _descend_by_default(z0: Float[Array, " parameters"], problem: Problem, max_steps: int) -> Stop:
    return _descend(problem, z0, None, max_steps)


# A short descent takes less time than the optimisation of its program would.
_DESCENTS = KeptPrograms(_descend_by_default, hasty_options)


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


def start_costs(
    problem: Problem, places: Sequence[Float[np.ndarray, " parameters"]]
) -> Callable[[], list[float]]:
    """The sums of squares at values of the free parameters; what is returned waits for them."""
    found = start_each(problem, places)

    def costs() -> list[float]:
        with np.errstate(invalid="ignore", over="ignore"):
            return [float(np.sum(as_residuals(problem, each.misfits) ** 2)) for each in found()]

    return costs
