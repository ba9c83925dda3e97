"""Which numbers of a model are free, under which names, and how each is scaled."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._core import require_float64


class Positive(NamedTuple):
    """A free parameter that keeps the sign of its starting value; its logarithm is fitted."""

    name: str


class Real(NamedTuple):
    """A free parameter that may cross zero; `scale` is its typical size, by default |start|."""

    name: str
    scale: float | None = None


Free = Sequence[str | Positive | Real] | Callable[[PyTree], PyTree] | None


class Place(NamedTuple):
    """Where a named number sits in a model: which array, and which of its elements."""

    name: str
    leaf: int
    index: int


Tie = Callable[[PyTree], Float[Array, ""]]


class Parameters(eqx.Module):
    """Free numbers first, then the fixed nonzero ones; `z` is the vector that a solver moves.

    Tied numbers follow the others: each is a function of the model.
    """

    places: tuple[Place, ...] = eqx.field(static=True)
    ties: tuple[tuple[Place, Tie], ...] = eqx.field(static=True)
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

    def insert(self, model: PyTree, z: Float[Array, " n"]) -> PyTree:
        """The model with its first `n` parameters set, and what is tied to them."""
        return self.replace(model, self.values(z))

    def replace(self, model: PyTree, values: Float[Array, " n"]) -> PyTree:
        """The model with other physical values of its first `n` parameters."""
        model = with_values(model, self.places[: values.shape[0]], values)
        for place, tie in self.ties:
            value = jnp.asarray(tie(model))
            if value.shape != ():
                raise ValueError(
                    f"{place.name} is tied to an array of shape {value.shape}: return one number"
                )
            model = with_values(model, (place,), value[None])
        return model


def with_values(model: PyTree, places: Sequence[Place], values: Float[Array, " n"]) -> PyTree:
    """Return `model` with the numbers at `places` replaced by `values`."""
    arrays, rest = eqx.partition(model, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
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


def select_parameters(
    model: PyTree, free: Free, tied: Mapping[str, Tie] | None = None
) -> Parameters:
    """The free and tied parameters of a model, as `jq.fit` takes them.

    **Arguments:**

    - `model`: any `eqx.Module`.
    - `free`, `tied`: as in `jq.fit`.

    **Raises:**

    - `ValueError`: a name that the model does not have, is given twice, or starts at 0 or inf.
    """
    places = name_places(model)
    ties = _tied(places, tied or {})
    bound = {place.name for place, _ in ties}
    wanted = _expand(model, [p for p in places if free is not None or p.name not in bound], free)
    values = _numbers(model, places)
    chosen = [_choose(item, places, values) for item in wanted]
    names = [place.name for place, _, _ in chosen]
    if len(set(names)) != len(names) or not names:
        raise ValueError(f"free={names}: name each free parameter once, and at least one")
    both = bound.intersection(names)
    if both:
        raise ValueError(
            f"{sorted(both)} cannot be free and tied at once: leave out one of the two"
        )
    taken = bound.union(names)
    fixed = [place for place in places if place.name not in taken and values[place.name] != 0]
    logs = tuple(log for _, log, _ in chosen) + (True,) * len(fixed)
    scales = [scale for _, _, scale in chosen] + [np.sign(values[p.name]) for p in fixed]
    ordered = tuple(place for place, _, _ in chosen) + tuple(fixed)
    ratio = np.array([values[p.name] for p in ordered]) / np.array(scales)
    start = np.where(logs, np.log(np.where(logs, ratio, 1.0)), ratio)
    return Parameters(
        ordered, ties, logs, len(chosen), jnp.asarray(scales, float), jnp.asarray(start)
    )


def _tied(places: list[Place], tied: Mapping[str, Tie]) -> tuple[tuple[Place, Tie], ...]:
    by_name = {place.name: place for place in places}
    for name, tie in tied.items():
        if name not in by_name:
            raise ValueError(f"no parameter {name!r} to tie; the model has: {', '.join(by_name)}")
        if not callable(tie):
            raise ValueError(
                f"{name} is tied to {tie!r}: give a function of the model, "
                "lambda m: -m.F[0, 1]; a plain number belongs in the model"
            )
    return tuple((by_name[name], tie) for name, tie in tied.items())


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
            raise ValueError(
                f"{name} starts at 0: give its typical size, jq.identify.Real({name!r}, scale=...)"
            )
        return by_name[name], False, scale
    if value == 0:
        raise ValueError(
            f"{name} starts at 0, so its sign is unknown: give a starting value, or let it cross "
            f"zero with jq.identify.Real({name!r}, scale=...)"
        )
    return by_name[name], True, float(np.sign(value))
