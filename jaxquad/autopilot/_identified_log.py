"""What an identified log says of its loop: law and filters, and where on the throttle they hold."""

import dataclasses
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxquad._core import announce, Message
from jaxquad.identify import (
    actuator,
    as_sampled,
    curve_of_parameter,
    CurveFirmware,
    filter_response,
    FirmwareValue,
    Fit,
    gain_over_throttle,
    GainOverThrottle,
    KnownFilter,
    MeasuredChain,
    model_response,
    throttle_levels,
    UndeterminedError,
    usable,
    with_values,
)
from jaxquad.plot import StepBand
from jaxquad.records import AXES, Proposal, propose, Record, RecordWarning
from jaxquad.report import LawLoop, reason_of
from jaxquad.spectra import BrokenLoop, FrequencyResponse

from ._filters import FilterChain
from ._firmware import firmware_named, HOVER
from ._flight_channels import (
    best_filters,
    FlownAutopilot,
    IdentifiedPlant,
    read_channels_if_any,
    RecordSettings,
    settings_of,
)
from ._law import linear_responses, RateLoop
from ._parameters import find_parameter, ParameterChange, propose_changes


Frequencies = Float[np.ndarray, " frequencies"]
Steps = Float[np.ndarray, "plants samples"]
_SAME = 1e-3  # of the response of filters, by which those of several logs may differ
_AT = np.array([3.0, 10.0, 30.0])  # Hz


@dataclasses.dataclass(frozen=True)
class FlownLaw:
    """The filters of the gyro and the rate loop of a log, by its parameters."""

    filters: tuple[KnownFilter, ...]  # in front of the logged rate; none where all are off
    text: str  # what is divided out, or why nothing is
    law: RateLoop | None = None  # from the identified output to the identified input, if that is it
    axis: int = 0
    unmodelled: tuple[Message, ...] = ()  # what of the firmware the law leaves out
    chains: tuple[FilterChain, ...] = ()  # the filters that the parameters describe

    def content(self) -> dict[str, object]:
        """For `result.json`; `StoredFilters.of` reads the filters."""
        measured = [x for x in self.filters if isinstance(x, MeasuredChain)]
        number = lambda x: 0.0 if x is None else float(np.ravel(np.asarray(x))[0])
        chains = [
            {"rate_hz": chain.rate_hz, "sections": [list(map(number, x)) for x in chain.sections()]}
            for chain in self.chains
        ]
        correction = [{"delay_s": x.delay, "lag_s": x.lag} for x in measured]
        return {"text": self.text, "chains": chains, "correction": (*correction, {})[0]}


@dataclasses.dataclass(frozen=True)
class StoredFilters:
    """Filters of a stored result: difference equations by their rates, then a delay and a lag."""

    chains: tuple[tuple[float, tuple[tuple[float, ...], ...]], ...]
    delay: float = 0.0  # s
    lag: float = 0.0  # s

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> "StoredFilters":
        """From what `FlownLaw.content` has stored. Raises ValueError for anything else."""
        try:
            numbers = lambda section: tuple(map(float, section))
            chains = tuple(
                (float(x["rate_hz"]), tuple(map(numbers, x["sections"]))) for x in content["chains"]
            )
            correction = content["correction"]
            ends = (float(correction.get(key, 0.0)) for key in ("delay_s", "lag_s"))
            return cls(chains, *ends)
        except (AttributeError, KeyError, TypeError) as error:
            raise ValueError(
                f"the result's gyro filters are incomplete ({error}): identify again"
            ) from error

    def response(self, frequency_hz: Frequencies) -> Complex[np.ndarray, " frequencies"]:
        """At frequencies in Hz."""
        turn = 2j * np.pi * np.asarray(frequency_hz, float)
        passed = np.exp(-turn * self.delay) / (1 + turn * self.lag)
        for rate, sections in self.chains:
            back = np.exp(-turn / rate)
            for b0, b1, a1, b2, a2 in sections:
                passed = passed * (b0 + back * (b1 + back * b2)) / (1 + back * (a1 + back * a2))
        return passed


def flown_law(
    paths: Sequence[Path], rate: str, axis: int, command: Mapping[str, float],
    proposal: Proposal | None, settings: RecordSettings,
) -> FlownLaw | None:  # fmt: skip
    """Of a logged `rate` that is identified; None where the logs are of no known autopilot.

    `command` are the channels of the identified input; `proposal` is that of the first log. What a
    log does not tell costs nothing but itself: `text` says why.
    """

    def law_of(path: Path, proposal: Proposal | None) -> FlownLaw | None:
        if proposal is None:
            try:
                proposal = propose(path, axis=AXES[axis])
            except ValueError:  # a table whose channels have these names
                return None
        firmware, setup = firmware_named(proposal.vehicle), proposal.setup
        if setup.rate != rate or not firmware.log.gyro_cutoffs:
            return None
        logged = settings_of(path, proposal)
        if not any(name in logged.values for name in firmware.log.gyro_cutoffs):
            names = " or ".join(firmware.log.gyro_cutoffs)
            return FlownLaw((), f"{in_model}: the log does not hold {names}")
        flight = read_channels_if_any(path, proposal, settings, logged.values)
        loop = firmware.flown_loop(
            logged.values, logged.version,
            throttle=HOVER if flight is None or flight.middle is None else flight.middle,
            tracked_hz={} if flight is None else flight.tracked_hz,
        )  # fmt: skip
        chains = tuple(chain for chain in loop.law.gyro_chains() if chain.filters)
        filters, text = best_filters(loop, flight, axis)
        flew = not firmware.flies_adrc(logged.values) and dict(command) == dict(setup.command)
        law = loop.law if flew else None
        return FlownLaw(filters, text, law, axis, tuple(loop.unmodelled), chains)

    announce("the gyro's filters")
    in_model = "the gyro's filters are in the model"
    try:
        first, *others = [law_of(path, proposal if path == paths[0] else None) for path in paths]
    except Exception as error:
        return FlownLaw((), f"{in_model}: {reason_of(error)}")
    passed = lambda law: np.prod([x.response(_AT) for x in law.filters], axis=0)
    alike = lambda law: np.max(np.abs(np.asarray(passed(first)) / passed(law) - 1)) <= _SAME
    if first is None or all(law is not None and alike(law) for law in others):
        return first
    return FlownLaw((), f"{in_model}: those of the logs differ")


_PERIOD, _SHOWN, _FINEST = 8.0, 1.2, 1 / 400  # s, of a computed step, of a shown one, of a sample


class StepGrid(NamedTuple):
    """Frequencies from whose closed responses steps are computed."""

    dt: float  # of the computed step in s
    omega: Float[np.ndarray, " frequencies"]  # rad/s
    fade: Float[np.ndarray, " frequencies"]  # where the law runs faster than the step is computed

    @classmethod
    def of(cls, dt: float) -> "StepGrid":
        coarse = max(dt, _FINEST)
        count = 2 * int(_PERIOD / coarse / 2)
        omega = 2 * np.pi * np.arange(1, count // 2) / (count * coarse)
        fade = np.cos(np.linspace(0, np.pi / 2, omega.size)) ** 2
        return cls(coarse, omega, fade if coarse > dt else np.ones(omega.size))

    def steps(self, closed: Complex[np.ndarray, "plants frequencies"]) -> Steps:
        """Of the responses from set-point to rate."""
        response = np.pad(self.fade * closed, ((0, 0), (1, 1)))
        response[:, 0] = 1.0
        impulse = np.fft.irfft(response, 2 * (self.omega.size + 1), axis=1)
        return np.cumsum(impulse, axis=1)[:, : int(_SHOWN / self.dt)]

    def band(self, closed: Complex[np.ndarray, "plants frequencies"]) -> StepBand:
        """Likewise, their median and 95 % of the plants."""
        return self.band_of(self.steps(closed))

    def band_of(self, steps: Steps) -> StepBand:
        """Of computed steps."""
        low, middle, high = np.percentile(steps, [2.5, 50.0, 97.5], axis=0)
        return StepBand(np.arange(steps.shape[1]) * self.dt, middle, low, high)


Response = Complex[np.ndarray, " frequencies"]
_COHERENT = 0.6  # magnitude-squared coherence from which a frequency counts
_LOWEST, _HIGHEST, _GRID = 0.3, 0.45, 512  # rad/s, of the law's rate, and how many frequencies
_PLANTS, _SEED = 64, 77  # of the step's band


def loop_of_law(
    flown: FlownLaw | None, fit: Fit, frf: FrequencyResponse, filters: Sequence[KnownFilter],
    unit: str,
) -> LawLoop | None:  # fmt: skip
    """The flown rate loop as law times plant; None where the log does not tell the law.

    The plant is up to what `filters` were given, with a rate in `unit`.
    """
    units = {"deg/s": np.pi / 180, "rad/s": 1.0}
    if flown is None or flown.law is None or unit not in units:
        return None
    law, axis = flown.law.without_gyro_filters(), flown.axis  # the logged rate is behind them

    def paths(omega: Frequencies) -> tuple[Response, Response, Response]:
        """The law from set-point and from logged rate to plus and minus the command; filters."""
        ahead, back = units[unit] * linear_responses(law.linear(axis), omega)
        return ahead, -back, filter_response(filters, omega)

    used = np.asarray(usable(frf, None, _COHERENT))[:, 0, 0]
    omega = np.asarray(frf.omega)[used]
    response, error, coherence = (
        np.asarray(x)[used, 0, 0] for x in (frf.response, frf.random_error, frf.coherence)
    )
    _, back, passed = paths(omega)
    measured = BrokenLoop(omega, back * response * passed, error, coherence)
    if not fit.identifiable:
        return LawLoop(measured, None, None, flown.unmodelled)
    plant_at = lambda model, omega: model_response(as_sampled(model, frf), omega)[:, 0, 0]
    grid = np.geomspace(_LOWEST, _HIGHEST * 2 * np.pi / law.dt / 2, _GRID)
    _, back, passed = paths(grid)
    broken = back * plant_at(fit.model, grid) * passed
    model = BrokenLoop(grid, broken, np.zeros(grid.size), np.ones(grid.size))
    # The step from set-point to rate, of plants that the fit leaves possible.
    steps = StepGrid.of(law.dt)
    ahead, back, passed = paths(steps.omega)
    places, random = fit.parameters.places[: len(fit.names)], np.random.default_rng(_SEED)
    values = random.multivariate_normal(fit.values, fit.covariance, _PLANTS, method="eigh")
    sign = np.sign(fit.values)
    values = np.where(sign * values > 0, values, 0.0 * sign)  # a parameter keeps its sign
    plants = np.stack([plant_at(with_values(fit.model, places, x), steps.omega) for x in values])
    step = steps.band(ahead * plants * passed / (1 + back * plants * passed))
    return LawLoop(measured, model, step, flown.unmodelled)


ReadBeside = Callable[[Mapping[str, Mapping[str, float]]], Sequence[Record]]
_DRAWN, _DRAWN_BY, _ENDS = 1000, 5, [2.5, 97.5]  # of the ratio of gains; in % of its draws
_VAGUE = 0.4  # half of the relative 95 % interval of a gain from which plants are not drawn


@dataclasses.dataclass(frozen=True)
class CurveVerdict:
    """The thrust curve's parameter: what flew, and what the log shows."""

    name: str
    flown: float | None  # None where the log does not hold it
    text: str
    estimate: FirmwareValue | None = None  # None where the log holds too little of the curve
    change: ParameterChange | None = None  # None where what flew is as good, or is not known

    def content(self) -> dict[str, object]:
        estimate = self.estimate
        return {
            "parameter": self.name,
            "flown": self.flown,
            "value": None if estimate is None else estimate.value,
            "standard_error": None if estimate is None else estimate.standard_error,
            "interval_95": None if estimate is None else list(estimate.interval),
            "proposed": self.change is not None,
            "text": self.text,
        }


@dataclasses.dataclass(frozen=True)
class ThrottleVerdict:
    """At which throttles the gains of a proposal hold."""

    text: str
    # Over the throttle, where the log holds several levels of it: plants are drawn from these.
    gains: GainOverThrottle | None = None
    span: tuple[float, float] = (0.0, 1.0)  # the lowest and the highest throttle of the levels
    logged: tuple[float, ...] = ()  # at which gains are certified, as the log has them
    ratio: tuple[float, float, float] | None = None  # of the gains at its ends, with 95 % interval
    curve: CurveVerdict | None = None  # of thrust

    @property
    def certified(self) -> tuple[float, ...]:
        """The throttles at which gains are certified; empty without a gain over the throttle."""
        low, high = self.span
        return () if self.gains is None else (low, (low + high) / 2, high)

    def content(self) -> dict[str, object]:
        return {
            "text": self.text,
            "certified_at": list(self.logged),
            "ratio_of_gains": None if self.ratio is None else list(self.ratio),
            "gain_over_throttle": None if self.gains is None else self.gains.to_dict(),
            "thrust_curve": None if self.curve is None else self.curve.content(),
        }


class _FlownCurve:
    """The thrust curve that flew, and its parameter."""

    kind: CurveFirmware | None = None  # None: the firmware has none
    value: float | None = None  # of the parameter; None where the log does not hold it
    curve: float = 0.0

    def __init__(self, flown: FlownAutopilot):
        firmware = firmware_named(flown.firmware)
        self.name = name = firmware.thrust_curve
        # Whether it is inverted for the axes alone, so that the motors get the throttle itself.
        self.kept = bool(name) and firmware.keeps_throttle
        if name:
            self.kind = firmware.curve_kind(flown.version)
            self.value = float(flown.values[name]) if name in flown.values else None
            default = find_parameter(flown.firmware, name).default
            assumed = default if self.value is None else self.value
            self.curve = curve_of_parameter(self.kind, assumed)

    def thrust(self, channel: str, factor: float) -> dict[str, float]:
        """What is asked for at a throttle, as a weighted sum of the channel and its square."""
        f = self.curve if self.kept else 0.0
        return {channel: (1 - f) * factor} | ({f"{channel}^2": f * factor**2} if f else {})

    def as_logged(self, thrust: float) -> float:
        """The throttle in the log that asks for a thrust."""
        return float(actuator(thrust, self.curve)) if self.kept else float(thrust)


def study_throttle(
    plant: IdentifiedPlant, proposal: Proposal, flown: FlownAutopilot, read: ReadBeside
) -> ThrottleVerdict:
    """The gain over the throttle, where the log holds at least two levels of it.

    `read` gives the identified records with further inputs.
    """
    if not proposal.setup.throttle:
        return ThrottleVerdict(
            "it is not in the log, so the gains hold near what was flown: log it, and fly two or "
            "three levels between 0.2 and 0.8 for gains that hold at each of them"
        )
    flown_curve, [(channel, factor)] = _FlownCurve(flown), proposal.setup.throttle.items()
    taken_together = "gains hold for the throttles of the log taken together"
    try:
        with warnings.catch_warnings():  # identification has said what there is
            warnings.simplefilter("ignore", RecordWarning)
            records = list(read({"throttle": flown_curve.thrust(channel, factor)}))
        levels = throttle_levels(records)
    except ValueError as error:  # of reading, too
        return ThrottleVerdict(f"{taken_together}: {error}")
    shown = lambda x: flown_curve.as_logged(float(x))
    if levels.throttle.size == 1:
        return ThrottleVerdict(
            f"gains hold near throttle {shown(levels.throttle[0]):.2f}, the only level of the log: "
            f"{levels.what_to_fly()}, for gains that hold over the throttle"
        )
    announce("the gain over the throttle")
    band = None
    if plant.settings.band is not None:  # from 3 cycles of the shortest level, at least 1.5 Hz
        low, high = plant.settings.band
        low = max(low, 1.5, 3 / float(levels.seconds.min()))
        band = (2 * np.pi * low, 2 * np.pi * min(high, 45.0)) if low < high else None
    try:
        gains = gain_over_throttle(
            records, filters=flown.filters, flown_curve=flown_curve.curve, band=band
        )
        low, high = span = float(gains.low.min()), float(gains.high.max())
        ends = gains.over(np.array(span))
        reach = float(np.max((ends.high - ends.low) / 2 / np.abs(ends.value)))
        if reach > _VAGUE:
            raise ValueError(
                f"it shows the gain at the ends of {low:.2f} .. {high:.2f} within +- "
                f"{100 * reach:.0f} % (95 %). Excite more or longer at each"
            )
        drawn = gains.draw(np.array(span), _DRAWN, seed=_DRAWN_BY).gain
    except (UndeterminedError, ValueError) as error:
        return ThrottleVerdict(f"{taken_together}, not for each: {error}")
    value, (least, most) = ends.value[1] / ends.value[0], np.percentile(drawn[1] / drawn[0], _ENDS)
    ratio = float(value), float(least), float(most)
    logged = shown(span[0]), shown(sum(span) / 2), shown(span[1])
    text = (
        f"gains hold from throttle {logged[0]:.2f} to {logged[2]:.2f}, of which the log has "
        f"{gains.throttle.size} levels: plants are drawn over all of it, and certified at both "
        f"ends and between. The gain at the highest is {value:.2f} times that at the lowest "
        f"(95 %: {least:.2f} .. {most:.2f})"
    )
    if flown_curve.kept and flown_curve.curve:
        text += ". Below, throttle is the thrust that the firmware makes of it, 0 to 1"
    curve = _curve_verdict(gains, flown.firmware, flown_curve)
    return ThrottleVerdict(text, gains, span, logged, ratio, curve)


def _curve_verdict(
    gains: GainOverThrottle, firmware: str, flown: _FlownCurve
) -> CurveVerdict | None:
    name, value = flown.name, flown.value
    if flown.kind is None:
        return None
    try:
        estimate = gains.firmware_value(flown.kind)
    except UndeterminedError as error:
        return CurveVerdict(name, value, str(error))
    low, high = estimate.interval
    shows = f"the log shows {estimate.value:.3g} (95 %: {low:.3g} .. {high:.3g})"
    if value is None:
        text = f"{name}: {shows}, not what flew, so that no file has it"
        return CurveVerdict(name, value, text, estimate)
    if low <= value <= high:
        return CurveVerdict(
            name, value, f"{name} {value:g} flew, and {shows}: it is kept", estimate
        )
    reason = f"proposal of its own: 95 % {low:.3g} .. {high:.3g}; all loops change with it"
    changes = propose_changes(
        firmware, {name: value}, {name: round(estimate.value, 3)}, reasons={name: reason}
    )
    if not changes:
        text = f"{name} {value:g} flew, and {shows}, stored as the same"
        return CurveVerdict(name, value, text, estimate)
    # One gain at every throttle, and another throttle at hover.
    straight, curve = gains.straight_gain, gains.curve
    if straight is None or curve is None:
        raise UndeterminedError(gains.what_to_fly())
    middle = float(np.median(gains.throttle))
    times = straight.value / float(gains.over(np.array([middle])).value[0])
    moved = (
        f"with it the gain of all axes is the same at every throttle, {times:.2f} times that at "
        f"{flown.as_logged(middle):.2f}"
    )
    if not flown.kept:
        x = float(actuator(middle, gains.flown))
        hover = curve.value * x**2 + (1 - curve.value) * x
        moved += f", and what throttle {middle:.2f} lifts then takes {hover:.2f}"
    text = (
        f"{name} {value:g} flew, but {shows}. It is a proposal in files of its own, apart from "
        f"the gains, which hold with the curve that flew: {moved}. Load it alone, fly, and tune "
        "the gains on that log"
    )
    return CurveVerdict(name, value, text, estimate, changes[0])
