import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int, PyTree

from jaxquad._core import (
    CONVERGED,
    decrement,
    minimise,
    Normal,
    require_x64,
    STALLED,
    TOLERANCE,
)
from jaxquad._xla import evaluate_once
from jaxquad.models import evaluate_response, with_arrays
from jaxquad.spectra import FrequencyResponse

from ._assess import assess, Counted, discrepancy_at
from ._cost import (
    Cost,
    least_coherence,
    MaximumLikelihood,
    Points,
    points_of,
    Range,
    usable,
)
from ._fit import check_options
from ._held import held, hold_of
from ._parameters import Free, Numbers, Parameters, Place, select_parameters, Tie
from ._problem import make_problem
from ._result import Fit
from ._solve import solution_at, stopped_early


_CHUNK = 64  # fits side by side: their Jacobians stay in the cache
_AT_ONCE = 128  # fits of one call


class BatchSolution(NamedTuple):
    """Where the fit of every response of a batch stopped."""

    z: Float[Numbers, "batch parameters"]
    values: Float[Numbers, "batch parameters"]  # physical
    cost: Float[Numbers, " batch"]  # sum of squares
    decrement: Float[Numbers, " batch"]  # what one more step would save of half the cost
    steps: Int[Numbers, " batch"]
    converged: Bool[Numbers, " batch"]  # stopped, and with nothing left to save


def solve_batch(
    model: PyTree,
    parameters: Parameters,
    omega: Float[Numbers, " frequencies"],
    measured: Complex[Numbers, "batch frequencies outputs inputs"],
    weights: Float[Numbers, "..."],
    *,
    hold: float = 0.0,
    max_steps: int = 64,
    tolerance: float = TOLERANCE,
) -> BatchSolution:
    """Fit every response of the batch from the same start, by Levenberg-Marquardt.

    `weights` (batch, frequencies, outputs, inputs, 2) are those of `ln|T/T^|` and of the wrapped
    phase of `T/T^` in rad, as of `jq.fit`, 0 where a point does not count. The model is evaluated
    one frequency at a time, with inputs held for `hold` s (0: not held). A member that did not
    reach a stationary point has `converged` false, and its decrement says how far it is; one in a
    local minimum shows by its cost alone.
    Raises ValueError for shapes that do not match, no batch at all, or a response that at one
    frequency depends on which others are asked for.
    """
    if measured.shape[0] == 0 or (*measured.shape, 2) != weights.shape:
        raise ValueError(
            f"measured has shape {measured.shape} and weights {weights.shape}: give at least one "
            "response (batch, frequencies, outputs, inputs), and weights with a last axis of two"
        )
    _check_pointwise(model, omega, measured.shape[1:])
    data = (np.asarray(omega), np.asarray(measured), np.asarray(weights))
    return _solve_portions(model, parameters, *data, hold, max_steps, tolerance)


def _check_pointwise(model: PyTree, omega: Float[Numbers, " f"], shape: tuple[int, ...]) -> None:
    whole, single = (np.asarray(part) for part in _both_ways(model, omega))
    if whole.shape != shape:
        raise ValueError(
            f"the model's response has shape {whole.shape}, the measured ones {shape} (frequencies,"
            " outputs, inputs): pick channels with jq.records.select, or extend the model"
        )
    if not np.allclose(whole, single, rtol=1e-9, atol=1e-12 * np.max(np.abs(whole))):
        raise ValueError(
            "the model's response at one frequency depends on the other frequencies that are asked "
            "for: a batch evaluates it frequency by frequency; fit the responses with jq.fit"
        )


@eqx.filter_jit
def _both_ways(model, omega):
    single = jax.vmap(lambda w: evaluate_response(model, w[None])[0])(omega)
    return evaluate_response(model, omega), single


def _portions(batch: int) -> list[Int[np.ndarray, "chunks chunk"]]:
    """The members of each call, by chunks; the last are filled up with the last member.

    Calls have few sizes, so that a batch of another length compiles nothing.
    """
    size = min(_AT_ONCE, 1 << (batch - 1).bit_length())
    places = np.minimum(np.arange(batch + -batch % size), batch - 1)
    return list(places.reshape(-1, -(-size // _CHUNK), min(size, _CHUNK)))


def _solve_portions(
    model, parameters, omega, measured, weights, hold, max_steps, tolerance
) -> BatchSolution:
    batch, used = len(measured), np.any(weights > 0, axis=-1)
    # Points that do not count may hold anything, NaN included.
    with np.errstate(invalid="ignore"):
        inverse = np.where(used, 1 / np.where(used, measured, 1.0), 1.0)

    def solve(members):
        data = tuple(np.moveaxis(array[members], 1, -1) for array in (inverse, weights))
        found = _solve_portion(model, parameters, omega, data, hold, max_steps, tolerance)
        return jax.tree.map(np.asarray, found)

    first, *others = _portions(batch)
    found = [solve(first)]  # it compiles; a program runs on one core
    if others:
        with ThreadPoolExecutor(max_workers=min(len(others), os.cpu_count() or 1)) as pool:
            found += pool.map(solve, others)
    return BatchSolution(*(np.concatenate(each)[:batch] for each in zip(*found, strict=True)))


@eqx.filter_jit
def _solve_portion(model, parameters, omega, data, hold, max_steps, tolerance) -> BatchSolution:
    count, size = parameters.count, data[0].shape[-1]
    z0 = jnp.broadcast_to(parameters.start[:count, None], (count, size))

    def chunk(data):
        evaluate = lambda z: _normal(model, parameters, z, hold, omega, *data)
        state = minimise(evaluate, z0, max_steps, tolerance)
        normal = evaluate(state.z)
        left = decrement(normal)
        level = left <= 1e-6 * normal.cost + 1e-12
        converged = (state.status == CONVERGED) & level
        return state.z, 2 * normal.cost, left, state.steps, converged

    stacked = jax.lax.map(chunk, data)
    z, *facts = (jnp.moveaxis(part, -1, 1).reshape(-1, *part.shape[1:-1]) for part in stacked)
    return BatchSolution(z, jax.vmap(parameters.values)(z), *facts)


def _normal(model, parameters, z, hold, omega, inverse, weights) -> Normal:
    """Normal equations of all members, frequencies outside and members inside."""

    def point(z, omega, inverse, weights):
        return _point(model, parameters, z, hold, omega, inverse, weights)

    members = jax.vmap(point, in_axes=(0, None, -1, -1))
    everywhere = evaluate_once(jax.vmap(members, in_axes=(None, 0, 0, 0)))
    columns = everywhere(list(z), omega, inverse, weights)
    stacked = jnp.stack([jnp.moveaxis(column, 1, -1) for column in columns])
    return _products(stacked.reshape(len(columns), -1, z.shape[1]))


def _point(model, parameters, z, hold, omega, inverse, weights) -> list[Float[Array, "..."]]:
    """Weighted slopes by each parameter, and then the weighted misfit, at one frequency."""

    def response(z):
        return evaluate_response(held(_insert(model, parameters, z), hold), omega[None])[0]

    here = response(z)
    columns = []
    for k in range(len(z)):
        # One parameter at a time: what does not depend on it costs nothing.
        along = lambda x, k=k: response([*z[:k], x, *z[k + 1 :]])
        slope = jax.jvp(along, (z[k],), (jnp.ones_like(z[k]),))[1] / here
        columns.append(jnp.stack([jnp.real(slope), jnp.imag(slope)], axis=-1) * weights)
    ratio = here * inverse
    size = jnp.real(ratio) ** 2 + jnp.imag(ratio) ** 2
    phase = jnp.arctan2(jnp.imag(ratio), jnp.real(ratio))
    return [*columns, jnp.stack([0.5 * jnp.log(size), phase], axis=-1) * weights]


def _insert(model: PyTree, parameters: Parameters, z: list[Float[Array, ""]]) -> PyTree:
    """As `Parameters.insert`, but without a vector that would make each depend on all."""
    logs, scale = parameters.logarithmic, parameters.scale
    values = [scale[k] * (jnp.exp(x) if logs[k] else x) for k, x in enumerate(z)]
    model = _write(model, parameters.places, values)
    for place, tie in parameters.ties:
        model = _write(model, (place,), [jnp.asarray(tie(model))])
    return model


def _write(model: PyTree, places: tuple[Place, ...], values: list[Float[Array, ""]]) -> PyTree:
    arrays, rest = eqx.partition(model, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
    for leaf in {place.leaf for place, _ in zip(places, values, strict=False)}:
        flat = list(leaves[leaf].reshape(-1))
        for place, value in zip(places, values, strict=False):
            if place.leaf == leaf:
                flat[place.index] = value
        shape = leaves[leaf].shape
        leaves[leaf] = flat[0] if shape == () else jnp.stack(flat).reshape(shape)
    return eqx.combine(jax.tree.unflatten(structure, leaves), rest)


def _products(columns: Float[Array, "columns points batch"]) -> Normal:
    """All scalar products of the columns in one pass over the points."""
    n = columns.shape[0] - 1
    first, second = np.tril_indices(n + 1)

    def add(k, total):
        point = columns[:, k]
        return total + point[first] * point[second]

    start = jnp.zeros((first.size, columns.shape[-1]), columns.dtype)
    sums = jax.lax.fori_loop(0, columns.shape[1], add, start)
    place = np.zeros((n + 1, n + 1), int)
    place[first, second] = place[second, first] = np.arange(first.size)
    matrix = sums[place]
    return Normal(0.5 * matrix[n, n], matrix[n, :n], matrix[:n, :n])


class BatchFit(eqx.Module):
    """Fits of one model to many responses; `fit(k)` is the whole result for response k."""

    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[np.ndarray, "batch parameters"]
    costs: Float[np.ndarray, " batch"]
    decrements: Float[np.ndarray, " batch"]  # what one more step would save of half the cost
    steps: Int[np.ndarray, " batch"]
    converged: Bool[np.ndarray, " batch"]
    model: PyTree
    parameters: Parameters
    points: tuple[Points, ...]
    weights: Float[np.ndarray, "batch frequencies outputs inputs 2"]
    z: Float[np.ndarray, "batch parameters"]

    def fit(self, k: int) -> Fit:
        """The fit of response k, with standard errors, verdict and remarks.

        Its standard errors count what the model leaves unexplained. Its values are those of the
        batch, where that is no floor on the random error as it is in `jq.fit`: it would take each
        response through a solution of its own.
        """
        points, steps = self.points[k], int(self.steps[k])
        problem = make_problem(self.model, self.parameters, [points.frf])
        problem = problem.weighted([self.weights[k]])
        message = "" if self.converged[k] else stopped_early(STALLED, steps)
        solution = solution_at(problem, self.z[k], message, steps)
        found = discrepancy_at(problem, [points], solution)
        return assess(problem, Counted([points], None, None, found), solution)

    def __str__(self) -> str:
        lost = int(np.sum(~self.converged))
        lines = [f"{len(self.values)} fits; {lost} of them reached no minimum"]
        good = self.values[self.converged]
        if len(good):
            low, middle, high = np.percentile(good, [5, 50, 95], axis=0)
            for row in zip(self.names, middle, low, high, strict=True):
                lines.append("{:<16} median {:11.5g}, 5 to 95 %: {:.5g} .. {:.5g}".format(*row))
        return "\n".join(lines)


class _Data(NamedTuple):
    """The responses on common arrays."""

    omega: Float[np.ndarray, " frequencies"]
    measured: np.ndarray
    points: list[Points]
    hold: float  # s


def fit_batch(
    model: PyTree,
    frfs: Sequence[FrequencyResponse],
    *,
    free: Free = None,
    tied: dict[str, Tie] | None = None,
    cost: Cost = MaximumLikelihood(),
    band: Range | None = None,
    min_coherence: float | None = None,
    max_steps: int = 64,
) -> BatchFit:
    """Fit one model to each of many responses on the same frequencies, in one compiled call.

    For fleets, Monte Carlo studies and sliding windows. All fits start from the model's values.

    **Arguments:**

    - `model`, `free`, `tied`, `cost`, `min_coherence`, `max_steps`: as in `jq.fit`.
    - `frfs`: responses on the same frequencies, with the same channels.
    - `band`: (low, high) in rad/s.

    **Returns:**

    `jq.identify.BatchFit`.

    **Raises:**

    - `ValueError`: responses on different frequencies or channels, or without a usable frequency.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits.
    """
    require_x64("a fit")
    frfs = list(frfs)
    if not frfs or not all(isinstance(frf, FrequencyResponse) for frf in frfs):
        raise ValueError(
            "fit_batch needs a list of jq.spectra.FrequencyResponse: fit_batch(model, frfs)"
        )
    check_options(cost, band, min_coherence, max_steps)
    model = with_arrays(model)
    parameters = select_parameters(model, free, tied)
    least = least_coherence(min_coherence, cost, frfs[0])
    data = _stack_responses(frfs, band, least)
    ones = [np.ones(each.used.shape) for each in data.points]
    weights = _weights(cost, data, ones)
    found = _solve(model, parameters, data, weights, max_steps)
    again = _weights(cost, data, _ratios(model, parameters, data, found))
    if not np.allclose(weights, again, rtol=1e-4):
        weights, found = again, _solve(model, parameters, data, again, max_steps)
    facts = (found.values, found.cost, found.decrement, found.steps, found.converged)
    return BatchFit(
        parameters.names, *(np.asarray(part) for part in facts),
        model=model, parameters=parameters, points=tuple(data.points), weights=weights,
        z=np.asarray(found.z),
    )  # fmt: skip


def _stack_responses(frfs: Sequence[FrequencyResponse], band: Range | None, least: float) -> _Data:
    omega, shape = np.asarray(frfs[0].omega), frfs[0].response.shape
    for k, frf in enumerate(frfs):
        if frf.response.shape != shape or not np.allclose(np.asarray(frf.omega), omega):
            raise ValueError(
                f"response {k} has shape {frf.response.shape} or other frequencies than the first "
                f"({shape}): estimate all at one omega, or fit them one by one with jq.fit"
            )
    used = [usable(frf, band, least) for frf in frfs]
    poor = [k for k, mask in enumerate(used) if not np.any(mask)]
    if poor:
        raise ValueError(
            f"{len(poor)} of {len(frfs)} responses have no usable frequency, the first is number "
            f"{poor[0]}: leave them out, or lower min_coherence"
        )
    measured = [np.asarray(frf.response) for frf in frfs]
    kept = [np.where(mask, each, 1.0) for mask, each in zip(used, measured, strict=True)]
    return _Data(omega, np.stack(kept), points_of(frfs, used), _shared_hold(frfs))


def _shared_hold(frfs: Sequence[FrequencyResponse]) -> float:
    holds = sorted({hold_of(frf) for frf in frfs})
    if len(holds) > 1:
        raise ValueError(
            f"the inputs of the responses are held for {holds} s: fit those of one hold together"
        )
    return holds[0]


def _weights(cost: Cost, data: _Data, ratios) -> np.ndarray:
    rows = zip(data.points, ratios, strict=True)
    return np.stack([cost.weights(*row) for row in rows])


def _solve(
    model: PyTree, parameters: Parameters, data: _Data, weights: np.ndarray, max_steps: int
) -> BatchSolution:
    arrays = (data.omega, data.measured, weights)
    return solve_batch(model, parameters, *arrays, hold=data.hold, max_steps=max_steps)


@eqx.filter_jit
def _responses(model, parameters, z, hold, omega):
    one = lambda each: evaluate_response(held(parameters.insert(model, each), hold), omega)
    return eqx.filter_vmap(one)(z)


def _ratios(
    model: PyTree, parameters: Parameters, data: _Data, found: BatchSolution
) -> Float[np.ndarray, "batch frequencies outputs inputs"]:
    """|model / measurement| of every member; 1 where a fit ran away."""
    parts = [
        _responses(model, parameters, found.z[members.reshape(-1)], data.hold, data.omega)
        for members in _portions(len(found.z))
    ]
    responses = np.concatenate(parts)[: len(found.z)]
    ratios = np.abs(responses / data.measured)
    return np.where(np.isfinite(ratios) & (ratios > 0), ratios, 1.0)
