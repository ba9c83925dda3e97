"""Normal equations of many fits side by side: members on the last axis."""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxquad._compile import evaluate_once
from jaxquad._core import Normal
from jaxquad.models import evaluate_response, StateSpace

from ..frequency_domain._cost import Mixing
from ..frequency_domain._parameters import Numbers, Parameters, Place, UNCHANGED
from ..frequency_domain._problem import Problem, problem_normal
from ..frequency_domain._sampled import behind_hold


class Member(NamedTuple):
    """What members are fitted to, after the axes of each array that are named here.

    Frequencies are filled up to a length that many records share, with weights of 0.
    """

    inverse: tuple[Numbers, Numbers]  # frequencies outputs inputs: 1 / measured, real, imaginary
    weights: Numbers  # frequencies outputs inputs parts
    factor: tuple[Numbers, Numbers] | None  # frequencies frequencies outputs inputs, a `Mixing`'s
    across: tuple[Numbers, Numbers] | None = None  # frequencies pairs pairs, of several pairs


class Batch(NamedTuple):
    """One structure and where it is evaluated."""

    model: PyTree
    parameters: Parameters
    hold: float  # s
    omega: Float[Numbers, " frequencies"]


Active = Bool[Array, " members"]
Evaluate = Callable[[Float[Array, "parameters members"], Active], Normal]


def normal_equations_of(batch: Batch, member: Member) -> Evaluate:
    """Cost, gradient and Gauss-Newton Hessian of members on the last axis of `member`.

    A `jq.StateSpace` is evaluated one member after the other, without those that are not active:
    its states are a loop of their own. Any other model of plain arithmetic becomes one kernel, at a
    quarter of the cost of what evaluates the rest: at all frequencies at once.
    """
    if evaluates_singly(batch):
        return _one_by_one(batch, member)
    return lambda z, active: _at_all_frequencies(batch, z, member)


def evaluates_singly(batch: Batch) -> bool:
    """Whether members are evaluated one after the other: a `jq.StateSpace` without ties."""
    return type(batch.model) is StateSpace and not batch.parameters.ties and not batch.hold


def _one_by_one(batch: Batch, member: Member) -> Evaluate:
    # With the members first: transposed once, not at each evaluation.
    measured = jnp.moveaxis(1 / jax.lax.complex(*member.inverse), (3, 0), (0, 3))
    weights = jnp.moveaxis(member.weights, (4, 3, 0), (0, 1, 4))
    factor = across = None
    if member.factor is not None:
        factor = tuple(jnp.moveaxis(x, (4, 0, 1), (0, 3, 4)) for x in member.factor)
    if member.across is not None:
        across = tuple(jnp.moveaxis(x, -1, 0) for x in member.across)
    members = (jnp.real(measured), jnp.imag(measured)), weights, factor, across

    def normal(z, member):
        measured, weights, factor, across = member
        mixing = None
        if factor is not None:
            factor = jax.lax.complex(*factor)
            across = None if across is None else jax.lax.complex(*across)
            # Traced, in the place of NumPy's arrays; correlations matter to nothing here.
            mixing = Mixing(factor, factor, across, across)  # pyright: ignore[reportArgumentType]
        problem = Problem(
            model=batch.model,
            parameters=batch.parameters,
            conditions=(UNCHANGED,),
            quantities=(),
            omega=(batch.omega,),
            measured=(jnp.moveaxis(jax.lax.complex(*measured), -1, 0),),
            weights=(jnp.moveaxis(weights, (3, 0), (0, 3)),),
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

    def evaluate(z: Float[Array, "parameters members"], active: Active) -> Normal:
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
    """Weighted slopes by each parameter, and then the weighted misfit, at one frequency.

    Each in magnitude and in phase.
    """

    def response(z):
        model = behind_hold(_insert(batch.model, batch.parameters, z), batch.hold)
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
