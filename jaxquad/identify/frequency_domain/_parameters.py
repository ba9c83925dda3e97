"""Which numbers of a model are free, how they are scaled, and how records change them."""

import functools as ft
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._core import (
    is_concrete,
    is_traced,
    pytree_node,
    require_finite,
    require_float64,
    require_positive,
)
from jaxquad.models import declares, StateSpace


_MOVED = 1.01  # factor on the free parameters at which ties are looked at


class Positive(NamedTuple):
    """A free parameter that keeps the sign of its starting value; its logarithm is fitted."""

    name: str


class Real(NamedTuple):
    """A free parameter that may cross zero; `scale` is its typical size, by default |start|."""

    name: str
    scale: float | None = None


Numbers = Array | np.ndarray

Free = Sequence[str | Positive | Real] | Callable[[PyTree], PyTree] | None


class Place(NamedTuple):
    """Where a named number sits in a model: which array, and which of its elements."""

    name: str
    leaf: int
    index: int
    path: str  # `F[1][1]`, which is the name too unless the model gives it one

    def number(self, model: PyTree) -> Any:
        """The number that is there in a model, of JAX or of NumPy as its array."""
        leaves = [leaf for leaf in jax.tree.leaves(model) if eqx.is_inexact_array(leaf)]
        return leaves[self.leaf].reshape(-1)[self.index]


Tie = Callable[[PyTree], Float[Array, ""]]


@pytree_node
class Parameters:
    """Free numbers first, then the fixed nonzero ones; `z` is the vector that a solver moves.

    Tied numbers follow the others: each is a function of the model. With a NumPy `z` all is done
    in NumPy, which compiles nothing, and models hold NumPy arrays.
    """

    places: tuple[Place, ...] = eqx.field(static=True)
    ties: tuple[tuple[Place, Tie], ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    count: int = eqx.field(static=True)  # of free ones
    scale: Float[Numbers, " all"]
    start: Float[Numbers, " all"]  # z at the starting values

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(place.name for place in self.places[: self.count])

    def values(self, z: Float[Numbers, " n"]) -> Float[Numbers, " n"]:
        """Physical values of the first parameters."""
        n, xp = z.shape[0], namespace_of(z)
        with np.errstate(over="ignore"):
            return self.scale[:n] * xp.where(np.array(self.logarithmic[:n]), xp.exp(z), z)

    def slopes(self, z: Float[Numbers, " n"]) -> Float[Numbers, " n"]:
        """Derivatives of the physical values with respect to `z`."""
        n, xp = z.shape[0], namespace_of(z)
        ones = xp.ones_like(z)
        with np.errstate(over="ignore"):
            return self.scale[:n] * xp.where(np.array(self.logarithmic[:n]), xp.exp(z), ones)

    def coordinates(self, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"] | None:
        """`z` at physical values; None where one of them has lost its sign."""
        ratio = values / np.asarray(self.scale)[: values.size]
        logarithmic = np.array(self.logarithmic[: values.size])
        if np.any(logarithmic & (ratio < 0)):
            return None
        return np.where(
            logarithmic, np.log(np.where(logarithmic, np.maximum(ratio, 1e-300), 1.0)), ratio
        )

    def insert(self, model: PyTree, z: Float[Numbers, " n"]) -> PyTree:
        """The model with its first `n` parameters set, and what is tied to them."""
        return self.replace(model, self.values(z))

    def replace(self, model: PyTree, values: Float[Numbers, " n"]) -> PyTree:
        """The model with other physical values of its first `n` parameters."""
        model, xp = with_values(model, self.places[: values.shape[0]], values), namespace_of(values)
        for place, tie in self.ties:
            value = xp.asarray(tie(model))
            if value.shape != ():
                raise ValueError(
                    f"{place.name} is tied to an array of shape {value.shape}: return one number"
                )
            model = with_values(model, (place,), value[None])
        return model


def namespace_of(x: Numbers) -> Any:
    """The module whose functions take `x`: NumPy, or `jax.numpy`."""
    return np if isinstance(x, np.ndarray) else jnp


def with_values(model: PyTree, places: Sequence[Place], values: Float[Numbers, " n"]) -> PyTree:
    """Return `model` with the numbers at `places` replaced by `values`; see `Parameters`."""
    all_leaves, structure = jax.tree.flatten(model)
    numbers = [k for k, leaf in enumerate(all_leaves) if eqx.is_inexact_array(leaf)]
    leaves, host = [all_leaves[k] for k in numbers], namespace_of(values) is np
    if host:
        leaves = [np.array(leaf) if is_concrete(leaf) else leaf for leaf in leaves]
    in_place = [host and isinstance(leaves[place.leaf], np.ndarray) for place in places]
    for place, value, numpy in zip(places, values if host else places, in_place, strict=True):
        if numpy:
            leaves[place.leaf].reshape(-1)[place.index] = value
    for leaf in {place.leaf for place, numpy in zip(places, in_place, strict=True) if not numpy}:
        mine = np.array([k for k, place in enumerate(places) if place.leaf == leaf])
        index = np.array([places[k].index for k in mine])
        if leaves[leaf].size == 1:  # a scatter takes ten times as long to trace
            number = jax.lax.slice_in_dim(values, mine[0], mine[0] + 1)
            leaves[leaf] = number.astype(leaves[leaf].dtype).reshape(leaves[leaf].shape)
        else:
            flat = jnp.asarray(leaves[leaf]).reshape(-1).at[index].set(values[mine])
            leaves[leaf] = flat.reshape(leaves[leaf].shape)
    for k, leaf in zip(numbers, leaves, strict=True):
        all_leaves[k] = leaf
    return jax.tree.unflatten(structure, all_leaves)


def name_places(model: PyTree) -> list[Place]:
    """Every floating-point number of a model: `lag`, `numerator[0]`, `axis.inertia[2]`."""
    leaves, structure = jax.tree.flatten(model)
    numbers = [leaf if eqx.is_inexact_array(leaf) else None for leaf in leaves]
    places, names = _places(structure, tuple(x if x is None else x.shape for x in numbers))
    for name, array in zip(names, (x for x in numbers if x is not None), strict=True):
        require_float64(f"parameter {name}", array)
    return list(places)


@ft.lru_cache(maxsize=64)
def _places(
    structure: PyTree, shapes: tuple[tuple[int, ...] | None, ...]
) -> tuple[tuple[Place, ...], tuple[str, ...]]:
    """Of all numbers in arrays of these shapes (None: no array); and the arrays' names."""
    hollow = jax.tree.unflatten(structure, [x if x is None else np.zeros(x) for x in shapes])
    text = ft.partial(jax.tree_util.keystr, simple=True, separator=".")
    # What the state spaces in a model name: `axis.F[1][1]` is `axis.Lp`.
    is_state_space, aliases = lambda x: isinstance(x, StateSpace), {}
    for path, node in jax.tree_util.tree_flatten_with_path(hollow, is_leaf=is_state_space)[0]:
        if isinstance(node, StateSpace):
            prefix = f"{text(path)}." if path else ""
            aliases |= {prefix + entry: prefix + name for name, entry in node.names}
    places, arrays = [], []
    for leaf, (path, array) in enumerate(jax.tree_util.tree_flatten_with_path(hollow)[0]):
        arrays.append(text(path))
        for index, entry in enumerate(np.ndindex(array.shape)):
            name = arrays[-1] + "".join(f"[{i}]" for i in entry)
            places.append(Place(aliases.get(name, name), leaf, index, name))
    return tuple(places), tuple(arrays)


def find_place(model: PyTree, name: str, purpose: str) -> Place:
    """The number of that name or path; ValueError where the model has none for the `purpose`."""
    places = name_places(model)
    by_name = _by_name(places)
    if name not in by_name:
        raise ValueError(
            f"no parameter {name!r} {purpose}; the model has: {', '.join(p.name for p in places)}"
        )
    return by_name[name]


def _by_name(places: Sequence[Place]) -> dict[str, Place]:
    """Each place by its path and by its name."""
    return {place.path: place for place in places} | {place.name: place for place in places}


def select_parameters(
    model: PyTree, free: Free, tied: Mapping[str, Tie] | None = None
) -> Parameters:
    """The free and tied parameters of a model, as `jq.fit` takes them.

    **Raises:** ValueError for a name that the model does not have, is given twice, or starts at 0
    or inf; for a tie that follows itself or a later one.
    """
    places = name_places(model)
    values, by_name = _numbers(model, places), _by_name(places)
    ties = tuple((find_place(model, name, "to tie"), tie) for name, tie in (tied or {}).items())
    for name, tie in (tied or {}).items():
        if not callable(tie):
            raise ValueError(
                f"{name} is tied to {tie!r}: give a function of the model, "
                "lambda m: -m.F[0, 1]; a plain number belongs in the model"
            )
    bound = {place.name for place, _ in ties}
    chosen, scales, logs = [], [], []
    for item in _expand(model, places, free, bound):
        name = item if isinstance(item, str) else item.name
        if name not in by_name:
            raise ValueError(f"no parameter {name!r} in the model; it has: {', '.join(values)}")
        place = by_name[name]
        name, value = place.name, values[place.name]
        if not np.isfinite(value):
            raise ValueError(f"parameter {name} starts at {value}: give a finite starting value")
        scale = float(np.sign(value))
        if isinstance(item, str) and declares(model, place.path, "signed"):
            item = Real(name)
        if isinstance(item, Real):
            scale = item.scale or abs(value)
            if not scale > 0:
                raise ValueError(
                    f"{name} starts at 0: give its typical size, "
                    f"jq.identify.Real({name!r}, scale=...)"
                )
        elif value == 0:
            raise ValueError(
                f"{name} starts at 0, so its sign is unknown: give a starting value, or let it "
                f"cross zero with jq.identify.Real({name!r}, scale=...)"
            )
        chosen.append(place)
        scales.append(scale)
        logs.append(not isinstance(item, Real))
    names = [place.name for place in chosen]
    if len(set(names)) != len(names) or not names:
        raise ValueError(f"free={names}: name each free parameter once, and at least one")
    both = bound.intersection(names)
    if both:
        raise ValueError(
            f"{sorted(both)} cannot be free and tied at once: leave out one of the two"
        )
    taken = bound.union(names)
    fixed = [place for place in places if place.name not in taken and values[place.name] != 0]
    ordered, logs = (*chosen, *fixed), (*logs, *(True for _ in fixed))
    scales += [np.sign(values[place.name]) for place in fixed]
    ratio = np.array([values[place.name] for place in ordered]) / np.array(scales)
    start = np.where(logs, np.log(np.where(logs, ratio, 1.0)), ratio)
    parameters = Parameters(ordered, ties, logs, len(chosen), np.asarray(scales, float), start)
    if not ties:
        return parameters
    # No tie follows itself, or one that comes after it.
    start = _MOVED * parameters.values(parameters.start[: parameters.count])
    moved = parameters.replace(model, start)
    again = parameters.replace(moved, start)
    tied_places = [place for place, _ in ties]
    for name, value in _numbers(moved, tied_places).items():
        if not np.isclose(value, _numbers(again, tied_places)[name], rtol=1e-9, equal_nan=True):
            raise ValueError(
                f"{name} is tied to itself, or to a parameter whose tie comes later: ties are "
                "computed one after the other, each from free, fixed and earlier tied parameters"
            )
    return parameters


def _expand(
    model: PyTree, places: list[Place], free: Free, bound: set[str]
) -> list[str | Positive | Real]:
    """All free parameters, with the entries of arrays in the place of these."""
    if free is None:
        values = _numbers(model, places)
        absent = lambda p: values[p.name] == 0 and declares(model, p.path, "optional")
        return [p.name for p in places if p.name not in bound and not absent(p)]
    if callable(free):
        flags = jax.tree.map(lambda _: False, eqx.filter(model, eqx.is_inexact_array))
        marked = jax.tree.leaves(eqx.tree_at(free, flags, replace_fn=lambda _: True))
        return [place.name for place in places if marked[place.leaf]]
    items = []
    for item in [free] if isinstance(free, str | Positive | Real) else free:
        name = item if isinstance(item, str) else item.name
        entries = [place.name for place in places if place.path.startswith(f"{name}[")]
        items += entries if isinstance(item, str) and entries else [item]
    return items


def _numbers(model: PyTree, places: list[Place]) -> dict[str, float]:
    arrays = (leaf for leaf in jax.tree.leaves(model) if eqx.is_inexact_array(leaf))
    leaves = [np.asarray(array).reshape(-1) for array in arrays]
    return {p.name: float(leaves[p.leaf][p.index]) for p in places}


Condition = Callable[[PyTree], PyTree]


@pytree_node
class _ByFunction:
    """A condition that is a function, into which JAX cannot look."""

    change: Condition = eqx.field(static=True)

    def __call__(self, model: PyTree) -> PyTree:
        return self.change(model)


def _same(model: PyTree) -> PyTree:
    return model


UNCHANGED = _ByFunction(_same)  # the condition of a record that was taken on the model as it is


@pytree_node
class Changed:
    """A known change of one parameter, in one of the records of a fit.

    A weight on the arms, another propeller: it tells parameters apart of which one record shows
    the ratio alone. The parameter counts as `times * value + plus`.

    **Arguments:**

    - `parameter`: its name, as in `free=`.
    - `plus`: what is added, in the parameter's unit.
    - `times`: a factor, above 0.

    **Raises:** ValueError for what is not one finite number each, and where both change nothing.

    A function of the model does the same. This one pickles, and fits with it keep their compiled
    program for the next process.

    !!! example

        ```python
        loaded = jq.identify.Changed("J_x", plus=0.0276)
        fit = jq.fit(model, (frf, frf_loaded), conditions=(None, loaded))
        ```
    """

    parameter: str = eqx.field(static=True)
    plus: float | Float[Numbers, ""] = 0.0
    times: float | Float[Numbers, ""] = 1.0

    def __post_init__(self):
        for name in ("plus", "times"):  # arrays: other numbers run the same program
            number = getattr(self, name)
            number = (np if is_concrete(number) else jnp).asarray(number, dtype=float)
            if number.ndim:
                raise ValueError(f"{name} has the shape {number.shape}: give one number")
            object.__setattr__(self, name, number)
        require_finite("plus", self.plus)
        require_positive("times", self.times)
        if not is_traced(self) and self.plus == 0.0 and self.times == 1.0:
            raise ValueError(f"{self.parameter} is not changed: give plus= or times=")

    def __call__(self, model: PyTree) -> PyTree:
        """The model with the change."""
        place = find_place(model, self.parameter, "for a condition")
        value = self.times * place.number(model) + self.plus
        return with_values(model, (place,), value[None])


def require_conditions(
    model: PyTree, conditions: Sequence[Condition | None] | None, count: int
) -> list[Condition]:
    """One for each of `count` responses, all of them pytrees."""
    changes = [None] * count if conditions is None else list(conditions)
    if len(changes) != count:
        raise ValueError(
            f"{len(changes)} conditions for {count} responses: give one for each, None where the "
            "model holds as it is"
        )
    nodes: list[Condition] = []
    for change in changes:
        if change is None:
            nodes.append(UNCHANGED)
            continue
        if isinstance(change, Changed):
            find_place(model, change.parameter, "for a condition")
        elif not callable(change):
            raise ValueError(
                f"condition {change!r} is no change of the model: give None, "
                "jq.identify.Changed(name, change), or a function from a model to a model"
            )
        is_leaf = jax.tree_util.all_leaves([change])
        nodes.append(_ByFunction(change) if is_leaf else change)
    return nodes
