import functools as ft
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree


_SHORT = 128  # samples that need no blocks


def scan_in_blocks(
    step: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]], carry: PyTree, xs: PyTree, count: int
) -> tuple[PyTree, PyTree]:
    """`jax.lax.scan` whose reverse keeps the carry of blocks only, and of the one it is in.

    Twice the square root of `count` carries instead of all, for one forward pass more.
    """

    size = _block_size(count)
    length = -(-count // size) * size
    if length > count:
        step, xs = _until(count, step), (jnp.arange(length), jax.tree.map(_lengthened(length), xs))

    # Within a scan nothing can be merged with the forward pass, so no barriers are needed.
    @ft.partial(jax.checkpoint, prevent_cse=False)
    def block(carry: PyTree, xs: PyTree) -> tuple[PyTree, PyTree]:
        return jax.lax.scan(jax.checkpoint(step, prevent_cse=False), carry, xs)

    if length == size:
        return block(carry, xs)
    apart = lambda x: x.reshape(length // size, size, *x.shape[1:])
    carry, out = jax.lax.scan(block, carry, jax.tree.map(apart, xs))
    return carry, jax.tree.map(lambda x: x.reshape(length, *x.shape[2:])[:count], out)


def _until(count: int, step: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]]) -> Any:
    """The step, which leaves the carry as it is after `count` samples.

    A last block of another length would be compiled as a second loop.
    """

    def masked(carry: PyTree, xs: tuple[Array, PyTree]) -> tuple[PyTree, PyTree]:
        index, now = xs
        after, out = step(carry, now)
        return jax.tree.map(lambda new, old: jnp.where(index < count, new, old), after, carry), out

    return masked


def _lengthened(length: int) -> Callable[[Array], Array]:
    """With the last sample repeated."""
    return lambda x: jnp.concatenate([x, jnp.repeat(x[-1:], length - x.shape[0], axis=0)])


def _block_size(count: int) -> int:
    """Near the square root of `count`, and a divisor if there is one."""
    if count <= _SHORT:
        return count
    root = math.isqrt(count)
    near = sorted(range(root // 2, 2 * root + 1), key=lambda size: abs(size - root))
    return next((size for size in near if count % size == 0), root)
