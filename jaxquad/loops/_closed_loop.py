"""A sampled axis joined with its controller: responses along frequency, and the closed loop."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from jaxquad.control import LinearController
from jaxquad.models import imaginary

from ._linear_parts import SampledAxis
from ._spectrum import balance


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
