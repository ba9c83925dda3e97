import functools as ft
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


_TERMS = 18  # of the series at a norm of 1: 1 / 19! is below the last bit
_SQUARINGS = 30
_FEW = 8  # rows or columns


def dot(a: Array, b: Array) -> Array:
    """The matrix product; a GPU would round float32 products to 10 bits."""
    return jnp.dot(a, b, precision="highest")


def small_dot(a: Array, b: Array) -> Array:
    """`dot` as a sum, if all sides are short: XLA calls a library, which takes longer than that.

    Derivatives in reverse keep every term of it.
    """
    if max(*a.shape, *b.shape) > _FEW:
        return dot(a, b)
    if a.ndim == 1:
        return jnp.sum(a.reshape(-1, *(1,) * (b.ndim - 1)) * b, axis=0)
    if b.ndim == 1:
        return jnp.sum(a * b[None], axis=1)
    return jnp.sum(a[:, :, None] * b[None], axis=1)


def matrix_exponential(
    matrix: Float[Array, "n n"], dot: Callable[[Array, Array], Array] = dot
) -> Float[Array, "n n"]:
    """e to the `matrix`, by its series with scaling and squaring, and by products of `dot`.

    It compiles in a fraction of the time of `jax.scipy.linalg.expm`, and without LAPACK under vmap.
    """
    size = jnp.maximum(jnp.max(jnp.sum(jnp.abs(matrix), axis=0)), 1.0)
    halvings = jax.lax.stop_gradient(jnp.clip(jnp.ceil(jnp.log2(size)), 0, _SQUARINGS))
    small = matrix * jnp.exp2(-halvings)
    unit = jnp.eye(len(matrix), dtype=matrix.dtype)

    def nest(power: Array, k: Array) -> tuple[Array, None]:
        return unit + dot(small, power) / k, None

    terms = jnp.arange(_TERMS, 0, -1, dtype=matrix.dtype)
    series = jax.lax.scan(nest, unit, terms)[0]
    return _squared(series, halvings, dot)


@ft.partial(jax.custom_jvp, nondiff_argnums=(2,))
def _squared(
    power: Float[Array, "n n"], times: Float[Array, ""], dot: Callable[[Array, Array], Array]
) -> Float[Array, "n n"]:
    """`power` squared so many times: of most matrices hardly one, of an ensemble's as the most."""
    more = lambda state: state[1] < times
    square = lambda state: (dot(state[0], state[0]), state[1] + 1)
    return jax.lax.while_loop(more, square, (power, jnp.zeros_like(times)))[0]


@_squared.defjvp
def _squared_jvp(
    dot: Callable[[Array, Array], Array], primals: tuple[Array, Array], tangents: tuple[Array, ...]
) -> tuple[Array, Array]:
    # A loop whose length is not known has no derivative in reverse.
    power, times = primals

    def square(power: Array, k: Array) -> tuple[Array, None]:
        return jnp.where(k < times, dot(power, power), power), None

    steps = jnp.arange(_SQUARINGS, dtype=power.dtype)
    run = lambda power: jax.lax.scan(square, power, steps)[0]
    return jax.jvp(run, (power,), (tangents[0],))
