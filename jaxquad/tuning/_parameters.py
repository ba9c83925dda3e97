"""Which numbers of a controller are tuned, and the coordinates in which they are."""

from collections.abc import Iterator

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._core import as_array, ensemble_shape
from jaxquad.control import find_transform, ObserverController, Transform, Tunable
from jaxquad.identify import Free, name_places, Parameters, Place, select_parameters, with_values

from ._verdict import Bound


class Block(eqx.Module):
    """An array that is tuned as a whole, in the coordinates of its `transform`."""

    places: tuple[Place, ...] = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)
    transform: Transform
    start: Float[Array, " numbers"]

    def values(self, z: Float[Array, " numbers"]) -> Float[Array, " numbers"]:
        """The elements of the array at the coordinates `z`."""
        return self.transform.forward(z.reshape(self.shape)).reshape(-1)


class Coordinates(eqx.Module):
    """Tuned numbers as one vector z: logarithms of gains first, then the arrays in `blocks`.

    `parameters` are those of `jq.fit`, for all numbers that are in no block.
    """

    controller: PyTree
    parameters: Parameters | None
    blocks: tuple[Block, ...]

    @property
    def start(self) -> Float[np.ndarray, " n"]:
        """z of the controller as it was given."""
        gains = (
            []
            if self.parameters is None
            else [np.asarray(self.parameters.start)[: self.parameters.count]]
        )
        return np.concatenate([*gains, *(np.asarray(block.start) for block in self.blocks)])

    @property
    def names(self) -> tuple[str, ...]:
        """The name of each tuned number."""
        names = () if self.parameters is None else self.parameters.names
        return names + tuple(place.name for block in self.blocks for place in block.places)

    @property
    def arrays(self) -> frozenset[str]:
        """The names of the arrays that the tuned numbers are in."""
        return frozenset(name.partition("[")[0] for name in self.names)

    def controller_at(self, z: Float[Array, " n"]) -> PyTree:
        """The controller with its tuned numbers set."""
        controller, first = self.controller, 0
        if self.parameters is not None:
            first = self.parameters.count
            controller = self.parameters.insert(controller, z[:first])
        for block in self.blocks:
            values = block.values(z[first : first + len(block.places)])
            controller = with_values(controller, block.places, values)
            first += len(block.places)
        return controller

    def values(self, z: Float[np.ndarray, " n"]) -> dict[str, float]:
        """The tuned numbers by name."""
        tuned = eqx.filter(build_design(self, as_array(z)), eqx.is_inexact_array)
        leaves = [np.asarray(x).reshape(-1) for x in jax.tree.leaves(tuned)]
        places = {place.name: place for place in name_places(self.controller)}
        at = lambda place: float(leaves[place.leaf][place.index])
        return {name: at(places[name]) for name in self.names}


@eqx.filter_jit
def build_design(coordinates: Coordinates, z: Float[Array, " n"]) -> PyTree:
    """`coordinates.controller_at(z)`, compiled as one."""
    return coordinates.controller_at(z)


def select_coordinates(controller: PyTree, free: Free = None) -> Coordinates:
    """The coordinates in which a controller is tuned.

    **Arguments:**

    - `controller`: the start.
    - `free`: the numbers to tune, as in `jq.fit`; by default those that `controller.tunable()`
        names. An array that is named as a whole, and that has a transform of its own, such as the
        knots of a `jq.control.InertiaMap`, is tuned in the coordinates of that.

    **Raises:**

    - `ValueError`: names that do not exist, a number that starts at 0, an ensemble of controllers,
        or single precision.
    """
    if ensemble := ensemble_shape(controller):
        raise ValueError(
            f"the controller is an ensemble of {ensemble}: give one controller; "
            "a tune makes its own copies for members and starts"
        )
    if free is None and not isinstance(controller, Tunable):
        raise ValueError(
            f"a {type(controller).__name__} does not say which of its numbers are tuned: name "
            'them, free=["kp", "kd"], or give it a method tunable()'
        )
    free = list(controller.tunable()) if free is None else free
    places = name_places(controller)
    blocks: list[Block] = []
    chosen = free
    if not callable(free):
        chosen = []
        for item in [free] if isinstance(free, str) else free:
            block = _block(controller, item, places) if isinstance(item, str) else None
            blocks.append(block) if block is not None else chosen.append(item)
    parameters = select_parameters(controller, chosen) if callable(chosen) or chosen else None
    if parameters is None and not blocks:
        raise ValueError('free is empty: name the numbers to tune, as ["wc", "wo"]')
    return Coordinates(controller, parameters, tuple(blocks))


def _block(controller: PyTree, name: str, places: list[Place]) -> Block | None:
    """The array of that name, if a part of the controller declares coordinates for it."""
    transform = find_transform(controller, name)
    if transform is None:
        return None
    mine = tuple(p for p in places if p.name == name or p.name.startswith(f"{name}["))
    leaves = jax.tree.leaves(eqx.filter(controller, eqx.is_inexact_array))
    values = np.asarray(leaves[mine[0].leaf])
    start = np.asarray(transform.inverse(values))
    return Block(mine, values.shape, transform, as_array(start.reshape(-1)))


_NEAR, _FLAT = 0.02, 1e-3  # nepers to a bound, and the slope per neper that pushes against it


def find_refusal(coordinates: Coordinates, z: Float[np.ndarray, " n"]) -> str:
    """Why the controller at `z` cannot be built or must not be flown; empty if it can."""
    return refusal_of(build_design(coordinates, as_array(z)))


def refusal_of(controller: PyTree) -> str:
    """As `find_refusal`, of a controller that was not checked when it was made."""
    for part in _iter_modules(controller):
        try:
            for kind in type(part).__mro__:  # as when it is made
                if "__check_init__" in vars(kind):
                    vars(kind)["__check_init__"](part)
        except ValueError as error:
            return str(error)
    if not isinstance(controller, ObserverController):
        return ""
    return controller.observer_instability() or controller.observer_slowness()


def find_bounds(
    coordinates: Coordinates, z: Float[np.ndarray, " n"], gradient: Float[np.ndarray, " n"]
) -> tuple[Bound, ...]:
    """The numbers that could lower the cost if the controller allowed them a small step more."""
    bounds, values = [], coordinates.values(z)
    for k, name in enumerate(values):
        step = np.zeros_like(z)
        step[k] = -_NEAR * np.sign(gradient[k])
        if abs(gradient[k]) > _FLAT and (why := find_refusal(coordinates, z + step)):
            bounds.append(Bound(name, values[name], why))
    return tuple(bounds)


def _iter_modules(tree: PyTree) -> Iterator[eqx.Module]:
    """`tree` and the modules in it."""
    if isinstance(tree, eqx.Module):
        yield tree
        for part in vars(tree).values():
            yield from _iter_modules(part)
