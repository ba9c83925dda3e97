"""Which numbers of a model are free, under which names, and how each is scaled."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad.spectra import require_float64


class Positive(NamedTuple):
    """A free parameter that keeps the sign of its starting value: fitted as its logarithm."""

    name: str


class Real(NamedTuple):
    """A free parameter that may cross zero; `scale` is its typical size (by default |start|)."""

    name: str
    scale: float | None = None


Free = Sequence[str | Positive | Real] | Callable[[PyTree], PyTree] | None


class Place(NamedTuple):
    """Where a named number sits in a model: which array, and which of its elements."""

    name: str
    leaf: int
    index: int


class Parameters(eqx.Module):
    """Free numbers first, then the fixed nonzero ones; `z` is the vector that a solver moves."""

    places: tuple[Place, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    count: int = eqx.field(static=True)  # of free ones
    scale: Float[Array, " all"]
    start: Float[Array, " all"]  # z at the starting values

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(place.name for place in self.places[: self.count])

    def values(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        """Physical values of the first parameters."""
        n = z.shape[0]
        return self.scale[:n] * jnp.where(np.array(self.logarithmic[:n]), jnp.exp(z), z)

    def slopes(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        """Derivatives of the physical values with respect to `z`."""
        n = z.shape[0]
        ones = jnp.ones_like(z)
        return self.scale[:n] * jnp.where(np.array(self.logarithmic[:n]), jnp.exp(z), ones)

    def replace(self, model: PyTree, values: Float[np.ndarray, " parameters"]) -> PyTree:
        """The model with other physical values of its free parameters, outside of any trace."""
        arrays, rest = eqx.partition(model, eqx.is_inexact_array)
        leaves, structure = jax.tree.flatten(arrays)
        leaves = [np.array(leaf) for leaf in leaves]
        for place, value in zip(self.places, values, strict=False):
            leaves[place.leaf].reshape(-1)[place.index] = value
        return eqx.combine(jax.tree.unflatten(structure, [jnp.asarray(x) for x in leaves]), rest)

    def insert(self, model: PyTree, z: Float[Array, " n"]) -> PyTree:
        """The model with its first `n` parameters set."""
        arrays, rest = eqx.partition(model, eqx.is_inexact_array)
        leaves, structure = jax.tree.flatten(arrays)
        values = self.values(z)
        places = self.places[: z.shape[0]]
        for leaf in {place.leaf for place in places}:
            mine = np.array([k for k, place in enumerate(places) if place.leaf == leaf])
            index = np.array([places[k].index for k in mine])
            flat = leaves[leaf].reshape(-1).at[index].set(values[mine])
            leaves[leaf] = flat.reshape(leaves[leaf].shape)
        return eqx.combine(jax.tree.unflatten(structure, leaves), rest)


def name_places(model: PyTree) -> list[Place]:
    """Every floating-point number of a model: `lag`, `numerator[0]`, `axis.inertia[2]`."""
    arrays = eqx.filter(model, eqx.is_inexact_array)
    places = []
    for leaf, (path, array) in enumerate(jax.tree_util.tree_flatten_with_path(arrays)[0]):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        require_float64(f"parameter {name}", array)
        for index in range(array.size):
            place = np.unravel_index(index, array.shape)
            suffix = "".join(f"[{i}]" for i in place)
            places.append(Place(name + suffix, leaf, index))
    return places


def select_parameters(model: PyTree, free: Free) -> Parameters:
    """Resolve `free=` against the model; raises `ValueError` for what it cannot mean."""
    places = name_places(model)
    wanted = _expand(model, places, free)
    values = _numbers(model, places)
    chosen = [_choose(item, places, values) for item in wanted]
    names = [place.name for place, _, _ in chosen]
    if len(set(names)) != len(names) or not names:
        raise ValueError(f"free={names}: name each free parameter once, and at least one")
    fixed = [place for place in places if place.name not in names and values[place.name] != 0]
    logs = tuple(log for _, log, _ in chosen) + (True,) * len(fixed)
    scales = [scale for _, _, scale in chosen] + [np.sign(values[p.name]) for p in fixed]
    ordered = tuple(place for place, _, _ in chosen) + tuple(fixed)
    ratio = np.array([values[p.name] for p in ordered]) / np.array(scales)
    start = np.where(logs, np.log(np.where(logs, ratio, 1.0)), ratio)
    return Parameters(ordered, logs, len(chosen), jnp.asarray(scales, float), jnp.asarray(start))


def _expand(model: PyTree, places: list[Place], free: Free) -> list[str | Positive | Real]:
    if free is None:
        return [place.name for place in places]
    if callable(free):
        return _marked(model, places, free)
    items = []
    for item in [free] if isinstance(free, str | Positive | Real) else free:
        name = item if isinstance(item, str) else item.name
        whole = [place.name for place in places if place.name.startswith(f"{name}[")]
        items += whole if isinstance(item, str) and whole else [item]
    return items


def _marked(
    model: PyTree, places: list[Place], where: Callable[[PyTree], PyTree]
) -> list[str | Positive | Real]:
    arrays = eqx.filter(model, eqx.is_inexact_array)
    flags = jax.tree.map(lambda _: False, arrays)
    flags = eqx.tree_at(where, flags, replace_fn=lambda _: True)
    marked = jax.tree.leaves(flags)
    return [place.name for place in places if marked[place.leaf]]


def _numbers(model: PyTree, places: list[Place]) -> dict[str, float]:
    leaves = jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array))
    return {p.name: float(np.asarray(leaves[p.leaf]).reshape(-1)[p.index]) for p in places}


def _choose(
    item: str | Positive | Real, places: list[Place], values: dict[str, float]
) -> tuple[Place, bool, float]:
    name = item if isinstance(item, str) else item.name
    by_name = {place.name: place for place in places}
    if name not in by_name:
        raise ValueError(f"no parameter {name!r} in the model; it has: {', '.join(by_name)}")
    value = values[name]
    if not np.isfinite(value):
        raise ValueError(f"parameter {name} starts at {value}: give a finite starting value")
    if isinstance(item, Real):
        scale = item.scale or abs(value)
        if not scale > 0:
            raise ValueError(f"{name} starts at 0: say its size with jq.Real({name!r}, scale=...)")
        return by_name[name], False, scale
    if value == 0:
        raise ValueError(
            f"{name} starts at 0, so its sign is unknown: give a starting value, or let it cross "
            f"zero with jq.Real({name!r}, scale=...)"
        )
    return by_name[name], True, float(np.sign(value))
