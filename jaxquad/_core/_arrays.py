"""Arrays of JAX from what a user gives."""

from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ._checks import is_concrete


Tree = TypeVar("Tree")


def as_float(x: ArrayLike | Sequence) -> Array:
    """`x` as an array of the default float type (a list of integers too)."""
    dtype = jnp.result_type(float)
    if any(isinstance(each, jax.Array) for each in jax.tree.leaves(x)):
        return jnp.asarray(x, dtype=dtype)
    # Of numbers jnp.asarray compiles a program for each new shape.
    return jax.device_put(np.asarray(x, dtype=dtype))


def as_array(x: ArrayLike) -> Array:
    """`x` as an array of JAX, of its own type; without a program for each new shape."""
    return x if isinstance(x, jax.Array) else jax.device_put(np.asarray(x))


def on_host(tree: Tree) -> Tree:
    """With the arrays of JAX as NumPy's, whose operations compile nothing; those traced stay."""
    known = lambda x: isinstance(x, jax.Array) and is_concrete(x)
    return jax.tree.map(lambda x: np.asarray(x) if known(x) else x, tree)


def as_float_or_none(x: ArrayLike | Sequence | None) -> Array | None:
    return None if x is None else as_float(x)


def align(parameter: Array, state: Array) -> Array:
    """`parameter` with axes of length one appended, to broadcast over the ensemble of `state`."""
    missing = state.ndim - parameter.ndim
    if missing < 0:
        raise ValueError(
            f"A parameter of shape {parameter.shape} belongs to an ensemble, but the state has "
            f"shape {state.shape}: give the state the same trailing axis, as init() does."
        )
    return parameter.reshape(parameter.shape + (1,) * missing)


def is_zero(x: Array | np.ndarray) -> bool:
    """Whether `x` is known to be 0 everywhere."""
    return is_concrete(x) and not np.any(np.asarray(x))  # jnp would trace even a constant
