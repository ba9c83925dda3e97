"""Controllers whose gains follow from the inertia that they are told."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import as_float, ensemble_shape, require_positive, require_shapes, times

from ._ladrc import LADRC
from ._pid import PID
from .inertia._maps import FuzzyMap, InertiaMap


InertiaToGain = Callable[[Array], Array]  # kg m^2 to b0 in rad/s^2 per unit of command


class ScheduledLADRC(eqx.Module):
    """A `LADRC` whose b0 is `map(inertia)` of an inertia that it is told, in kg m^2.

    The `ladrc`'s own b0 has no effect. It flies and is analysed as `told(inertia)`; exported to C,
    it is told in flight. Source: Eq. (25) with the map of docs/control.md.
    """

    ladrc: LADRC
    map: InertiaToGain

    @property
    def dt(self) -> float:
        return self.ladrc.dt

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of all gains, () for one controller."""
        return _ensemble(self.ladrc, self.map)

    def told(self, inertia: Float[ArrayLike, "..."]) -> LADRC:
        """The LADRC of each member at the `inertia` that it is told, in kg m^2.

        Raises ValueError for an inertia that is not above 0 or does not fit the map's axes.
        """
        return dataclasses.replace(self.ladrc, b0=gain_at(self.map, inertia))


class ScheduledPID(eqx.Module):
    """A `PID` of the acceleration: its gains are divided by `map(inertia)`, as a LADRC's by b0.

    kp, ki and kd of `pid` are those of b u: rad/s^2 per rad, per rad s and per rad/s; its
    feedforward is the share of the reference's acceleration, 1 for all of it. The filters, weights,
    limit and anti-windup are what they are. It flies and is analysed as `told(inertia)`.
    """

    pid: PID
    map: InertiaToGain

    @property
    def dt(self) -> float:
        return self.pid.dt

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of all gains, () for one controller."""
        return _ensemble(self.pid, self.map)

    def told(self, inertia: Float[ArrayLike, "..."]) -> PID:
        """The PID of each member at the `inertia` that it is told, in kg m^2.

        Raises ValueError for an inertia that is not above 0 or does not fit the map's axes.
        """
        per_gain = 1 / gain_at(self.map, inertia)
        names = ("kp", "ki", "kd", "feedforward")
        scaled = {name: times(getattr(self.pid, name), per_gain) for name in names}
        return dataclasses.replace(self.pid, **scaled)


def told(controller: Any, inertia: Float[ArrayLike, "..."]) -> Any:
    """`controller.told(inertia)` if there is such a method, else the controller: what to linearise.

    An adaptive controller becomes the one that it is once its estimate has reached `inertia`.
    """
    return controller.told(inertia) if hasattr(controller, "told") else controller


def flown(controller: Any, inertia: Float[ArrayLike, "..."]) -> Any:
    """What to simulate of `controller`: a scheduled one as told, any that can step as it is."""
    return controller if hasattr(controller, "step") else told(controller, inertia)


def gain_at(map: InertiaToGain, inertia: Float[ArrayLike, "..."]) -> Array:
    """b0 at an inertia in kg m^2, for all the members of `map` and inertia.

    Raises ValueError for an inertia that is not above 0 or does not fit the map's axes.
    """
    inertia = as_float(inertia)
    require_positive("the inertia told", inertia, "give kg m^2")
    if inertia.ndim == 0:
        raise ValueError(f"the inertia told is {inertia}: give one value per axis, in kg m^2.")
    arrays = _arrays(map)
    require_shapes({"inertia": inertia} | arrays)
    ensemble = ensemble_shape({"inertia": inertia} | arrays, rank=1)
    wide = inertia.reshape(inertia.shape + (1,) * (1 + len(ensemble) - inertia.ndim))
    return as_float(map(jnp.broadcast_to(wide, (len(inertia), *ensemble))))


def _arrays(map: InertiaToGain) -> dict[str, Array]:
    """What one of the library's maps has per axis; nothing of any other function."""
    if isinstance(map, InertiaMap):
        return {"nominal": map.nominal, "values": map.values[0]}
    return {"nominal": map.nominal, "b0": map.b0} if isinstance(map, FuzzyMap) else {}


def _ensemble(controller: LADRC | PID, map: InertiaToGain) -> tuple[int, ...]:
    shapes = controller.ensemble, getattr(map, "ensemble", ())
    rank = max(len(shape) for shape in shapes)
    return np.broadcast_shapes(*(shape + (1,) * (rank - len(shape)) for shape in shapes))
