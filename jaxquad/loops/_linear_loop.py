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
from jaxtyping import Array, Complex, Float, Int

from jaxquad._compile import brief_options, Jit
from jaxquad._core import ensemble_shape
from jaxquad.control import LinearController, LinearisableController
from jaxquad.models import imaginary, LinearAxis, matrix_exponential, split_delay
from jaxquad.records import AXES

from ._loop import Loop
from ._protocols import assumed_gain, LinearisablePlant
from ._spectrum import balance


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
    # Time in samples, so that the entries have one size whatever the sample interval.
    unit = np.ones(len(axis.command))
    unit[1] = dt  # of the rate
    inputs = jnp.asarray(dt * unit, axis.A.dtype)
    flow = axis.A * jnp.asarray(dt * unit[:, None] / unit[None], axis.A.dtype)
    command, torque = axis.command * inputs, axis.torque * inputs
    augmented = _propagate(flow, jnp.stack([command, torque], axis=1), jnp.ones((), flow.dtype))
    states = len(flow)
    transition, driven, push = augmented[:, :states], augmented[:, states], augmented[:, states + 1]
    if delay is None:
        return SampledAxis(transition, driven, jnp.zeros_like(driven), push, jnp.zeros((), int))
    shift, late = split_delay(delay, dt)
    fresh = _propagate(flow, command[:, None], 1 - late)[:, states]
    return SampledAxis(transition, fresh, driven - fresh, push, shift)


def _propagate(
    flow: Float[Array, "states states"],
    inputs: Float[Array, "states inputs"],
    time: Float[Array, ""],
) -> Float[Array, "states columns"]:
    """What held inputs and the state make of the state after `time`: Van Loan's augmentation."""
    states, columns = inputs.shape
    both = jnp.concatenate([flow, inputs], axis=1) * time
    return matrix_exponential(jnp.pad(both, ((0, columns), (0, 0))))[:states]


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
        if len(member) != len(ensemble) or not all(
            0 <= m < n for m, n in zip(member, ensemble, strict=True)
        ):
            raise ValueError(
                f"member is {member}, but the ensemble has the shape {ensemble}: give one index "
                "each"
            )
    # The indices of the members, one array for each axis of the ensemble.
    places = [x.ravel() for x in np.indices(ensemble)] if ensemble else []
    places = tuple(places if member is None else [np.array([k]) for k in member])
    dt, delay = loop.dt, loop.delay if loop.memory else None
    physical, sampled, late, ratio = _linearised(
        plant, controller, delay, tuple(axes), places, states, dt
    )
    parts = LinearParts(physical, sampled, late, ratio, loop.memory, dt)
    return parts, () if member is not None else ensemble


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
    rank = len(ensemble_shape(controller))

    def of_axis(axis: int) -> tuple:
        linear, b0 = plant.linearise(axis), jnp.asarray(assumed_gain(controller, axis))

        def of_member(*place: Int[Array, ""]) -> tuple:
            def at(x: Array, rank: int) -> Array:
                """Of an array whose ensemble axes follow the first `rank`."""
                sizes = zip(place, x.shape[rank:], strict=False)
                return x[(slice(None),) * rank + tuple(0 if n == 1 else p for p, n in sizes)]

            physical = LinearAxis(
                at(linear.A, 2), at(linear.command, 1), at(linear.torque, 1), at(linear.gain, 0)
            )
            late = None if delay is None else at(delay.astype(linear.A.dtype), 0)
            sampled = (
                controller
                if isinstance(controller, LinearController)
                else controller.linear(axis, place[:rank] if rank else None)
            )
            if not math.isclose(sampled.dt, dt, rel_tol=1e-6):
                raise ValueError(
                    f"the controller's linear form is for samples of {sampled.dt} s, the loop's "
                    f"are {dt} s: give the loop dt={sampled.dt}"
                )
            return (
                physical,
                _with_states(sampled, states),
                late,
                at(linear.gain, 0) / (at(b0.astype(linear.gain.dtype), 0)),
            )

        if not places:
            return jax.tree.map(lambda x: jnp.asarray(x)[None], of_member())
        return jax.vmap(of_member)(*(jnp.asarray(x) for x in places))

    return jax.tree.map(lambda *rows: jnp.concatenate(rows), *(of_axis(k) for k in axes))


def axis_index(axis: int | str) -> int:
    """The number of an axis. Raises ValueError for a name that it does not have."""
    if isinstance(axis, int):
        if axis < 0:
            raise ValueError(f"axis is {axis}: give 0 or above, or one of {', '.join(AXES)}")
        return axis
    if axis not in AXES:
        raise ValueError(f"axis is {axis!r}: choose one of {', '.join(AXES)}, or a number")
    return AXES.index(axis)


def _with_states(controller: LinearController, states: int) -> LinearController:
    """With further states that nothing drives and nothing reads.

    A state that nothing drives, as the integral of a PID with ki = 0, stays at 0: it is no mode.
    """
    A = controller.A
    others = jnp.where(jnp.eye(len(A), dtype=bool), 0, A)
    inputs = (controller.measurement_in != 0) | (controller.reference_in != 0)
    driven = jnp.any(others != 0, axis=1) | inputs
    extra = max(0, states - len(controller.C))
    longer = lambda x: jnp.pad(x, (0, extra))
    return dataclasses.replace(
        controller,
        A=jnp.pad(jnp.where(driven[:, None], A, 0), ((0, extra), (0, extra))),
        reference_in=longer(controller.reference_in),
        measurement_in=longer(controller.measurement_in),
        C=longer(controller.C),
    )


class Rational(NamedTuple):
    """numerators / denominator, highest power of z - 1 first.

    In z itself, slow poles would crowd about 1 and their coefficients cancel.
    """

    numerators: Float[Array, "inputs degrees"]
    denominator: Float[Array, " degrees"]

    def __call__(self, ahead: Complex[Array, " points"]) -> Complex[Array, "inputs points"]:
        """The values at `ahead`, which is z - 1."""
        above, below = self.split(ahead)
        return above / below

    def split(
        self, ahead: Complex[Array, " points"]
    ) -> tuple[Complex[Array, "inputs points"], Complex[Array, "1 points"]]:
        """The values of the numerators and of the denominator at `ahead`."""
        rows = jnp.concatenate([self.numerators, self.denominator[None]]).astype(ahead.dtype)
        value = jnp.broadcast_to(rows[:, :1], (len(rows), *ahead.shape))
        for k in range(1, rows.shape[1]):
            value = value * ahead[None] + rows[:, k, None]
        return value[:-1], value[-1:]


def rational(
    A: Float[Array, "states states"],
    B: Float[Array, "states inputs"],
    C: Float[Array, " states"],
    D: Float[Array, " inputs"],
) -> Rational:
    """C (z - A)^-1 B + D, by the Faddeev-LeVerrier recursion on A - 1.

    Source: Householder, The Theory of Matrices in Numerical Analysis, section 6.7. It loses digits
    as the number of states grows; sampled controllers have up to about eight.
    """
    unit = jnp.eye(len(A), dtype=A.dtype)
    change, adjugate = A - unit, unit
    above, below = [jnp.zeros_like(D)], [jnp.ones((), A.dtype)]
    for k in range(1, len(A) + 1):
        above.append(_dot(_dot(C, adjugate), B))
        advanced = _dot(change, adjugate)
        below.append(-jnp.trace(advanced) / k)
        adjugate = advanced + below[-1] * unit
    denominator = jnp.stack(below)
    return Rational(jnp.stack(above, axis=1) + D[:, None] * denominator[None], denominator)


def _dot(a: Array, b: Array) -> Array:
    return jnp.dot(a, b, precision="highest")


class OpenLoop(eqx.Module):
    """One axis and its controller, broken at the command.

    `frequency_response` is that of the loop L, closed as 1 + L = 0, at frequencies below pi / dt;
    beyond, it repeats itself. `jq.loops.margins` and its kin take it.
    """

    angle: Rational  # per command just in time, per command a sample late, per disturbance torque
    command: Rational  # per angle, per reference
    shift: Float[Array, ""]  # whole samples of the delay
    dt: float = eqx.field(static=True)  # s

    def frequency_response(
        self, omega: Float[Array, " frequencies"]
    ) -> Complex[Array, "frequencies 1 1"]:
        """L at `omega` in rad/s."""
        return self.loop(omega)[:, None, None]

    def loop(self, omega: Float[Array, " points"]) -> Complex[Array, " points"]:
        driven, _, feedback, _ = self.parts(omega)
        return -driven * feedback

    def parts(self, omega: Float[Array, " points"]) -> Complex[Array, "4 points"]:
        """Angle per command and per disturbance torque, command per angle and per reference."""
        angle = omega * self.dt
        ahead = _ahead(angle)
        fresh, stale, disturbance = self.angle(ahead)
        late = jnp.exp(-self.shift.astype(ahead.dtype) * imaginary(angle))
        driven = late * (fresh + stale / (1 + ahead))
        feedback, prefilter = self.command(ahead)
        return jnp.stack([driven, disturbance, feedback, prefilter])

    def squared_distance(self, omega: Float[Array, " points"]) -> Float[Array, " points"]:
        """|1 + L|^2, without a complex quotient: in float64 only, the products are that small."""
        angle = omega * self.dt
        ahead = _ahead(angle)
        (fresh, stale, _), below = self.angle.split(ahead)
        (feedback, _), inner = self.command.split(ahead)
        late = jnp.exp(-self.shift.astype(ahead.dtype) * imaginary(angle))
        driven = late * (fresh + stale * (1 + jnp.conj(ahead)))  # |1 + ahead| is 1
        denominator = below[0] * inner[0]
        return _square(denominator - driven * feedback) / _square(denominator)

    def static_gain_margin(self) -> Float[Array, ""]:
        """-1 / L at frequency 0, the gain at which a pole passes z = 1; `nan` without one.

        There is one where L is finite and negative, as about an unstable plant.
        """
        above = (self.angle.numerators[0, -1] + self.angle.numerators[1, -1]) * (
            self.command.numerators[0, -1]
        )
        below = self.angle.denominator[-1] * self.command.denominator[-1]
        crosses = above * below > 0  # L is their ratio, with a minus
        return jnp.where(crosses, below / jnp.where(above == 0, 1.0, above), jnp.nan)


def _ahead(angle: Float[Array, " points"]) -> Complex[Array, " points"]:
    """exp(j angle) - 1 without the cancellation at small angles."""
    return jax.lax.complex(-2 * jnp.sin(angle / 2) ** 2, jnp.sin(angle))


def _square(x: Complex[Array, " points"]) -> Float[Array, " points"]:
    return x.real**2 + x.imag**2


def join(plant: SampledAxis, controller: LinearController) -> OpenLoop:
    """Frequency responses of the loop."""
    inputs = jnp.stack([plant.fresh, plant.stale, plant.push], axis=1)
    first = jnp.zeros_like(plant.fresh).at[0].set(1)
    angle = rational(plant.transition, inputs, first, jnp.zeros_like(inputs[0]))
    inward = jnp.stack([controller.measurement_in, controller.reference_in], axis=1)
    through = jnp.stack([controller.measurement_through, controller.reference_through])
    command = rational(controller.A, inward, controller.C, through)
    return OpenLoop(angle, command, plant.shift.astype(first.dtype), controller.dt)


class ClosedLoopMatrix(eqx.Module):
    """x+ = matrix x + noise n, u = command x + through n, with measurement noise n.

    x holds the states of the axis, the commands on their way, and those of the controller; scaled.
    """

    matrix: Float[Array, "states states"]
    noise: Float[Array, " states"]
    command: Float[Array, " states"]
    through: Float[Array, ""]

    def balanced(self) -> "ClosedLoopMatrix":
        """The same loop in states whose units do not matter."""
        scale = balance(self.matrix)
        matrix = self.matrix * scale[None] / scale[:, None]
        return ClosedLoopMatrix(matrix, self.noise / scale, self.command * scale, self.through)


def close(plant: SampledAxis, controller: LinearController, memory: int) -> ClosedLoopMatrix:
    """The closed loop in state space, with room for `memory` commands on their way."""
    states, inner = len(plant.fresh), len(controller.C)
    dtype = plant.fresh.dtype
    first = jnp.zeros(states, dtype).at[0].set(1)
    way = jnp.arange(memory + 1)
    arriving = plant.fresh[:, None] * (way == plant.shift)[None].astype(dtype)
    arriving = arriving + plant.stale[:, None] * (way == plant.shift + 1)[None].astype(dtype)
    now, before = arriving[:, 0], arriving[:, 1:]
    zeros = lambda *shape: jnp.zeros(shape, dtype)
    sent = jnp.concatenate([controller.measurement_through * first, zeros(memory), controller.C])
    body = jnp.concatenate([plant.transition, before, zeros(states, inner)], axis=1)
    queue = jnp.eye(memory, states + memory + inner, k=states - 1, dtype=dtype)
    queue = queue * (jnp.arange(memory) > 0)[:, None].astype(dtype)
    mind = jnp.concatenate(
        [controller.measurement_in[:, None] * first[None], zeros(inner, memory), controller.A],
        axis=1,
    )
    entry = jnp.concatenate([now, jnp.eye(1, memory, dtype=dtype)[0], zeros(inner)])
    matrix = jnp.concatenate([body, queue, mind]) + entry[:, None] * sent[None]
    heard = jnp.concatenate([zeros(states + memory), controller.measurement_in])
    through = controller.measurement_through
    return ClosedLoopMatrix(matrix, entry * through + heard, sent, through)
