"""The powers of given lines that carry the most information within limits."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._criteria import Criterion


_STEPS = 40_000
_BETWEEN = 25  # steps between two looks at the certificate
_TOLERANCE = 3e-4  # of the flight time

Power = Float[Array, " frequencies"]
PerPower = Float[Array, "models frequencies parameters parameters"]
Costs = Float[Array, "limits frequencies"]
Share = Float[Array, ""]


class Powers(NamedTuple):
    """Mean squares of the lines, and the price of each limit in information; prices sum to 1."""

    power: Power
    price: Float[Array, " limits"]


class Certificate(NamedTuple):
    """How far powers are from the best, by the equivalence theorem."""

    dispersion: Power  # information that a line buys per cost, to all there is: 1 at best
    gap: Float[Array, ""]  # the best design's log information exceeds this one's by no more


def optimal_powers(
    per_power: PerPower, costs: Costs, criterion: Criterion, names: tuple[str, ...], share: Share
) -> Powers:
    """Maximise the mean of the models' log information, each limit's `costs @ power` at most 1.

    No line takes more than `share` of what the limits leave it alone. Each step multiplies the
    powers by the information that a unit of cost buys at each line, to the criterion's exponent,
    and the prices of the limits by their use. With a single limit that is the algorithm of Silvey,
    Titterington and Torsney (1978), under which D- and A-optimality never fall (Yu, 2010).
    """
    price = jnp.full(costs.shape[0], 1 / costs.shape[0], costs.dtype)
    start = Powers(_feasible(_cap(costs, share), costs), price)
    return _improved(start, per_power, costs, criterion, names, share, jnp.asarray(_STEPS))[0]


def certify(
    found: Powers,
    per_power: PerPower,
    costs: Costs,
    criterion: Criterion,
    names: tuple[str, ...],
    share: Share,
) -> Certificate:
    """Bound what any powers within the limits could gain over those found, whatever these are.

    Weak duality; with one limit and no cap, the equivalence theorem of Kiefer and Wolfowitz (1960).
    """
    return _improved(found, per_power, costs, criterion, names, share, jnp.asarray(0))[1]


@eqx.filter_jit
def _improved(
    found: Powers,
    per_power: PerPower,
    costs: Costs,
    criterion: Criterion,
    names: tuple[str, ...],
    share: Share,
    steps: Int[Array, ""],
) -> tuple[Powers, Certificate]:
    """At most so many steps on; with none, only the certificate, at no second compilation."""
    slope = _slope(per_power, criterion, names)
    cap = _cap(costs, share)

    def step(_, state):
        price = state.price * (costs @ state.power)
        price = price / jnp.sum(price)
        cost = price @ costs
        gain = (slope(state.power) / cost) ** criterion.exponent
        return Powers(_filled(state.power * gain, cost, cap), price)

    def certificate(state):
        power, cost = _feasible(state.power, costs), state.price @ costs
        slopes = slope(power)
        return Certificate(slopes / cost, _gap(slopes, cost, cap, power))

    def improve(carry):
        state, _, done = carry
        state = jax.lax.fori_loop(0, jnp.minimum(_BETWEEN, steps), step, state)
        return state, certificate(state), done + _BETWEEN

    def unfinished(carry):
        _, proof, done = carry
        return (done == 0) | ((proof.gap > _TOLERANCE) & (done < steps))

    unknown = Certificate(jnp.zeros_like(found.power), jnp.asarray(jnp.inf))
    start = (found, unknown, jnp.zeros_like(steps))
    state, proof, _ = jax.lax.while_loop(unfinished, improve, start)
    return state._replace(power=_feasible(state.power, costs)), proof


def _slope(
    per_power: PerPower, criterion: Criterion, names: tuple[str, ...]
) -> Callable[[Power], Power]:
    def information(power):
        each = jnp.einsum("f,mfpq->mpq", power, per_power)
        return jnp.mean(jax.vmap(lambda m: criterion.log_information(m, names))(each))

    return jax.grad(information)


def _cap(costs: Costs, share: Share) -> Power:
    return share / jnp.max(costs, axis=0)


def _feasible(power: Power, costs: Costs) -> Power:
    return power / jnp.maximum(jnp.max(costs @ power), 1.0)


def _filled(wanted: Power, cost: Power, cap: Power) -> Power:
    """`wanted` scaled to a cost of 1, where what exceeds its cap goes to the others."""

    def again(_, scale):
        full = scale * wanted >= cap
        left = 1 - jnp.sum(jnp.where(full, cost * cap, 0.0))
        open = jnp.sum(jnp.where(full, 0.0, cost * wanted))
        return jnp.where(open > 0, left / jnp.where(open > 0, open, 1.0), scale)

    scale = jax.lax.fori_loop(0, 12, again, 1 / jnp.sum(cost * wanted))
    return jnp.minimum(scale * wanted, cap)


def _gap(slope: Power, cost: Power, cap: Power, power: Power) -> Float[Array, ""]:
    """By how much any powers within the limits could do better: concavity, and the best filling."""
    order = jnp.argsort(-slope / cost)
    room = (cost * cap)[order]
    before = jnp.cumsum(room) - room
    taken = jnp.clip(1 - before, 0, room)
    return jnp.sum(taken * (slope / cost)[order]) - slope @ power
