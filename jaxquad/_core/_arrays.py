"""Arrays of JAX from what a user gives, their precision, and data that JAX looks into."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import dataclass_transform, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ._messages import is_concrete


Tree = TypeVar("Tree")


def as_float(x: ArrayLike | Sequence) -> Array:
    """`x` as an array of the default float type (a list of integers too)."""
    dtype = jnp.result_type(float)
    if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(x)):
        return jnp.asarray(x, dtype=dtype)
    # Of numbers jnp.asarray compiles a program for each new shape.
    return jax.device_put(np.asarray(x, dtype=dtype))


def as_array(x: ArrayLike) -> Array:
    """`x` as an array of JAX, of its own type; without a program for each new shape."""
    return x if isinstance(x, jax.Array) else jax.device_put(np.asarray(x))


def on_host(tree: Tree) -> Tree:
    """With the arrays of JAX as NumPy's, whose operations compile nothing; those traced stay."""
    has_values = lambda x: isinstance(x, jax.Array) and is_concrete(x)
    return jax.tree.map(lambda x: np.asarray(x) if has_values(x) else x, tree)


def concrete_values(tree: Tree, what: str) -> Tree:
    """With the values of what `jax.grad` and its like trace, in the place of their tracers.

    **Raises:** ValueError under `jax.jit` and `vmap`, whose tracers have none.
    """
    values = jax.tree.map(lambda x: x if is_concrete(x) else jax.lax.stop_gradient(x), tree)
    if not all(map(is_concrete, jax.tree.leaves(values))):
        raise ValueError(
            f"{what} decides by the values of its data, which jax.jit and jax.vmap hide: call it "
            "outside of them (jax.grad, jvp, jacfwd, jacrev and hessian take it as it is)"
        )
    return values


def is_traced(tree: Tree) -> bool:
    """Whether a transformation of JAX is looking at any of its numbers."""
    return not all(map(is_concrete, jax.tree.leaves(tree)))


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


T = TypeVar("T")


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, eqx.field))
def pytree_node(cls: type[T]) -> type[T]:
    """A frozen dataclass that is a pytree; fields with `eqx.field(static=True)` are static.

    An `eqx.Module` checks itself when it is made, and wraps each of its methods when it is looked
    up: tens of microseconds that add up to half of a small fit. Copies that JAX makes run no
    `__init__` (those of `jax.tree_util.register_dataclass` do): they hold what stands for arrays.
    """
    cls.__repr__ = lambda self: eqx.tree_pformat(self)
    cls = dataclasses.dataclass(frozen=True, eq=False, repr=False)(cls)
    fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
    static = [x.name for x in fields if x.metadata.get("static", False)]
    data = [x.name for x in fields if x.name not in static]
    keys = [jax.tree_util.GetAttrKey(name) for name in data]

    def flatten(node: T) -> tuple[list, tuple]:
        values = vars(node)
        return [values[name] for name in data], tuple([values[name] for name in static])

    def flatten_with_keys(node: T) -> tuple[list, tuple]:
        leaves, rest = flatten(node)
        return list(zip(keys, leaves, strict=True)), rest

    def unflatten(rest: tuple, leaves: Iterable) -> T:
        node = object.__new__(cls)
        vars(node).update(zip([*data, *static], [*leaves, *rest], strict=True))
        return node

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


class PrecisionError(ValueError):
    """Spectra and fits need 64-bit numbers, and JAX is set to 32."""


def enable_x64() -> None:
    """Let JAX compute with 64-bit numbers; call it before any array is created.

    Fits and gradients for tuning need them. Importing jaxquad never sets this by itself.
    """
    jax.config.update("jax_enable_x64", True)


def require_x64(what: str) -> None:
    """Raise a `PrecisionError` unless JAX runs with 64-bit numbers."""
    if not jax.config.read("jax_enable_x64"):
        raise PrecisionError(
            f"{what} needs float64, but JAX runs in float32: call jaxquad.enable_x64() "
            "before any array is created, or set JAX_ENABLE_X64=1"
        )


def require_float64(what: str, array: Array | np.ndarray) -> None:
    """Raise a `PrecisionError` if `array` was created in single precision."""
    require_x64(what)
    if array.dtype in (jnp.float32, jnp.complex64):
        raise PrecisionError(
            f"{what} is {array.dtype}: create it after "
            "jaxquad.enable_x64(), or convert it with jnp.asarray(x, float)"
        )
