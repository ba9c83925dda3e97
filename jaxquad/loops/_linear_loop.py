"""The linear loops of some axes of all members, and one axis from sample to sample, exactly."""

import dataclasses
import functools as ft
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Complex, Float, Int

from jaxquad._compile import brief_options, Jit
from jaxquad._core import ensemble_shape, require_signature
from jaxquad.control import LinearController, LinearisableController
from jaxquad.models import imaginary, LinearAxis, matrix_exponential, split_delay

from ._loop import LinearisablePlant, Loop


Tree = TypeVar("Tree")

# Growth and noise of a sampled system without its eigenvalues: values come from repeated squaring,
# derivatives from Lyapunov equations, of which only the first exist.
_SWEEPS = 6
_FADED = 20.0  # nepers, after which a sum over samples has no more to add
_ROUNDINGS = 100.0


class Powers(NamedTuple):
    """matrix^(2^k) = matrices[k] exp(logs[k]), without derivatives."""

    matrices: Float[Array, "powers states states"]
    logs: Float[Array, " powers"]


def sharpest(smoothing: float, dt: float, dtype: DTypeLike) -> float:
    """`smoothing` in 1/s, or what the rounding of a sample leaves of it."""
    return max(smoothing, _ROUNDINGS * float(jnp.finfo(dtype).eps) / dt)


def powers(matrix: Float[Array, "states states"], dt: float, smoothing: float) -> Powers:
    """Powers up to one in which modes that are `smoothing` in 1/s apart have parted."""
    count = max(1, math.ceil(math.log2(_FADED / (smoothing * dt))))
    size = lambda m: jnp.maximum(jnp.max(jnp.abs(m)), jnp.finfo(m.dtype).tiny)

    def square(carry, _):
        power, log = carry
        following = _dot(power, power)
        scale = size(following)
        return (following / scale, 2 * log + jnp.log(scale)), carry

    fixed = jax.lax.stop_gradient(matrix)
    start = (fixed / size(fixed), jnp.log(size(fixed)))
    last, earlier = jax.lax.scan(square, start, length=count)
    return Powers(*(jnp.concatenate([a, b[None]]) for a, b in zip(earlier, last, strict=True)))


def growth(ladder: Powers, dt: float) -> Float[Array, ""]:
    """ln |matrix^N| / (N dt) in 1/s for the highest power N.

    Never below the growth rate of the slowest mode, and above it by up to ln(N times the condition
    of the eigenvectors) / (N dt).
    """
    size = 0.5 * jnp.log(jnp.sum(ladder.matrices[-1] ** 2))
    return (ladder.logs[-1] + size) / (2.0 ** (len(ladder.logs) - 1) * dt)


def gramian(
    ladder: Powers, start: Float[Array, "states states"], shift: Float[Array, ""]
) -> Float[Array, "states states"]:
    """The sum over k of tame^k start tame'^k with tame = matrix exp(-shift): Smith's doubling."""

    def double(total, power):
        matrix, log = power
        return total + jnp.exp(2 * log) * _dot(_dot(matrix, total), matrix.T), None

    samples = jnp.exp2(jnp.arange(len(ladder.logs) - 1, dtype=start.dtype))
    logs = ladder.logs[:-1] - samples * shift
    return jax.lax.scan(double, start, (ladder.matrices[:-1], logs))[0]


def abscissa(
    matrix: Float[Array, "states states"], ladder: Powers, dt: float, smoothing: float
) -> Float[Array, ""]:
    """Growth rate of the slowest mode in 1/s, with derivatives that stay finite.

    With H(s) the sum over |matrix^k|^2 exp(-2 k s dt), 1 / H falls to 0 at that rate: a Newton step
    on it starts `smoothing` (1/s) above the `growth`, and the derivatives are those of the
    root of H(s) = H there. Both are exact for a single slowest mode or pair as the smoothing
    becomes small; of modes that coincide the value is above the rate by less than the smoothing.
    (The norm of matrix^N turns with the phase of complex modes: its own gradient is wrong.)
    Source: Vanbiervliet et al., The smoothed spectral abscissa for robust stability optimization,
    SIAM J. Optim. 20 (2009), for sampled time.
    """
    start = growth(ladder, dt) + smoothing
    unit, shift = jnp.eye(len(matrix), dtype=matrix.dtype), start * dt
    reachable, observable = gramian(ladder, unit, shift), gramian(_turned(ladder), unit, shift)
    tame = jnp.exp(-shift) * jax.lax.stop_gradient(matrix)
    pull = _dot(_dot(observable, tame), reachable)
    slope = jnp.sum(pull * tame) * dt
    moved = jnp.sum(pull * (jnp.exp(-shift) * matrix - tame)) / slope  # 0, with the derivative
    return start - 0.5 * jnp.trace(reachable) / slope + moved


def noise_gain(
    matrix: Float[Array, "states states"], noise: Float[Array, " states"],
    command: Float[Array, " states"], through: Float[Array, ""], ladder: Powers,
    shift: Float[Array, ""],
) -> Float[Array, ""]:  # fmt: skip
    """rms of command x + through n per rms of white n, a new value each sample.

    The state is x+ = tame x + noise n with tame = matrix exp(-shift), which is stable.
    """
    live = (jnp.exp(-shift) * matrix, noise, command, through)
    tame, entry, reading, direct = jax.lax.stop_gradient(live)
    reachable = gramian(ladder, jnp.outer(entry, entry), shift)
    observable = gramian(_turned(ladder), jnp.outer(reading, reading), shift)
    power = _dot(reading, _dot(reachable, reading)) + direct**2
    pulls = (
        _dot(_dot(observable, tame), reachable),
        _dot(observable, entry),
        _dot(reachable, reading),
        direct,
    )
    changes = (x - fixed for x, fixed in zip(live, (tame, entry, reading, direct), strict=True))
    moved = 2 * sum(jnp.sum(p * d) for p, d in zip(pulls, changes, strict=True))
    return jnp.sqrt(power) + moved / (2 * jnp.sqrt(jnp.where(power > 0, power, jnp.inf)))


def _turned(ladder: Powers) -> Powers:
    return Powers(jnp.swapaxes(ladder.matrices, 1, 2), ladder.logs)


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

    def map(self, of_one: Callable[["LinearParts"], Tree]) -> Tree:
        """What `of_one` makes of each loop, on a first axis; of a single one without vmap."""
        if len(self.ratio) > 1:
            return jax.vmap(of_one)(self)
        one = jax.tree.map(lambda x: x[0], self)
        return jax.tree.map(lambda x: x[None], of_one(one))

    def sampled(self) -> tuple[SampledAxis, LinearController]:
        """Plant and controller of a single loop, from sample to sample."""
        plant = sample_axis(self.plant, self.delay, self.dt)
        if self.delay is not None:  # a traced one may be longer than it was said to be
            fresh = jnp.where(plant.shift < self.memory, plant.fresh, jnp.nan)
            plant = plant._replace(fresh=fresh)
        return plant, self.controller


def linear_parts(
    loop: Loop, axes: Sequence[int], member: int | tuple[int, ...] | None = None, *,
    states: int = 0,
) -> tuple[LinearParts, tuple[int, ...]]:  # fmt: skip
    """The linear loops of all members, or of one, axis by axis; and the shape of the ensemble.

    Controllers get as many `states` at least, idle ones, to share what is compiled.
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
    require_signature(plant, LinearisablePlant, "linearise", 1)
    require_signature(controller, LinearisableController, "linear", 2)
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
        linear, b0 = plant.linearise(axis), jnp.asarray(getattr(controller, "b0", 1.0))
        b0 = b0[axis if b0.shape[0] > 1 else 0] if b0.ndim else b0

        def of_member(*place: Int[Array, ""]) -> tuple:
            def at(x: Array, rank: int) -> Array:
                """Of an array whose ensemble axes follow the first `rank`."""
                sizes = zip(place, x.shape[rank:], strict=False)
                return x[(slice(None),) * rank + tuple(0 if n == 1 else p for p, n in sizes)]

            physical = LinearAxis(
                at(linear.A, 2), at(linear.command, 1), at(linear.torque, 1), at(linear.gain, 0)
            )
            late = None if delay is None else at(delay.astype(linear.A.dtype), 0)
            sampled = controller
            if not isinstance(sampled, LinearController):
                sampled = sampled.linear(axis, place[:rank] if rank else None)
            if not math.isclose(sampled.dt, dt, rel_tol=1e-6):
                raise ValueError(
                    f"the controller's linear form is for samples of {sampled.dt} s, the loop's "
                    f"are {dt} s: give the loop dt={sampled.dt}"
                )
            # A state that nothing drives, as the integral of a PID with ki = 0, is no mode.
            A = sampled.A
            others = jnp.where(jnp.eye(len(A), dtype=bool), 0, A)
            inputs = (sampled.measurement_in != 0) | (sampled.reference_in != 0)
            driven = jnp.any(others != 0, axis=1) | inputs
            extra = max(0, states - len(sampled.C))
            longer = lambda x: jnp.pad(x, (0, extra))
            padded = dataclasses.replace(
                sampled,
                A=jnp.pad(jnp.where(driven[:, None], A, 0), ((0, extra), (0, extra))),
                reference_in=longer(sampled.reference_in),
                measurement_in=longer(sampled.measurement_in),
                C=longer(sampled.C),
            )
            ratio = at(linear.gain, 0) / (at(b0.astype(linear.gain.dtype), 0))
            return physical, padded, late, ratio

        if not places:
            return jax.tree.map(lambda x: jnp.asarray(x)[None], of_member())
        return jax.vmap(of_member)(*(jnp.asarray(x) for x in places))

    return jax.tree.map(lambda *rows: jnp.concatenate(rows), *(of_axis(k) for k in axes))


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
    """C (z - A)^-1 B + D, by the Faddeev-LeVerrier recursion on A - 1, for up to about 8 states.

    Source: Householder, The Theory of Matrices in Numerical Analysis, section 6.7.
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
        square = lambda x: x.real**2 + x.imag**2
        return square(denominator - driven * feedback) / square(denominator)

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


def join(plant: SampledAxis, controller: LinearController) -> OpenLoop:
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
        """The same loop in states for which rows and columns are of one size (Osborne)."""
        fixed, unit = jax.lax.stop_gradient(self.matrix), jnp.eye(len(self.matrix))
        size = jnp.abs(fixed) * (1 - unit.astype(fixed.dtype))
        scale = jnp.ones(len(fixed), fixed.dtype)
        for _ in range(_SWEEPS):
            now = size * scale[None] / scale[:, None]
            row, column = jnp.sum(now, axis=1), jnp.sum(now, axis=0)
            usable = (row > 0) & (column > 0)
            ratio = jnp.where(usable, row, 1.0) / jnp.where(usable, column, 1.0)
            scale = scale * ratio**0.25  # half of the step: all states move at once
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
