"""Derivatives of a fit by its data, its fixed parameters and its priors, at the minimum.

Where the cost's gradient g(z, a) by the parameters z vanishes, dz = -(dg/dz)^-1 (dg/da) da for what
it depends on, a (the implicit function theorem). dg/dz is the whole Hessian: without the second
derivatives of the residuals, as Gauss and Newton have it, derivatives would be off by the size of
the misfit. A fit descends several times, under weights that follow from the last stop and from
what the model leaves unexplained there: so derivatives go from stop to stop.
"""

import functools as ft
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._compile import hasty_options
from jaxquad._core import invert_definite, is_traced
from jaxquad.models import with_arrays
from jaxquad.spectra import FrequencyResponse

from ..uncertainty._discrepancy import find_discrepancy
from ..uncertainty._response_term import PriorRows, ResponseTerm
from ..uncertainty._verdict import NO_MINIMUM
from ._cost import Cost, mixing_of, Points
from ._parameters import Condition, Numbers, require_conditions
from ._problem import misfits, on_device, Prior, Problem, residuals
from ._result import Fit
from ._solve import by_record, Frame, Sensitivity, Solution, take_apart


_FLAT = 1e-10  # curvature over the largest one, below which a direction has no minimum

Vector = Float[Array, " parameters"]
Matrix = Float[Array, "parameters parameters"]


class Inputs(NamedTuple):
    """What a fit has derivatives by."""

    model: PyTree
    frf: FrequencyResponse | Sequence[FrequencyResponse]
    conditions: Sequence[Condition | None] | None
    priors: Sequence[Prior]


class Descent(NamedTuple):
    """One of a fit: the problem with its weights, the points that gave them, and the stop."""

    problem: Problem
    points: Sequence[Points]
    solution: Solution


class _Data(NamedTuple):
    """`Inputs` as a problem has them; of each response the values, their errors, the coherence."""

    model: PyTree
    conditions: tuple[Condition, ...]
    prior: Float[Numbers, "priors 2"]
    frfs: tuple[tuple[Numbers, Numbers, Numbers], ...]


class _Step(NamedTuple):
    """A `Descent` as a program has it."""

    problem: Problem  # without weights
    points: tuple[Points, ...]
    z: Float[Numbers, " parameters"]
    at_zero: tuple[int, ...]
    is_mixed: bool
    has_floor: bool

    @property
    def moving(self) -> Float[np.ndarray, " parameters"]:
        """1 for the parameters that are not at a bound, else 0."""
        return 1.0 - np.isin(np.arange(self.z.size), self.at_zero)


def with_derivatives(fit: Fit, descents: Sequence[Descent], inputs: Inputs, cost: Cost) -> Fit:
    """The fit with a model and values that JAX's transformations see through.

    **Raises:** ValueError where there is no minimum to follow, or a function uses NumPy.
    """
    if not fit.verdict.fitted or fit.verdict.kind == NO_MINIMUM:
        raise ValueError(f"a fit without a minimum has no derivative: {fit.verdict.summary}")
    if not descents:
        raise ValueError(
            "this fit knows a delay only to its sample, which has no derivative: fix it (free=)"
        )
    frfs = list(inputs.frf) if isinstance(inputs.frf, Sequence) else [inputs.frf]
    priors = [jnp.stack([one.value, one.standard_error]) for one in inputs.priors]
    model, steps = with_arrays(inputs.model), []
    conditions = tuple(require_conditions(model, inputs.conditions, len(frfs)))
    responses = tuple((frf.response, frf.random_error, frf.coherence) for frf in frfs)
    data = _Data(model, conditions, jnp.stack(priors) if priors else np.zeros((0, 2)), responses)
    for problem, points, solution in descents:
        plain = tuple(
            replace(one, frf=replace(one.frf, remarks=(), log_noise_covariance=None))
            for one in points
        )
        kinds = any(problem.mixings), bool(np.any(points[0].floor))
        steps.append(
            _Step(problem.weighted(()), plain, solution.z, tuple(solution.at_zero), *kinds)
        )
    grids = tuple(
        (one.used.shape, one.used.tobytes(), np.asarray(one.frf.omega).tobytes()) for one in points
    )
    # Strictness about types and shapes is for a user's own arrays.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        try:
            z = _estimate(data, (steps, cost), grids)
        except jax.errors.TracerArrayConversionError as error:
            raise ValueError(
                f"{type(cost).__name__}, or another function of this fit, computes with NumPy, "
                "which has no derivatives: use jax.numpy in it"
            ) from error
        except np.linalg.LinAlgError as error:
            raise ValueError(
                "the cost is flat along one direction of the parameters, so that their derivatives "
                f"are not determined: {fit.verdict.summary}; fix a parameter (free=), or add a "
                "jq.identify.Prior"
            ) from error
        parameters = problem.parameters
        values = jnp.where(steps[-1].moving > 0, parameters.values(z), solution.values[: z.size])
        return replace(fit, model=on_device(parameters.replace(model, values)), values=values)


def _estimate(data: _Data, rest: PyTree, grids: tuple) -> Vector:
    """Where the last descent stopped, with its derivatives by the data."""
    (frame, arrays), count = take_apart((data, rest)), len(take_apart(data)[1])
    rest, z = arrays[count:], rest[0][-1].z

    @jax.custom_jvp
    def estimate(data: list[Numbers]) -> Vector:
        return jnp.asarray(z)

    @estimate.defjvp
    def along(primals, tangents) -> Any:
        (data,), (changes,) = primals, tangents
        if is_traced(data):  # by a second derivative
            follow = lambda data: _follow_jitted(frame, grids, data, rest)[0]
            return jax.jvp(follow, (data,), (changes,))
        slopes, curvature = _slopes()(frame, grids, data, rest)
        if not np.linalg.eigvalsh(np.asarray(curvature))[0] > _FLAT:
            raise np.linalg.LinAlgError
        smooth = (change for change in changes if change.dtype != jax.dtypes.float0)
        pairs = zip(slopes, smooth, strict=True)
        change = sum(jnp.real(jnp.tensordot(slope, x, x.ndim)) for slope, x in pairs)
        return estimate(data), change

    return estimate(arrays[:count])


@ft.cache
def _slopes() -> Callable[..., tuple[list[Array], Matrix]]:
    """The program of the estimates' slopes by the data, and of the last curvature.

    There are few parameters, so that both modes share it; and it takes brief compiling, as a
    program within a derivative cannot.
    """

    def slopes(frame, grids, data, rest):
        smooth = [jnp.issubdtype(x.dtype, jnp.inexact) for x in data]

        def follow(chosen):
            left = iter(chosen)
            filled = [next(left) if one else x for x, one in zip(data, smooth, strict=True)]
            return _follow(frame, grids, filled, rest)

        chosen = [x for x, one in zip(data, smooth, strict=True) if one]
        z, pull, curvature = jax.vjp(follow, chosen, has_aux=True)
        return jax.vmap(pull)(jnp.eye(z.size))[0], curvature

    return jax.jit(slopes, static_argnums=(0, 1), compiler_options=hasty_options())


def _follow(
    frame: Frame, grids: tuple, data: list[Numbers], rest: list[Numbers]
) -> tuple[Vector, Matrix]:
    """Where the last descent stopped, from stop to stop, and the curvature there.

    `grids` has the places of the points in use, and their frequencies.
    """
    inputs, (steps, cost) = frame.filled([*data, *rest])
    problem, z = steps[0].problem, jnp.asarray(steps[0].z)
    for k, step in enumerate(steps):
        rows = zip(step.points, inputs.frfs, grids, strict=True)
        points = [_traced(*row) for row in rows]
        ratios = [jnp.ones(one.used.shape) for one in points]
        if k:
            along = ft.partial(misfits, problem=problem)
            reached = by_record(problem, along(z), jax.jacfwd(along)(z).T)
            ratios = [jnp.exp(misfit[..., 0]) for misfit in reached.misfits]
            if step.has_floor:
                floor = _unexplained(steps[k - 1], points, reached)
                points = [replace(one, floor=jnp.full(one.used.shape, floor)) for one in points]
        weights = [type(cost).weights(cost, *pair) for pair in zip(points, ratios, strict=True)]
        pairs = zip(points, weights, strict=True)
        mixings = [mixing_of(*pair) if step.is_mixed else None for pair in pairs]
        problem = replace(
            step.problem,
            model=inputs.model,
            conditions=inputs.conditions,
            prior=inputs.prior,
            measured=tuple(one.frf.response for one in points),
        ).weighted(weights, [mixing and mixing._replace(idle=None) for mixing in mixings])
        frame, arrays = take_apart(problem)
        z = _minimum(frame, step.z, step.moving, arrays)
    fixed = jax.lax.stop_gradient((z, arrays))
    return z, _unit(_curvature(frame, *fixed), step.moving)[0]


_follow_jitted = jax.jit(_follow, static_argnums=(0, 1))


def _traced(points: Points, numbers: tuple[Numbers, ...], grid: tuple) -> Points:
    """The points with the response and its errors as they are traced; 1 where they do not count."""
    shape, used, omega = grid
    used, old = np.frombuffer(used, bool).reshape(shape), points.frf
    response, error, coherence = (jnp.where(used, x, 1.0) for x in numbers)
    # Correlations are relative to the response: they turn with its phase.
    turn = jnp.conj(response / jnp.where(used, old.response, 1.0))
    turn = turn / jnp.abs(turn)
    correlations, between, flat = {}, points.between, turn.reshape(len(turn), -1)
    for pair, rho in points.correlations.items():
        row = turn[np.flatnonzero(used[:, *pair]), *pair]
        correlations[pair] = row[:, None] * rho * jnp.conj(row)
    if between is not None:
        between = flat[:, :, None] * between * jnp.conj(flat)[:, None, :]
    measured = {"response": response, "random_error": error, "coherence": coherence}
    frf = replace(old, omega=np.frombuffer(omega), **measured)
    return replace(points, used=used, frf=frf, correlations=correlations, between=between)


def _unexplained(step: _Step, points: Sequence[Points], reached: Sensitivity) -> Array:
    """The amplitude of the discrepancy at a stop."""
    terms = [
        ResponseTerm(one.frf, misfit, slopes, one.used[..., None] * np.ones(2), None, step.z.size)
        for one, misfit, slopes in zip(points, reached.misfits, reached.slopes, strict=True)
    ]
    prior = PriorRows(reached.prior_misfits, reached.prior_slopes)
    shared, moving = [one.shared for one in points], np.flatnonzero(step.moving).tolist()
    mixture = find_discrepancy(terms, shared, prior, moving)[0]
    return jnp.sqrt(jnp.sum(mixture.powers))


@ft.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _minimum(
    frame: Frame, z: Vector, moving: Float[Numbers, " parameters"], arrays: list[Numbers]
) -> Vector:
    """The minimum `z` of the cost of a problem, by its arrays."""
    return jnp.asarray(z)


@_minimum.defjvp
def _minimum_jvp(frame, primals, tangents):
    moving, arrays = primals[1:]
    z = _minimum(frame, *primals)
    along = lambda arrays: _gradient(frame, z, arrays)
    pull = jax.jvp(along, (arrays,), (tangents[2],))[1]
    unit, size = _unit(_curvature(frame, z, arrays), moving)
    return z, -moving * (invert_definite(unit)[0] @ (moving * pull / size)) / size


def _unit(curvature: Matrix, moving: Float[Numbers, " parameters"]) -> tuple[Matrix, Vector]:
    """A Hessian with ones on its diagonal, and its scale; without the parameters at a bound."""
    diagonal = jnp.abs(jnp.diagonal(curvature))
    size = jnp.sqrt(jnp.where((moving > 0) & (diagonal > 0), diagonal, 1.0))
    both = curvature * moving[:, None] * moving[None] / size[:, None] / size[None]
    return both + jnp.diag(1.0 - moving), size


def _gradient(frame: Frame, z: Vector, arrays: list[Numbers]) -> Vector:
    return jax.grad(lambda z: 0.5 * jnp.sum(residuals(z, frame.filled(arrays)) ** 2))(z)


_curvature = jax.jacfwd(_gradient, 1)
