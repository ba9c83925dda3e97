"""Fits of one model to many responses, in one compiled call."""

import functools as ft
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxquad._compile import evaluate_once, Jit
from jaxquad._core import (
    advance,
    available_cores,
    begin,
    CONVERGED,
    decrement,
    default_device,
    free_memory,
    Message,
    Normal,
    require_x64,
    RUNNING,
    settle,
    TOLERANCE,
)
from jaxquad.models import evaluate_response, StateSpace, with_arrays
from jaxquad.spectra import FrequencyResponse

from ._batch_result import BatchFit
from .frequency_domain._cost import (
    Cost,
    least_coherence,
    MaximumLikelihood,
    Mixing,
    mixing_of,
    points_of,
    Range,
    usable,
)
from .frequency_domain._feedthrough import free_delays
from .frequency_domain._parameters import (
    Free,
    Numbers,
    Parameters,
    Place,
    select_parameters,
    Tie,
    UNCHANGED,
)
from .frequency_domain._problem import make_problem, Problem, problem_normal
from .frequency_domain._refits import check_options
from .frequency_domain._sampled import behind_hold, count_aliases, direct_part, hold_before


class Member(NamedTuple):
    """What members are fitted to, after the axes of each array that are named here. Frequencies are
    filled up to a length that many records share, with weights of 0."""

    inverse: tuple[Numbers, Numbers]  # frequencies outputs inputs: 1 / measured, real, imaginary
    weights: Numbers  # frequencies outputs inputs parts
    factor: tuple[Numbers, Numbers] | None  # frequencies frequencies outputs inputs, a `Mixing`'s
    across: tuple[Numbers, Numbers] | None = None  # frequencies pairs pairs, of several pairs


class Batch(NamedTuple):
    """One structure and where it is evaluated."""

    model: PyTree
    parameters: Parameters
    hold: float  # s
    aliases: int  # of the hold, to either side
    omega: Float[Numbers, " frequencies"]

    @property
    def evaluates_singly(self) -> bool:
        """Whether members are evaluated one by one: a `jq.StateSpace`, whose states are a loop of
        their own. Other models become one kernel, at a quarter of the cost. An accelerator
        evaluates all side by side."""
        if default_device().platform != "cpu":
            return False
        return type(self.model) is StateSpace and not self.parameters.ties and not self.hold


Active = Bool[Array, " members"]
Places = Float[Array, "parameters members"]
Evaluate = Callable[[Places, Active], Normal]  # cost, gradient and Gauss-Newton Hessian


def _one_by_one(batch: Batch, member: Member) -> Evaluate:
    """One member after the other, without those that are not active."""
    members = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), member)

    def normal(z: Array, member: Member) -> Normal:
        mixing = None
        if member.factor is not None:
            factor = jnp.moveaxis(jax.lax.complex(*member.factor), (0, 1), (2, 3))
            across = None if member.across is None else jax.lax.complex(*member.across)
            # Traced, in the place of NumPy's arrays; correlations matter to nothing here.
            mixing = Mixing(factor, factor, across, across)  # pyright: ignore[reportArgumentType]
        problem = Problem(
            model=batch.model,
            parameters=batch.parameters,
            conditions=(UNCHANGED,),
            quantities=(),
            omega=(batch.omega,),
            measured=(1 / jax.lax.complex(*member.inverse),),
            weights=(member.weights,),
            prior=np.zeros((0, 2)),
            aliases=(None,),
            silent=((),),
            mixings=(mixing,),
        )
        return problem_normal(z, problem)

    def one(parts):
        active, z, member = parts
        shapes = jax.eval_shape(normal, z, member)
        skip = lambda *_: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return jax.lax.cond(active, normal, skip, z, member)

    def evaluate(z: Places, active: Active) -> Normal:
        normals = jax.lax.map(one, (active, z.T, members))
        return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), normals)

    return evaluate


def _at_all_frequencies(batch: Batch, z: Array, member: Member) -> Normal:
    """Frequencies outside and members inside."""
    members = jax.vmap(ft.partial(_columns, batch), in_axes=(0, None, -1, -1, -1), out_axes=-1)
    everywhere = evaluate_once(jax.vmap(members, in_axes=(None, 0, 0, 0, 0)))
    columns = everywhere(list(z), batch.omega, *member.inverse, member.weights)
    real, imag = map(jnp.stack, zip(*columns, strict=True))
    if member.factor is not None:
        factor = jax.lax.complex(*member.factor)
        mixed = jnp.einsum("fgoib,cgoib->cfoib", factor, jax.lax.complex(real, imag))
        if member.across is not None:
            flat = mixed.reshape(*mixed.shape[:2], -1, mixed.shape[-1])
            turned = jnp.einsum("fpqb,cfqb->cfpb", jax.lax.complex(*member.across), flat)
            mixed = turned.reshape(mixed.shape)
        real, imag = jnp.real(mixed), jnp.imag(mixed)
    points = [part.reshape(len(columns), -1, z.shape[1]) for part in (real, imag)]
    points = jnp.concatenate(points, axis=1)
    # All scalar products of the columns in one pass over the points.
    first, second = np.tril_indices(len(points))

    def add(k, total):
        point = points[:, k]
        return total + point[first] * point[second]

    start = jnp.zeros((first.size, points.shape[-1]), points.dtype)
    products = jax.lax.fori_loop(0, points.shape[1], add, start)
    n, place = len(points) - 1, np.zeros((len(points), len(points)), int)
    place[first, second] = place[second, first] = np.arange(first.size)
    matrix = jnp.stack([products[k] for k in place.reshape(-1)]).reshape(n + 1, n + 1, -1)
    return Normal(0.5 * matrix[n, n], matrix[n, :n], matrix[:n, :n])


def _columns(
    batch: Batch, z: list[Array], omega: Array, real: Array, imag: Array, weights: Array
) -> list[tuple[Array, Array]]:
    """Weighted slopes by each parameter, and then the weighted misfit, at one frequency. Each in
    magnitude and in phase."""

    def response(z):
        # As `Parameters.insert`, but without a vector that would make each depend on all.
        logs, scale = batch.parameters.logarithmic, batch.parameters.scale
        values = [scale[k] * (jnp.exp(x) if logs[k] else x) for k, x in enumerate(z)]
        model = _write(batch.model, batch.parameters.places, values)
        for place, tie in batch.parameters.ties:
            model = _write(model, (place,), [jnp.asarray(tie(model))])
        return evaluate_response(behind_hold(model, batch.hold, batch.aliases), omega[None])[0]

    here, columns = response(z), []
    for k in range(len(z)):
        # One parameter at a time: what does not depend on it costs nothing.
        along = lambda x, k=k: response([*z[:k], x, *z[k + 1 :]])
        slope = jax.jvp(along, (z[k],), (jnp.ones_like(z[k]),))[1] / here
        columns.append((jnp.real(slope) * weights[..., 0], jnp.imag(slope) * weights[..., 1]))
    ratio = here * jax.lax.complex(real, imag)
    size = jnp.real(ratio) ** 2 + jnp.imag(ratio) ** 2
    phase = jnp.arctan2(jnp.imag(ratio), jnp.real(ratio))
    return [*columns, (0.5 * jnp.log(size) * weights[..., 0], phase * weights[..., 1])]


def _write(model: PyTree, places: tuple[Place, ...], values: list[Array]) -> PyTree:
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


_CHUNK = 32  # fits side by side on a core
_CHUNK_OF_SINGLES = 8  # fits of which each is evaluated by itself
_CHUNKS = 8  # of one call
_MOST = 2**17  # fits side by side on an accelerator
_SHARE = 0.1  # of its free memory, for what is computed at all frequencies


class BatchSolution(NamedTuple):
    """Where the fit of every response of a batch stopped."""

    z: Float[Numbers, "batch parameters"]
    values: Float[Numbers, "batch parameters"]  # physical
    cost: Float[Numbers, " batch"]  # sum of squares
    decrement: Float[Numbers, " batch"]  # what one more step would save of half the cost
    steps: Int[Numbers, " batch"]
    converged: Bool[Numbers, " batch"]  # stopped, and with nothing left to save


def _members(measured: np.ndarray, weights: np.ndarray, mixings: Sequence[Mixing | None]) -> Member:
    """What the members are fitted to, which are on the first axis. `mixings`, one for each member
    or none at all, take points together that share noise."""
    if (*measured.shape, 2) != weights.shape:
        raise ValueError(
            f"measured has shape {measured.shape} and weights {weights.shape}: give at least one "
            "response (batch, frequencies, outputs, inputs), and weights with a last axis of two"
        )
    used = np.any(weights > 0, axis=-1)
    # Points that do not count may hold anything, NaN included.
    with np.errstate(invalid="ignore"):
        inverse = _pad(np.where(used, 1 / np.where(used, measured, 1.0), 1.0), 1)
    weights = _pad(weights, 1)
    weights[:, measured.shape[1] :] = 0
    parts = np.real(inverse), np.imag(inverse)
    if all(mixing is None for mixing in mixings):
        return Member(parts, weights, None)
    (batch, count, outputs, inputs), length = measured.shape, inverse.shape[1]
    # The identity for members whose points, and pairs at a frequency, share no noise.
    factors = np.zeros((batch, length, length, outputs, inputs), complex)
    pairs = outputs * inputs
    across = np.zeros((batch, length, pairs, pairs), complex)
    across[:] = np.eye(pairs)
    for factor, row, mixing in zip(factors, across, mixings, strict=True):
        factor[:count, :count] = np.eye(count)[:, :, None, None]
        if mixing is not None:
            factor[:count, :count] = np.moveaxis(mixing.factor, (0, 1), (2, 3))
            if mixing.across is not None:
                row[:count] = mixing.across
    split = lambda x: (np.real(x), np.imag(x))
    return Member(parts, weights, split(factors), split(across) if pairs > 1 else None)


def _pad(array: np.ndarray, axis: int = 0) -> np.ndarray:
    """Filled up with the last frequency: few lengths, few programs. The array where it is full."""
    size = array.shape[axis]
    step = max(8, 1 << max((size - 1).bit_length() - 3, 0))
    if not size % step:
        return array
    return np.take(array, np.minimum(np.arange(size + -size % step), size - 1), axis)


@eqx.filter_jit
def _both_ways(model, omega):
    single = jax.vmap(lambda w: evaluate_response(model, w[None])[0])(omega)
    return evaluate_response(model, omega), single


def _places(batch: int, chunk: int) -> Int[np.ndarray, "chunks chunk"]:
    """Members by chunks; the last is filled up with the last member."""
    return np.minimum(np.arange(batch + -batch % chunk), batch - 1).reshape(-1, chunk)


def _chunk_sizes(where: Batch, members: Member) -> tuple[int, int]:
    """Fits of a chunk, and chunks of a call: what suits the caches of a core, or as many fits as
    the memory of an accelerator takes, in powers of two, so that few programs are compiled."""
    device, batch = default_device(), len(members.weights)
    if device.platform == "cpu":
        chunk = _CHUNK_OF_SINGLES if where.evaluates_singly else _CHUNK
        return chunk, _CHUNKS if members.factor is None else 1  # factors are large
    bytes_of_one = sum(x.nbytes for x in jax.tree.leaves(members)) / batch
    bytes_of_one += members.weights[0].nbytes * (where.parameters.count + 1)
    most = max(_SHARE * (free_memory(device) or 0.0) / bytes_of_one, _CHUNK)
    return 1 << int(np.log2(min(most, _MOST, 2 * batch - 1))), 1


def _solve(where: Batch, members: Member, start: np.ndarray, max_steps: int) -> BatchSolution:
    """Fit every member from its start, by Levenberg-Marquardt."""
    chunk, chunks = _chunk_sizes(where, members)

    def solve(places: Int[np.ndarray, "chunks chunk"]) -> BatchSolution:
        # Chunks first and members last; all calls have one size: few programs are compiled.
        def arrange(array: np.ndarray) -> np.ndarray:
            mine = np.moveaxis(array[places], 1, -1)
            filled = np.zeros((chunks, *mine.shape[1:]), mine.dtype)
            filled[: len(places)] = mine
            return filled

        mine, z0 = jax.tree.map(arrange, (members, start))
        parts = _solve_call(where, mine, z0, np.asarray(len(places)), np.asarray(max_steps))
        return BatchSolution(*(np.asarray(part)[: places.size] for part in parts))

    places = _places(len(start), chunk)
    count = max(-(-len(places) // chunks), min(len(places), available_cores()))
    calls = np.array_split(places, count)
    if len(calls) > 1:
        solve(calls[0][:0])  # of no chunk: compiled here, once for all threads
    # A program runs on one core, or on all of an accelerator.
    workers = min(len(calls), available_cores()) if default_device().platform == "cpu" else 1
    with ThreadPoolExecutor(max_workers=workers) as pool:
        solutions = list(pool.map(solve, calls))
    parts = zip(*solutions, strict=True)
    return BatchSolution(*(np.concatenate(part)[: len(start)] for part in parts))


@Jit
def _solve_call(where, members, z0, chunks, max_steps) -> BatchSolution:
    """Solve the first `chunks` of the chunks that there is room for."""

    def chunk(k):
        mine, start = jax.tree.map(
            lambda x: jax.lax.dynamic_index_in_dim(x, k, keepdims=False), (members, z0)
        )
        together = lambda z, active: _at_all_frequencies(where, z, mine)
        evaluate = _one_by_one(where, mine) if where.evaluates_singly else together
        return _descend(evaluate, start, max_steps)

    add = lambda k, total: jax.tree.map(lambda out, x: out.at[k].set(x), total, chunk(k))
    shapes = jax.eval_shape(chunk, jnp.zeros((), int))
    room = jax.tree.map(lambda x: jnp.zeros((len(z0), *x.shape), x.dtype), shapes)
    stacked = jax.lax.fori_loop(0, chunks, add, room)
    z, *facts = (jnp.moveaxis(part, -1, 1).reshape(-1, *part.shape[1:-1]) for part in stacked)
    return BatchSolution(z, jax.vmap(where.parameters.values)(z), *facts)


def _descend(evaluate: Evaluate, z0: Array, max_steps: Array) -> tuple:
    """Where members stop, with the cost, what is left to save, steps, and whether they converged.
    As `minimise` does, and with one evaluation at the end, in the same loop: it compiles once."""

    def step(walk):
        state, _, _ = walk
        active = (state.status == RUNNING) & (state.steps < max_steps)
        ended = ~jnp.any(active)
        state = state._replace(change=jnp.where(ended, 0.0, state.change))
        normal = evaluate(state.z + state.change, active | ended)
        return advance(lambda _: normal, state, max_steps, TOLERANCE), normal, ended

    start = begin(z0)
    walk = start, start.normal, jnp.asarray(False)
    state, normal, _ = jax.lax.while_loop(lambda walk: ~walk[2], step, walk)
    left = decrement(normal)
    converged = (settle(state).status == CONVERGED) & (left <= 1e-6 * normal.cost + 1e-12)
    return state.z, 2 * normal.cost, left, state.steps, converged


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
    omega, shape = np.asarray(frfs[0].omega), frfs[0].response.shape
    for k, frf in enumerate(frfs):
        mine = np.asarray(frf.omega)
        equal = np.array_equal(mine, omega)  # faster than the next
        if frf.response.shape != shape or not (equal or np.allclose(mine, omega)):
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
    pairs = zip(used, frfs, strict=True)
    measured = np.stack([np.where(mask, np.asarray(frf.response), 1.0) for mask, frf in pairs])
    holds = sorted({hold_before(model, frf) for frf in frfs})
    if len(holds) > 1:
        raise ValueError(
            f"the inputs of the responses are held for {holds} s: fit those of one hold together"
        )
    passes = holds[0] and eqx.filter_eval_shape(direct_part, model) is not None
    if passes and free_delays(make_problem(model, parameters, frfs[:1])):
        raise ValueError(
            Message(
                f"the input is held for {holds[0]:g} s and passes directly to an output, late by a "
                "free delay that shows only in whole samples: fit the responses one by one with "
                "jq.fit, which tries these, or leave the delay out of «free=»"
            )
        )
    points = [points_of(*pair) for pair in zip(frfs, used, strict=True)]
    weigh = lambda ratios: np.stack([cost.weights(*x) for x in zip(points, ratios, strict=True)])
    weights, mixed = weigh(np.ones(measured.shape)), isinstance(cost, MaximumLikelihood)
    # Without a floor on the errors, they do not depend on the weights.
    mixings = [mixing_of(*x) for x in zip(points, weights, strict=True)] if mixed else ()
    aliases = count_aliases(model, frfs) if holds[0] else 0
    where = Batch(model, parameters, holds[0], aliases, _pad(omega))
    together, single = (np.asarray(part) for part in _both_ways(model, where.omega))
    if together.shape != (*where.omega.shape, *measured.shape[2:]):
        raise ValueError(
            f"the model's response has shape {together.shape[1:]}, the measured ones "
            f"{measured.shape[2:]} (outputs, inputs): pick channels with jq.records.select, or "
            "extend the model"
        )
    if not np.allclose(together, single, rtol=1e-9, atol=1e-12 * np.max(np.abs(together))):
        raise ValueError(
            "the model's response at one frequency depends on the other frequencies that are asked "
            "for: a batch evaluates it frequency by frequency; fit the responses with jq.fit"
        )
    start = parameters.start[: parameters.count]
    start = np.array(np.broadcast_to(start, (len(measured), parameters.count)))
    solution = _solve(where, _members(measured, weights, mixings), start, max_steps)
    again = weigh(_ratios(where, measured, solution))
    if not np.allclose(weights, again, rtol=1e-4):
        weights, start = again, np.where(np.isfinite(solution.z), solution.z, 0.0)
        solution = _solve(where, _members(measured, weights, mixings), start, max_steps)
    return BatchFit(
        parameters.names, *(np.asarray(part) for part in solution[1:]),
        model=model, parameters=parameters, points=tuple(points), weights=weights,
        mixed=mixed, z=np.asarray(solution.z),
    )  # fmt: skip


@eqx.filter_jit
def _sizes(where, z) -> Float[Array, "batch frequencies outputs inputs"]:
    def one(z):
        model = where.parameters.insert(where.model, z)
        sampled = behind_hold(model, where.hold, where.aliases)
        return jnp.abs(evaluate_response(sampled, where.omega))

    return jax.vmap(one)(z)


def _ratios(where: Batch, measured: np.ndarray, solution: BatchSolution) -> np.ndarray:
    """|model / measurement| of every member; 1 where a fit ran away."""
    side_by_side = min(_MOST, 1 << (len(solution.z) - 1).bit_length())
    chunk = 2 * _CHUNK if default_device().platform == "cpu" else side_by_side
    parts = [_sizes(where, solution.z[members]) for members in _places(len(solution.z), chunk)]
    sizes = np.concatenate([np.asarray(part) for part in parts])
    with np.errstate(invalid="ignore"):
        ratios = sizes[: len(measured), : measured.shape[1]] / np.abs(measured)
    return np.where(np.isfinite(ratios) & (ratios > 0), ratios, 1.0)
