"""Data that JAX looks into, for what is made dozens of times in a millisecond."""

import dataclasses
from collections.abc import Iterable
from typing import dataclass_transform, TypeVar

import equinox as eqx
import jax


T = TypeVar("T")


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, eqx.field))
def pytree_node(cls: type[T]) -> type[T]:
    """A frozen dataclass that is a pytree; fields with `eqx.field(static=True)` are static.

    An `eqx.Module` checks itself when it is made, and wraps each of its methods when it is looked
    up: tens of microseconds that add up to half of a small fit. Copies that JAX makes run no
    `__init__`, because they hold what stands for arrays.
    """
    cls.__repr__ = lambda self: eqx.tree_pformat(self)
    cls = dataclasses.dataclass(frozen=True, eq=False, repr=False)(cls)
    fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
    static = tuple(f.name for f in fields if f.metadata.get("static", False))
    data = tuple(f.name for f in fields if f.name not in static)
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in data)

    def flatten(node: T) -> tuple[tuple, tuple]:
        mine = vars(node)
        return tuple([mine[name] for name in data]), tuple([mine[name] for name in static])

    def flatten_with_keys(node: T) -> tuple[tuple, tuple]:
        leaves, rest = flatten(node)
        return tuple(zip(keys, leaves, strict=True)), rest

    def unflatten(rest: tuple, leaves: Iterable) -> T:
        node = object.__new__(cls)
        vars(node).update(zip(data, leaves, strict=True))
        vars(node).update(zip(static, rest, strict=True))
        return node

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls
