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
from jaxquad.identify import draw_models, filter_response, Fit, GainOverThrottle, KnownFilter

from ._firmware import OuterLoop, Parameter
from ._law import RateLoop
from ._parameters import PARAMETERS, store_parameters


Gains = Float[np.ndarray, "designs gains"]
Paths = Complex[np.ndarray, "designs frequencies"]
Loops = Float[np.ndarray, "designs plants frequencies"]
Frequencies = Float[np.ndarray, " frequencies"]
Response = Complex[np.ndarray, " frequencies"]
FIELDS = ("p", "i", "d")


class OuterQualities(NamedTuple):
    """What an angle loop gives, for each plant; the resonance is from set-point to angle."""

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

    omega: Frequencies
    feedback: Complex[np.ndarray, "gains frequencies"]
    ahead: Complex[np.ndarray, "gains frequencies"]
    plants: Complex[np.ndarray, "plants frequencies"]
    noise: Frequencies
    passed: Response
    ceiling: float = 1.0
    chain: Response | None = None
    relaxed: bool = False
    forward: Response | None = None
    angle: Response | None = None
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
        qualities = self._qualities(*self.paths(gains, filters))
        if self.ceiling != 1:
            raised = gains * np.array([[1.0, 1.0, self.ceiling]])
            qualities = _worst_of(qualities, self._qualities(*self.paths(raised, filters)))
        parts = [qualities, *(loops.qualities(gains, filters) for loops in self.others)]
        return together(parts) if self.others else qualities

    def relaxed_qualities(self, gains: Gains) -> LoopQualities:
        """With the integral held where it can be held in flight, D as set and at its ceiling."""
        parts = []
        for group in self.groups:
            if not group.relaxed:
                parts.append(group.qualities(gains))
                continue
            base, raised = (
                group._qualities(*group.paths(gains * np.array([[1.0, 0.0, factor]])))
                for factor in (1.0, group.ceiling)
            )
            parts.append(_worst_of(base, raised))
        return together(parts)

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
        # Real and imaginary part of 1 + L, each in one piece of memory.
        a, b = np.real(feedback)[:, None], np.imag(feedback)[:, None]
        c, d = (np.ascontiguousarray(x) for x in (np.real(self.plants), np.imag(self.plants)))
        real, product = a * c, b * d
        real -= product
        real += 1
        imaginary = a * d
        imaginary += np.multiply(b, c, out=product)
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


def cells_of(omega: Frequencies) -> Frequencies:
    """The width around each frequency, by the trapezoidal rule."""
    edges = np.concatenate([omega[:1], (omega[1:] + omega[:-1]) / 2, omega[-1:]])
    return np.diff(edges)


def _is_stable(real: Loops, imaginary: Loops) -> Bool[np.ndarray, "designs plants"]:
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
    loop: Complex[np.ndarray, "plants frequencies"], omega: Frequencies
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
    law: RateLoop, axis: int, omega: Frequencies
) -> tuple[Complex[np.ndarray, "gains frequencies"], Complex[np.ndarray, "gains frequencies"]]:
    """Per unit of P, I and D: from the filtered rate to minus the command, from the set-point."""
    bare = law.without_gyro_filters()  # the logged rate is behind them: they are in the plant
    fields, responses = (*FIELDS, *law.feed_forward), []
    for name in FIELDS:  # a gain of 1, none of the other two and no feed-forward
        gains = [jnp.full_like(vars(law)["p"], float(field == name)) for field in fields]
        # What `replace` would check anew is known to be right.
        alone = eqx.tree_at(lambda law: [vars(law)[field] for field in fields], bare, gains)
        responses.append(law_responses(alone, axis, omega))
    ahead, back = np.stack(responses, axis=1)
    return -back, ahead


def gyro_chain_response(law: RateLoop, omega: Frequencies) -> Response:
    """Of all filters of the gyro."""
    return filter_response(law.gyro_chains(), omega)


def forward_path(law: RateLoop, axis: int, omega: Frequencies) -> Response | None:
    """Of the law's feed-forward, from the set-point to the command; of Betaflight's sticks none."""
    if law.of_sticks or not any(np.any(vars(law)[name]) for name in law.feed_forward):
        return None
    without = eqx.tree_at(
        lambda x: [vars(x)[name] for name in FIELDS],
        law.without_gyro_filters(), [jnp.zeros_like(vars(law)["p"])] * len(FIELDS),
    )  # fmt: skip
    return law_responses(without, axis, omega)[0]


def law_responses(
    law: RateLoop, axis: int, omega: Frequencies
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
    omega: Frequencies,
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


Drawn = Float[np.ndarray, "plants 1"]
_LOWEST = 0.05  # rad/s, below which only the integrals count
_FREQUENCIES = 300
_AT_ONCE = 256  # draws: each other number would be compiled anew


@dataclasses.dataclass(frozen=True)
class PlantSource:
    """What plants are drawn from.

    **Attributes:**

    - `fit`: up to what the gyro's filters are given, in `unit`.
    - `over`: the gain over the throttle, whose plants take the place of those of `fit`.
    - `span`: the lowest and the highest throttle of these.
    - `filters`: of the gyro, as measured; None takes those of the law.
    """

    fit: Fit
    unit: str
    over: GainOverThrottle | None = None
    span: tuple[float, float] = (0.0, 1.0)
    filters: Sequence[KnownFilter] | None = None

    @property
    def damping(self) -> float:
        """Of the rate in 1/s, as the fit has it."""
        return float(np.asarray(vars(self.fit.model).get("damping", 0.0)))

    def loops(
        self, law: RateLoop, axis: int, count: int, seed: int, *,
        omega: Frequencies | None = None, throttle: float | None = None,
        angle: OuterLoop | None = None,
    ) -> RateLoops:  # fmt: skip
        """The loops of a law with so many plants, and an angle loop around them.

        All are at one `throttle`, or each is at its own, evenly over the span.

        Raises ValueError where a drawn gain is not above 0.
        """
        if omega is None:
            omega = np.geomspace(_LOWEST, 0.999 * np.pi / law.dt, _FREQUENCIES)
        back, ahead = law_paths(law, axis, omega)
        chain = gyro_chain_response(law, omega)
        passed = chain if self.filters is None else filter_response(self.filters, omega)
        gain, lag, delay, damping = self._drawn(count, seed, throttle)
        if np.any(gain <= 0):
            raise ValueError(
                f"the gain from the command to the rate is not above 0 in {int(np.sum(gain <= 0))} "
                f"of {count} plants drawn from the fit: check the sign of the input, or fly more "
                "excitation"
            )
        per_radian = np.pi / 180 if self.unit == "deg/s" else 1.0
        plants = hold_plants(per_radian * gain, lag, delay, omega, law.dt, damping)
        white = cells_of(omega) * np.abs(passed) ** 2
        return RateLoops(
            omega, back, ahead, plants * passed, white, passed, law.d_ceiling(axis), chain,
            law.holds_integral(axis), forward_path(law, axis, omega),
            None if angle is None else angle.path(omega),
        )  # fmt: skip

    def _drawn(
        self, count: int, seed: int, throttle: float | None
    ) -> tuple[Drawn, Drawn, Drawn, Drawn]:
        """Gain, lag, delay and damping."""
        if self.over is None:
            names = len(self.fit.names)
            scores = np.zeros((names, -(-count // _AT_ONCE) * _AT_ONCE))
            scores[:, :count] = np.random.default_rng(seed).standard_normal((names, count))
            models = draw_models(self.fit, jnp.asarray(scores))
            wide = lambda x: np.broadcast_to(np.asarray(x, float), scores[0].shape)[:count, None]
            return wide(models.gain), wide(models.lag), wide(models.delay), wide(models.damping)
        if throttle is None:
            drawn = self.over.draw(np.linspace(*self.span, count), count, seed=seed)
            gain = np.diagonal(drawn.gain)
        else:
            drawn = self.over.draw(np.array([throttle]), count, seed=seed)
            gain = drawn.gain[0]
        lag, delay = drawn.lag[:, None], drawn.delay[:, None]
        return gain[:, None], lag, delay, np.full_like(lag, self.damping)
