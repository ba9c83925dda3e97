"""Normal equations of many fits side by side: members on the last axis, one frequency at a time."""

import functools as ft
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxquad._core import Normal
from jaxquad._xla import (
    as_one_kernel,
    evaluate_once,
    in_real_parts,
    NotInRealPartsError,
    why_no_kernels,
)
from jaxquad.models import evaluate_response, StateSpace

from ..frequency_domain._condition import UNCHANGED
from ..frequency_domain._held import held
from ..frequency_domain._mixing import Mixing
from ..frequency_domain._normal import problem_normal
from ..frequency_domain._parameters import Numbers, Parameters, Place
from ..frequency_domain._problem import Problem


class Member(NamedTuple):
    """What members are fitted to, after the axes of each array that are named here.

    Frequencies are filled up to a length that many records share; only `count` of them count.
    """

    inverse: tuple[Numbers, Numbers]  # frequencies outputs inputs: 1 / measured, real, imaginary
    weights: Numbers  # frequencies outputs inputs parts: one of both for single evaluation
    factor: tuple[Numbers, Numbers] | None  # frequencies frequencies outputs inputs, a `Mixing`'s
    across: tuple[Numbers, Numbers] | None = None  # frequencies pairs pairs, of several pairs


class Batch(NamedTuple):
    """One structure and where it is evaluated."""

    model: PyTree
    parameters: Parameters
    hold: float  # s
    omega: Float[Numbers, " frequencies"]
    count: Int[Numbers, ""]  # of the frequencies


Column = tuple[Array, Array]  # of slopes or misfits: magnitudes and phases, weighted
Active = Bool[Array, " members"]
Evaluate = Callable[[Float[Array, "parameters members"], Active], Normal]


def normal_equations_of(batch: Batch, member: Member) -> Evaluate:
    """Cost, gradient and Gauss-Newton Hessian of members on the last axis of `member`.

    A plain `jq.StateSpace` has slopes of its own, one member after the other, without those that
    are not active. Any other model of plain arithmetic becomes one kernel, at a quarter of the cost
    of what evaluates the rest: at all frequencies at once.
    """

    if evaluates_singly(batch):
        return _one_by_one(batch, member)

    def evaluate(z: Float[Array, "parameters members"], active: Active) -> Normal:
        if why_no_kernels() is None and _fits_a_kernel(z, member):
            accumulate = ft.partial(_accumulate, batch)
            try:
                return _assemble(as_one_kernel(accumulate, z, batch.omega, batch.count, member))
            except NotInRealPartsError:
                pass
        return _at_all_frequencies(batch, z, member)

    return evaluate


def evaluates_singly(batch: Batch) -> bool:
    """Whether members are evaluated one after the other, by a plain `jq.StateSpace`'s slopes."""
    return type(batch.model) is StateSpace and not batch.parameters.ties and not batch.hold


def _one_by_one(batch: Batch, member: Member) -> Evaluate:
    members = _lay_out(member)

    def one(given):
        active, z, mine = given
        normal = lambda z, mine: problem_normal(z, _problem_of_one(batch, mine))
        shapes = jax.eval_shape(normal, z, mine)
        skip = lambda *_: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return jax.lax.cond(active, normal, skip, z, mine)

    def evaluate(z: Float[Array, "parameters members"], active: Active) -> Normal:
        found = jax.lax.map(one, (active, z.T, members))
        return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), found)

    return evaluate


class _Single(NamedTuple):
    """What one member is fitted to, in the order in which normal equations take it."""

    measured: tuple[Array, Array]  # outputs inputs frequencies: real, imaginary
    weights: Array  # parts outputs inputs frequencies
    factor: tuple[Array, Array] | None  # outputs inputs frequencies frequencies
    across: tuple[Array, Array] | None  # frequencies pairs pairs


def _lay_out(member: Member) -> _Single:
    """With the members first: transposed once, not at each evaluation."""
    measured = jnp.moveaxis(1 / jax.lax.complex(*member.inverse), (3, 0), (0, 3))
    weights = jnp.moveaxis(member.weights, (4, 3, 0), (0, 1, 4))
    factor = across = None
    if member.factor is not None:
        real, imag = (jnp.moveaxis(x, (4, 0, 1), (0, 3, 4)) for x in member.factor)
        factor = real, imag
    if member.across is not None:
        real, imag = (jnp.moveaxis(x, -1, 0) for x in member.across)
        across = real, imag
    return _Single((jnp.real(measured), jnp.imag(measured)), weights, factor, across)


def _problem_of_one(batch: Batch, member: _Single) -> Problem:
    mixing = None
    if member.factor is not None:
        factor = jax.lax.complex(*member.factor)
        across = None if member.across is None else jax.lax.complex(*member.across)
        # Traced, in the place of NumPy's arrays; correlations matter to nothing here.
        mixing = Mixing(factor, factor, across, across)  # pyright: ignore[reportArgumentType]
    return Problem(
        model=batch.model,
        parameters=batch.parameters,
        conditions=(UNCHANGED,),
        quantities=(),
        omega=(batch.omega,),
        measured=(jnp.moveaxis(jax.lax.complex(*member.measured), -1, 0),),
        weights=(jnp.moveaxis(member.weights, (3, 0), (0, 3)),),
        known=np.zeros((0, 2)),
        aliases=(None,),
        silent=((),),
        mixings=(mixing,),
    )


_WIDEST = 4096  # numbers of one array's arithmetic in a kernel
_MOST_PARAMETERS = 12  # of a kernel; it grows with their square


def _fits_a_kernel(z: Array, member: Member) -> bool:
    wide = member.weights[0].size // 2
    if member.factor is not None:
        wide *= len(z) + 1
    if member.across is not None:
        wide *= member.across[0].shape[1]
    return wide < _WIDEST and len(z) <= _MOST_PARAMETERS


def _lower(columns: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(columns) for j in range(i + 1)]


def _accumulate(
    batch: Batch, z: Array, omega: Array, count: Int[Array, ""], member: Member
) -> list[Float[Array, " members"]]:
    """The scalar products of all columns, frequency by frequency."""
    columns_at = ft.partial(_columns_at, batch, z, omega, member)
    if member.factor is not None:
        columns_at = _mix(columns_at, omega, count, member, len(z) + 1)
    pairs = _lower(len(z) + 1)

    def add(k, total):
        columns = columns_at(k)
        return [t + _dot(columns[i], columns[j]) for t, (i, j) in zip(total, pairs, strict=True)]

    return jax.lax.fori_loop(0, count, add, [jnp.zeros_like(z[0]) for _ in pairs])


def _dot(a: Column, b: Column) -> Float[Array, " members"]:
    return jnp.sum(a[0] * b[0] + a[1] * b[1], axis=(0, 1))


def _columns_at(batch: Batch, z: Array, omega: Array, member: Member, k: Array) -> list[Column]:
    point = jax.vmap(ft.partial(_point, batch), in_axes=(0, None, -1, -1, -1), out_axes=-1)
    here = lambda array: jax.lax.dynamic_index_in_dim(array, k, keepdims=False)
    data = *map(here, member.inverse), here(member.weights)
    return in_real_parts(point, list(z), here(omega), *data)


def _mix(
    columns_at: Callable[[Array], list[Column]],
    omega: Array,
    count: Int[Array, ""],
    member: Member,
    columns: int,
) -> Callable[[Array], list[Column]]:
    """The same columns with points that share noise taken together, by triangular factors."""
    factor, across = member.factor, member.across
    assert factor is not None
    shape = (omega.size, columns, *factor[0].shape[2:])
    zero = jnp.zeros(shape, omega.dtype), jnp.zeros(shape, omega.dtype)

    def store(k, stored):
        parts = map(jnp.stack, zip(*columns_at(k), strict=True))
        pairs = zip(stored, parts, strict=True)
        return tuple(jax.lax.dynamic_update_index_in_dim(s, part, k, 0) for s, part in pairs)

    stored = jax.lax.fori_loop(0, count, store, zero)

    def mixed_at(k):
        def add(g, total):
            c, s = (_two_indices(part, k, g) for part in factor)
            real, imag = (jax.lax.dynamic_index_in_dim(x, g, keepdims=False) for x in stored)
            return total[0] + (c * real - s * imag), total[1] + (s * real + c * imag)

        zero = jnp.zeros(shape[1:], omega.dtype), jnp.zeros(shape[1:], omega.dtype)
        real, imag = jax.lax.fori_loop(0, k + 1, add, zero)
        if across is not None:
            here = [jax.lax.dynamic_index_in_dim(x, k, keepdims=False) for x in across]
            real, imag = _turn_pairs(here[0], here[1], real, imag)
        return [(real[n], imag[n]) for n in range(columns)]

    return mixed_at


def _turn_pairs(
    c: Float[Array, "pairs pairs members"],
    s: Float[Array, "pairs pairs members"],
    real: Float[Array, "columns outputs inputs members"],
    imag: Float[Array, "columns outputs inputs members"],
) -> tuple[Array, Array]:
    """Products of matrices and vectors, members last."""
    shape, flat = real.shape, (real.shape[0], 1, -1, real.shape[-1])
    a, b, c, s = real.reshape(flat), imag.reshape(flat), c[None], s[None]
    turned = jnp.sum(c * a - s * b, axis=2), jnp.sum(s * a + c * b, axis=2)
    return turned[0].reshape(shape), turned[1].reshape(shape)


def _two_indices(array: Numbers, k: Array, g: Array) -> Array:
    first, rest = (1, 1), array.shape[2:]
    start = (k, g, *(jnp.zeros_like(k) for _ in rest))
    return jax.lax.dynamic_slice(array, start, (*first, *rest))[0]


def _at_all_frequencies(batch: Batch, z: Array, member: Member) -> Normal:
    """Frequencies outside and members inside."""
    members = jax.vmap(ft.partial(_point, batch), in_axes=(0, None, -1, -1, -1), out_axes=-1)
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
    return _assemble(_products(jnp.concatenate(points, axis=1)))


def _products(columns: Float[Array, "columns points members"]) -> Float[Array, "pairs members"]:
    """All scalar products of the columns in one pass over the points."""
    first, second = np.array(_lower(len(columns))).T

    def add(k, total):
        point = columns[:, k]
        return total + point[first] * point[second]

    start = jnp.zeros((first.size, columns.shape[-1]), columns.dtype)
    return jax.lax.fori_loop(0, columns.shape[1], add, start)


def _assemble(products: Sequence[Array] | Array) -> Normal:
    n = (math.isqrt(8 * len(products) + 1) - 1) // 2 - 1  # pairs of n + 1 columns
    place = np.zeros((n + 1, n + 1), int)
    for k, (i, j) in enumerate(_lower(n + 1)):
        place[i, j] = place[j, i] = k
    matrix = jnp.stack([products[k] for k in place.reshape(-1)])
    matrix = matrix.reshape(n + 1, n + 1, -1)
    return Normal(0.5 * matrix[n, n], matrix[n, :n], matrix[:n, :n])


def _point(
    batch: Batch, z: list[Array], omega: Array, real: Array, imag: Array, weights: Array
) -> list[Column]:
    """Weighted slopes by each parameter, and then the weighted misfit, at one frequency."""

    def response(z):
        model = held(_insert(batch.model, batch.parameters, z), batch.hold)
        return evaluate_response(model, omega[None])[0]

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
