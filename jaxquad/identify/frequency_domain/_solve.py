"""Descents of fits, the derivatives where they stop, and the test for saddles."""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxquad._compile import evaluate_once, FEW, hasty_options, KeptPrograms
from jaxquad._core import (
    advance,
    begin,
    invert_definite,
    Normal,
    normal_equations,
    RUNNING,
    settle,
    STALLED,
    TOLERANCE,
)

from ._cost import mix
from ._parameters import namespace_of, Numbers
from ._problem import misfits, on_device, Problem, problem_normal, residuals, weigh_parts


_FEW = 2000  # points times parameters, whose slopes take a tenth of a ms
_SHORT = 3e4  # residuals times parameters squared: a few ms for a whole descent
_LONGEST = 0.05  # relative step to either side of a stop
_RIDGE = 1e-12  # of a matrix with ones on its diagonal, so that it has an inverse

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
                misfit = (weights * np.asarray(misfit))[..., None]
                rows.append(mix(mixing, misfit)[..., 0][weights > 0])
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
    aside: Float[np.ndarray, " sides"] | None = None  # costs to either side, if it has them

    @property
    def converged(self) -> bool:
        return not self.message


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
        names = ("model", "measured", "parameters", "aliases", "prior")
        self.ids = tuple(id(getattr(problem, name)) for name in names)

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
    """Misfits and slopes at all places in parallel. Records of equal shape share a program,
    whatever they are weighted by: compiling it takes longer than a fit."""
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
        evaluations.append(by_record(problem, *parts[0]))
    return evaluations


def by_record(problem: Problem, lined_up: Any, rows: Any) -> Sensitivity:
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

    - `residual`: a function of `z` and `args` that returns a vector. `z` should be relative or
        logarithmic, so that one unit means the same for all elements.
    - `solver`: any optimistix least-squares solver, with its own tolerance; `None` for damped
        Gauss-Newton (Levenberg-Marquardt) on the normal equations.
    - `tolerance`: of the default solver, for steps relative to 1 + |z|.
    - `normal`: a faster way to the normal equations of the same residuals, for the default solver.
    """
    # Imported late: optimistix doubles the time of `import jaxquad`.
    import optimistix as optx

    chosen = _gauss_newton()(tolerance, normal) if solver is None else solver
    if not isinstance(chosen, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        raise ValueError(
            f"solver is a {type(chosen).__name__}: give an optimistix least-squares solver, for "
            "instance optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)"
        )

    def finite(z, args):
        # A wall of NaN would look like a minimum to the solver: make it a high one instead.
        r = residual(z, args)
        return jnp.where(jnp.isfinite(r), r, 1e6)

    function = residual if solver is None else finite
    end = optx.least_squares(function, chosen, z0, args=args, max_steps=max_steps, throw=False)
    reason = end.state.status if solver is None else end.result
    return Stop(end.value, end.result == optx.RESULTS.successful, reason, end.stats["num_steps"])


@ft.cache
def _gauss_newton() -> Callable[..., PyTree]:
    import optimistix as optx

    class DampedGaussNewton(optx.AbstractLeastSquaresSolver):
        """Gauss-Newton on the normal equations, damped as far as its steps fail.

        A step that meets NaN is shortened like any that fails. `result` is `nonlinear_divergence`
        where no shorter step helps either; the last point is then the best. Without LAPACK, so
        `vmap` over solves is safe on few cores.
        Source: Nielsen (1999), Damping parameter in Marquardt's method, IMM-REP-1999-05.
        """

        rtol: float
        atol: float
        norm: Callable[[PyTree], Float[Array, ""]]
        normal: Evaluate | None  # a faster way to the normal equations than to differentiate

        def __init__(self, tolerance: float, normal: Evaluate | None):
            self.rtol = self.atol = tolerance
            self.norm, self.normal = optx.max_norm, normal

        def init(self, fn, y, args, options, f_struct, aux_struct, tags):
            return begin(y)

        def step(self, fn, y, args, options, state, tags):
            by_slopes = lambda z: normal_equations(lambda z, args: fn(z, args)[0], z, args)
            faster = self.normal
            at = by_slopes if faster is None else lambda z: faster(z, args)
            state = advance(at, state, jnp.iinfo(jnp.int32).max, self.rtol)
            state = jax.lax.cond(state.status == STALLED, settle, lambda same: same, state)
            return state.z, state, None  # to ask `fn` for it would trace the residuals once more

        def terminate(self, fn, y, args, options, state, tags):
            failed, good = optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
            result = optx.RESULTS.where(state.status == STALLED, failed, good)
            return state.status != RUNNING, result

        def postprocess(self, fn, y, aux, args, options, state, tags, result):
            return y, aux, {}

    return DampedGaussNewton


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
            z, values, slopes, *parts, aside = map(np.asarray, (stop.z, *rest))
            parts = message, steps, by_record(problem, *parts)
            return Solution(z, model, values, slopes, *parts, aside=aside)
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
    options: dict[str, Any] = {"compiler_options": hasty_options()} if short else {}
    return eqx.filter_jit(descend, **options)


def _solve_by_default(z0: Float[Array, " parameters"], problem: Problem, max_steps: int) -> tuple:
    """The stop, and what a `Solution` says of that point; for problems of a single record."""
    stop, parameters = _descend(z0, problem, max_steps), problem.parameters
    z = jnp.concatenate([stop.z, parameters.start[z0.size :]])
    values = parameters.values(z)
    model = parameters.replace(problem.model, values[: z0.size])
    return stop, take_apart(model)[1], values, *_around(z, problem, z0.size)


def _around(z: Float[Array, " all"], problem: Problem, count: int) -> tuple[Numbers, ...]:
    """Slopes of the values, misfits and their slopes, and the costs to either side of a stop, of
    which the first `count` parameters are free; for problems of a single record."""
    lined_up, slopes = misfits_and_slopes(z, problem)
    # The costs to either side, from misfits and slopes.
    both = jnp.concatenate([lined_up[None], slopes[:count]])
    parts = both.reshape(len(both), 2, *jnp.moveaxis(problem.measured[0], 0, -1).shape)
    weighed = jax.vmap(ft.partial(weigh_parts, problem, 0))(parts[:, 0], parts[:, 1])
    rows = jnp.concatenate([part.reshape(len(both), -1) for part in weighed], axis=1)
    sides = _sides(z[:count], rows[1:] @ rows[1:].T, rows[0] @ rows[0])
    costs = jax.vmap(lambda z: jnp.sum(residuals(z, problem) ** 2))(sides)
    return problem.parameters.slopes(z), lined_up, slopes, costs


def _around_each(z: Float[Array, "stops all"], problems: Problem, count: int) -> tuple:
    """The values at stops of problems that differ by their numbers, and what is around them."""
    numbers, rest = eqx.partition(problems, eqx.is_array)

    def one(parts: tuple) -> tuple[Numbers, ...]:
        z, problem = parts[0], eqx.combine(parts[1], rest)
        return problem.parameters.values(z), *_around(z, problem, count)

    return jax.lax.map(one, (z, numbers))


_STOPS = 16  # of one call


class Stops(NamedTuple):
    """What is around the stops of many problems of one record."""

    values: Float[np.ndarray, "stops all"]
    slopes: Float[np.ndarray, "stops all"]  # of the values, by z
    misfits: Float[np.ndarray, "stops frequencies outputs inputs 2"]
    misfit_slopes: Float[np.ndarray, "stops frequencies outputs inputs 2 all"]
    aside: Float[np.ndarray, "stops sides"]  # costs to either side


def stops_at(problems: Sequence[Problem], z: Float[np.ndarray, "stops parameters"]) -> Stops:
    """Where each of many problems of one record stopped, which are alike but for their numbers."""
    alike = problems
    if any(mixing is not None for problem in problems for mixing in problem.mixings):
        alike = [problem.mixed() for problem in problems]
    frames, arrays = zip(*map(take_apart, alike), strict=True)
    z_all = np.tile(np.asarray(problems[0].parameters.start), (len(z), 1))
    z_all[:, : z.shape[1]] = z
    numbers = [z_all, *map(np.stack, zip(*arrays, strict=True))]
    run, parts = _program(frames[0], "stops", z.shape[1]), []
    # All calls have one size, so that one program is compiled: the last is filled up.
    for first in range(0, len(problems), _STOPS):
        here = np.minimum(np.arange(first, first + _STOPS), len(problems) - 1)
        parts.append(run([array[here] for array in numbers]))
    columns = (np.concatenate(column)[: len(problems)] for column in zip(*parts, strict=True))
    values, slopes, lined_up, by_all, aside = columns
    shape = (len(problems), -1, 2, *np.moveaxis(np.asarray(problems[0].measured[0]), 0, -1).shape)
    ordered = [np.moveaxis(x.reshape(shape), (1, 5, 2), (5, 1, 4)) for x in (lined_up, by_all)]
    return Stops(values, slopes, ordered[0][..., 0], ordered[1], aside)


def solutions_at(
    problems: Sequence[Problem],
    z: Float[np.ndarray, "problems parameters"],
    messages: Sequence[str],
    steps: Sequence[int],
) -> list[Solution]:
    """As `solution_at` of each of many problems, of one record and alike but for their numbers."""
    stops, solutions = stops_at(problems, z), []
    pairs = zip(problems, stops.values, strict=True)
    models = on_device([p.parameters.replace(p.model, x[: z.shape[1]]) for p, x in pairs])
    none = np.zeros(0), np.zeros((0, stops.values.shape[1]))
    for k, (values, slopes, lined_up, by_all, aside) in enumerate(zip(*stops, strict=True)):
        numbers = z[k], models[k], values, slopes, messages[k], steps[k]
        solutions.append(Solution(*numbers, Sensitivity([lined_up], [by_all], *none), aside=aside))
    return solutions


_KEPT = {
    "few": KeptPrograms(misfits_and_slopes, hasty_options),
    "many": KeptPrograms(misfits_and_slopes, dict),
    "short": KeptPrograms(_descend, hasty_options),
    "long": KeptPrograms(_descend, dict),
    "at once": KeptPrograms(_solve_by_default, hasty_options),
    "stops": KeptPrograms(_around_each, hasty_options),
}


@ft.lru_cache(maxsize=256)
def _program(frame: Frame, kind: str, *options: int) -> Callable[[list[Numbers]], Any]:
    fill = lambda arrays: (arrays[0], frame.filled(arrays[1:]), *options)
    return _KEPT[kind].of_arrays(fill)


def is_saddle(problem: Problem, solution: Solution, here: float, bread: np.ndarray) -> bool:
    """Whether the cost is lower than `here`, at the solution, a small step to either side of it.
    `bread` is J'J of its weighted residuals."""
    costs = solution.aside
    if costs is None:
        sides = evaluate(problem, *_sides(solution.z, bread, np.asarray(here)))
        costs = np.array([row @ row for row in (side.weighted(problem) for side in sides)])
    return bool(np.min(costs) < here * (1 - 1e-6) - 1e-12)


def _sides(
    z: Float[Numbers, " parameters"],
    bread: Float[Numbers, "parameters parameters"],
    here: Float[Numbers, ""],
) -> Float[Numbers, "sides parameters"]:
    """A small step from `z` to either side along the weakest direction of `bread`."""
    xp = namespace_of(z)
    size = xp.sqrt(xp.maximum(xp.diagonal(bread), 1e-300))
    unit = bread / (size[:, None] * size[None])
    if xp is np:
        curvatures, vectors = np.linalg.eigh(unit)
        weakest, curvature = vectors[:, 0] / size, curvatures[0]
    else:
        # A kept program that calls LAPACK crashes in a process that has not traced it. So: the 32nd
        # power of the inverse, in whose columns nothing is left but the weakest direction.
        inverse = invert_definite(unit + _RIDGE * jnp.eye(z.size, dtype=z.dtype))[0]
        power = inverse / jnp.trace(inverse)
        for _ in range(5):
            power = power @ power
        column = power[:, jnp.argmax(jnp.diagonal(power))]
        vector = column / jnp.sqrt(column @ column)
        weakest, curvature = vector / size, vector @ unit @ vector
    step = xp.sqrt(1e-2 * xp.maximum(here, 1e-12) / xp.maximum(curvature, 1e-12))
    step = xp.minimum(step, _LONGEST / xp.maximum(xp.max(xp.abs(weakest)), 1e-300))
    return xp.stack([z + step * weakest, z - step * weakest])


def same_responses(problem: Problem, solution: Solution, values: np.ndarray) -> bool:
    """Whether other values of the free parameters leave all responses as they are."""
    if (z := problem.parameters.coordinates(values)) is None:
        return False
    moved = solution_at(problem, z).sensitivity.misfits
    pairs = zip(moved, solution.sensitivity.misfits, strict=True)
    return all(np.allclose(*pair, atol=1e-6, rtol=0, equal_nan=True) for pair in pairs)
