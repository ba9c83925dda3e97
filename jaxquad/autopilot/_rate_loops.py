"""Rate loops over the plants that a fit leaves uncertain, and what gains give there.

P, I and D enter a rate loop's response one by one as factors, and the identified plant under a held
command has a closed form: a design is a search over three numbers, and no flight is simulated.
Source: docs/autopilots.md.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float

from jaxquad.identify import draw_models, filter_response, KnownFilter, MeasuredChain

from ._firmware import OuterLoop, Stage as FilterStage
from ._flight_channels import FlownAutopilot, IdentifiedPlant
from ._identified_log import ThrottleVerdict
from ._law import linear_responses, RateLoop


Frequencies = Float[np.ndarray, " frequencies"]
Response = Complex[np.ndarray, " frequencies"]
Responses = Complex[np.ndarray, "plants frequencies"]
SomePlants = Complex[np.ndarray, "_ frequencies"]  # of one of several loops
Paths = Complex[np.ndarray, "designs frequencies"]
Parts = Complex[np.ndarray, "gains frequencies"]
Filters = Mapping[FilterStage, Paths]  # of other filters of each design, over those that flew
Parted = Float[np.ndarray, "designs plants frequencies"]  # of 1 + L
Gains = Float[np.ndarray, "designs gains"]
OneGains = Float[np.ndarray, " gains"]
Column = Float[np.ndarray, "plants 1"]


class LoopQualities(NamedTuple):
    """What gains give, for each design and plant."""

    stable: Bool[np.ndarray, "designs plants"]  # by Nyquist's criterion on the sampled loop
    peak: Float[np.ndarray, "designs plants"]  # Ms
    resonance: Float[np.ndarray, "designs plants"]  # from set-point to rate, no feed-forward
    crossover: Float[np.ndarray, "designs plants"]  # the highest frequency with |L| = 1, rad/s
    # Root of the integrated square of the rate after a step of torque, relative.
    rejection: Float[np.ndarray, "designs plants"]
    noise: Float[np.ndarray, "designs plants"]  # rms of the command of the gyro's noise, relative


@dataclasses.dataclass(frozen=True)
class RateLoops:
    """The open rate loops of one axis for all plants, on a grid of frequencies."""

    omega: Frequencies  # rad/s
    feedback: Parts  # per unit of P, I and D: from the logged rate to minus the command
    ahead: Parts  # likewise from the set-point to the command
    plants: Responses  # from the command to the logged rate in rad/s, the hold included
    noise: Frequencies  # power of the logged rate around each frequency, behind the flown filters
    passed: Response  # of the flown gyro filters, as measured where the law lacks some of them
    ceiling: float = 1.0  # by which factor D can rise in flight (D_MAX)
    chain: Response | None = None  # of the flown gyro filters that the law has
    relaxed: bool = False  # whether the integral can be held in flight (iterm_relax)
    forward: Response | None = None  # of the law's feed-forward, from the set-point to the command
    angle: Response | None = None  # of the angle loop around this one: `OuterLoop.path`

    @classmethod
    def of(
        cls, law: RateLoop, axis: int, plants: Responses, omega: Frequencies,
        filters: Sequence[KnownFilter] | None = None, angle: OuterLoop | None = None,
    ) -> "RateLoops":  # fmt: skip
        """Of plants up to the gyro's filters, which are the law's if they are not given."""
        chain = gyro_chain_response(law, omega)
        passed = chain if filters is None else filter_response(filters, omega)
        return cls(
            omega, *law_paths(law, axis, omega), plants * passed,
            cells_of(omega) * np.abs(passed) ** 2, passed, law.d_ceiling(axis), chain,
            law.holds_integral(axis), forward_path(law, axis, omega),
            None if angle is None else angle.path(omega),
        )  # fmt: skip

    def in_single_precision(self) -> "RateLoops":
        """The same plants, for a search: half the time, and qualities to about 1e-4."""
        return dataclasses.replace(self, plants=self.plants.astype(np.complex64))

    def of_law(self, law: RateLoop, axis: int) -> "RateLoops":
        """The plants of this throttle under a law with other filters."""
        back, ahead = law_paths(law, axis, self.omega)
        before = self.passed if self.chain is None else self.chain
        back = back * (gyro_chain_response(law, self.omega) / before)
        forward = forward_path(law, axis, self.omega)
        return dataclasses.replace(self, feedback=back, ahead=ahead, forward=forward)

    def qualities(self, gains: Gains, filters: Filters | None = None) -> LoopQualities:
        """What each row of P, I and D gives; stability and peaks with D at its ceiling, too."""
        qualities = self._qualities(*self.paths(gains, filters))
        if self.ceiling != 1:
            raised = gains * np.array([[1.0, 1.0, self.ceiling]])
            other = self._qualities(*self.paths(raised, filters))
            names = ("peak", "resonance", "crossover")
            worse = {x: np.maximum(getattr(qualities, x), getattr(other, x)) for x in names}
            qualities = qualities._replace(stable=qualities.stable & other.stable, **worse)
        return qualities

    def outer_loops(self, gains: OneGains, angle_gain: float) -> Responses:
        """Of the angle with a gain in 1/s; the true rate is before the filters."""
        assert self.angle is not None
        ahead = gains @ self.ahead + (0 if self.forward is None else self.forward)
        rate = ahead * self.plants / self.passed / (1 + gains @ self.feedback * self.plants)
        return angle_gain * self.angle * rate

    def paths(self, gains: Gains, filters: Filters | None = None) -> tuple[Paths, Paths]:
        """The law from the logged rate to minus the command, and from the set-point to it."""
        if filters is None:
            return gains @ self.feedback, gains @ self.ahead
        both, slow, quick = filters["gyro"], gains[:, :2], gains[:, 2:]
        back = slow @ self.feedback[:2] + (quick @ self.feedback[2:]) * filters["derivative"]
        return back * both, slow @ self.ahead[:2] + (quick @ self.ahead[2:]) * filters["derivative"]

    def _qualities(self, feedback: Paths, ahead: Paths) -> LoopQualities:
        plants, cells, gain = _power(self.plants), cells_of(self.omega), _power(feedback)
        # Real and imaginary part of 1 + L, each in one piece of memory.
        c, d = (np.ascontiguousarray(x) for x in (np.real(self.plants), np.imag(self.plants)))
        as_plants = lambda x: x.astype(c.dtype, copy=False)
        a, b = (as_plants(x)[:, None] for x in (np.real(feedback), np.imag(feedback)))
        real, product = a * c, b * d
        real -= product
        real += 1
        imaginary = a * d
        imaginary += np.multiply(b, c, out=product)
        stable = is_stable(real, imaginary)
        distance, product = real**2, imaginary**2
        distance += product
        above = np.multiply(as_plants(gain)[:, None], plants, out=product) > 1  # |L|
        last = above.shape[-1] - 1 - np.argmax(above[..., ::-1], axis=-1)
        inverse = np.divide(1.0, distance, out=real)
        closed = np.multiply(as_plants(_power(ahead))[:, None], plants, out=product)
        closed *= inverse
        return LoopQualities(
            stable,
            1 / np.sqrt(distance.min(axis=-1)),
            np.sqrt(closed.max(axis=-1)),
            np.where(above.any(axis=-1), self.omega[last], 0.0),
            np.sqrt(np.einsum("dpf,pf->dp", inverse, as_plants(plants / self.omega**2 * cells))),
            np.sqrt(np.einsum("dpf,df->dp", inverse, as_plants(gain * self.noise))),
        )


Loops = TypeVar("Loops", bound=RateLoops)


def with_plants(loops: Iterable[Loops], plants: Iterable[SomePlants]) -> list[Loops]:
    """The loops, each with other plants."""
    return [dataclasses.replace(x, plants=y) for x, y in zip(loops, plants, strict=True)]


def with_more_plants(loops: Sequence[Loops], more: Iterable[SomePlants]) -> list[Loops]:
    pairs = zip(loops, more, strict=True)
    return with_plants(loops, (np.concatenate([loop.plants, x]) for loop, x in pairs))


def worst_plants(loops: Sequence[RateLoops], gains: Gains, count: int) -> list[SomePlants]:
    """Those of all loops that have the greatest peaks under these gains."""
    peaks = []
    for x in (loop.qualities(gains) for loop in loops):
        peaks.append(np.where(x.stable, np.maximum(x.peak, x.resonance), np.inf).max(axis=0))
    chosen = np.zeros(sum(map(len, peaks)), bool)
    chosen[np.argsort(np.concatenate(peaks), kind="stable")[-count:]] = True
    parts = np.split(chosen, np.cumsum([len(peak) for peak in peaks])[:-1])
    return [loop.plants[part] for loop, part in zip(loops, parts, strict=True)]


def together(parts: Iterable[LoopQualities]) -> LoopQualities:
    """Of the plants of all parts."""
    return LoopQualities(*(np.concatenate(column, axis=1) for column in zip(*parts, strict=True)))


def _power(response: Complex[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    return np.real(response) ** 2 + np.imag(response) ** 2


def cells_of(omega: Frequencies) -> Frequencies:
    """The width around each frequency, by the trapezoidal rule."""
    edges = np.concatenate([omega[:1], (omega[1:] + omega[:-1]) / 2, omega[-1:]])
    return np.diff(edges)


def is_stable(real: Parted, imaginary: Parted) -> Bool[np.ndarray, "designs plants"]:
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


def delay_margin(loop: Responses, omega: Frequencies) -> Float[np.ndarray, " plants"]:
    """The delay in s that brings each open loop to -1, at the worst of its crossings of 1."""
    size, angle = np.log(np.abs(loop)), np.angle(loop)
    falls = np.diff(np.sign(size), axis=1) != 0
    span = size[:, :-1] - size[:, 1:]
    part = np.where(falls, size[:, :-1] / np.where(span == 0, 1.0, span), 0.0)
    turned = np.angle(loop[:, 1:] / loop[:, :-1])
    phase = np.mod(angle[:, :-1] + part * turned + np.pi, 2 * np.pi)  # beyond -180 deg
    at = omega[:-1] * (omega[1:] / omega[:-1]) ** part
    return np.where(falls, phase / at, np.inf).min(axis=1)


def law_paths(law: RateLoop, axis: int, omega: Frequencies) -> tuple[Parts, Parts]:
    """Per unit of P, I and D: from the filtered rate to minus the command, from the set-point."""
    paths = [unit_path(law, axis, name, omega) for name in law.tuned]
    ahead, back = np.stack(paths, axis=1)
    return -back, ahead


def unit_path(
    law: RateLoop, axis: int, name: str, omega: Frequencies
) -> Complex[np.ndarray, "2 frequencies"]:
    """With a gain of 1 and no other, from the set-point and the filtered rate to the command."""
    bare = law.without_gyro_filters()  # the logged rate is behind them: they are in the plant
    fields = (*law.tuned, *law.feed_forward)
    gains = [jnp.full_like(vars(law)["p"], float(field == name)) for field in fields]
    # What `replace` would check anew is known to be right.
    alone = eqx.tree_at(lambda law: [vars(law)[field] for field in fields], bare, gains)
    return linear_responses(alone.linear(axis), omega)


def gyro_chain_response(law: RateLoop, omega: Frequencies) -> Response:
    return filter_response(law.gyro_chains(), omega)


def forward_path(law: RateLoop, axis: int, omega: Frequencies) -> Response | None:
    """Of the law's feed-forward, from the set-point to the command; of Betaflight's sticks none."""
    if law.of_sticks or not any(np.any(vars(law)[name]) for name in law.feed_forward):
        return None
    without = eqx.tree_at(
        lambda x: [vars(x)[name] for name in law.tuned],
        law.without_gyro_filters(), [jnp.zeros_like(vars(law)["p"])] * len(law.tuned),
    )  # fmt: skip
    return linear_responses(without.linear(axis), omega)[0]


def hold_plants(
    gain: Column, lag: Column, delay: Column, omega: Frequencies, dt: float,
    damping: Column | None = None,
) -> Responses:  # fmt: skip
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


_LOWEST = 0.05  # rad/s, below which only the integrals count
_FREQUENCIES = 300
_AT_ONCE = 256  # draws: each other number would be compiled anew


def draw_loops(
    plant: IdentifiedPlant, over: ThrottleVerdict | None, flown: FlownAutopilot, count: int,
    seed: int, *, omega: Frequencies | None = None, throttle: float | None = None,
) -> RateLoops:  # fmt: skip
    """The loops of what flew with plants drawn from the fit, or from the gain `over` the throttle.

    All are at one `throttle`, or each is at its own, evenly over the span.

    Raises ValueError where a drawn gain is not above 0.
    """
    law, fit = flown.law, plant.fit
    if omega is None:
        omega = np.geomspace(_LOWEST, 0.999 * np.pi / law.dt, _FREQUENCIES)
    if over is None or over.gains is None:
        scores = np.zeros((len(fit.names), -(-count // _AT_ONCE) * _AT_ONCE))
        scores[:, :count] = np.random.default_rng(seed).standard_normal((len(fit.names), count))
        models = draw_models(fit, jnp.asarray(scores))
        wide = lambda x: np.broadcast_to(np.asarray(x, float), scores[0].shape)[:count]
        gain, lag, delay = wide(models.gain), wide(models.lag), wide(models.delay)
        damping = wide(models.damping)
    else:
        at = np.linspace(*over.span, count) if throttle is None else np.array([throttle])
        drawn = over.gains.draw(at, count, seed=seed)
        gain = np.diagonal(drawn.gain) if throttle is None else drawn.gain[0]
        lag, delay, damping = drawn.lag, drawn.delay, np.full(count, float(fit.model.damping))
    if np.any(gain <= 0):
        raise ValueError(
            f"the gain from the command to the rate is not above 0 in {int(np.sum(gain <= 0))} of "
            f"{count} plants drawn from the fit: check the sign of the input, or fly more "
            "excitation"
        )
    per_radian = np.pi / 180 if plant.records[0].output_units[0] == "deg/s" else 1.0
    gain, lag, delay, damping = (x[:, None] for x in (per_radian * gain, lag, delay, damping))
    plants = hold_plants(gain, lag, delay, omega, law.dt, damping)
    measured = any(isinstance(x, MeasuredChain) for x in flown.filters)
    filters = flown.filters if measured else None
    return RateLoops.of(law, flown.axis, plants, omega, filters, flown.angle)


Kind = Literal["proposed", "kept", "cannot tell", "not to be flown"]
WAYS = ("what flew", "a third of the way", "all of it")


@runtime_checkable
class Limits(Protocol):
    """What is kept: `DesignSettings`, or the `ADRCTargets`."""

    @property
    def sensitivity(self) -> float: ...
    @property
    def resonance(self) -> float: ...
    @property
    def noise(self) -> float: ...
    @property
    def change(self) -> float: ...


@runtime_checkable
class DesignSettings(Limits, Protocol):
    """What is kept, and how many plants: `jq.workflows.AutopilotSettings`."""

    @property
    def keep_filters(self) -> bool: ...
    @property
    def members(self) -> int: ...
    @property
    def fresh(self) -> int: ...
    @property
    def seed(self) -> int: ...
    def content(self) -> dict[str, Any]: ...
    def words(self) -> list[str]: ...


class OuterStage(NamedTuple):
    """What the angle loop around a rate loop gives on fresh plants."""

    parameter: str  # of its gain
    value: float
    closed: bool  # whether it was closed in the flight
    stable: float  # share of the plants
    peak: float  # the greatest Ms
    resonance: float  # the greatest peak from set-point to angle
    delay_margin: float  # the least, in s


class Stage(NamedTuple):
    """What gains give on fresh plants."""

    gains: tuple[float, ...]  # P, I and D
    stable: float  # share of the plants
    peak: float  # the greatest
    resonance: float  # the greatest
    crossover: float  # the median, in rad/s
    rejection: float  # relative to what flew
    noise: float  # relative to what flew
    peaks: tuple[float, ...] = ()  # the greatest Ms at each throttle
    relaxed: float | None = None  # the greatest Ms with the integral held; None where it never is
    delay_margin: float = float("inf")  # the least, in s
    angle: OuterStage | None = None  # of the angle loop around it

    def cells(self) -> list[str]:
        """The numbers as text and page print them, the crossover in Hz, the delay margin in ms."""
        margin = f"{1e3 * self.delay_margin:.1f}" if self.stable == 1 else "none"
        peaks, effects = (self.peak, self.resonance), (self.rejection, self.noise)
        peaks, effects = ([f"{x:.2f}" for x in part] for part in (peaks, effects))
        hertz = self.crossover / (2 * np.pi)
        return [f"{100 * self.stable:.1f}", *peaks, f"{hertz:.1f}", margin, *effects]

    def content(self) -> dict[str, object]:
        return {**self._asdict(), "angle": None if self.angle is None else self.angle._asdict()}


def certify_angle(
    loops: Sequence[RateLoops], gains: OneGains, angle: OuterLoop, value: float
) -> OuterStage:
    """The angle loop with a value of its parameter around the rate loop with these gains."""
    around = np.concatenate([loop.outer_loops(gains, angle.unit * value) for loop in loops])
    distance = 1 + around
    stable = is_stable(np.real(distance)[None], np.imag(distance)[None])
    peak = np.max(1 / np.abs(distance).min(axis=1))
    resonance = np.max(np.abs(around / distance).max(axis=1))
    margin = np.min(delay_margin(around, loops[0].omega))
    numbers = map(float, (np.mean(stable), peak, resonance, margin))
    return OuterStage(angle.name, value, angle.closed, *numbers)


def certify_gains(loops: Sequence[Sequence[RateLoops]], designs: Sequence[OneGains]) -> list[Stage]:
    """What each of the designs gives under its own law, the first of which is what flew."""
    rms, stages, flown = lambda x: float(np.sqrt(np.mean(x**2))), [], None
    for groups, gains in zip(loops, designs, strict=True):
        parts = [group.qualities(gains[None]) for group in groups]
        qualities, still = together(parts), None
        flown = flown or qualities
        stable = qualities.stable
        if any(group.relaxed for group in groups):  # with the integral held
            free = lambda group: np.array([[1.0, 0.0 if group.relaxed else 1.0, 1.0]])
            still = together(group.qualities(gains * free(group)) for group in groups)
            stable = stable & still.stable
        opened = np.concatenate([gains @ x.feedback * x.plants for x in groups])
        stages.append(
            Stage(
                tuple(map(float, gains)), float(np.mean(stable)), float(np.max(qualities.peak)),
                float(np.max(qualities.resonance)), float(np.median(qualities.crossover)),
                rms(qualities.rejection) / rms(flown.rejection),
                rms(qualities.noise) / rms(flown.noise),
                tuple(float(np.max(part.peak)) for part in parts),
                None if still is None else float(np.max(still.peak)),
                float(np.min(delay_margin(opened, groups[0].omega))),
            )
        )  # fmt: skip
    return stages
