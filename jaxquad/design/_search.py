"""Powers and phases in turn: which power is best depends on the crest factors of the phases."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int


_NORMS = (4, 16, 64, 256)  # one the start of the next; the last is almost the peak
_PHASE_STEPS = 60  # of each
_STARTS = 4
_COARSE, _FINE = 8, 64  # least points to a cycle of the highest line: to search, and to judge
_STEPS = 40_000
_BETWEEN = 25  # steps between two looks at the certificate
_TOLERANCE = 3e-4  # of the flight time
_CREST = 1.5  # before phases are known
_ROUNDS = 2  # of powers, phases, and the crest factors that they have
_FAINT = 3e-3  # power, to that of the strongest line in its share of the limits, that is left out

Orders = Int[np.ndarray, " frequencies"]
Lines = Float[np.ndarray, " frequencies"]
Amplitudes = Complex[np.ndarray, "signals frequencies"]
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

    def log_information(
        self, information: Information, names: tuple[str, ...]
    ) -> Float[Array, ""]: ...


class DOptimal(eqx.Module):
    """The smallest joint confidence region: log det M, over the number of parameters."""

    @property
    def exponent(self) -> float:
        return 1.0

    def log_information(self, information: Information, names: tuple[str, ...]) -> Float[Array, ""]:
        return jnp.linalg.slogdet(information)[1] / len(names)


class AOptimal(eqx.Module):
    """The smallest sum of the relative variances of the named parameters, or of all.

    With one name it is c-optimality: the smallest standard error of that parameter alone.
    """

    names: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def exponent(self) -> float:
        return 0.5

    def log_information(self, information: Information, names: tuple[str, ...]) -> Float[Array, ""]:
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

    def log_information(self, information: Information, names: tuple[str, ...]) -> Float[Array, ""]:
        logs = jnp.log(jnp.diagonal(jnp.linalg.inv(information)))
        top = jnp.max(logs)
        return -top - jnp.log(jnp.sum(jnp.exp(self.power * (logs - top)))) / self.power


def least_peak_phases(orders: Orders, amplitudes: Amplitudes, *, seed: int) -> Lines:
    """Liness of the lines under which several signals peak least, relative to their limits.

    The signals are sums of `amplitudes` times cos(order 2 pi t + phase), `orders` per period, in
    units of their limits. The p-norm over all of them is lowered for a rising p, from several
    starts. Source: Guillaume, Schoukens, Pintelon and Kollar (1991), for one signal.
    """
    from scipy.optimize import minimize

    used = np.flatnonzero(amplitudes[0])
    few, heights = orders[used], amplitudes[:, used]
    # Delays in proportion to the power of the lines below (Schroeder, 1970), and random starts.
    power, rng = np.abs(heights[0]) ** 2, np.random.default_rng(seed)
    below = np.concatenate([[0.0], np.cumsum(power)[:-1]]) / power.sum()
    starts = [-2 * np.pi * np.concatenate([[0.0], np.cumsum(below[1:] * np.diff(few))])]
    starts += [rng.uniform(-np.pi, np.pi, used.size) for _ in range(_STARTS - 1)]
    points, ends = 1 << int(np.ceil(np.log2(_COARSE * few.max()))), []
    for phase in starts:
        for norm in _NORMS:
            phase = minimize(
                _log_norm, phase, (few, heights, points, norm),
                jac=True, method="CG", options=dict(maxiter=_PHASE_STEPS),
            ).x  # fmt: skip
        ends.append(phase)
    highest = [multisine_peaks(few, phase, heights).max() for phase in ends]
    phase = np.zeros(orders.size)
    phase[used] = ends[int(np.argmin(highest))]
    return phase


def multisine_peaks(
    orders: Orders, phase: Lines, amplitudes: Amplitudes
) -> Float[np.ndarray, " signals"]:
    """A bound on each signal's peak at any time, from its values at many points.

    Between N points, a signal of order n exceeds them by 1 / cos(pi n / N) at most (Ehlich and
    Zeller, 1964): 0.1 %.
    """
    points = 1 << int(np.ceil(np.log2(_FINE * orders.max())))
    levels = np.abs(multisine_signals(orders, phase, amplitudes, points))
    return levels.max(axis=1) / np.cos(np.pi * orders.max() / points)


def multisine_signals(
    orders: Orders, phase: Lines, amplitudes: Amplitudes, points: int
) -> Float[np.ndarray, "signals points"]:
    """One period of each multisine, at evenly spaced points.

    **Arguments:**

    - `orders`: whole cycles per period of each line.
    - `phase`: of each line, rad.
    - `amplitudes`: complex, one row for each signal.
    - `points`: how many.
    """
    return _synthesise(orders, amplitudes * np.exp(1j * phase), points)


def _log_norm(
    phase: Lines, orders: Orders, amplitudes: Amplitudes, points: int, norm: int
) -> tuple[float, Lines]:
    """Logarithm of the norm over all signals and points, and its gradient."""
    turned = amplitudes * np.exp(1j * phase)
    signals = _synthesise(orders, turned, points)
    top = np.abs(signals).max()
    unit = signals / top
    powers = unit ** (norm - 2)
    total = np.sum(powers * unit**2)
    through = np.fft.rfft(powers * unit / (top * total), axis=1)[:, orders]
    slope = np.real(1j * turned * np.conj(through)).sum(axis=0)
    return float(np.log(total / unit.size) / norm + np.log(top)), slope


def _synthesise(
    orders: Orders, amplitudes: Amplitudes, points: int
) -> Float[np.ndarray, "signals points"]:
    spectrum = np.zeros((len(amplitudes), points // 2 + 1), complex)
    spectrum[:, orders] = 0.5 * points * amplitudes
    return np.fft.irfft(spectrum, points, axis=1)


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


class Limits(NamedTuple):
    """Signals made from the input by a filter each, and the peaks that they may have."""

    names: tuple[str, ...]
    filters: Complex[np.ndarray, "limits frequencies"]
    peaks: Float[np.ndarray, " limits"]

    def costs(self, crest: Float[np.ndarray, " limits"]) -> Float[np.ndarray, "limits frequencies"]:
        """Share of each limit that unit mean square at a line takes, at these crest factors."""
        return np.abs(self.filters) ** 2 * (crest / self.peaks)[:, None] ** 2


def gather_limits(
    omega: Float[np.ndarray, " frequencies"],
    responses: Sequence[Complex[np.ndarray, "frequencies outputs"]],
    amplitude: float | int,
    rate: float | int | None,
    output_amplitude: float | int | Sequence[float] | None,
) -> Limits:
    """All limits of a design; an output's holds for every model of an ensemble."""
    names, filters, peaks = ["amplitude"], [np.ones(omega.size, complex)], [amplitude]
    if rate is not None:
        names, filters, peaks = [*names, "rate"], [*filters, 1j * omega], [*peaks, rate]
    outputs = responses[0].shape[1]
    if output_amplitude is None or isinstance(output_amplitude, int | float):
        output_peaks = [np.inf if output_amplitude is None else float(output_amplitude)] * outputs
    else:
        output_peaks = list(output_amplitude)
    if len(output_peaks) != outputs:
        raise ValueError(
            f"output_amplitude has {len(output_peaks)} values for {outputs} outputs: give one for "
            "each, inf where there is no limit"
        )
    for o, peak in enumerate(output_peaks):
        for m, response in enumerate(responses):
            if peak < np.inf:
                which = f" {o}" if outputs > 1 else ""
                names.append(f"output{which}" + (f", model {m}" if len(responses) > 1 else ""))
                filters.append(response[:, o])
                peaks.append(peak)
    for name, peak in zip(names, peaks, strict=True):
        if not 0 < peak < np.inf:
            raise ValueError(f"the limit of {name} is {peak}: it has to be positive and finite")
    return Limits(tuple(names), np.array(filters), np.array(peaks, float))


class Plan(NamedTuple):
    """The lines on offer, the limits, and the criterion of a design."""

    omega: Lines  # rad/s
    orders: np.ndarray
    samples: int  # of a period
    names: tuple[str, ...]
    per_power: Float[np.ndarray, "models frequencies parameters parameters"]
    limits: Limits
    criterion: Criterion


class Trial(NamedTuple):
    """Lines scaled to the limits by their actual peaks."""

    power: Lines
    phase: Lines
    peaks: Float[np.ndarray, " limits"]  # to their limits
    dispersion: Lines
    efficiency: float
    value: float  # log information
    lines: int
    crest: Float[np.ndarray, " limits"]  # factors of the limited signals


def search(plan: Plan, lines: tuple[int, ...], seed: int) -> Trial:
    """The most informative trial, over the least numbers of `lines` and some rounds of each."""
    trials = []
    for least in lines:
        crest = np.full(plan.limits.peaks.size, _CREST)
        for _ in range(_ROUNDS):
            trials.append(_trial(plan, least, crest, seed))
            crest = trials[-1].crest
    return max(trials, key=lambda trial: trial.value)


def _trial(plan: Plan, lines: int, crest: Float[np.ndarray, " limits"], seed: int) -> Trial:
    """One design for these crest factors."""
    costs, per_power = plan.limits.costs(crest), jnp.asarray(plan.per_power)
    share = jnp.asarray(1 / lines, dtype=per_power.dtype)

    def signals(power: Lines) -> Complex[np.ndarray, "limits frequencies"]:
        """Complex amplitudes of the limited signals, in units of their limits."""
        return plan.limits.filters * np.sqrt(2 * power) / plan.limits.peaks[:, None]

    best = optimal_powers(per_power, jnp.asarray(costs), plan.criterion, plan.names, share)
    power = np.asarray(best.power)
    used = costs.max(axis=0) * power
    power = np.where(used > _FAINT * used.max(), power, 0.0)
    phase = least_peak_phases(plan.orders, signals(power), seed=seed)
    reached = multisine_peaks(plan.orders, phase, signals(power))
    power, reached = power / reached.max() ** 2, reached / reached.max()
    crest = reached / np.sqrt(0.5 * np.sum(np.abs(signals(power)) ** 2, axis=1))
    proof = certify_powers(
        Powers(jnp.asarray(power), best.price), per_power, jnp.asarray(plan.limits.costs(crest)),
        plan.criterion, plan.names, share,
    )  # fmt: skip
    dispersion = len(plan.names) * np.asarray(proof.dispersion)
    efficiency = min(1.0, float(np.exp(-np.asarray(proof.gap))))
    totals = np.einsum("f,mfpq->mpq", power, plan.per_power)
    values = [plan.criterion.log_information(jnp.asarray(m), plan.names) for m in totals]
    value = float(np.mean([float(value) for value in values]))
    return Trial(power, phase, reached, dispersion, efficiency, value, lines, crest)
