"""Where a tuner must not step: controllers that refuse their numbers, or whose observer fails."""

from collections.abc import Iterator

import equinox as eqx
import numpy as np
from jaxtyping import Float, PyTree

from jaxquad._core import as_array
from jaxquad.control import ObserverController

from ._parameters import build_design, Coordinates
from ._verdict import Bound


_NEAR, _FLAT = 0.02, 1e-3  # nepers to a bound, and the slope per neper that pushes against it


def find_refusal(coordinates: Coordinates, z: Float[np.ndarray, " n"]) -> str:
    """Why the controller at `z` cannot be built or must not be flown; empty if it can."""
    return refusal_of(build_design(coordinates, as_array(z)))


def refusal_of(controller: PyTree) -> str:
    """As `find_refusal`, of a controller that was not checked when it was made."""
    for part in _iter_modules(controller):
        try:
            _check_again(part)
        except ValueError as error:
            return str(error)
    if not isinstance(controller, ObserverController):
        return ""
    return controller.observer_instability() or controller.observer_slowness()


def find_bounds(
    coordinates: Coordinates, z: Float[np.ndarray, " n"], gradient: Float[np.ndarray, " n"]
) -> tuple[Bound, ...]:
    """The numbers that could lower the cost if the controller allowed them a small step more."""
    found, values = [], coordinates.values(z)
    for k, name in enumerate(values):
        step = np.zeros_like(z)
        step[k] = -_NEAR * np.sign(gradient[k])
        if abs(gradient[k]) > _FLAT and (why := find_refusal(coordinates, z + step)):
            found.append(Bound(name, values[name], why))
    return tuple(found)


def _check_again(module: eqx.Module) -> None:
    """Raise ValueError where the module would refuse to be built with the values it has."""
    for kind in type(module).__mro__:
        if "__check_init__" in vars(kind):
            vars(kind)["__check_init__"](module)


def _iter_modules(tree: PyTree) -> Iterator[eqx.Module]:
    """`tree` and the modules in it."""
    if isinstance(tree, eqx.Module):
        yield tree
        for part in vars(tree).values():
            yield from _iter_modules(part)
