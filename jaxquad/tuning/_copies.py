"""One objective for many problems: arrays with a leading axis of problems."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree


def copies(tree: PyTree, count: int) -> PyTree:
    """`count` problems with the same numbers."""
    arrays, rest = eqx.partition(tree, eqx.is_array)
    stack = lambda x: jnp.asarray(np.broadcast_to(np.asarray(x), (count, *x.shape)))
    wide = jax.tree.map(stack, arrays)
    return eqx.combine(wide, rest)


def one_of(tree: Any, index: int) -> Any:
    """The problem with that index."""
    arrays, rest = eqx.partition(tree, eqx.is_array)
    return eqx.combine(jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[index]), arrays), rest)
