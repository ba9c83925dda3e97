"""The least-squares problem of an output-error fit, and the descent to its minimum."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxquad._core import minimise_on_host, Normal, RUNNING, solve_definite, STALLED

from ._known_loop import close_loop
from ._noise_model import NoiseModel
from ._parameters import Numbers
from ._problem import prior_misfits, Problem
from ._simulated import (
    band_filter,
    forced_response,
    free_response,
    integrate_plant,
    linear_model,
    Motions,
)
from ._solve import Solution, solution_at
from ._whitening import Whitener


_RIDGE = 1e-10  # of the squared length of a column, and taken out again by refinement
_LOOSE = 1e-2  # standard errors per unit of initial state: holds what has no effect


class RecordTerm(eqx.Module):
    """A record as the fit sees it."""

    u: Float[Numbers, "samples inputs"]
    y: Float[Numbers, "samples outputs"]  # within the band
    weights: Float[Numbers, " outputs"]  # one over the residual's standard deviation
    gain: Float[Numbers, " bins"] | None  # of the band, over frequency
    motions: tuple[Float[Numbers, "states slow"], Float[Numbers, "states fast"]] | None
    start: Float[Numbers, " unknown"]  # units of an unknown initial state; none if it is eliminated
    dt: float = eqx.field(static=True)
    hold: str = eqx.field(static=True)
    whitener: Whitener | None = None  # of the noise, where it has a model
    feedback: Float[Numbers, " samples"] | None = None  # of a known loop, after a unit of output

    def weighted(
        self, x: Float[Numbers, "samples outputs *columns"]
    ) -> Float[Array, "samples outputs *columns"]:
        """What counts of outputs: within the band, unpredicted by the noise, in units of it."""
        x = jnp.asarray(x)
        seen = band_filter(x, self.gain) if self.whitener is None else self.whitener(x)
        return jnp.asarray(seen) * self.weights.reshape(1, -1, *(1,) * (x.ndim - 2))

    @property
    def measured(self) -> Float[Numbers, "samples outputs"]:
        """The measured output as `weighted` sees it."""
        return self.y * self.weights[None] if self.whitener is None else self.weighted(self.y)

    @property
    def counted(self) -> Int[np.ndarray, " outputs"]:
        """Samples of each output that the noise model predicts."""
        samples, outputs = self.y.shape
        unseen = np.zeros(outputs, int) if self.whitener is None else self.whitener.start
        return samples - np.asarray(unseen)


class OutputError(eqx.Module):
    """Residuals of all records as a function of the free parameters and the initial states."""

    base: Problem  # model, parameters and priors
    terms: tuple[RecordTerm, ...]
    zeros: tuple[int, ...] = eqx.field(static=True)  # arrays of the model that are known to be 0

    def reweighted(self, sizes: Sequence[Float[np.ndarray, " outputs"]]) -> "OutputError":
        """The same problem with its residuals divided by `sizes`."""
        terms = [
            dataclasses.replace(term, weights=np.asarray(term.weights) / size)
            for term, size in zip(self.terms, sizes, strict=True)
        ]
        return dataclasses.replace(self, terms=tuple(terms))

    @property
    def unknown(self) -> int:
        """How many initial states follow the parameters in z."""
        return sum(term.start.size for term in self.terms)


def split(z: Float[Numbers, " n"], problem: OutputError) -> list[Float[Numbers, " part"]]:
    """The parameters, and then each record's initial state."""
    ends = np.cumsum([0, *(term.start.size for term in problem.terms)])
    count = z.size - problem.unknown
    return [z[:count], *(z[count + a : count + b] for a, b in zip(ends, ends[1:], strict=False))]


def insert_parameters(z: Float[Numbers, " n"], problem: OutputError) -> PyTree:
    """The model at these parameters; what is 0 and fixed stays known to be 0 under jit."""
    model = problem.base.parameters.insert(problem.base.model, z)
    arrays, rest = eqx.partition(model, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
    for k in problem.zeros:
        leaves[k] = np.zeros(leaves[k].shape, leaves[k].dtype)
    return eqx.combine(jax.tree.unflatten(structure, leaves), rest)


def misfit_and_columns(
    model: PyTree, start: Float[Array, " unknown"], term: RecordTerm
) -> tuple[Float[Array, "samples outputs"], Float[Array, "samples outputs unknowns"]]:
    """Weighted misfit at zero start and trim, and what each unit of them adds to the output."""
    if term.motions is None:
        simulated = integrate_plant(model, term.u, term.start * start, term.dt, term.hold)
        shifts = jnp.eye(term.y.shape[1])[None]
        columns = jnp.broadcast_to(shifts, (*term.y.shape, term.y.shape[1]))
    else:
        plant = linear_model(model)
        simulated = forced_response(plant, term.u, term.dt, term.hold)
        motions = Motions(*term.motions, ())
        columns = free_response(plant, motions, len(term.u), term.dt)
        if (feedback := term.feedback) is not None:
            late = jnp.asarray(feedback)
            closed = lambda x: term.weighted(close_loop(plant, x, late, term.dt))
            return closed(term.y - simulated), closed(columns)
    return jnp.asarray(term.measured) - term.weighted(simulated), term.weighted(columns)


def project_out(
    found: Float[Array, "samples outputs"], columns: Float[Array, "samples outputs unknowns"]
) -> Float[Array, "samples outputs"]:
    """The misfit that no start, trim or shift explains (variable projection)."""
    flat = columns.reshape(found.size, -1)
    square = jax.lax.stop_gradient(jnp.sum(flat**2, axis=0))
    flat = flat / jnp.sqrt(jnp.where(square > 1e-20 * jnp.max(square), square, 1.0))[None]
    normal = jnp.dot(flat.T, flat, precision="highest")
    aim = flat.T @ found.reshape(-1)
    ridged = normal + _RIDGE * jnp.eye(aim.size)

    def refine(_, unknowns):
        return unknowns + solve_definite(ridged, aim - normal @ unknowns)[0]

    unknowns = jax.lax.fori_loop(0, 3, refine, jnp.zeros_like(aim))
    return found - (flat @ unknowns).reshape(found.shape)


class Evaluation(NamedTuple):
    """Misfits, slopes and columns at one place, record by record; all weighted."""

    misfits: list[Float[Array, "samples outputs"]]
    slopes: list[Float[Array, "samples outputs n"]]  # by parameters, then initial states
    columns: list[Float[Array, "samples outputs unknowns"]]  # of start, trim and shift
    normal: Normal  # of these, of the priors and of a hold on the initial states

    def reweighted(self, sizes: Sequence[Float[np.ndarray, " outputs"]]) -> "Evaluation":
        """The same, divided by `sizes`; the normal equations as they were."""
        divided = lambda parts: [
            part / jnp.asarray(size).reshape(1, -1, *(1,) * (part.ndim - 2))
            for part, size in zip(parts, sizes, strict=True)
        ]
        parts = (divided(self.misfits), divided(self.slopes), divided(self.columns))
        return Evaluation(*parts, normal=self.normal)


@eqx.filter_jit
def evaluate_misfits(z: Float[Numbers, " n"], problem: OutputError) -> Evaluation:
    """Everything at the first parameters and the initial states `z`."""

    def simulated(z):
        values, *starts = map(jnp.asarray, split(z, problem))
        model = insert_parameters(values, problem)
        pairs = [
            misfit_and_columns(model, *each) for each in zip(starts, problem.terms, strict=True)
        ]
        left = [project_out(*pair) for pair in pairs]
        rest = [prior_misfits(values, problem.base), *(_LOOSE * start for start in starts)]
        return (left, rest), (left, rest, [columns for _, columns in pairs])

    (slopes, others), (left, rest, columns) = jax.jacfwd(simulated, has_aux=True)(z)
    r = jnp.concatenate([one.reshape(-1) for one in (*left, *rest)])
    J = jnp.concatenate([one.reshape(-1, z.size) for one in (*slopes, *others)])
    return Evaluation(left, slopes, columns, Normal(0.5 * jnp.sum(r**2), J.T @ r, J.T @ J))


CLOSE = 1e-6  # last step of a descent, relative to 1 + |z|
_PASSES = 4  # of noise level and parameters by turns
_LEVEL = 0.01  # change of the noise level that no longer matters


class RecordNoise(NamedTuple):
    """The noise models of a record's outputs, and what their coefficients do to the misfit."""

    models: tuple[NoiseModel, ...]
    slopes: Float[np.ndarray, "samples outputs coefficients"]  # weighted as the misfit


class Descent(NamedTuple):
    """Where the descent ended, and all that the result is made from."""

    problem: OutputError  # under the final noise level
    z: Float[np.ndarray, " n"]  # free parameters and initial states
    solution: Solution
    found: Evaluation
    noise: tuple[RecordNoise, ...] = ()  # of each record, where it has a model


class Point(NamedTuple):
    """Where the descent stands. Changes of z below 1e-6 count as none: errors are far larger."""

    problem: OutputError
    z: Float[np.ndarray, " n"]
    found: Evaluation

    @property
    def cost(self) -> float:
        finite = all(np.all(np.isfinite(np.asarray(part))) for part in self.found.normal)
        return float(self.found.normal.cost) if finite else np.inf

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(self.found.normal.gradient), np.asarray(self.found.normal.hessian)

    def moved(self, change: Float[np.ndarray, " n"]) -> "Point":
        return _point(self.problem, self.z + change)


def _point(problem: OutputError, z: Float[np.ndarray, " n"]) -> Point:
    return Point(problem, z, evaluate_misfits(np.asarray(z), problem))


def descend_by_turns(problem: OutputError, max_steps: int, tolerance: float = CLOSE) -> Descent:
    """Parameters and noise level by turns: the maximum of the likelihood of both."""
    base, steps = problem.base, 0
    count = base.parameters.count
    z = np.concatenate([np.asarray(base.parameters.start)[:count], np.zeros(problem.unknown)])
    # A factor common to all residuals moves no minimum.
    common = len(problem.terms) == problem.terms[0].weights.size == 1
    common = common and not base.quantities and not problem.unknown
    for turn in range(_PASSES):
        stop, status, taken = descend(problem, z, max_steps, tolerance)
        z, steps, found, message = stop.z, steps + taken, stop.found, message_of(status, taken)
        sizes = sizes_of(problem, found)
        changed = max(float(np.max(np.abs(np.log(size)))) for size in sizes)
        problem = problem.reweighted(sizes)
        if common or changed < _LEVEL or message or turn == _PASSES - 1:
            break
    found = found.reweighted(sizes)
    return Descent(problem, np.asarray(z), describe_stop(base, z, message, steps), found)


def describe_stop(base: Problem, z: Float[np.ndarray, " n"], message: str, steps: int) -> Solution:
    """The model, its values and the priors' slopes where the descent stopped."""
    at = np.asarray(z)[: base.parameters.count]
    low, sizes = _at_zero(base, at)
    return solution_at(base, at, message, steps)._replace(at_zero=low, units_at_zero=sizes)


_FAR = 7.0  # in ln: a parameter that shrank by a factor of 1000 ran to zero


def _at_zero(
    base: Problem, z: Float[np.ndarray, " parameters"]
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Parameters that ran to zero, and their sizes at the start."""
    start, scale = (np.asarray(x)[: z.size] for x in (base.parameters.start, base.parameters.scale))
    logarithmic = np.array(base.parameters.logarithmic[: z.size])
    low = np.flatnonzero(logarithmic & (np.asarray(z) - start < -_FAR))
    return tuple(low.tolist()), tuple((scale[low] * np.exp(start[low])).tolist())


def sizes_of(problem: OutputError, found: Evaluation) -> list[Float[np.ndarray, " outputs"]]:
    """Standard deviations of the weighted residuals."""
    sizes = []
    for term, misfit in zip(problem.terms, found.misfits, strict=True):
        size = np.sqrt(np.sum(np.asarray(misfit) ** 2, axis=0) / term.counted)
        least = 1e-9 * np.std(np.asarray(term.y), axis=0) * np.asarray(term.weights)
        sizes.append(np.maximum(size, least))
    return sizes


def descend(
    problem: OutputError, z: Float[np.ndarray, " n"], max_steps: int, tolerance: float = CLOSE
) -> tuple[Point, int, int]:
    """The minimum near `z`, to a last step of `tolerance`; why it ended, and after what steps."""
    start = _point(problem, z)
    if not np.isfinite(start.cost):
        raise ValueError(
            "the simulated output of the model, or its derivative, is not finite at the starting "
            "values: the model is unstable over so long a record, or a value has the wrong size. "
            "Start from other values, cut the record with jq.records.trim, or fit in the "
            "frequency domain with jq.fit"
        )
    return minimise_on_host(start, Point.moved, max_steps, tolerance=tolerance)


def message_of(status: int, steps: int) -> str:
    """Why the descent stopped before a minimum; empty at one."""
    if status == RUNNING:
        return f"the maximum of {steps} steps was reached"
    if status == STALLED:
        return (
            "every shorter step fails too: the simulation is not finite or not smooth nearby "
            f"(after {steps} steps)"
        )
    return ""


_STEP_FIXED_SLOPES = 1e-5  # relative; its square is the error


def with_fixed_slopes(descent: Descent) -> Evaluation:
    """The misfits' slopes by the free parameters, then the fixed, then the initial states.

    Central differences: they serve for names alone, and compile nothing anew.
    """
    parameters, found = descent.problem.base.parameters, descent.found
    count, values = parameters.count, np.asarray(descent.solution.values)
    fixed = [_slopes(descent, k, values) for k in range(count, values.size)]
    slopes = [
        jnp.concatenate([mine[:, :, :count], jnp.stack(others, axis=2), mine[:, :, count:]], axis=2)
        for mine, *others in zip(found.slopes, *fixed, strict=True)
    ]
    return found._replace(slopes=slopes)


def _slopes(descent: Descent, k: int, values: np.ndarray) -> list:
    problem = descent.problem
    ends = []
    for step in (_STEP_FIXED_SLOPES, -_STEP_FIXED_SLOPES):
        moved = values.copy()
        moved[k] *= np.exp(step)
        model = problem.base.parameters.replace(problem.base.model, moved)
        base = dataclasses.replace(problem.base, model=model)
        ends.append(evaluate_misfits(descent.z, dataclasses.replace(problem, base=base)).misfits)
    return [
        (after - before) / (2 * _STEP_FIXED_SLOPES) for after, before in zip(*ends, strict=True)
    ]
