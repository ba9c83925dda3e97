"""Which numbers of a controller are tuned, and the coordinates in which they are."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad.control import AdaptiveLADRC, InertiaMap, LADRC, PID, ScheduledLADRC, ScheduledPID
from jaxquad.identify import Free, name_places, Parameters, Place, select_parameters, with_values


_SHARPNESS = 20.0
FLATTEST = 0.05  # nepers from knot to knot that a start is given at least: a flat one has no slope


def falling(z: Float[Array, "knots columns"]) -> Float[Array, "knots columns"]:
    """The first row as it is, each further one softplus(20 z) / 20 below the last."""
    drops = jax.nn.softplus(_SHARPNESS * z[1:]) / _SHARPNESS
    return z[:1] - jnp.concatenate([jnp.zeros_like(z[:1]), jnp.cumsum(drops, axis=0)])


def falling_inverse(
    values: Float[np.ndarray, "knots columns"],
) -> Float[np.ndarray, "knots columns"]:
    """The z whose `falling` is nearest to `values`, in which rows that do not fall are flat."""
    drops = np.maximum(values[:-1] - values[1:], FLATTEST)
    return np.concatenate([values[:1], np.log(np.expm1(_SHARPNESS * drops)) / _SHARPNESS])


_OF_PID = ("kp", "ki", "kd", "filter", "proportional_weight")


class Row(eqx.Module):
    """The knots of a map, which fall; a column for each axis."""

    name: str = eqx.field(static=True)
    places: tuple[Place, ...] = eqx.field(static=True)
    shape: tuple[int, int] = eqx.field(static=True)
    start: Float[Array, " numbers"]


class Coordinates(eqx.Module):
    """Tuned numbers as one vector: logarithms of gains, the falling knots of maps.

    `parameters` are those of `jq.fit`, for all numbers that are in no map.
    """

    controller: PyTree
    parameters: Parameters | None
    rows: tuple[Row, ...]

    @property
    def start(self) -> Float[np.ndarray, " n"]:
        gains = (
            []
            if self.parameters is None
            else [np.asarray(self.parameters.start)[: self.parameters.count]]
        )
        return np.concatenate([np.asarray(x) for x in [*gains, *(row.start for row in self.rows)]])

    @property
    def names(self) -> tuple[str, ...]:
        names = () if self.parameters is None else self.parameters.names
        return names + tuple(place.name for row in self.rows for place in row.places)

    def controller_at(self, z: Float[Array, " n"]) -> Any:
        """The controller with its tuned numbers set."""
        controller, first = self.controller, 0
        if self.parameters is not None:
            first = self.parameters.count
            controller = self.parameters.insert(controller, z[:first])
        for row in self.rows:
            values = falling(z[first : first + len(row.places)].reshape(row.shape))
            controller = with_values(controller, row.places, values.reshape(-1))
            first += len(row.places)
        return controller

    def values(self, z: Float[np.ndarray, " n"]) -> dict[str, float]:
        """The tuned numbers by name."""
        tuned = design_at(self, jnp.asarray(z))
        held = [np.asarray(x).reshape(-1) for x in _leaves(tuned)]
        by_name = {place.name: float(held[place.leaf][place.index]) for place in self._places}
        return {name: by_name[name] for name in self.names}

    @property
    def _places(self) -> list[Place]:
        return name_places(self.controller)


@eqx.filter_jit
def design_at(coordinates: Coordinates, z: Float[Array, " n"]) -> Any:
    """`coordinates.controller_at(z)`, compiled as one."""
    return coordinates.controller_at(z)


def coordinates(controller: Any, free: Free = None) -> Coordinates:
    """Of a controller and of `free`, as in `jq.fit`; None is what its class makes sense of.

    The knots `values` of an `InertiaMap` that are named as a whole stay falling. Raises ValueError
    for names that do not exist, for numbers that start at 0 without a scale, and in float32.
    """
    if getattr(controller, "ensemble", ()):
        raise ValueError(
            f"the controller is an ensemble of {controller.ensemble}: give one controller; "
            "a tune makes its own copies for members and starts"
        )
    free = _default(controller) if free is None else free
    places = name_places(controller)
    wanted = [free] if isinstance(free, str) else free
    rows, others = [], []
    for item in wanted if not callable(wanted) else ():
        row = _row(controller, item, places) if isinstance(item, str) else None
        rows.append(row) if row is not None else others.append(item)
    chosen = wanted if callable(wanted) else others
    parameters = select_parameters(controller, chosen) if callable(chosen) or chosen else None
    if parameters is None and not rows:
        raise ValueError('free is empty: name the numbers to tune, as ["wc", "wo"]')
    return Coordinates(controller, parameters, tuple(rows))


def _default(controller: Any) -> list[str]:
    if isinstance(controller, LADRC):
        return ["wc", "wo", "b0"]
    if isinstance(controller, PID):
        return _gains_of(controller, "")
    if isinstance(controller, ScheduledLADRC | AdaptiveLADRC):
        return ["ladrc.wc", "ladrc.wo", "map.values"]
    if isinstance(controller, ScheduledPID):
        # Its map's size and that of all gains are one and the same: kd stays.
        return [name for name in _gains_of(controller.pid, "pid.") if name != "pid.kd"] + [
            "map.values"
        ]
    raise ValueError(
        f"which numbers of a {type(controller).__name__} are to be tuned is not known: name them, "
        "free=[...], as in jq.fit"
    )


def _gains_of(pid: PID, prefix: str) -> list[str]:
    names = [name for name in _OF_PID if np.all(np.asarray(getattr(pid, name)) != 0)]
    if getattr(pid, "measurement_filter", None) is not None:
        names.append("measurement_filter")
    return [prefix + name for name in names]


def _row(controller: Any, name: str, places: list[Place]) -> Row | None:
    """The row of knots of that name, if it is one of an `InertiaMap`."""
    owner, _, last = name.rpartition(".")
    part = controller
    for step in owner.split(".") if owner else ():
        part = getattr(part, step, None)
    if last != "values" or not isinstance(part, InertiaMap):
        return None
    values = np.asarray(part.values)
    mine = tuple(place for place in places if place.name.startswith(f"{name}["))
    columns = values.reshape(values.shape[0], -1)
    return Row(name, mine, columns.shape, jnp.asarray(falling_inverse(columns).reshape(-1)))


def _leaves(model: Any) -> list[Array]:
    return jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array))
