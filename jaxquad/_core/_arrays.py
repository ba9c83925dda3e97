"""Arrays from what a user gives, their precision, and the members of an ensemble on their axes.

A field declares these: `per_member(rank=...)` says that the first `rank` axes of its arrays are the
field's own (1 for `[axes]`, 2 for `[samples, axes]`), and that all axes after them are the
ensemble's. What is not declared is the same for all members.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, dataclass_transform, TYPE_CHECKING, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import KeyPath
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from ._host import is_concrete


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


def is_traced(tree: object) -> bool:
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


def member_rank(module: object, name: str) -> int | None:
    """The rank that a module declares for a field by `per_member`; None if it declares none."""
    field = getattr(module, "__dataclass_fields__", {}).get(name)
    return None if field is None else field.metadata.get(_KEY)


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
    ranks: dict[str | None, int] = {}
    if isinstance(tree, eqx.Module):
        fields = dataclasses.fields(tree)
        ranks |= {x.name: x.metadata[_KEY] for x in fields if _KEY in x.metadata}
    children, _ = jax.tree_util.tree_flatten_with_path(tree, is_leaf=lambda x: x is not tree)
    for path, child in children:
        name = path[0].name if isinstance(path[0], jax.tree_util.GetAttrKey) else None
        yield from _leaves(child, ranks.get(name, rank), at + path)


def _name(tree: PyTree, path: KeyPath) -> str:
    within = jax.tree_util.keystr(path, simple=True, separator=".")
    if isinstance(tree, eqx.Module):
        return f"{type(tree).__name__}.{within}"
    return within or "an array"


Member = int | Int[Array, ""]  # an index, which may be traced


def broadcast_gain(gain: Float[Array, "..."], signal: Float[Array, "..."]) -> Float[Array, "..."]:
    """A gain that broadcasts over `signal`, in its precision."""
    return align(gain, signal).astype(signal.dtype)


def match_reference(
    reference: PyTree, measurement: Float[Array, " axes *ensemble"], state: Float[Array, "..."]
) -> PyTree:
    """A set-point that broadcasts over the `measurement`, in its precision.

    Raises ValueError for a measurement of another shape than the state.
    """
    if measurement.shape != state.shape:
        raise ValueError(
            f"The measurement has shape {measurement.shape}, but the controller was started for "
            f"{state.shape}: give init() an array of the measurements' shape."
        )
    return jax.tree.map(lambda x: broadcast_gain(x, measurement), reference)


Numbers = TypeVar("Numbers", jax.Array, np.ndarray)


def of_one_rank(a: Numbers, b: Numbers) -> tuple[Numbers, Numbers]:
    """Both with as many axes; the one with fewer trailing axes holds for all members."""
    rank = max(a.ndim, b.ndim)
    return a.reshape(a.shape + (1,) * (rank - a.ndim)), b.reshape(b.shape + (1,) * (rank - b.ndim))


def multiply_gains(a: Numbers, b: Numbers) -> Numbers:
    a, b = of_one_rank(a, b)
    return a * b


def signal_shape(like: Float[Array, " axes ..."], ensemble: tuple[int, ...]) -> tuple[int, ...]:
    """Of a signal as wide as `like` and as the `ensemble` of the gains."""
    gains = jax.ShapeDtypeStruct((1, *ensemble), like.dtype)
    return like.shape[:1] + ensemble_shape(like, gains, rank=1)


def pick_gain(
    gain: Float[Array, "..."], axis: int, member: Member | tuple[Member, ...] | None
) -> Float[Array, ""]:
    """The value for one axis of one member. Raises ValueError for one that does not exist."""
    if gain.ndim == 0:
        return gain
    if isinstance(axis, int) and not 0 <= axis < gain.shape[0]:
        raise ValueError(f"axis is {axis}, but the gains are for axes 0 to {gain.shape[0] - 1}.")
    ensemble = gain.shape[1:]
    if ensemble and member is None:
        raise ValueError(f"The gains are for an ensemble of {ensemble}: pick one, as member=0.")
    if member is None or not ensemble:
        return gain[axis]
    members = member if isinstance(member, tuple) else (member,)
    if len(members) != len(ensemble):
        raise ValueError(
            f"member is {member}, but the ensemble has the shape {ensemble}: give one index each."
        )
    for one, size in zip(members, ensemble, strict=True):
        if isinstance(one, int) and not 0 <= one < size and size > 1:
            raise ValueError(f"member is {one}, but the ensemble's are 0 to {size - 1}.")
    pairs = zip(members, ensemble, strict=True)
    return gain[axis][tuple(0 if size == 1 else one for one, size in pairs)]


def require_common_shape(gains: Mapping[str, Array]) -> None:
    """Raises ValueError unless the gains fit together."""
    shapes = {name: gain.shape for name, gain in gains.items() if gain.ndim}
    text = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
    remedy = "give each as a scalar, one value per axis, or (axes, members) for an ensemble"
    if len({shape[0] for shape in shapes.values()}) > 1:
        raise ValueError(f"The gains are for different numbers of axes, {text}: {remedy}.")
    try:
        ensemble_shape(gains, rank=1)
    except ValueError:
        raise ValueError(f"The gains are for different ensembles, {text}: {remedy}.") from None


def require_limit(limit: Float[Array, "..."]) -> None:
    if is_concrete(limit) and not np.all(np.asarray(limit) > 0):
        raise ValueError(
            f"limit is {limit}, but it must be above 0: it bounds the command on both sides; "
            "inf bounds nothing."
        )


def require_sample_interval(dt: float) -> None:
    if not (dt > 0 and np.isfinite(dt)):
        raise ValueError(f"dt is {dt} s, but it must be above 0 and finite: give seconds.")


def require_below_sampling(name: str, value: Array, bound: float, dt: float) -> None:
    """Raises ValueError unless `value` times `dt` is below `bound`."""
    if is_concrete(value) and not np.all(np.asarray(value) * dt < bound):
        raise ValueError(
            f"{name} is {np.max(np.asarray(value)):.6g} rad/s, but at dt = {dt} s it must be below "
            f"{bound / dt:.4g} rad/s: lower it or sample faster."
        )
