"""Gains of a firmware's rate loop over the plants that a fit leaves uncertain, and what they give.

P, I and D enter a rate loop's response one by one as factors, and the identified plant under a held
command has a closed form: a design is a search over three numbers, and no flight is simulated.
Source: docs/autopilots.md.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float

from jaxquad._core import Number
from jaxquad.identify import filter_response

from ._firmware import Parameter
from ._law import RateLoop
from ._parameters import PARAMETERS, store_parameters


Gains = Float[np.ndarray, "designs gains"]
Paths = Complex[np.ndarray, "designs frequencies"]
FIELDS = ("p", "i", "d")


class OuterQualities(NamedTuple):
    """What an angle loop gives, for each plant.

    **Attributes:**

    - `stable`; `peak`: Ms; `resonance`: of the response from set-point to angle.
    """

    stable: Bool[np.ndarray, " plants"]
    peak: Float[np.ndarray, " plants"]
    resonance: Float[np.ndarray, " plants"]


class LoopQualities(NamedTuple):
    """What gains give, for each design and plant.

    **Attributes:**

    - `stable`: by Nyquist's criterion on the sampled loop.
    - `peak`: Ms; `resonance`: of the response from set-point to rate, without feed-forward.
    - `crossover`: the highest frequency with |L| = 1, in rad/s.
    - `rejection`: root of the integrated square of the rate after a step of torque, relative.
    - `noise`: rms of the command of white noise before the gyro's filters, relative.
    """

    stable: Bool[np.ndarray, "designs plants"]
    peak: Float[np.ndarray, "designs plants"]
    resonance: Float[np.ndarray, "designs plants"]
    crossover: Float[np.ndarray, "designs plants"]
    rejection: Float[np.ndarray, "designs plants"]
    noise: Float[np.ndarray, "designs plants"]


class Filters(NamedTuple):
    """Responses of other filters of each design over those that flew."""

    gyro: Paths
    derivative: Paths


@dataclasses.dataclass(frozen=True)
class RateLoops:
    """The open rate loops of one axis for all plants, on a grid of frequencies.

    **Attributes:**

    - `omega`: rad/s.
    - `feedback`: of the law, from the logged rate to minus the command, per unit of P, I and D.
    - `ahead`: likewise from the set-point to the command.
    - `plants`: from the command to the logged rate in rad/s, the hold included.
    - `noise`: power of the logged rate's noise around each frequency, behind the flown filters.
    - `passed`: response of the gyro's filters that flew, as measured where the log shows more than
        the law has; `chain`: as the law has them.
    - `ceiling`: by which factor D can rise in flight (D_MAX); 1 where it cannot.
    - `relaxed`: whether the integral can be held in flight, as Betaflight's iterm_relax does.
    - `forward`: response of the law's feed-forward, from the set-point to the command.
    - `angle`: of the angle loop around this one, from rate to minus the set-point, per 1/s of its
        gain; None where there is none.
    - `others`: loops at other throttles, under the law there; their plants count, too.
    """

    omega: Float[np.ndarray, " frequencies"]
    feedback: Complex[np.ndarray, "gains frequencies"]
    ahead: Complex[np.ndarray, "gains frequencies"]
    plants: Complex[np.ndarray, "plants frequencies"]
    noise: Float[np.ndarray, " frequencies"]
    passed: Complex[np.ndarray, " frequencies"]
    ceiling: float = 1.0
    chain: Complex[np.ndarray, " frequencies"] | None = None
    relaxed: bool = False
    forward: Complex[np.ndarray, " frequencies"] | None = None
    angle: Complex[np.ndarray, " frequencies"] | None = None
    others: tuple["RateLoops", ...] = ()

    @property
    def groups(self) -> tuple["RateLoops", ...]:
        """For each throttle its own."""
        return dataclasses.replace(self, others=()), *self.others

    def of_law(self, law: RateLoop, axis: int) -> "RateLoops":
        """The same plants under a law with other filters, as exactly as those of the flown one.

        Without those beside.
        """
        back, ahead = law_paths(law, axis, self.omega)
        before = self.passed if self.chain is None else self.chain
        changed = gyro_chain_response(law, self.omega) / before
        return dataclasses.replace(
            self, feedback=back * changed, ahead=ahead, forward=forward_path(law, axis, self.omega),
        )  # fmt: skip

    def worst(self, gains: Gains, count: int) -> "RateLoops":
        """With those plants alone that have the greatest peaks under these gains."""
        groups, peaks = self.groups, []
        for group in groups:
            qualities = group.qualities(gains)
            peak = np.where(
                qualities.stable, np.maximum(qualities.peak, qualities.resonance), np.inf
            )
            peaks.append(peak.max(axis=0))
        chosen = np.zeros(sum(map(len, peaks)), bool)
        chosen[np.argsort(np.concatenate(peaks), kind="stable")[-count:]] = True
        parts = np.split(chosen, np.cumsum([len(peak) for peak in peaks])[:-1])
        return grouped(
            dataclasses.replace(group, plants=group.plants[part])
            for group, part in zip(groups, parts, strict=True)
        )

    def joined(self, others: "RateLoops") -> "RateLoops":
        """With the plants of `others`, each at its throttle, under the laws of these."""
        plants = [group.plants for group in others.groups]
        groups = self.groups if self.others else (self,)
        if not self.others:
            plants = [np.concatenate(plants)]
        return grouped(
            dataclasses.replace(group, plants=np.concatenate([group.plants, more]))
            for group, more in zip(groups, plants, strict=True)
        )

    def qualities(self, gains: Gains, filters: Filters | None = None) -> LoopQualities:
        """What each row of P, I and D gives; stability and Ms with D at its ceiling, too.

        `filters` are the responses of other filters over those that flew.
        """
        qualities = [self._own_qualities(gains, filters)]
        qualities += [loops.qualities(gains, filters) for loops in self.others]
        return qualities[0] if len(qualities) == 1 else together(qualities)

    def _own_qualities(self, gains: Gains, filters: Filters | None) -> LoopQualities:
        base = self._qualities(*self.paths(gains, filters))
        if self.ceiling == 1:
            return base
        return _worst_of(base, self._moved(gains, filters, (1.0, 1.0, self.ceiling)))

    def relaxed_qualities(self, gains: Gains) -> LoopQualities:
        """With the integral held where it can be held in flight, D as set and at its ceiling."""
        parts = []
        for group in self.groups:
            if not group.relaxed:
                parts.append(group._own_qualities(gains, None))
                continue
            base = group._moved(gains, None, (1.0, 0.0, 1.0))
            raised = group._moved(gains, None, (1.0, 0.0, group.ceiling))
            parts.append(_worst_of(base, raised))
        return together(parts)

    def _moved(
        self, gains: Gains, filters: Filters | None, factors: tuple[float, ...]
    ) -> LoopQualities:
        return self._qualities(*self.paths(gains * np.array([factors]), filters))

    def open_loops(
        self, gains: Float[np.ndarray, " gains"]
    ) -> Complex[np.ndarray, "plants frequencies"]:
        """Of the rate, of all groups."""
        return np.concatenate([gains @ group.feedback * group.plants for group in self.groups])

    def outer_loops(
        self, gains: Float[np.ndarray, " gains"], angle_gain: float
    ) -> Complex[np.ndarray, "plants frequencies"]:
        """Of the angle with a gain in 1/s, of all groups; the true rate is before the filters."""
        loops = []
        for group in self.groups:
            assert group.angle is not None
            ahead = gains @ group.ahead + (0 if group.forward is None else group.forward)
            rate = ahead * group.plants / group.passed / (1 + gains @ group.feedback * group.plants)
            loops.append(angle_gain * group.angle * rate)
        return np.concatenate(loops)

    def outer_qualities(
        self, gains: Float[np.ndarray, " gains"], angle_gain: float
    ) -> OuterQualities:
        """What an angle loop with a gain in 1/s gives around the rate loop."""
        loops = self.outer_loops(gains, angle_gain)
        distance = 1 + loops
        stable = _is_stable(np.real(distance)[None], np.imag(distance)[None])[0]
        peaks = 1 / np.abs(distance).min(axis=1), np.abs(loops / distance).max(axis=1)
        return OuterQualities(stable, *peaks)

    def paths(self, gains: Gains, filters: Filters | None = None) -> tuple[Paths, Paths]:
        """The law from the logged rate to minus the command, and from the set-point to it."""
        if filters is None:
            return gains @ self.feedback, gains @ self.ahead
        both, slow, quick = filters.gyro, gains[:, :2], gains[:, 2:]
        back = slow @ self.feedback[:2] + (quick @ self.feedback[2:]) * filters.derivative
        return back * both, slow @ self.ahead[:2] + (quick @ self.ahead[2:]) * filters.derivative

    def _qualities(self, feedback: Paths, ahead: Paths) -> LoopQualities:
        plants, cells, gain = _power(self.plants), cells_of(self.omega), _power(feedback)
        real, imaginary = _one_plus(feedback, self.plants)
        stable = _is_stable(real, imaginary)
        distance, product = real**2, imaginary**2
        distance += product
        above = np.multiply(gain[:, None], plants, out=product) > 1  # |L|
        last = above.shape[-1] - 1 - np.argmax(above[..., ::-1], axis=-1)
        inverse = np.divide(1.0, distance, out=real)
        closed = np.multiply(_power(ahead)[:, None], plants, out=product)
        closed *= inverse
        return LoopQualities(
            stable,
            1 / np.sqrt(distance.min(axis=-1)),
            np.sqrt(closed.max(axis=-1)),
            np.where(above.any(axis=-1), self.omega[last], 0.0),
            np.sqrt(np.einsum("dpf,pf->dp", inverse, plants / self.omega**2 * cells)),
            np.sqrt(np.einsum("dpf,df->dp", inverse, gain * self.noise)),
        )


def _one_plus(
    feedback: Paths, plants: Complex[np.ndarray, "plants frequencies"]
) -> tuple[
    Float[np.ndarray, "designs plants frequencies"], Float[np.ndarray, "designs plants frequencies"]
]:
    """Real and imaginary part of 1 + L, each in one piece of memory."""
    a, b = np.real(feedback)[:, None], np.imag(feedback)[:, None]
    c, d = (np.ascontiguousarray(part) for part in (np.real(plants), np.imag(plants)))
    real, product = a * c, b * d
    real -= product
    real += 1
    imaginary = a * d
    imaginary += np.multiply(b, c, out=product)
    return real, imaginary


def _worst_of(one: LoopQualities, other: LoopQualities) -> LoopQualities:
    """Of each plant; effects of torque and of noise are those of the first."""
    return one._replace(
        stable=one.stable & other.stable,
        peak=np.maximum(one.peak, other.peak),
        resonance=np.maximum(one.resonance, other.resonance),
        crossover=np.maximum(one.crossover, other.crossover),
    )


def grouped(groups: Iterable[RateLoops]) -> RateLoops:
    """The loops of several throttles as one."""
    first, *others = groups
    return dataclasses.replace(first, others=tuple(others))


def together(parts: Sequence[LoopQualities]) -> LoopQualities:
    """Of the plants of all parts."""
    return LoopQualities(*(np.concatenate(column, axis=1) for column in zip(*parts, strict=True)))


def _power(response: Complex[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    return np.real(response) ** 2 + np.imag(response) ** 2


def cells_of(omega: Float[np.ndarray, " frequencies"]) -> Float[np.ndarray, " frequencies"]:
    """The width around each frequency, by the trapezoidal rule."""
    edges = np.concatenate([omega[:1], (omega[1:] + omega[:-1]) / 2, omega[-1:]])
    return np.diff(edges)


def _is_stable(
    real: Float[np.ndarray, "designs plants frequencies"],
    imaginary: Float[np.ndarray, "designs plants frequencies"],
) -> Bool[np.ndarray, "designs plants"]:
    """Whether 1 + L turns from -pi, of the double integrator, to 0; 2 pi for each unstable pair."""
    size = imaginary.shape[-1]
    upper = (imaginary >= 0).ravel()
    k = np.flatnonzero(upper[1:] != upper[:-1])  # through the real axis
    k = k[(k + 1) % size != 0]  # of one loop
    x, y = real.ravel(), imaginary.ravel()
    cross = x[k] * y[k + 1] - x[k + 1] * y[k]  # by which it is left or right of 0
    falls = y[k] >= 0
    turns = np.where(falls & (cross > 0), 1.0, 0.0) - np.where(~falls & (cross < 0), 1.0, 0.0)
    rounds_between = np.bincount(k // size, turns, minlength=x.size // size).reshape(real.shape[:2])
    ends = [np.arctan2(imaginary[..., end], real[..., end]) for end in (0, -1)]
    rounds = np.round((ends[1] + 2 * np.pi * rounds_between) / (2 * np.pi))
    return ends[0] - 2 * np.pi * rounds < 0


def delay_margin(
    loop: Complex[np.ndarray, "plants frequencies"], omega: Float[np.ndarray, " frequencies"]
) -> Float[np.ndarray, " plants"]:
    """The delay in s that brings each open loop to -1, at the worst of its crossings of 1."""
    size, angle = np.log(np.abs(loop)), np.angle(loop)
    falls = np.diff(np.sign(size), axis=1) != 0
    span = size[:, :-1] - size[:, 1:]
    part = np.where(falls, size[:, :-1] / np.where(span == 0, 1.0, span), 0.0)
    turned = np.angle(loop[:, 1:] / loop[:, :-1])
    phase = np.mod(angle[:, :-1] + part * turned + np.pi, 2 * np.pi)  # beyond -180 deg
    at = omega[:-1] * (omega[1:] / omega[:-1]) ** part
    return np.where(falls, phase / at, np.inf).min(axis=1)


def law_paths(
    law: RateLoop, axis: int, omega: Float[np.ndarray, " frequencies"]
) -> tuple[Complex[np.ndarray, "gains frequencies"], Complex[np.ndarray, "gains frequencies"]]:
    """Per unit of P, I and D: from the filtered rate to minus the command, from the set-point."""
    bare = law.without_gyro_filters()  # the logged rate is behind them: they are in the plant
    responses = [law_responses(_alone(bare, name), axis, omega) for name in FIELDS]
    ahead, back = np.stack(responses, axis=1)
    return -back, ahead


def gyro_chain_response(
    law: RateLoop, omega: Float[np.ndarray, " frequencies"]
) -> Complex[np.ndarray, " frequencies"]:
    """Of all filters of the gyro."""
    return filter_response(law.gyro_chains(), omega)


def forward_path(
    law: RateLoop, axis: int, omega: Float[np.ndarray, " frequencies"]
) -> Complex[np.ndarray, " frequencies"] | None:
    """Of the law's feed-forward, from the set-point to the command; of Betaflight's sticks none."""
    if law.of_sticks or not any(np.any(vars(law)[name]) for name in law.feed_forward):
        return None
    without = eqx.tree_at(
        lambda x: [vars(x)[name] for name in FIELDS],
        law.without_gyro_filters(), [jnp.zeros_like(vars(law)["p"])] * len(FIELDS),
    )  # fmt: skip
    return law_responses(without, axis, omega)[0]


def _alone(law: RateLoop, name: str) -> RateLoop:
    """The law with a gain of 1, none of the other two and no feed-forward."""
    fields = (*FIELDS, *law.feed_forward)
    of = lambda law: [vars(law)[field] for field in fields]
    gains = [jnp.full_like(vars(law)["p"], float(field == name)) for field in fields]
    return eqx.tree_at(of, law, gains)  # what `replace` would check anew is known to be right


def law_responses(
    law: RateLoop, axis: int, omega: Float[np.ndarray, " frequencies"]
) -> Complex[np.ndarray, "inputs frequencies"]:
    """From the set-point and from the rate, both in rad/s, to the command."""
    linear = law.linear(axis)
    A, c = np.asarray(linear.A), np.asarray(linear.C)
    into = np.stack([linear.reference_in, linear.measurement_in], axis=1)
    through = np.array([linear.reference_through, linear.measurement_through])
    z = np.exp(1j * omega * linear.dt)[:, None, None]
    inner = np.linalg.solve(z * np.eye(len(A)) - A, np.broadcast_to(into, (len(z), *into.shape)))
    return (c @ inner + through).T


def hold_plants(
    gain: Float[np.ndarray, "plants 1"],
    lag: Float[np.ndarray, "plants 1"],
    delay: Float[np.ndarray, "plants 1"],
    omega: Float[np.ndarray, " frequencies"],
    dt: float,
    damping: Float[np.ndarray, "plants 1"] | None = None,
) -> Complex[np.ndarray, "plants frequencies"]:
    """K e^(-delay s) / ((s + damping) (lag s + 1)) behind a hold: its modified z-transform."""
    lag, delay = np.maximum(lag, 1e-6), np.maximum(delay, 0.0)
    samples = np.floor(delay / dt)
    ahead = dt * (samples + 1) - delay  # from the command's arrival to the next sample
    q = np.exp(-1j * omega * dt)[None]
    actuator = np.exp(-ahead / lag) / (1 - np.exp(-dt / lag) * q)
    if damping is None or not np.any(damping > 0):
        steps = dt * q / (1 - q) ** 2 + (ahead - lag) / (1 - q) + lag * actuator
    else:  # the step's response is 1/damping and two exponentials
        damping = np.maximum(damping, 1e-4)
        spacing = 1 - damping * lag
        rate = np.exp(-damping * ahead) / (1 - np.exp(-damping * dt) * q)
        steps = (1 / (1 - q) - (rate - damping * lag * actuator) / spacing) / damping
    return gain * (1 - q) * q ** (samples + 1) * steps


def gains_of(law: RateLoop, axis: int) -> Float[np.ndarray, " gains"]:
    """P, I and D of one axis."""
    return np.array([float(np.broadcast_to(vars(law)[name], (3,))[axis]) for name in FIELDS])


def gain_row(firmware: str, axis: int, field: str) -> Parameter:
    """The parameter of a gain of one axis."""
    rows = PARAMETERS[firmware].values()
    return next(row for row in rows if row.field == field and row.axis == axis)


def _ceiling_name(law: RateLoop, axis: int) -> str:
    """The parameter up to which D can rise in flight; empty where the firmware has none."""
    rows = PARAMETERS[law.firmware].values()
    return next((x.name for x in rows if x.field == "d_max.ceiling" and x.axis == axis), "")


def parameters_of(law: RateLoop, axis: int, gains: Float[np.ndarray, " gains"]) -> dict[str, float]:
    """The parameters that stand for these gains; a ceiling of D rises with D."""
    firmware = law.firmware
    flown = gains_of(law, axis)
    values = {
        gain_row(firmware, axis, name).name: float(gain)
        for name, gain, old in zip(FIELDS, gains, flown, strict=True)
        if old > 0
    }
    if (ceiling := law.d_ceiling(axis)) > 1:
        values[_ceiling_name(law, axis)] = ceiling * float(gains[2])
    return store_parameters(firmware, values)


def ceiling_in(law: RateLoop, axis: int, designs: Sequence[Mapping[str, Number]]) -> float:
    """The most by which D can rise in flight under one of these stored sets of parameters."""
    flown = law.d_ceiling(axis)
    pairs = [
        (design.get(_ceiling_name(law, axis)), gains_in(law, axis, design)[2]) for design in designs
    ]
    return max([flown, *(float(top / base) for top, base in pairs if top and base > 0)])


def gains_in(
    law: RateLoop, axis: int, parameters: Mapping[str, Number]
) -> Float[np.ndarray, " gains"]:
    """P, I and D of parameters; those that are not named stay."""
    gains = gains_of(law, axis)
    for row in PARAMETERS[law.firmware].values():
        if row.field in FIELDS and row.axis == axis and row.name in parameters:
            gains[FIELDS.index(row.field)] = parameters[row.name]
    return gains
