"""What a loop is analysed from, checked once, for one member or an ensemble."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxquad._core import ensemble_shape
from jaxquad.control import LinearController, LinearisableController
from jaxquad.models import DecoupledAxes, Multirotor
from jaxquad.records import AXES

from ._loop import Loop
from ._sampled_axis import AxisParameters, parameters_of, sampled, SampledAxis


class LinearParts(eqx.Module):
    """One axis with its controller and delay; every part may have the shape of an ensemble."""

    axis: AxisParameters
    controller: Any
    delay: Float[Array, "..."] | None  # s; None without
    ensemble: tuple[int, ...] = eqx.field(static=True)
    member: tuple[int, ...] | None = eqx.field(static=True)
    index: int = eqx.field(static=True)  # of the axis
    memory: int = eqx.field(static=True)  # samples that a command may be on its way
    dt: float = eqx.field(static=True)

    def of_member(self, place: Any) -> tuple[SampledAxis, LinearController]:
        """Plant and controller of the member with the indices `place`."""
        axis = jax.tree.map(lambda x: _at(x, place), self.axis)
        delay = None if self.delay is None else _at(self.delay, place)
        plant = sampled(axis, delay, self.dt)
        if delay is not None:  # a traced one may be longer than it was said to be
            fresh = jnp.where(plant.shift < self.memory, plant.fresh, jnp.nan)
            plant = plant._replace(fresh=fresh)
        return plant, without_idle_states(self._linear(place))

    def ratio(self, place: Any) -> Float[Array, ""]:
        """b/b0 of a member, with a b0 of 1 for a controller that has none."""
        gain = _at(self.axis.torque_gain, place) / _at(self.axis.inertia, place)
        b0 = getattr(self.controller, "b0", None)
        if b0 is None:
            return gain
        return gain / _at(b0[self.index] if b0.ndim else b0, place)

    def _linear(self, place: Any) -> LinearController:
        if isinstance(self.controller, LinearController):
            return self.controller
        own = len(ensemble_shape(self.controller))
        return self.controller.linear(self.index, place[:own] if own else None)


def linear_parts(loop: Loop, axis: int | str, member: int | tuple[int, ...] | None) -> LinearParts:
    """The checked parts of one axis. Raises ValueError for what has no linear form."""
    plant, controller = loop.plant, loop.controller
    plant = plant.decoupled() if isinstance(plant, Multirotor) else plant
    _require_parts(plant, controller)
    axis = _index_of(axis, plant)
    memory = loop.memory
    ensemble = ensemble_shape(plant, controller, loop)
    if member is not None:
        member = member if isinstance(member, tuple) else (member,)
        _require_member(member, ensemble)
    delay = None if memory == 0 else loop.delay.astype(plant.inertia.dtype)
    parameters = parameters_of(plant, axis)
    return LinearParts(parameters, controller, delay, ensemble, member, axis, memory, loop.dt)


def _index_of(axis: int | str, plant: DecoupledAxes) -> int:
    if isinstance(axis, str):
        if axis not in AXES:
            raise ValueError(f"axis is {axis!r}: choose one of {', '.join(AXES)}, or a number")
        axis = AXES.index(axis)
    axes = max(plant.shape[0], axis + 1) if plant.shape[0] == 1 else plant.shape[0]
    if not 0 <= axis < axes:
        raise ValueError(f"axis is {axis}, but the plant has axes 0 to {axes - 1}.")
    return axis


def _require_parts(plant: Any, controller: Any) -> None:
    if not isinstance(plant, DecoupledAxes):
        raise ValueError(
            f"the plant is a {type(plant).__name__}: give jq.DecoupledAxes or a jq.models.Multirotor."
        )
    if not isinstance(controller, LinearController | LinearisableController):
        raise ValueError(
            f"{type(controller).__name__} has no method linear(axis, member) that returns a "
            "jq.control.LinearController: give it one, or pass the LinearController itself."
        )


def _require_member(member: tuple[int, ...], ensemble: tuple[int, ...]) -> None:
    if len(member) != len(ensemble) or not all(
        0 <= m < n for m, n in zip(member, ensemble, strict=True)
    ):
        raise ValueError(f"member is {member}, but the ensemble has the shape {ensemble}.")


def without_idle_states(controller: LinearController) -> LinearController:
    # A state that nothing drives, as the integral of a PID with ki = 0, stays at 0: it is no mode.
    A = controller.A
    others = jnp.where(jnp.eye(len(A), dtype=bool), 0, A)
    inputs = (controller.measurement_in != 0) | (controller.reference_in != 0)
    driven = jnp.any(others != 0, axis=1) | inputs
    return dataclasses.replace(controller, A=jnp.where(driven[:, None], A, 0))


def _at(x: Array, place: tuple[int | Int[Array, ""], ...]) -> Array:
    return x[tuple(0 if n == 1 else p for p, n in zip(place, x.shape, strict=False))]
