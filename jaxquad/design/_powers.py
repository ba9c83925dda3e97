"""Powers of a test signal's lines that buy the most information within limits."""

from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


_STEPS = 40_000
_BETWEEN = 25  # steps between two looks at the certificate
_TOLERANCE = 3e-4  # of the flight time

Power = Float[Array, " frequencies"]
PerPower = Float[Array, "models frequencies parameters parameters"]
Costs = Float[Array, "limits frequencies"]
Share = Float[Array, ""]
Information = Float[Array, "parameters parameters"]


@runtime_checkable
class Criterion(Protocol):
    """What a design maximises: the logarithm of an amount of information.

    The amount has to be concave in the information matrix, and twice as large for two flights as
    for one, so that the ratio of two amounts is a ratio of flight times. `exponent` is that of the
    multiplicative update under which it never falls. Any object with these two members will do.
    """

    @property
    def exponent(self) -> float: ...

    def log_information(self, information: Information, names: tuple[str, ...]) -> Share: ...


class DOptimal(eqx.Module):
    """The smallest joint confidence region: log det M, over the number of parameters."""

    @property
    def exponent(self) -> float:
        return 1.0

    def log_information(self, information: Information, names: tuple[str, ...]) -> Share:
        return jnp.linalg.slogdet(information)[1] / len(names)


class AOptimal(eqx.Module):
    """The smallest sum of the relative variances of the named parameters, or of all.

    With one name it is c-optimality: the smallest standard error of that parameter alone.
    """

    names: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def exponent(self) -> float:
        return 0.5

    def log_information(self, information: Information, names: tuple[str, ...]) -> Share:
        for name in self.names:
            if name not in names:
                raise ValueError(f"{name!r} is no free parameter; free are: {', '.join(names)}")
        wanted = np.array([names.index(name) for name in self.names or names])
        return -jnp.log(jnp.sum(jnp.diagonal(jnp.linalg.inv(information))[wanted]))


class LargestError(eqx.Module):
    """The smallest worst relative error, as the `power` norm of the relative variances.

    A higher power is closer to the maximum, and slower: at 8, the worst of p equal variances
    counts p^(1/8) times itself.
    """

    power: int = eqx.field(static=True, default=8)

    def __check_init__(self):
        if not 1 <= self.power <= 32:
            raise ValueError(
                f"power is {self.power}: give 1 (the sum of variances) to 32; 8 is usual"
            )

    @property
    def exponent(self) -> float:
        return 1 / (1 + self.power)

    def log_information(self, information: Information, names: tuple[str, ...]) -> Share:
        logs = jnp.log(jnp.diagonal(jnp.linalg.inv(information)))
        top = jnp.max(logs)
        return -top - jnp.log(jnp.sum(jnp.exp(self.power * (logs - top)))) / self.power


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
    steps = jnp.asarray(_STEPS)
    return _improve(start, per_power, costs, criterion, names, share, steps)[0]


def certify_powers(
    powers: Powers,
    per_power: PerPower,
    costs: Costs,
    criterion: Criterion,
    names: tuple[str, ...],
    share: Share,
) -> Certificate:
    """Bound what any powers within the limits could gain over these, whatever they are.

    Weak duality; with one limit and no cap, the equivalence theorem of Kiefer and Wolfowitz (1960).
    """
    return _improve(powers, per_power, costs, criterion, names, share, jnp.asarray(0))[1]


@eqx.filter_jit
def _improve(
    powers: Powers,
    per_power: PerPower,
    costs: Costs,
    criterion: Criterion,
    names: tuple[str, ...],
    share: Share,
    steps: Int[Array, ""],
) -> tuple[Powers, Certificate]:
    """At most so many steps on; with none, only the certificate, at no second compilation."""
    cap = _cap(costs, share)

    def information(power):
        totals = jnp.einsum("f,mfpq->mpq", power, per_power)
        return jnp.mean(jax.vmap(lambda m: criterion.log_information(m, names))(totals))

    slope = jax.grad(information)

    def step(_, state):
        price = state.price * (costs @ state.power)
        price = price / jnp.sum(price)
        cost = price @ costs
        wanted = state.power * (slope(state.power) / cost) ** criterion.exponent

        # Scaled to a cost of 1; what exceeds a line's cap goes to the other lines.
        def rescale(_, scale):
            full = scale * wanted >= cap
            left = 1 - jnp.sum(jnp.where(full, cost * cap, 0.0))
            open = jnp.sum(jnp.where(full, 0.0, cost * wanted))
            return jnp.where(open > 0, left / jnp.where(open > 0, open, 1.0), scale)

        scale = jax.lax.fori_loop(0, 12, rescale, 1 / jnp.sum(cost * wanted))
        return Powers(jnp.minimum(scale * wanted, cap), price)

    def certificate(state):
        power, cost = _feasible(state.power, costs), state.price @ costs
        slopes = slope(power)
        # Any powers within the limits could do better by so much: concavity, and the best filling.
        order = jnp.argsort(-slopes / cost)
        room = (cost * cap)[order]
        taken = jnp.clip(1 - (jnp.cumsum(room) - room), 0, room)
        gap = jnp.sum(taken * (slopes / cost)[order]) - slopes @ power
        return Certificate(slopes / cost, gap)

    def improve(carry):
        state, _, done = carry
        state = jax.lax.fori_loop(0, jnp.minimum(_BETWEEN, steps), step, state)
        return state, certificate(state), done + _BETWEEN

    def unfinished(carry):
        _, proof, done = carry
        return (done == 0) | ((proof.gap > _TOLERANCE) & (done < steps))

    unknown = Certificate(jnp.zeros_like(powers.power), jnp.asarray(jnp.inf))
    start = (powers, unknown, jnp.zeros_like(steps))
    state, proof, _ = jax.lax.while_loop(unfinished, improve, start)
    return state._replace(power=_feasible(state.power, costs)), proof


def _cap(costs: Costs, share: Share) -> Power:
    return share / jnp.max(costs, axis=0)


def _feasible(power: Power, costs: Costs) -> Power:
    return power / jnp.maximum(jnp.max(costs @ power), 1.0)
