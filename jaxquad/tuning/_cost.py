"""The cost of many designs at once, with its gradient: one compile for both phases of a tune."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._objective import Limit, Objective, soft
from ._observer_alone import barrier
from ._parameters import Coordinates
from ._problem import Problem, split
from ._quantities import OF_THE_LOOP, per_member


_BARRIER = 0.01  # weight of the barrier before observers that are slower than the feedback
SMOOTHING = 1e-6  # 1/s, of the abscissa: its derivative is off by as much, relative to 1 1/s


class Pull(NamedTuple):
    """What the limits add to a cost: an augmented Lagrangian, a constraint for each member."""

    multipliers: tuple[Float[Array, "problems members"], ...]  # of each limit
    stiffness: Float[Array, "problems limits"]


class Told(NamedTuple):
    """What an evaluation tells of each problem."""

    value: Float[Array, " problems"]
    gradient: Float[Array, "problems n"]
    cost: Float[Array, " problems"]  # the objective, without what limits add
    costs: Float[Array, "problems members"]
    numbers: dict[str, Float[Array, "problems members"]]  # of each member's worst axis
    bounded: tuple[Float[Array, "problems members"], ...]  # of each limit, on its members
    beyond: tuple[Float[Array, "problems members"], ...]  # the same as levels: above 0, violated


class Aim(NamedTuple):
    """What is minimised: the abscissa, as far as to `rate`, or all of it."""

    objective: Objective  # arrays [problems, ...]
    limits: tuple[Limit, ...]  # the same
    pull: Pull
    fly: Bool[Array, " problems"]  # phase 2
    rate: Float[Array, " problems"]  # 1/s


@eqx.filter_jit
def evaluate(
    z: Float[Array, "problems n"],
    on: Bool[Array, " problems"],
    coordinates: Coordinates,
    problem: Problem,
    aim: Aim,
) -> Told:
    """Value and gradient for each problem that is `on`; what the others tell means nothing."""
    arrays, rest = eqx.partition(aim, eqx.is_array)

    def one(given: Any) -> Told:
        z, on, mine = given
        mine = eqx.combine(mine, rest)
        run = lambda z: _told(z, coordinates, problem, mine)
        like = jax.eval_shape(run, z)
        still = lambda z: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
        return jax.lax.cond(on, run, still, z)

    # One after the other: the members of each fill the machine, and none waits for another's phase.
    return jax.lax.map(one, (z, on, arrays))


def _told(z: Array, coordinates: Coordinates, problem: Problem, aim: Aim) -> Told:
    def total(z):
        controller = coordinates.controller_at(z)
        value, others = _cost(controller, problem, aim)
        if any("observer_factor" in name for name in coordinates.names):
            value = value + _BARRIER * barrier(controller)
        return value, others

    (value, others), gradient = jax.value_and_grad(total, has_aux=True)(z)
    return Told(value, gradient, *others)


def _cost(controller: Any, problem: Problem, aim: Aim) -> tuple[Array, tuple[Any, ...]]:
    objective, limits = aim.objective, aim.limits
    wanted = objective.quantities | {limit.quantity for limit in limits}
    flown, linear = split(wanted)
    numbers = problem.loops.numbers(controller, linear, SMOOTHING)
    slowest = jnp.max(numbers["abscissa"], axis=0)
    still = {name: jnp.ones_like(numbers["abscissa"]) for name in flown}
    if flown:
        fly = lambda c: problem.in_time(c, flown)
        numbers |= jax.lax.cond(aim.fly, fly, lambda c: still, controller)
    costs = objective.costs(numbers)
    seen = {name: per_member(name, x, worst=True) for name, x in numbers.items()}
    bounded = _bounded(controller, problem, limits, seen)
    beyond = tuple(limit.beyond(x) for limit, x in zip(limits, bounded, strict=True))
    cost = objective.risk(costs)
    settling = jnp.mean(soft(slowest - aim.rate))
    total = jnp.where(aim.fly, cost + _pulled(beyond, aim.pull), settling)
    return total, (cost, costs, seen, bounded, beyond)


def _bounded(
    controller: Any, problem: Problem, limits: Sequence[Limit], seen: dict[str, Array]
) -> tuple[Array, ...]:
    """What each limit is on: of the linear loop, which is cheap, on many more members."""
    names = {limit.quantity for limit in limits if limit.quantity in OF_THE_LOOP}
    if problem.wide is None or not names:
        return tuple(seen[limit.quantity] for limit in limits)
    wide = problem.wide.numbers(controller, names, SMOOTHING)
    found = seen | {name: per_member(name, wide[name], worst=True) for name in names}
    return tuple(found[limit.quantity] for limit in limits)


def _pulled(beyond: Sequence[Array], pull: Pull) -> Float[Array, ""]:
    """The augmented Lagrangian of Powell, Hestenes and Rockafellar."""
    total = jnp.zeros(())
    for k, levels in enumerate(beyond):
        multiplier, stiffness = pull.multipliers[k], pull.stiffness[k]
        forced = jnp.maximum(multiplier + stiffness * levels, 0)
        total = total + jnp.sum(forced**2 - multiplier**2) / (2 * stiffness)
    return total
