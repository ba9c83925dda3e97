"""The members of an ensemble: which axes of which arrays they are on.

A field declares it: `per_member(rank=...)` says that the first `rank` axes of its arrays are the
field's own (1 for `[axes]`, 2 for `[samples, axes]`), and that all axes after them are the
ensemble's. What is not declared is the same for all members.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, TYPE_CHECKING

import equinox as eqx
import jax
import numpy as np
from jax.tree_util import KeyPath
from jaxtyping import PyTree


_KEY = "axes before the ensemble's"
_ARRAYS = (jax.Array, np.ndarray, jax.ShapeDtypeStruct)


if TYPE_CHECKING:  # a checker then knows that the arguments of a module pass the converter
    from equinox import field as per_member
else:

    def per_member(rank: int, **options: Any) -> Any:
        """An `equinox.field` whose arrays may have one value for each member of an ensemble.

        **Arguments:**

        - `rank`: how many leading axes are the field's own. All axes after these are the
            ensemble's.
        - `options`: those of `equinox.field`, such as `converter` and `default`.

        **Returns:**

        The field. It may hold one array or a tree of them: `rank` holds for all of its arrays,
        except for those of a module within it that has declarations of its own.

        !!! example

            ```python
            class Plant(eqx.Module):
                inertia: Float[Array, "axes *ensemble"] = per_member(rank=1)
                delay: Float[Array, "*ensemble"] = per_member(rank=0, default=0.0)
            ```
        """
        metadata = {**options.pop("metadata", {}), _KEY: rank}
        return eqx.field(metadata=metadata, **options)


def ensemble_shape(*trees: PyTree, rank: int | None = None) -> tuple[int, ...]:
    """The shape of the ensemble that all declared arrays in `trees` serve together.

    Axes of length 1 serve any number of members. An array with fewer ensemble axes than others
    lacks the last ones: it holds for all members on those. Only shapes are looked at, so this works
    under `jax.jit` and on the `jax.ShapeDtypeStruct`s of `jax.eval_shape`.

    **Arguments:**

    - `trees`: modules, or tuples, dicts and `None`, in any depth.
    - `rank`: of the arrays that no field declares; `None` if all members share those.

    **Returns:**

    The common shape, `()` for a single member.

    **Raises:**

    - `ValueError`: the arrays are for ensembles of different shapes. It names them.
    """
    leaves = [(tree, *leaf) for tree in trees for leaf in _leaves(tree, rank)]
    shapes = [
        (_name(tree, path), leaf.shape[rank_of_field:])
        for tree, path, leaf, rank_of_field in leaves
        if rank_of_field is not None
        and isinstance(leaf, _ARRAYS)
        and len(leaf.shape) > rank_of_field
    ]
    most = max((len(shape) for _, shape in shapes), default=0)
    try:
        return np.broadcast_shapes(*(shape + (1,) * (most - len(shape)) for _, shape in shapes))
    except ValueError:
        text = ", ".join(f"{name} {shape}" for name, shape in shapes)
        raise ValueError(
            f"These are for ensembles of different shapes: {text}. Give all of them one shape."
        ) from None


def mark_members(tree: PyTree, ensemble: tuple[int, ...], rank: int | None = None) -> PyTree:
    """Which leaves have one value for each member of the ensemble's last axis.

    **Arguments:**

    - `tree`: as for `ensemble_shape`, and `rank` too.
    - `ensemble`: the shape of the ensemble.

    **Returns:**

    A tree of the same structure with `True` for the arrays whose last axis is that of the
    `ensemble`, and `False` for all others, such as those of length 1 on it.
    """

    def has(leaf: object, field_rank: int | None) -> bool:
        if field_rank is None or not ensemble or not isinstance(leaf, _ARRAYS):
            return False
        shape = leaf.shape[field_rank:]
        return len(shape) == len(ensemble) and shape[-1] == ensemble[-1]

    marks = [has(leaf, field_rank) for _, leaf, field_rank in _leaves(tree, rank)]
    return jax.tree.unflatten(jax.tree.structure(tree), marks)


def _leaves(
    tree: PyTree, rank: int | None, at: KeyPath = ()
) -> Iterator[tuple[KeyPath, object, int | None]]:
    """The path, the leaf and its declared rank, in the order of `jax.tree.leaves`."""
    if jax.tree_util.all_leaves([tree]):
        yield at, tree, rank
        return
    ranks = _declared(tree)
    children, _ = jax.tree_util.tree_flatten_with_path(tree, is_leaf=lambda x: x is not tree)
    for path, child in children:
        name = path[0].name if isinstance(path[0], jax.tree_util.GetAttrKey) else None
        yield from _leaves(child, ranks.get(name, rank), at + path)


def _declared(tree: PyTree) -> dict[str | None, int]:
    if not isinstance(tree, eqx.Module):
        return {}
    return {x.name: x.metadata[_KEY] for x in dataclasses.fields(tree) if _KEY in x.metadata}


def _name(tree: PyTree, path: KeyPath) -> str:
    within = jax.tree_util.keystr(path, simple=True, separator=".")
    if isinstance(tree, eqx.Module):
        return f"{type(tree).__name__}.{within}"
    return within or "an array"
