import functools as ft
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from ._resolvent import equilibrium, inverse, Split


Parts = Float[Array, "frequencies 2 _ _"]  # real and imaginary, rows, columns


class Matrices(NamedTuple):
    """What a `StateSpace` holds; None stands for an M of ones, for no H1 and for no delay."""

    F: Float[Array, "states states"]
    G: Float[Array, "states inputs"]
    H0: Float[Array, "outputs states"]
    H1: Float[Array, "outputs states"] | None
    M: Float[Array, "states states"] | None
    late: Float[Array, "outputs inputs"] | None  # s, of input and output together


@jax.custom_jvp
def response(matrices: Matrices, omega: Float[Array, " frequencies"]) -> Parts:
    """(H0 + s H1) (s M - F)^-1 G exp(-s late); rows are outputs and columns inputs.

    Infinite, with an undefined phase, where a pole lies so near that more than a hundredth of the
    states may be rounding. Source: Tischler & Remple, eq. 12.11 and 12.12.
    """
    resolvent = _resolvent(matrices, omega)
    states = _times(resolvent, matrices.G)
    found = _turned(_output(matrices, omega, states), matrices.late, omega)
    lost = _lost(matrices, omega, resolvent, states)
    undefined = jnp.asarray([jnp.inf, jnp.nan], omega.dtype)[None, :, None, None]
    return jnp.where(lost[:, None], undefined, found)


@ft.partial(response.defjvp, symbolic_zeros=True)
def _response_jvp(primals, tangents):
    # With the states X = R G and L = (H0 + s H1) R, both small, instead of the products R dF R:
    # dT = L (dG + dF X - d(s M) X) + d(H0 + s H1) X, late, and -j d(omega late) T.
    matrices, omega = primals
    d, d_omega = (_present(each) for each in tangents)
    value = response(matrices, omega)
    resolvent = _resolvent(matrices, omega)
    states = _times(resolvent, matrices.G)
    rate = _derivative(states, omega)
    push = [_applied(d.F, states), _applied(d.M, -rate), _real(d.G, states)]
    change = [_applied(d.H0, states), _applied(d.H1, rate)]
    if d_omega is not None:
        turned = _derivative(states, d_omega)
        push.append(-turned if matrices.M is None else _applied(matrices.M, -turned))
        change.append(_applied(matrices.H1, turned))
    pushed = _sum(push)
    if pushed is not None:
        change.append(_product(_output(matrices, omega, resolvent), pushed))
    changed = _sum(change)
    moved = [None if changed is None else _turned(changed, matrices.late, omega)]
    for late, frequency in ((d.late, omega), (matrices.late, d_omega)):
        if late is not None and frequency is not None:
            angle = (frequency[:, None, None] * late[None])[:, None]
            moved.append(angle * jnp.stack([value[:, 1], -value[:, 0]], axis=1))
    return value, _sum([jnp.zeros_like(value), *moved])


def _turned(parts: Parts, late: Array | None, omega: Float[Array, " frequencies"]) -> Parts:
    if late is None:
        return parts
    angle = omega[:, None, None] * late[None]
    (real, imag), (c, s) = (parts[:, 0], parts[:, 1]), (jnp.cos(angle), jnp.sin(angle))
    return jnp.stack([real * c + imag * s, imag * c - real * s], axis=1)


def _resolvent(matrices: Matrices, omega: Float[Array, " frequencies"]) -> Parts:
    return jnp.transpose(jnp.stack(inverse(_pencil(matrices, omega))), (3, 0, 1, 2))


def _pencil(matrices: Matrices, omega: Float[Array, " frequencies"]) -> Split:
    F, M = matrices.F, _mass(matrices)
    shape = (*F.shape, omega.size)
    return Split(jnp.broadcast_to(-F[:, :, None], shape), M[:, :, None] * omega[None, None])


def _mass(matrices: Matrices) -> Float[Array, "states states"]:
    F, M = matrices.F, matrices.M
    return jnp.eye(len(F), dtype=F.dtype) if M is None else M


def _output(matrices: Matrices, omega: Float[Array, " frequencies"], states: Parts) -> Parts:
    """(H0 + s H1) times `states`, or times the resolvent."""
    found = _dot("ij,fcjk->fcik", matrices.H0, states)
    if matrices.H1 is None:
        return found
    return found + _dot("ij,fcjk->fcik", matrices.H1, _derivative(states, omega))


def _lost(
    matrices: Matrices, omega: Float[Array, " frequencies"], resolvent: Parts, states: Parts
) -> Bool[Array, "frequencies outputs inputs"]:
    # A first-order bound of the rounding error in the states, beside the largest state in the
    # units that make the equations alike; and what only a pivot of zero can make so large.
    pencil = _pencil(matrices, omega)
    scales = equilibrium(jnp.maximum(jnp.abs(pencil.real), jnp.abs(pencil.imag)))
    row, unit = (jnp.transpose(scale)[:, :, None] for scale in scales)
    size, gain = (jnp.sum(jnp.abs(x), axis=1) for x in (states, resolvent))
    turned = omega[:, None, None] * _dot("ij,fjk->fik", jnp.abs(_mass(matrices)), size)
    error = _dot("fij,fjk->fik", gain, _dot("ij,fjk->fik", jnp.abs(matrices.F), size) + turned)
    limit = 0.01 / float(jnp.finfo(omega.dtype).eps)
    push = jnp.max(row * jnp.abs(matrices.G)[None], axis=1, keepdims=True)
    doubtful = ~(error / unit <= limit * jnp.max(size / unit, axis=1, keepdims=True))
    doubtful = doubtful | (size / unit > limit**1.5 * push)
    H = [jnp.abs(each) for each in (matrices.H0, matrices.H1) if each is not None]
    seen = (sum(H[1:], H[0]) > 0).astype(omega.dtype)
    return _dot("ij,fjk->fik", seen, doubtful.astype(omega.dtype)) > 0


def _derivative(states: Parts, omega: Float[Array, " frequencies"]) -> Parts:
    factor = omega[:, None, None]
    return jnp.stack([-factor * states[:, 1], factor * states[:, 0]], axis=1)


def _product(a: Parts, b: Parts) -> Parts:
    # Of complex matrices as one of real blocks: small, but far quicker than complex numbers.
    real, imag = a[:, 0], a[:, 1]
    rows = [jnp.concatenate([real, -imag], axis=2), jnp.concatenate([imag, real], axis=2)]
    stacked = b.reshape(b.shape[0], -1, b.shape[-1])
    found = _dot("fij,fjk->fik", jnp.concatenate(rows, axis=1), stacked)
    return found.reshape(a.shape[0], 2, a.shape[2], b.shape[3])


def _times(resolvent: Parts, G: Float[Array, "states inputs"]) -> Parts:
    return _dot("fcij,jk->fcik", resolvent, G)


def _applied(matrix: Array | None, states: Parts) -> Parts | None:
    return None if matrix is None else _dot("ij,fcjk->fcik", matrix, states)


def _real(matrix: Array | None, like: Parts) -> Parts | None:
    if matrix is None:
        return None
    zero = jnp.zeros_like(matrix)
    return jnp.broadcast_to(jnp.stack([matrix, zero])[None], like.shape)


def _sum(terms: Sequence[Parts | None]) -> Any:
    total = None
    for term in terms:
        total = term if total is None else total if term is None else total + term
    return total


def _present(tangents: Any) -> Any:
    """The tangents, with None for those that are known to be zero."""
    absent = lambda x: isinstance(x, SymbolicZero)
    return jax.tree.map(lambda x: None if absent(x) else x, tangents, is_leaf=absent)


def _dot(axes: str, a: Array, b: Array) -> Array:
    return jnp.einsum(axes, a, b, precision="highest")
