import functools as ft
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import PyTree


_SHORT = 128  # samples that need no blocks


def scan_in_blocks(
    step: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]], carry: PyTree, xs: PyTree, count: int
) -> tuple[PyTree, PyTree]:
    """`jax.lax.scan` whose reverse keeps the carry of blocks only, and of the one it is in.

    Twice the square root of `count` carries instead of all, for one forward pass more.
    """

    # Within a scan nothing can be merged with the forward pass, so no barriers are needed.
    @ft.partial(jax.checkpoint, prevent_cse=False)
    def block(carry: PyTree, xs: PyTree) -> tuple[PyTree, PyTree]:
        return jax.lax.scan(jax.checkpoint(step, prevent_cse=False), carry, xs)

    size = _block_size(count)
    blocks = count // size
    if blocks == 1 and size == count:
        return block(carry, xs)
    split = blocks * size
    apart = lambda x: x[:split].reshape(blocks, size, *x.shape[1:])
    joined = lambda x: x.reshape(split, *x.shape[2:])
    carry, out = jax.lax.scan(block, carry, jax.tree.map(apart, xs))
    out = jax.tree.map(joined, out)
    if split == count:
        return carry, out
    carry, tail = block(carry, jax.tree.map(lambda x: x[split:], xs))
    return carry, jax.tree.map(lambda x, y: jnp.concatenate([x, y]), out, tail)


def _block_size(count: int) -> int:
    """Near the square root of `count`, and a divisor if there is one."""
    if count <= _SHORT:
        return count
    root = math.isqrt(count)
    near = sorted(range(root // 2, 2 * root + 1), key=lambda size: abs(size - root))
    return next((size for size in near if count % size == 0), root)
