"""Descents of fits from one start or many, and the derivatives where they stop."""

import functools as ft
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxquad._compile import evaluate_once, FEW, hasty_options, KeptPrograms
from jaxquad._core import (
    CONVERGED,
    decrement,
    minimise,
    Normal,
    normal_equations,
    RUNNING,
    STALLED,
    TOLERANCE,
)

from ._cost import mix
from ._parameters import Numbers, Parameters
from ._problem import misfits, Problem, problem_normal, residuals


_FEW = 2000  # points times parameters, whose slopes take a tenth of a ms
_SHORT = 3e4  # residuals times parameters squared: a few ms for a whole descent
_LONGEST = 0.05  # relative step to either side of a stop

Vector = Float[np.ndarray, " parameters"]
Evaluate = Callable[[Float[Array, " parameters"], PyTree], Normal]
Residual = Callable[[Float[Array, " parameters"], PyTree], Float[Array, " residuals"]]


class Sensitivity(NamedTuple):
    """Misfits and their derivatives with respect to free and then fixed parameters."""

    misfits: list[Float[np.ndarray, "frequencies outputs inputs 2"]]  # magnitude and phase
    slopes: list[Float[np.ndarray, "frequencies outputs inputs 2 all"]]  # of the misfits
    prior_misfits: Float[np.ndarray, " priors"]
    prior_slopes: Float[np.ndarray, "priors all"]

    def weighted(self, problem: Problem) -> Float[np.ndarray, " residuals"]:
        """The residuals of the points in use, and then of the priors."""
        rows, parts = [], zip(problem.weights, problem.mixings, self.misfits, strict=True)
        with np.errstate(invalid="ignore", over="ignore"):  # a model that is not finite there
            for weights, mixing, misfit in parts:
                weights = np.asarray(weights)
                rows.append(mix(mixing, weights * np.asarray(misfit))[weights > 0])
        return np.concatenate([*rows, np.asarray(self.prior_misfits)])


class Solution(NamedTuple):
    """Where the solver stopped, why, and the derivatives there."""

    z: Vector
    model: PyTree  # with arrays of NumPy or of JAX
    values: Float[np.ndarray, " all"]  # physical, of free and then fixed parameters
    slopes: Float[np.ndarray, " all"]  # of the physical values with respect to z
    message: str  # why it is no minimum; empty where it converged
    steps: int
    sensitivity: Sensitivity
    at_zero: tuple[int, ...] = ()  # parameters at their bound, where z stands for next to nothing
    units_at_zero: tuple[float, ...] = ()  # changes of them that show

    @property
    def converged(self) -> bool:
        return not self.message


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


class _Unweighted:
    """A problem whatever its weights: equal where it was made once and weighted anew."""

    def __init__(self, problem: Problem):
        self.problem = problem
        self.ids = tuple(map(id, (problem.model, problem.measured, problem.parameters)))

    def __hash__(self) -> int:
        return hash(self.ids)

    def __eq__(self, other: object) -> bool:  # both hold their problems: no id is used again
        return isinstance(other, _Unweighted) and self.ids == other.ids


@ft.lru_cache(maxsize=8)
def _parts(unweighted: _Unweighted) -> list[tuple[Callable[..., tuple], list[Numbers]]]:
    """The programs of misfits and slopes of each record, and the arrays that they are run with."""
    parts = [(has_few_slopes(part), *take_apart(part)) for part in unweighted.problem.parts()]
    return [(_program(frame, "few" if few else "many"), arrays) for few, frame, arrays in parts]


def has_few_slopes(problem: Problem) -> bool:
    """Whether all slopes take less time than the optimisation of their program would."""
    points = sum(measured.size for measured in problem.measured)
    return points * problem.parameters.start.size <= _FEW


def evaluate(problem: Problem, *places: Vector) -> list[Sensitivity]:
    """Misfits and slopes at values of the free parameters, at all places in parallel.

    Records of equal shape share a program, whatever they are weighted by: compiling it takes longer
    than a fit.
    """
    programs, running = _parts(_Unweighted(problem)), []
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
        evaluations.append(_by_record(problem, *parts[0]))
    return evaluations


def _by_record(problem: Problem, lined_up: np.ndarray, rows: np.ndarray) -> Sensitivity:
    parts, slopes, start = [], [], 0
    for measured in problem.measured:
        shape, size = (2, *measured.shape[1:], len(measured)), 2 * measured.size
        mine = slice(start, start + size)
        parts.append(lined_up[mine].reshape(shape).transpose(3, 1, 2, 0))
        slopes.append(rows[:, mine].reshape(-1, *shape).transpose(4, 2, 3, 1, 0))
        start += size
    return Sensitivity(parts, slopes, lined_up[start:], rows[:, start:].T)


def misfits_and_slopes(
    z: Float[Array, " all"], problem: Problem
) -> tuple[Float[Array, " residuals"], Float[Array, "all residuals"]]:
    """The misfits, as `misfits` lines them up, and their slopes by all parameters."""
    along = lambda z, change: jax.jvp(lambda z: misfits(z, problem), (z,), (change,))
    everywhere = jax.vmap(along, in_axes=(None, 0), out_axes=(None, 0))
    return evaluate_once(everywhere, least=FEW)(z, jnp.eye(z.size, dtype=z.dtype))


class Stop(NamedTuple):
    """Where and how a solver stopped; `reason` is the default solver's status, or optimistix's."""

    z: Float[Array, " parameters"]
    converged: Bool[Array, ""]
    reason: PyTree
    steps: Int[Array, ""]

    @property
    def message(self) -> str:
        """Why the solver stopped before a minimum, if it did."""
        if np.asarray(self.converged):
            return ""
        if isinstance(self.reason, jax.Array):
            return stopped_early(int(self.reason), int(self.steps))
        import optimistix as optx

        reason = str(optx.RESULTS[self.reason]).strip().split(".")[0].rstrip()
        return f"{reason} (after {int(self.steps)} steps)"


_MESSAGES = {
    RUNNING: "The maximum number of steps was reached",
    STALLED: "No shorter step lowers the cost: the model is not finite or not smooth nearby",
}


def stopped_early(status: int, steps: int) -> str:
    """Why the default solver stopped before a minimum."""
    return f"{_MESSAGES[status]} (after {steps} steps)"


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
    if solver is None:
        at = lambda z: normal_equations(residual, z, args) if normal is None else normal(z, args)
        end = minimise(at, jnp.asarray(z0), max_steps - 1, tolerance)
        return Stop(end.z, end.status == CONVERGED, end.status, end.steps + 1)
    # Imported late: optimistix doubles the time of `import jaxquad`.
    import optimistix as optx

    if not isinstance(solver, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        raise ValueError(
            f"solver is a {type(solver).__name__}: give an optimistix least-squares solver, for "
            "instance optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)"
        )

    def finite(z, args):
        # A wall of NaN would look like a minimum to the solver: make it a high one instead.
        r = residual(z, args)
        return jnp.where(jnp.isfinite(r), r, 1e6)

    end = optx.least_squares(finite, solver, z0, args=args, max_steps=max_steps, throw=False)
    converged = end.result == optx.RESULTS.successful
    return Stop(end.value, converged, end.result, end.stats["num_steps"])


def solve(problem: Problem, z0: Vector, solver: eqx.Module | None, max_steps: int) -> Solution:
    """Lower the sum of squares from `z0`: damped Gauss-Newton (Levenberg-Marquardt) by default."""
    # A short descent takes less time than the optimisation of its program would.
    short = sum(weights.size for weights in problem.weights) * z0.size**2 < _SHORT
    mixed = problem.mixed() if short else problem
    if solver is not None:
        stop = _descent_by_solver(short)(mixed, jax.device_put(z0), solver, max_steps)
    else:
        # `eqx.filter_jit` sorts the problem into arrays and others for half the descent's time.
        frame, arrays = take_apart(mixed)
        at_once = short and problem.is_single and has_few_slopes(problem)
        kind = "at once" if at_once else "short" if short else "long"
        stop = _program(frame, kind, max_steps)([z0, *arrays])
        if at_once:  # all of a solution: to run one more program takes as long as what it computes
            stop, leaves, *rest = stop
            model = take_apart(problem.model)[0].filled(leaves)  # while the program runs
            message, steps = stop.message, int(np.asarray(stop.steps))
            z, values, slopes, *parts = map(np.asarray, (stop.z, *rest))
            derivatives = _by_record(problem, *parts)
            return Solution(z, model, values, slopes, message, steps, derivatives)
    return solution_at(problem, np.asarray(stop.z), stop.message, int(np.asarray(stop.steps)))


def solution_at(problem: Problem, z: Vector, message: str = "", steps: int = 0) -> Solution:
    """The model and all derivatives at `z`; the `message` says why it is no minimum."""
    [derivatives], parameters = evaluate(problem, np.asarray(z)), problem.parameters
    z_all = np.array(parameters.start)
    z_all[: z.size] = z
    values, slopes = np.asarray(parameters.values(z_all)), np.asarray(parameters.slopes(z_all))
    model = parameters.replace(problem.model, values[: z.size])
    return Solution(z, model, values, slopes, message, steps, derivatives)


def _descend(
    z0: Float[Array, " parameters"], problem: Problem, max_steps: int, solver: PyTree = None
) -> Stop:
    options = {"solver": solver, "max_steps": max_steps, "normal": problem_normal}
    return least_squares(residuals, z0, problem, **options)


@ft.cache
def _descent_by_solver(short: bool) -> Callable[..., Stop]:
    descend = lambda problem, z0, solver, max_steps: _descend(z0, problem, max_steps, solver)
    return eqx.filter_jit(descend, **({"compiler_options": hasty_options()} if short else {}))


def _solve_by_default(z0: Float[Array, " parameters"], problem: Problem, max_steps: int) -> tuple:
    """The stop, and what a `Solution` says of that point; for problems of a single record."""
    stop, parameters = _descend(z0, problem, max_steps), problem.parameters
    z = jnp.concatenate([stop.z, parameters.start[z0.size :]])
    values = parameters.values(z)
    arrays = take_apart(parameters.replace(problem.model, values[: z0.size]))[1]
    return stop, arrays, values, parameters.slopes(z), *misfits_and_slopes(z, problem)


_KEPT = {
    "few": KeptPrograms(misfits_and_slopes, hasty_options),
    "many": KeptPrograms(misfits_and_slopes, dict),
    "short": KeptPrograms(_descend, hasty_options),
    "long": KeptPrograms(_descend, dict),
    "at once": KeptPrograms(_solve_by_default, hasty_options),
}


@ft.lru_cache(maxsize=256)
def _program(frame: Frame, kind: str, *options: int) -> Callable[[list[Numbers]], tuple]:
    fill = lambda arrays: (arrays[0], frame.filled(arrays[1:]), *options)
    return _KEPT[kind].of_arrays(fill)


def is_saddle(problem: Problem, solution: Solution, here: float, bread: np.ndarray) -> bool:
    """Whether the cost is lower than `here`, at the solution, a small step to either side of it.

    The step is along the weakest direction of `bread`, J'J of its weighted residuals.
    """
    size = np.sqrt(np.maximum(np.diagonal(bread), 1e-300))
    curvature, directions = np.linalg.eigh(bread / (size[:, None] * size[None]))
    weakest = directions[:, 0] / size
    step = np.sqrt(1e-2 * max(here, 1e-12) / max(curvature[0], 1e-12))
    step = min(step, _LONGEST / max(float(np.max(np.abs(weakest))), 1e-300))
    sides = evaluate(problem, solution.z + step * weakest, solution.z - step * weakest)
    rows = [side.weighted(problem) for side in sides]
    return bool(min(row @ row for row in rows) < here * (1 - 1e-6) - 1e-12)


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


MINIMUM = "minimum"
FLAT = "flat: some change of parameters does not change the cost"
SADDLE = "stationary, but no minimum: the cost falls to one side"
WALL = "no minimum: no shorter step lowers the cost, yet its slope is not zero"
UNFINISHED = "the maximum number of steps was reached"
NOT_FINITE = "the model is not finite at the start"


class Minimum(NamedTuple):
    """A point at which the fits from some of the starts ended."""

    cost: float  # sum of squares
    z: Float[np.ndarray, " parameters"]
    values: Float[np.ndarray, " parameters"]  # physical
    starts: tuple[int, ...]  # which of them led here
    decrement: float  # Newton decrement: half of what one more step would save of the cost
    curvature: float  # smallest eigenvalue of the cost's Hessian, scaled to unit diagonal
    kind: str  # "minimum", or what it is instead

    @property
    def is_minimum(self) -> bool:
        """Whether slope and curvature are those of a minimum, isolated or flat."""
        return self.kind in (MINIMUM, FLAT)


def spread_starts(
    parameters: Parameters, count: int, *, fastest: float, factor: float = 5.0, seed: int = 0
) -> Float[np.ndarray, "starts parameters"]:
    """Starting vectors `z`: the given start, then a Latin hypercube around it.

    Parameters that keep their sign spread evenly in the logarithm, those that may cross zero over
    twice their scale. A parameter whose name ends in `delay` stays below half a turn at the fastest
    frequency, beyond which minima repeat with each turn.

    **Arguments:**

    - `parameters`: of `jq.identify.select_parameters`.
    - `count`: how many starts.
    - `fastest`: the highest frequency in rad/s.
    - `factor`: how far to spread to both sides, above 1.
    - `seed`: of the random numbers.

    **Raises:**

    - `ValueError`: no starts, or a factor that spreads nothing.
    """
    if count < 1:
        raise ValueError(f"starts is {count}: give 1 for the given start alone, or more")
    if not (1 < factor < np.inf and 0 < fastest < np.inf):
        raise ValueError(
            f"factor {factor} and fastest frequency {fastest} rad/s: give a finite factor above 1, "
            "for instance 5, and a positive frequency"
        )
    n, rng = parameters.count, np.random.default_rng(seed)
    start, scale = (np.asarray(x)[:n] for x in (parameters.start, parameters.scale))
    cells = np.stack([rng.permutation(count - 1) for _ in range(n)], axis=1).reshape(count - 1, n)
    unit = (cells + rng.uniform(size=cells.shape)) / max(count - 1, 1)
    logarithmic = np.array(parameters.logarithmic[:n])
    reach = np.where(logarithmic, np.log(factor), 2.0)
    low, high = start - reach, start + reach
    for k, name in enumerate(parameters.names):
        if name.split(".")[-1].split("[")[0].endswith("delay") and logarithmic[k]:
            most = max(np.log(np.pi / fastest / abs(scale[k])), start[k])
            high[k] = min(high[k], most)
    return np.concatenate([start[None], low + (high - low) * unit])


def solve_from_many(
    problem: Problem,
    starts: Float[np.ndarray, "starts parameters"],
    solver: eqx.Module | None,
    max_steps: int,
) -> tuple[Solution, tuple[Minimum, ...]]:
    """Solve from every start in one call.

    Starts of the default solver run side by side, those of an optimistix solver one by one, since
    its LAPACK calls can hang under `vmap`.

    **Arguments:**

    - `problem`: of `jq.identify.make_problem`.
    - `starts`: vectors `z`, of `spread_starts`.
    - `solver`: `None` for the default, or an optimistix least-squares solver.
    - `max_steps`: of the solver.

    **Returns:**

    The best solution, a minimum before a lower point that is none; and all distinct points, sorted
    by cost.

    **Raises:**

    - `ValueError`: no start has a finite response.
    """
    stops = jax.tree.map(np.asarray, _solve_all(problem, np.asarray(starts), solver, max_steps))
    z, status, steps, normal, left, bent = stops
    costs, groups = normal.cost, list[list[int]]()

    def same(one: int, other: int) -> bool:
        """Those within a millionth of the cost are one."""
        floor, difference = 1e-6 * (costs[one] + 1e-6), np.asarray(z[one] - z[other])
        if abs(costs[other] - costs[one]) > floor:
            return False
        near = bool(np.max(np.abs(difference)) <= 1e-4)
        return near or bool(0.5 * difference @ normal.hessian[one] @ difference <= floor)

    for k in (int(k) for k in np.argsort(costs) if np.isfinite(costs[k])):
        group = next((group for group in groups if same(group[0], k)), None)
        groups.append([k]) if group is None else group.append(k)
    if not groups:
        raise ValueError(
            f"the model's response is not finite at any of {len(starts)} starts: check the model "
            "at its starting values with model.frequency_response(omega)"
        )
    minima = []
    for k, *others in groups:
        curvature, cost = -np.inf, float(costs[k])
        if np.all(np.isfinite(bent[k])):
            size = np.sqrt(np.maximum(np.abs(np.diagonal(bent[k])), 1e-300))
            curvature = float(np.linalg.eigvalsh(bent[k] / np.outer(size, size))[0])
        # Noise-free data leave a cost of rounding errors, of which no share means anything.
        if left[k] > 1e-6 * cost + 1e-12:
            kind = UNFINISHED if status[k] == RUNNING else WALL
        elif curvature < -1e-6:
            kind = SADDLE
        else:
            kind = MINIMUM if curvature > 1e-9 else FLAT
        values, led = np.asarray(problem.parameters.values(z[k])), tuple(sorted([k, *others]))
        minima.append(Minimum(2 * cost, z[k], values, led, float(left[k]), curvature, kind))
    best = min(minima, key=lambda point: (not point.is_minimum, point.cost))
    if lost := tuple(k for k in range(len(z)) if not np.isfinite(costs[k])):
        values = np.asarray(problem.parameters.values(z[lost[0]]))
        minima.append(Minimum(np.inf, z[lost[0]], values, lost, np.inf, -np.inf, NOT_FINITE))
    reason, count = (int(part[best.starts[0]]) for part in (status, steps))
    message = "" if best.is_minimum else best.kind
    if message and reason in (RUNNING, STALLED):
        message = stopped_early(reason, count)
    return solution_at(problem, best.z, message, count), tuple(minima)


@eqx.filter_jit
def _solve_all(problem, starts, solver, max_steps) -> tuple:
    """Of every start: `z`, status and steps of its stop; there the normal equations, the Newton
    decrement, and second derivatives of half the cost."""

    def normal_at(z):
        return problem_normal(z, problem)

    if solver is None:
        side_by_side = jax.vmap(normal_at, in_axes=-1, out_axes=-1)
        state = minimise(side_by_side, starts.T, max_steps, TOLERANCE)
        z, status, steps = state.z.T, state.status, state.steps
    else:
        solve = lambda z0: least_squares(residuals, z0, problem, solver=solver, max_steps=max_steps)
        stop = jax.lax.map(solve, starts)
        z, steps = stop.z, stop.steps
        status = jnp.where(stop.converged, CONVERGED, RUNNING)
    normal = jax.vmap(normal_at)(z)
    # Forward over forward: a model need not support reverse differentiation.
    bent = jax.vmap(jax.jacfwd(lambda z: normal_at(z).gradient))(z)
    return z, status, steps, normal, jax.vmap(decrement)(normal), bent
