"""What a loop is analysed from, checked once, for one member or an ensemble."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxquad.control import LinearController
from jaxquad.models import DecoupledAxes, Multirotor

from ._sampled_axis import AxisParameters, parameters_of, sampled, SampledAxis


class Case(eqx.Module):
    """One axis with its controller and delay; every part may have the shape of an ensemble."""

    axis: AxisParameters
    controller: Any
    delay: Float[Array, "..."] | None  # s; None without
    ensemble: tuple[int, ...] = eqx.field(static=True)
    member: tuple[int, ...] | None = eqx.field(static=True)
    index: int = eqx.field(static=True)  # of the axis
    memory: int = eqx.field(static=True)  # samples that a command may be on its way
    dt: float = eqx.field(static=True)

    def parts(self, place: Any) -> tuple[SampledAxis, LinearController]:
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
        own = len(getattr(self.controller, "ensemble", ()))
        return self.controller.linear(self.index, place[:own] if own else None)


def case_of(
    plant: DecoupledAxes | Multirotor,
    controller: Any,
    axis: int,
    member: int | tuple[int, ...] | None,
    dt: float | None,
    delay: Any,
    longest_delay: float | None,
) -> Case:
    """The checked case. Raises ValueError for parts that do not fit together."""
    plant = plant.decoupled() if isinstance(plant, Multirotor) else plant
    _require_parts(plant, controller)
    dt = _interval(controller, dt)
    axes = max(plant.shape[0], axis + 1) if plant.shape[0] == 1 else plant.shape[0]
    if not 0 <= axis < axes:
        raise ValueError(f"axis is {axis}, but the plant has axes 0 to {axes - 1}.")
    # NumPy keeps a constant's value under jit.
    late = delay if isinstance(delay, Array) else np.asarray(delay, plant.inertia.dtype)
    memory = _memory(late, longest_delay, dt)
    shapes = (plant.shape[1:], getattr(controller, "ensemble", ()), late.shape)
    ensemble = _common(shapes)
    if member is not None:
        member = member if isinstance(member, tuple) else (member,)
        _require_member(member, ensemble)
    late = None if memory == 0 else jnp.asarray(late, plant.inertia.dtype)
    return Case(parameters_of(plant, axis), controller, late, ensemble, member, axis, memory, dt)


def _require_parts(plant: Any, controller: Any) -> None:
    if not isinstance(plant, DecoupledAxes):
        raise ValueError(
            f"the plant is a {type(plant).__name__}: give jq.DecoupledAxes or a jq.models.Multirotor."
        )
    if not isinstance(controller, LinearController) and not hasattr(controller, "linear"):
        raise ValueError(
            f"{type(controller).__name__} has no method linear(axis, member) that returns a "
            "jq.control.LinearController: give it one, or pass the LinearController itself."
        )


def _interval(controller: Any, dt: float | None) -> float:
    made_for = getattr(controller, "dt", None)
    given = made_for if dt is None else dt
    if given is None or not (given > 0 and math.isfinite(given)):
        raise ValueError(f"dt is {given} s: give the sample interval, above 0 and finite.")
    if made_for is not None and not math.isclose(made_for, given, rel_tol=1e-6):
        raise ValueError(f"the controller was made for samples of {made_for} s, not {given} s.")
    return float(given)


def _memory(delay: Any, longest: float | None, dt: float) -> int:
    traced = isinstance(delay, Tracer)
    if traced and not (longest is not None and longest > 0):
        raise ValueError(
            f"the delay is traced, so its length is unknown, and longest_delay is {longest}: give "
            "one above 0, in s."
        )
    if longest is None:
        longest = float(np.max(np.asarray(delay), initial=0.0))
    if not traced:
        values = np.asarray(delay)
        if not np.all((values >= 0) & np.isfinite(values)):
            raise ValueError(f"delay is {values} s, but it must be 0 or above and finite.")
        if np.max(values, initial=0.0) > longest:
            raise ValueError(f"delay is {values} s, above longest_delay, which is {longest} s.")
    if not 0 <= longest < math.inf:
        raise ValueError(f"longest_delay is {longest} s, but it must be 0 or above and finite.")
    return math.floor(longest / dt + 1e-9) + 1 if longest > 0 else 0


def _common(shapes: tuple[tuple[int, ...], ...]) -> tuple[int, ...]:
    longest = max(len(shape) for shape in shapes)
    try:
        return np.broadcast_shapes(*(shape + (1,) * (longest - len(shape)) for shape in shapes))
    except ValueError:
        raise ValueError(
            f"plant, controller and delay are for the ensembles {shapes}, which do not match."
        ) from None


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
