"""The linear loops of some axes of all members, and one axis from sample to sample, exactly."""

import dataclasses
import functools as ft
import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxquad._compile import brief_options, Jit
from jaxquad._core import ensemble_shape
from jaxquad.control import LinearController, LinearisableController
from jaxquad.models import LinearAxis, matrix_exponential, split_delay
from jaxquad.records import AXES

from ._loop import Loop
from ._protocols import assumed_gain, LinearisablePlant


class SampledAxis(NamedTuple):
    """x+ = transition x + fresh u[k - shift] + stale u[k - shift - 1] + push d, angle = x[0].

    The states are those of a `LinearAxis`, its rate times dt. The command u and the disturbance
    torque d are held over a sample; the command acts late.
    """

    transition: Float[Array, "states states"]
    fresh: Float[Array, " states"]
    stale: Float[Array, " states"]
    push: Float[Array, " states"]
    shift: Int[Array, ""]  # whole samples of the delay


def sample_axis(axis: LinearAxis, delay: Float[Array, ""] | None, dt: float) -> SampledAxis:
    """The axis between samples `dt` seconds apart, its command `delay` seconds late."""
    flow, command, torque = _in_samples(axis, dt)
    whole = _propagate(flow, jnp.stack([command, torque], axis=1), jnp.ones((), flow.dtype))
    states = len(flow)
    transition, driven, push = whole[:, :states], whole[:, states], whole[:, states + 1]
    if delay is None:
        return SampledAxis(transition, driven, jnp.zeros_like(driven), push, jnp.zeros((), int))
    shift, late = split_delay(delay, dt)
    fresh = _propagate(flow, command[:, None], 1 - late)[:, states]
    return SampledAxis(transition, fresh, driven - fresh, push, shift)


def _in_samples(
    axis: LinearAxis, dt: float
) -> tuple[Float[Array, "states states"], Float[Array, " states"], Float[Array, " states"]]:
    # Time in samples, so that the entries have one size whatever the sample interval.
    unit = np.ones(len(axis.command))
    unit[1] = dt  # of the rate
    entries = jnp.asarray(dt * unit[:, None] / unit[None], axis.A.dtype)
    inputs = jnp.asarray(dt * unit, axis.A.dtype)
    return axis.A * entries, axis.command * inputs, axis.torque * inputs


def _propagate(
    flow: Float[Array, "states states"],
    inputs: Float[Array, "states inputs"],
    time: Float[Array, ""],
) -> Float[Array, "states columns"]:
    """What held inputs and the state make of the state after `time`: Van Loan's augmentation."""
    states, columns = inputs.shape
    both = jnp.concatenate([flow, inputs], axis=1) * time
    return matrix_exponential(jnp.pad(both, ((0, columns), (0, 0))))[:states]


Place = tuple[Int[Array, ""], ...]  # of a member


class LinearParts(eqx.Module):
    """Plant, controller and delay of many linear loops, one after the other on a first axis."""

    plant: LinearAxis
    controller: LinearController
    delay: Float[Array, " loops"] | None  # s; None without
    ratio: Float[Array, " loops"]  # b/b0, with a b0 of 1 for a controller that has none
    memory: int = eqx.field(static=True)  # samples that a command may be on its way
    dt: float = eqx.field(static=True)  # s

    @property
    def count(self) -> int:
        """How many loops there are."""
        return len(self.ratio)

    def at(self, k: int) -> "LinearParts":
        """One of the loops."""
        return jax.tree.map(lambda x: x[k], self)

    def sampled(self) -> tuple[SampledAxis, LinearController]:
        """Plant and controller of a single loop, from sample to sample."""
        plant = sample_axis(self.plant, self.delay, self.dt)
        if self.delay is not None:  # a traced one may be longer than it was said to be
            fresh = jnp.where(plant.shift < self.memory, plant.fresh, jnp.nan)
            plant = plant._replace(fresh=fresh)
        return plant, self.controller


def linear_parts(
    loop: Loop,
    axes: Sequence[int],
    member: int | tuple[int, ...] | None = None,
    *,
    states: int = 0,
) -> tuple[LinearParts, tuple[int, ...]]:
    """The linear loops of all members, or of one, axis by axis; and the shape of the ensemble.

    Controllers get as many `states` at least, of which those in excess do nothing: then controllers
    of any kind share what is compiled. Raises ValueError for what has no linear form.
    """
    plant, controller = loop.plant, loop.controller
    if not isinstance(plant, LinearisablePlant):
        raise ValueError(
            f"{type(plant).__name__} has no method linearise(axis) that returns a "
            "jq.models.LinearAxis: add it, as jq.DecoupledAxes has it"
        )
    if not isinstance(controller, LinearController | LinearisableController):
        raise ValueError(
            f"{type(controller).__name__} has no method linear(axis, member) that returns a "
            "jq.control.LinearController: give it one, or pass the LinearController itself."
        )
    ensemble = ensemble_shape(loop)
    if member is not None:
        member = member if isinstance(member, tuple) else (member,)
        _require_member(member, ensemble)
    places = _places_of(ensemble, member)
    dt, delay = loop.dt, loop.delay if loop.memory else None
    given = _linearised(plant, controller, delay, tuple(axes), places, states, dt)
    physical, sampled, late, ratio = given
    parts = LinearParts(physical, sampled, late, ratio, loop.memory, dt)
    return parts, () if member is not None else ensemble


def _places_of(
    ensemble: tuple[int, ...], member: tuple[int, ...] | None
) -> tuple[Int[np.ndarray, " members"], ...]:
    """The indices of the members, one array for each axis of the ensemble."""
    if member is not None:
        return tuple(np.array([k]) for k in member)
    return tuple(x.ravel() for x in np.indices(ensemble)) if ensemble else ()


@ft.partial(Jit, options=brief_options)
def _linearised(
    plant: LinearisablePlant,
    controller: LinearController | LinearisableController,
    delay: Float[Array, "..."] | None,
    axes: tuple[int, ...],
    places: tuple[Int[Array | np.ndarray, " members"], ...],
    states: int,
    dt: float,
) -> tuple[LinearAxis, LinearController, Float[Array, " loops"] | None, Float[Array, " loops"]]:
    own = len(ensemble_shape(controller))

    def of_axis(axis: int) -> tuple:
        linear, b0 = plant.linearise(axis), jnp.asarray(assumed_gain(controller, axis))

        def of_member(*place: Int[Array, ""]) -> tuple:
            at = lambda x, rank: _at(x, rank, place)
            physical = LinearAxis(
                at(linear.A, 2), at(linear.command, 1), at(linear.torque, 1), at(linear.gain, 0)
            )
            late = None if delay is None else at(delay.astype(linear.A.dtype), 0)
            sampled = _linear_form(controller, axis, place[:own] if own else None)
            _require_interval(sampled, dt)
            return (
                physical,
                _padded(_without_idle_states(sampled), states),
                late,
                at(linear.gain, 0) / (at(b0.astype(linear.gain.dtype), 0)),
            )

        if not places:
            return jax.tree.map(lambda x: jnp.asarray(x)[None], of_member())
        return jax.vmap(of_member)(*(jnp.asarray(x) for x in places))

    return jax.tree.map(lambda *rows: jnp.concatenate(rows), *(of_axis(k) for k in axes))


def _linear_form(
    controller: LinearController | LinearisableController, axis: int, place: Place | None
) -> LinearController:
    if isinstance(controller, LinearController):
        return controller
    return controller.linear(axis, place)


def _require_interval(controller: LinearController, dt: float) -> None:
    if not math.isclose(controller.dt, dt, rel_tol=1e-6):
        raise ValueError(
            f"the controller's linear form is for samples of {controller.dt} s, the loop's are "
            f"{dt} s: give the loop dt={controller.dt}"
        )


def axis_index(axis: int | str) -> int:
    """The number of an axis. Raises ValueError for a name that it does not have."""
    if isinstance(axis, int):
        if axis < 0:
            raise ValueError(f"axis is {axis}: give 0 or above, or one of {', '.join(AXES)}")
        return axis
    if axis not in AXES:
        raise ValueError(f"axis is {axis!r}: choose one of {', '.join(AXES)}, or a number")
    return AXES.index(axis)


def _require_member(member: tuple[int, ...], ensemble: tuple[int, ...]) -> None:
    if len(member) != len(ensemble) or not all(
        0 <= m < n for m, n in zip(member, ensemble, strict=True)
    ):
        raise ValueError(
            f"member is {member}, but the ensemble has the shape {ensemble}: give one index each"
        )


def _without_idle_states(controller: LinearController) -> LinearController:
    # A state that nothing drives, as the integral of a PID with ki = 0, stays at 0: it is no mode.
    A = controller.A
    others = jnp.where(jnp.eye(len(A), dtype=bool), 0, A)
    inputs = (controller.measurement_in != 0) | (controller.reference_in != 0)
    driven = jnp.any(others != 0, axis=1) | inputs
    return dataclasses.replace(controller, A=jnp.where(driven[:, None], A, 0))


def _padded(controller: LinearController, states: int) -> LinearController:
    """With further states that nothing drives and nothing reads."""
    extra = max(0, states - len(controller.C))
    longer = lambda x: jnp.pad(x, (0, extra))
    return dataclasses.replace(
        controller,
        A=jnp.pad(controller.A, ((0, extra), (0, extra))),
        reference_in=longer(controller.reference_in),
        measurement_in=longer(controller.measurement_in),
        C=longer(controller.C),
    )


def _at(x: Array, rank: int, place: Place) -> Array:
    """The value of a member, of an array whose ensemble axes follow the first `rank`."""
    own = (slice(None),) * rank
    return x[own + tuple(0 if n == 1 else p for p, n in zip(place, x.shape[rank:], strict=False))]
