"""Damped Gauss-Newton descents of fits, derivatives where they stop, and the test for saddles."""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxquad._compile import evaluate_once, FEW, hasty_options, KeptPrograms
from jaxquad._core import Normal, RUNNING, solve_definite, STALLED, TOLERANCE

from ._cost import mix
from ._parameters import namespace_of, Numbers
from ._problem import misfits, Problem, problem_normal, residuals, weigh_parts


_FEW = 2000  # points times parameters: a tenth of a ms

Program = Callable[[list[Numbers]], tuple[Array, Array]]


class Evaluation(NamedTuple):
    """The misfits of a problem, as `misfits` lines them up, and their slopes by all parameters."""

    misfits: Float[np.ndarray, " residuals"]
    slopes: Float[np.ndarray, "all residuals"]


def evaluate(problem: Problem, *places: Float[np.ndarray, " parameters"]) -> list[Evaluation]:
    """Unweighted misfits and slopes at values of the free parameters, at all places in parallel.

    Records of equal shape share a program, whatever they are weighted by: compiling it takes longer
    than a fit.
    """
    programs, running = _programs(_Unweighted(problem)), []
    for z in places:
        z_all = np.array(problem.parameters.start)
        z_all[: z.size] = z
        running.append([run([z_all, *arrays]) for run, arrays in programs])
    evaluations, none = [], (np.zeros(0), np.zeros((problem.parameters.start.size, 0)))
    for records in running:
        parts = [(np.asarray(r), np.asarray(rows)) for r, rows in records]
        if len(parts) != 1:  # all records, one after the other
            all_misfits, slopes = zip(none, *parts, strict=True)
            parts = [(np.concatenate(all_misfits), np.concatenate(slopes, axis=1))]
        evaluations.append(Evaluation(*parts[0]))
    return evaluations


class _Unweighted:
    """A problem whatever its weights: equal where it was made once and weighted anew."""

    def __init__(self, problem: Problem):
        self.problem = problem
        self.ids = tuple(map(id, (problem.model, problem.measured, problem.parameters)))

    def __hash__(self) -> int:
        return hash(self.ids)

    def __eq__(self, other: object) -> bool:  # both hold their problems: no id is used again
        return isinstance(other, _Unweighted) and self.ids == other.ids


class Frame(NamedTuple):
    """A problem without its arrays: what a program is compiled for."""

    structure: PyTree
    rest: tuple[PyTree, ...]

    def filled(self, arrays: Sequence[Numbers]) -> PyTree:
        """The problem with these arrays."""
        left = iter(arrays)
        leaves = [next(left) if leaf is None else leaf for leaf in self.rest]
        return jax.tree.unflatten(self.structure, leaves)


def take_apart(problem: PyTree) -> tuple[Frame, list[Numbers]]:
    """What a program is compiled for, and the arrays that it is run with."""
    leaves, structure = jax.tree.flatten(problem)
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
    rest = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)
    return Frame(structure, rest), arrays


@ft.lru_cache(maxsize=8)
def _programs(unweighted: _Unweighted) -> list[tuple[Program, list[Numbers]]]:
    parts = [(has_few_slopes(part), *take_apart(part)) for part in unweighted.problem.parts()]
    return [(_slopes_program(frame, few), arrays) for few, frame, arrays in parts]


@ft.lru_cache(maxsize=128)
def _slopes_program(frame: Frame, few: bool) -> Program:
    kept = _OF_FEW if few else _OF_MANY
    return kept.of_arrays(lambda arrays: (arrays[0], frame.filled(arrays[1:])))


def has_few_slopes(problem: Problem) -> bool:
    """Whether all slopes take less time than the optimisation of their program would."""
    points = sum(measured.size for measured in problem.measured)
    return points * problem.parameters.start.size <= _FEW


def misfits_and_slopes(
    z: Float[Array, " all"], problem: Problem
) -> tuple[Float[Array, " residuals"], Float[Array, "all residuals"]]:
    """Those of an `Evaluation`, in JAX."""

    def along(z, change):
        return jax.jvp(lambda z: misfits(z, problem), (z,), (change,))

    everywhere = jax.vmap(along, in_axes=(None, 0), out_axes=(None, 0))
    return evaluate_once(everywhere, least=FEW)(z, jnp.eye(z.size, dtype=z.dtype))


_OF_FEW = KeptPrograms(misfits_and_slopes, hasty_options)
_OF_MANY = KeptPrograms(misfits_and_slopes, dict)


_SHORT = 3e4  # residuals times parameters squared: a few ms for a whole descent
_LONGEST = 0.05  # relative step to either side of a stop
_RIDGE = 1e-12  # of a matrix with ones on its diagonal, so that it has an inverse

Vector = Float[np.ndarray, " parameters"]


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
    aside: Float[np.ndarray, " sides"] | None = None  # costs to either side, if it has them


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


def solve(problem: Problem, z0: Vector, solver: eqx.Module | None, max_steps: int) -> Solution:
    """Lower the sum of squares from `z0`: damped Gauss-Newton (Levenberg-Marquardt) by default."""
    # A short descent takes less time than the optimisation of its program would.
    short = sum(weights.size for weights in problem.weights) * z0.size**2 < _SHORT
    if short and solver is None and problem.is_single and has_few_slopes(problem):
        return _solve_at_once(problem.mixed(), z0, max_steps)
    mixed = problem.mixed() if short else problem
    if solver is None:
        # `eqx.filter_jit` sorts the problem into arrays and others for half the descent's time.
        frame, arrays = take_apart(mixed)
        stop = _program(frame, max_steps, "short" if short else "long")([z0, *arrays])
    else:
        stop = _descent_by_solver(short)(mixed, jax.device_put(z0), solver, max_steps)
    return solution_at(problem, np.asarray(stop.z), *_message_and_steps(stop))


def _message_and_steps(stop: Stop) -> tuple[str, int]:
    """Why the solver stopped before a minimum, if it did, and after how many steps."""
    converged, steps = bool(np.asarray(stop.converged)), int(np.asarray(stop.steps))
    if converged:
        return "", steps
    if isinstance(stop.reason, jax.Array):
        return stopped_early(int(stop.reason), steps), steps
    import optimistix as optx

    reason = str(optx.RESULTS[stop.reason]).strip().split(".")[0].rstrip()
    return f"{reason} (after {steps} steps)", steps


def stopped_early(status: int, steps: int) -> str:
    """Why the default solver stopped before a minimum."""
    return f"{_MESSAGES[status]} (after {steps} steps)"


def solution_at(problem: Problem, z: Vector, message: str = "", steps: int = 0) -> Solution:
    """The model and all derivatives at `z`; the `message` says why it is no minimum."""
    [evaluation], parameters = evaluate(problem, np.asarray(z)), problem.parameters
    z_all = np.array(parameters.start)
    z_all[: z.size] = z
    values, slopes = np.asarray(parameters.values(z_all)), np.asarray(parameters.slopes(z_all))
    model = parameters.replace(problem.model, values[: z.size])
    derivatives = _sensitivity(problem, evaluation)
    return Solution(z, model, values, slopes, message, not message, steps, derivatives)


def _sensitivity(problem: Problem, evaluation: Evaluation) -> Sensitivity:
    misfits, slopes, start = [], [], 0
    for measured in problem.measured:
        shape, size = (2, *measured.shape[1:], len(measured)), 2 * measured.size
        mine = slice(start, start + size)
        misfits.append(evaluation.misfits[mine].reshape(shape).transpose(3, 1, 2, 0))
        slopes.append(evaluation.slopes[:, mine].reshape(-1, *shape).transpose(4, 2, 3, 1, 0))
        start += size
    priors = evaluation.misfits[start:], evaluation.slopes[:, start:].T
    return Sensitivity(misfits, slopes, *priors)


def weighted_residuals(
    problem: Problem, sensitivity: Sensitivity
) -> Float[np.ndarray, " residuals"]:
    """Of the points in use, and then of the priors."""
    rows, parts = [], zip(problem.weights, problem.mixings, sensitivity.misfits, strict=True)
    with np.errstate(invalid="ignore", over="ignore"):  # a model that is not finite there
        for weights, mixing, misfit in parts:
            weights = np.asarray(weights)
            rows.append(mix(mixing, weights * np.asarray(misfit))[weights > 0])
    return np.concatenate([*rows, np.asarray(sensitivity.prior_misfits)])


def _descend(
    problem: Problem, z0: Float[Array, " parameters"], solver: eqx.Module | None, max_steps: int
) -> Stop:
    options: dict[str, Any] = {"solver": solver, "max_steps": max_steps}
    return least_squares(residuals, z0, problem, normal=problem_normal, **options)


@ft.cache
def _descent_by_solver(short: bool) -> Callable[..., Stop]:
    options: dict[str, Any] = {"compiler_options": hasty_options()} if short else {}
    return eqx.filter_jit(_descend, **options)


def _descend_by_default(z0: Float[Array, " parameters"], problem: Problem, max_steps: int) -> Stop:
    return _descend(problem, z0, None, max_steps)


def _solve_by_default(z0: Float[Array, " parameters"], problem: Problem, max_steps: int) -> tuple:
    """The stop, and what a `Solution` says of that point; for problems of a single record."""
    stop, parameters = _descend(problem, z0, None, max_steps), problem.parameters
    z = jnp.concatenate([stop.z, parameters.start[z0.size :]])
    values = parameters.values(z)
    model = parameters.replace(problem.model, values[: z0.size])
    lined_up, slopes = misfits_and_slopes(z, problem)
    # The costs to either side, from misfits and slopes.
    both = jnp.concatenate([lined_up[None], slopes[: z0.size]])
    parts = both.reshape(len(both), 2, *jnp.moveaxis(problem.measured[0], 0, -1).shape)
    weighed = jax.vmap(ft.partial(weigh_parts, problem, 0))(parts[:, 0], parts[:, 1])
    rows = jnp.concatenate([part.reshape(len(both), -1) for part in weighed], axis=1)
    sides = _sides(stop.z, rows[1:] @ rows[1:].T, rows[0] @ rows[0])
    costs = jax.vmap(lambda z: jnp.sum(residuals(z, problem) ** 2))(sides)
    arrays = take_apart(model)[1]
    return stop, arrays, values, parameters.slopes(z), lined_up, slopes, costs


_KEPT = {
    "short": KeptPrograms(_descend_by_default, hasty_options),
    "long": KeptPrograms(_descend_by_default, dict),
    "at once": KeptPrograms(_solve_by_default, hasty_options),
}


@ft.lru_cache(maxsize=256)
def _program(frame: Frame, max_steps: int, kind: str) -> Callable[[list[Numbers]], Any]:
    fill = lambda arrays: (arrays[0], frame.filled(arrays[1:]), max_steps)
    return _KEPT[kind].of_arrays(fill)


def _solve_at_once(problem: Problem, z0: Vector, max_steps: int) -> Solution:
    """All of a solution by one program: to run one more takes as long as what it computes."""
    frame, arrays = take_apart(problem)
    stop, leaves, *rest = _program(frame, max_steps, "at once")([z0, *arrays])
    model = take_apart(problem.model)[0].filled(leaves)  # while the program runs
    message, steps = _message_and_steps(stop)
    z, values, slopes, *evaluation, costs = map(np.asarray, (stop.z, *rest))
    derivatives = _sensitivity(problem, Evaluation(*evaluation))
    solution = Solution(z, model, values, slopes, message, not message, steps, derivatives)
    return solution._replace(aside=costs)


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

    def finite(z, args):
        # A wall of NaN would look like a minimum to the solver: make it a high one instead.
        r = residual(z, args)
        return jnp.where(jnp.isfinite(r), r, 1e6)

    function = residual if ours else finite
    end = optx.least_squares(function, chosen, z0, args=args, max_steps=max_steps, throw=False)
    reason = end.state.status if ours else end.result
    return Stop(end.value, end.result == optx.RESULTS.successful, reason, end.stats["num_steps"])


def is_saddle(problem: Problem, solution: Solution, here: float, bread: np.ndarray) -> bool:
    """Whether the cost is lower than `here`, at the solution, a small step to either side of it.

    `bread` is J'J of its weighted residuals.
    """
    costs = solution.aside
    if costs is None:
        sides = evaluate(problem, *_sides(solution.z, bread, np.asarray(here)))
        rows = [weighted_residuals(problem, _sensitivity(problem, side)) for side in sides]
        costs = np.array([row @ row for row in rows])
    return bool(np.min(costs) < here * (1 - 1e-6) - 1e-12)


def _sides(
    z: Float[Numbers, " parameters"],
    bread: Float[Numbers, "parameters parameters"],
    here: Float[Numbers, ""],
) -> Float[Numbers, "sides parameters"]:
    """A small step from `z` to either side along the weakest direction of `bread`."""
    xp = namespace_of(z)
    size = xp.sqrt(xp.maximum(xp.diagonal(bread), 1e-300))
    weakest, curvature = _weakest(bread / (size[:, None] * size[None]))
    weakest = weakest / size
    step = xp.sqrt(1e-2 * xp.maximum(here, 1e-12) / xp.maximum(curvature, 1e-12))
    step = xp.minimum(step, _LONGEST / xp.maximum(xp.max(xp.abs(weakest)), 1e-300))
    return xp.stack([z + step * weakest, z - step * weakest])


def _weakest(
    matrix: Float[Numbers, "parameters parameters"],
) -> tuple[Float[Numbers, " parameters"], Float[Numbers, ""]]:
    """The eigenvector of the smallest eigenvalue, and that value."""
    if isinstance(matrix, np.ndarray):
        values, vectors = np.linalg.eigh(matrix)
        return vectors[:, 0], np.asarray(values[0])
    # A kept program that calls LAPACK crashes in a process that has not traced it. So: the 32nd
    # power of the inverse, in whose columns nothing is left but the weakest direction.
    unit = jnp.eye(len(matrix), dtype=matrix.dtype)
    ridged = jnp.broadcast_to((matrix + _RIDGE * unit)[..., None], (*matrix.shape, len(matrix)))
    inverse = solve_definite(ridged, unit)[0]
    power = inverse / jnp.trace(inverse)
    for _ in range(5):
        power = power @ power
    column = power[:, jnp.argmax(jnp.diagonal(power))]
    vector = column / jnp.sqrt(column @ column)
    return vector, vector @ matrix @ vector


def same_responses(problem: Problem, solution: Solution, values: np.ndarray) -> bool:
    """Whether other values of the free parameters leave all responses as they are."""
    parameters, count = problem.parameters, problem.parameters.count
    ratio = values / np.asarray(parameters.scale)[:count]
    logarithmic = np.array(parameters.logarithmic[:count])
    if np.any(logarithmic & (ratio < 0)):
        return False
    z = np.where(logarithmic, np.log(np.where(logarithmic, np.maximum(ratio, 1e-300), 1.0)), ratio)
    moved = solution_at(problem, z).sensitivity.misfits
    pairs = zip(moved, solution.sensitivity.misfits, strict=True)
    return all(np.allclose(*pair, atol=1e-6, rtol=0, equal_nan=True) for pair in pairs)
