"""What the loops of all firmwares share: state, linear form, and the filters of the gyro."""

import abc
import dataclasses
from collections.abc import Mapping
from typing import ClassVar, Generic, NamedTuple, TYPE_CHECKING, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Complex, Float, PyTree

from jaxquad._core import (
    as_messages,
    broadcast_gain,
    ensemble_shape,
    is_concrete,
    match_reference,
    Message,
    pick_gain,
    require_common_shape,
    require_finite,
    require_nonnegative,
    require_sample_interval,
    signal_shape,
)
from jaxquad.control import as_setpoint, LinearController, Member, Reference, Setpoint, Transform

from ._filters import FilterChain, Memory, rest_of, run_sections, Section


DEGREES = 180 / np.pi  # per radian
Signal = Float[Array, " axes *ensemble"]
Series = Float[np.ndarray, " samples"]
Samples = Float[np.ndarray, "samples axes"]
Terms = Mapping[str, Signal]
Memories = Mapping[str, PyTree]  # filters, integrals, last samples
Advance = tuple[dict[str, PyTree], Signal, Terms]  # memory, command and its terms


class LoopState(NamedTuple):
    """What the loop of a firmware remembers from the last sample."""

    memory: Memories
    command: Signal  # in the firmware's unit
    excess: Signal  # of it beyond what the drive gave
    terms: Terms  # P, I, D and F of the last sample, in units of the command


class FirmwareLoop(eqx.Module):
    """A control law of a firmware, one `step` per sample. Its linear form is its exact derivative.

    Subclasses are final: they say what the law remembers at rest, and how it advances.
    """

    if TYPE_CHECKING:  # fields of each law, in its own order

        @property
        def dt(self) -> float: ...  # s

    @abc.abstractmethod
    def rest(self, zero: Signal) -> dict[str, PyTree]:
        """What the law remembers at rest, for signals like `zero`."""

    @abc.abstractmethod
    def advance(
        self, memory: Memories, excess: Signal, reference: Reference, measurement: Signal
    ) -> Advance:
        """Memory, command and its terms, one sample later."""

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the gains, () for one controller."""
        return ensemble_shape(self)

    def init(self, like: Signal) -> LoopState:
        """At rest; shaped as the measurement `like` and the ensemble of the gains."""
        zero = jnp.zeros(signal_shape(like, self.ensemble), like.dtype)
        return LoopState(self.rest(zero), zero, zero, dict.fromkeys("PIDF", zero))

    def step(
        self, state: LoopState, reference: Reference, measurement: Signal
    ) -> tuple[LoopState, Signal]:
        """One sample: the command to hold until the next one, in the firmware's unit."""
        reference = match_reference(reference, measurement, state.command)
        memory, command, terms = self.advance(state.memory, state.excess, reference, measurement)
        return LoopState(memory, command, jnp.zeros_like(command), terms), command

    def applied(self, state: LoopState, achieved: Signal) -> LoopState:
        """The state with what the drive really gave: what a firmware learns from its mixer."""
        return state._replace(excess=state.command - achieved)

    def signals(self, state: LoopState) -> dict[str, Array]:
        """The terms "P", "I", "D" and "F" of the command, in its unit, as a log has them."""
        return dict(state.terms)

    def linear(self, axis: int = 0, member: Member = None) -> LinearController:
        """One axis for small signals: the law's derivative at rest; `member` picks one member."""
        return _derivative(pick_axis(self, axis, member))

    def tunable(self) -> dict[str, Transform | None]:
        """The gains of P, I and D that are not 0."""
        gains = self.gains().items()
        return dict.fromkeys(name for name, gain in gains if np.all(np.asarray(gain) != 0))

    @abc.abstractmethod
    def gains(self) -> dict[str, Array]:
        """What `tunable` names unless it is 0."""


_UNROLLED = 2  # samples of the gyro, up to which a loop costs more than it saves


class RateLoop(FirmwareLoop):
    """The rate loop of a firmware: rates in rad/s in, behind filters of the gyro.

    The methods say what a design has to know of a law; all have defaults for what it does not have.

    **Raises:**

    - `ValueError`: a gain is not finite, the gyro's rate is no multiple of 1/dt, or a filter lies
        beyond half of its rate.
    """

    firmware: ClassVar[str]  # its name
    tuned: ClassVar[tuple[str, ...]] = ("p", "i", "d")
    factors: ClassVar[tuple[str, ...]] = ()  # of gains
    feed_forward: ClassVar[tuple[str, ...]] = ()  # gains of it
    limits: ClassVar[tuple[str, ...]] = ()  # fields that are not below 0
    of_sticks: ClassVar[bool] = False  # whether feed-forward is theirs, between samples
    if TYPE_CHECKING:

        @property
        def gyro(self) -> FilterChain: ...

    def __check_init__(self):
        gains = {name: vars(self)[name] for name in (*self.factors, *self.feed_forward)}
        limits = {name: vars(self)[name] for name in self.limits}
        require_gains(self.dt, {**self.gains(), **gains}, limits)
        if self.gyro.filters:
            samples_between(self.gyro, self.dt)  # refuses another rate than a multiple

    def gains(self) -> dict[str, Array]:
        return {name: vars(self)[name] for name in self.tuned}

    def filter_gyro(
        self, memory: Memories, rate: Signal, *more: Section
    ) -> tuple[dict[str, PyTree], tuple[Signal, Signal]]:
        """The filtered rate at this sample, and it through the sections `more` at the gyro's rate.

        Between two samples of the loop the rate is taken as straight.
        """
        sections, before = self.gyro.sections(), memory["rate"]
        count = samples_between(self.gyro, self.dt) if self.gyro.filters else 1

        def advance(memories: tuple[Memory, Memory], part: Array):
            gyro, smooth = run_sections(sections, memories[0], before + part * (rate - before))
            derivative, further = run_sections(more, memories[1], smooth)
            return (gyro, derivative), (smooth, further)

        memories, passed = (memory["gyro"], memory["derivative"]), (rate, rate)
        parts = jnp.arange(1, count + 1, dtype=rate.dtype) / count
        if count <= _UNROLLED:
            for k in range(count):
                memories, passed = advance(memories, parts[k])
        else:
            memories, (smooth, further) = jax.lax.scan(advance, memories, parts)
            passed = smooth[-1], further[-1]
        return {"gyro": memories[0], "derivative": memories[1], "rate": rate}, passed

    def gyro_rest(self, zero: Signal, *more: Section) -> dict[str, PyTree]:
        """What `filter_gyro` remembers at rest."""
        return {"gyro": self.gyro.init(zero), "derivative": rest_of(more, zero), "rate": zero}

    def low_passed(self, cutoff_hz: Array, before: Signal, value: Signal) -> Signal:
        """x += k (value - x) from `before`, k = 1 for a cutoff of 0 (alpha of PX4, ArduPilot)."""
        on = cutoff_hz > 0
        w = 2 * np.pi * self.dt * jnp.where(on, cutoff_hz, 1.0)
        return before + broadcast_gain(jnp.where(on, w / (w + 1), 1.0), value) * (value - before)

    def gyro_chains(self) -> list[FilterChain]:
        """All filters of the gyro, at their own rates."""
        return [self.gyro]

    def derivative_chain(self, axis: int) -> FilterChain:
        """The filters of the D term alone."""
        return FilterChain((), 1 / self.dt)

    def without_gyro_filters(self) -> "RateLoop":
        """The law as it acts on the logged rate: a plant up to that contains the filters."""
        return dataclasses.replace(self, gyro=FilterChain())

    def levelled(self) -> "RateLoop":
        """The law as it is inside an angle loop that was closed."""
        return self

    def deflected(self) -> "RateLoop":
        """The law under sticks far from their middle, for all of the feed-forward."""
        return self

    def holds_integral(self, axis: int) -> bool:
        """Whether the integral can be held while the set-point moves (iterm_relax)."""
        return False

    def d_ceiling(self, axis: int) -> float:
        """By which factor D can rise in flight (D_MAX); 1 where it cannot."""
        return 1.0


RateLaw = TypeVar("RateLaw", bound=RateLoop)


class FlownLoop(eqx.Module, Generic[RateLaw]):
    """The rate loop of a log, for roll, pitch and yaw, and what of it is not modelled.

    The `law` is that at hover (for Betaflight, with throttle-dependent cutoffs at 30 %). Sentences
    of `unmodelled` have the kind "notch", "anti-gravity", "feedforward" or none.
    """

    law: RateLaw
    unmodelled: tuple[Message, ...] = eqx.field(static=True, converter=as_messages, default=())

    def parameters(self) -> dict[str, float]:
        """The values that flew, by the names of `PARAMETERS`."""
        from ._parameters import list_parameters

        return list_parameters(self.law)

    def at(self, throttle: Float[ArrayLike, "..."]) -> RateLaw:
        """The law at a throttle of 0 to 1."""
        return self.law

    # What a replay of a log asks for

    def moments(
        self, throttle: Series, before: Series, mixer_range: Series | None
    ) -> tuple[Series, ...]:
        """What `at_moment` takes, by the throttle now and a loop before, and the mixer's range."""
        return ()

    def at_moment(self, *moment: Array) -> RateLaw:
        """The law at one sample of a log."""
        return self.law

    def setpoint_speed(self, slope: Samples, fed: Samples) -> Samples:
        """In rad/s^2, by the slope of the set-point and the logged F."""
        return slope


class AngleLoop(FirmwareLoop):
    """An angle loop of a firmware around its rate loop: angles in rad in.

    The rate that the inner loop sees is the difference of the measured angles over a sample.
    Subclasses are final: they say what rate they ask for.
    """

    outer: ClassVar[tuple[str, ...]] = ("p",)  # gains of the angle alone
    rate: eqx.AbstractVar[FirmwareLoop]

    @property
    def dt(self) -> float:
        return self.rate.dt

    def gains(self) -> dict[str, Array]:
        outer = {name: vars(self)[name] for name in self.outer}
        return outer | {f"rate.{name}": x for name, x in self.rate.gains().items()}

    def rest(self, zero: Signal) -> dict[str, PyTree]:
        return {"rate": self.inner().rest(zero), "angle": zero, **self.outer_rest(zero)}

    def advance(
        self, memory: Memories, excess: Signal, reference: Reference, measurement: Signal
    ) -> Advance:
        rate = (measurement - memory["angle"]) / self.dt
        outer, wanted = self.wanted_rate(memory, as_setpoint(reference), measurement, rate)
        inner, command, terms = self.inner().advance(memory["rate"], excess, wanted, rate)
        return {"rate": inner, "angle": measurement, **outer}, command, terms

    def inner(self) -> FirmwareLoop:
        """The rate loop as it is inside this one."""
        return self.rate

    def outer_rest(self, zero: Signal) -> dict[str, PyTree]:
        """What the angle loop remembers at rest besides the last angle."""
        return {}

    @abc.abstractmethod
    def wanted_rate(
        self, memory: Memories, aim: Setpoint, angle: Signal, rate: Signal
    ) -> tuple[dict[str, PyTree], Signal]:
        """What the angle loop remembers, and the set-point of the rate in rad/s."""


Law = TypeVar("Law", bound=eqx.Module)


def pick_axis(law: Law, axis: int, member: Member = None) -> Law:
    """The law of one axis of one member, all of its numbers scalars."""
    return jax.tree.map(lambda gain: pick_gain(gain, axis, member), law)


@eqx.filter_jit
def _derivative(law: FirmwareLoop) -> LinearController:
    zero = jnp.zeros((1,), jax.tree.leaves(law)[0].dtype)
    rest, unravel = ravel_pytree(law.rest(zero))
    states = len(rest)

    def advance(x: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        memory, command, _ = law.advance(unravel(x[:-2]), zero, x[-2:-1], x[-1:])
        return jnp.concatenate([ravel_pytree(memory)[0], command])

    slopes = jax.jacfwd(advance)(jnp.zeros(states + 2, zero.dtype))
    return LinearController(
        A=slopes[:states, :states], C=slopes[states, :states],
        reference_in=slopes[:states, states], measurement_in=slopes[:states, states + 1],
        reference_through=slopes[states, states], measurement_through=slopes[states, states + 1],
        dt=law.dt,
    )  # fmt: skip


def require_gains(dt: float, gains: Mapping[str, Array], limits: Mapping[str, Array]) -> None:
    """Raises ValueError for gains that are not finite, limits below 0, shapes that do not fit."""
    require_sample_interval(dt)
    for name, gain in gains.items():
        require_finite(name, gain)
    for name, limit in limits.items():
        if is_concrete(limit):
            require_nonnegative(name, np.where(np.isinf(limit), 0.0, limit))
    require_common_shape({**gains, **limits})


def samples_between(chain: FilterChain, dt: float) -> int:
    """How many samples of the gyro there are in `dt` seconds. Raises ValueError for a part."""
    count = chain.rate_hz * dt
    if not (count > 0.5 and abs(count - round(count)) < 1e-3):
        raise ValueError(
            f"the gyro's filters run at {chain.rate_hz:g} Hz, which is {count:.4g} samples in "
            f"dt = {dt:g} s: give FilterChain a rate_hz that is a whole number of times "
            f"{1 / dt:g} Hz."
        )
    return round(count)


def split_reference(reference: Reference, before: Signal, dt: float) -> tuple[Signal, Signal]:
    """The reference and its rate of change: a set-point's own, else the last difference."""
    if isinstance(reference, Setpoint):
        return reference.angle, reference.rate
    return reference, (reference - before) / dt


def sum_of(terms: Terms) -> Signal:
    return terms["P"] + terms["I"] + terms["D"] + terms["F"]


def bounded(value: Signal, limit: Array) -> Signal:
    most = broadcast_gain(limit, value)
    return jnp.clip(value, -most, most)


def linear_responses(
    linear: LinearController, omega: Float[np.ndarray, " frequencies"]
) -> Complex[np.ndarray, "2 frequencies"]:
    """From the set-point and from the measurement to the command."""
    A, c = np.asarray(linear.A), np.asarray(linear.C)
    into = np.stack([linear.reference_in, linear.measurement_in], axis=1)
    through = np.array([linear.reference_through, linear.measurement_through])
    z = np.exp(1j * omega * linear.dt)[:, None, None]
    inner = np.linalg.solve(z * np.eye(len(A)) - A, np.broadcast_to(into, (len(z), *into.shape)))
    return (c @ inner + through).T
