"""The gain over the throttle by the thrust curve t = f x^2 + (1 - f) x, and b0."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from jaxquad._core import plain_content

from .frequency_domain._fit_table import counted
from .frequency_domain._result import Fit
from .uncertainty._derived import draw_models
from .uncertainty._verdict import Combination, reach_of_interval, UndeterminedError


CurveFirmware = Literal["px4", "ardupilot", "betaflight", "betaflight 2025.12"]
_PARAMETERS: Mapping[str, tuple[str, float, float, float]] = {  # name, factor on f, least, most
    "px4": ("THR_MDL_FAC", 1.0, 0.0, 1.0),
    "ardupilot": ("MOT_THST_EXPO", 1.0, -1.0, 1.0),
    "betaflight": ("thrust_linear", 100.0, 0.0, 150.0),
    "betaflight 2025.12": ("thrust_linear", 100.0, 0.0, 150.0),
}


def actuator(throttle: Float[ArrayLike, "..."], curve: float) -> Float[np.ndarray, "..."]:
    """The motor's command x, 0 to 1, of a firmware that inverts t = curve x^2 + (1 - curve) x."""
    t = np.asarray(throttle, float)
    if curve == 0:
        return t
    half = (1 - curve) / (2 * curve)
    return np.asarray(-half + np.sign(curve) * np.sqrt(half**2 + t / curve))


def relative_slope(
    throttle: Float[ArrayLike, "..."], curve: float, flown: float
) -> Float[np.ndarray, "..."]:
    """The gain over the throttle, relative to that of the `flown` curve being right."""
    x = actuator(throttle, flown)
    return np.asarray((1 - curve + 2 * curve * x) / (1 - flown + 2 * flown * x))


class FirmwareValue(NamedTuple):
    """A parameter of a firmware that straightens the thrust curve, with its 95 % interval."""

    name: str
    value: float  # within the documented range
    standard_error: float
    interval: tuple[float, float]  # not cut to the range

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.name} {self.value:.3g} (95 %: {low:.3g} .. {high:.3g})"

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        return {"interval_95" if k == "interval" else k: x for k, x in self._asdict().items()}


def _parameter(firmware: CurveFirmware) -> tuple[str, float, float, float]:
    if firmware not in _PARAMETERS:
        raise ValueError(f"firmware is {firmware!r}: use one of {', '.join(_PARAMETERS)}")
    return _PARAMETERS[firmware]


def _cubic(curve: float) -> float:
    """e of t (1 + e (1 - t)^2) nearest to the inverse of the thrust curve."""
    t = (np.arange(1000) + 0.5) / 1000
    shape = t * (1 - t) ** 2
    return float(shape @ (actuator(t, curve) - t) / (shape @ shape))


def curve_of_parameter(firmware: CurveFirmware, value: float | int) -> float:
    """f of the thrust curve that a firmware inverts with this value of its parameter.

    It is the inverse of `GainOverThrottle.firmware_value`: `value` is that of THR_MDL_FAC,
    MOT_THST_EXPO or thrust_linear.

    **Returns:** -1 to 1; for thrust_linear beyond what a curve of this family can be, the nearest.

    **Raises:** ValueError for another firmware.
    """
    share = float(value) / _parameter(firmware)[1]
    if firmware == "betaflight 2025.12":
        curves = np.linspace(0.0, 1.0, 201)
        return float(np.interp(share, [_cubic(float(curve)) for curve in curves], curves))
    return float(np.clip(share, -1.0, 1.0))


B0Law = Literal["FIXED", "SQRT", "LINEAR", "QUADRATIC"]
B0_POWERS: Mapping[B0Law, float] = {"FIXED": 0.0, "SQRT": 0.5, "LINEAR": 1.0, "QUADRATIC": 2.0}


class B0Schedule(NamedTuple):
    """How Betaflight's proposed ADRC scales b0 over the throttle."""

    law: B0Law  # adrc_b0_law
    hover: float  # adrc_hover_throttle, 0 to 1, where the scale is 1
    low: float = 1.0  # adrc_b0_scale_min, as a factor
    high: float = 3.0  # adrc_b0_scale_max

    def scale(self, throttle: Float[ArrayLike, "..."]) -> Float[np.ndarray, "..."]:
        """The factor on b0 at a throttle of 0 to 1."""
        scale = (np.asarray(throttle) / self.hover) ** B0_POWERS[self.law]
        return np.asarray(np.clip(scale, self.low, self.high))


Levels = Float[np.ndarray, " levels"]
_SHARP = 0.2  # half of the 95 % interval of f below which a firmware's parameter is given
_DEGREES = {"deg/s": 1.0, "rad/s": 180 / np.pi}


class ScaledB0(NamedTuple):
    """b0 at hover for Betaflight's proposed ADRC, and the law by which it follows the throttle.

    `deviations` says how far each law is from the measured b0 over the throttles that were flown,
    at most and relative; `law` is the nearest.
    """

    hover: float  # throttle, 0 to 1
    b0: Combination  # at hover, deg/s^3 per unit of command
    law: B0Law
    deviations: Mapping[B0Law, float]
    extrapolated: bool  # hover lies outside of what was flown

    def __str__(self) -> str:
        low, high = self.b0.interval
        others = ", ".join(f"{law} {100 * far:.0f} %" for law, far in self.deviations.items())
        where = ", outside of what was flown" if self.extrapolated else ""
        return (
            f"b0 {self.b0.value:.0f} deg/s^3 (95 %: {low:.0f} .. {high:.0f}) at {self.hover:.2f} "
            f"throttle{where}; law {self.law} (off by at most: {others})"
        )


class GainBand(NamedTuple):
    """A quantity over the throttle with its 95 % band, for figures."""

    throttle: Float[np.ndarray, " points"]  # 0 to 1
    value: Float[np.ndarray, " points"]
    low: Float[np.ndarray, " points"]
    high: Float[np.ndarray, " points"]


class ThrottleLevels(NamedTuple):
    """Levels of throttle at which records hold an excitation, the lowest first."""

    throttle: Levels  # mean of each level, 0 to 1
    low: Levels  # of the throttle within it
    high: Levels
    seconds: Levels  # flown at each

    def what_to_fly(self) -> str:
        """In words, for gains at other throttles; empty where there are several levels."""
        if self.throttle.size > 1:
            return ""
        return _advise_flight(float(self.throttle[0]), 0.2, float(self.seconds[0]))


class PlantsOverThrottle(NamedTuple):
    """Plants K e^(-delay s) / (s (lag s + 1)) that a record leaves possible, at some throttles."""

    gain: Float[np.ndarray, "throttles plants"]  # output's unit per s, per unit of input
    lag: Float[np.ndarray, " plants"]  # s
    delay: Float[np.ndarray, " plants"]  # s


class _Line(NamedTuple):
    """The gain at a compensated throttle, a + b x by generalised least squares."""

    ends: Float[np.ndarray, "2"]  # a, b
    weights: Float[np.ndarray, "2 levels"]  # (a, b) is this times the gains
    misfit: float  # chi^2
    probability: float  # that the family has a larger one

    @property
    def widening(self) -> float:
        """Of errors by the curve, where the curve itself does not fit."""
        levels = self.weights.shape[1]
        return 1.0 if self.probability >= 0.05 else float(np.sqrt(self.misfit / (levels - 2)))


class GainOverThrottle(eqx.Module):
    """K of K e^(-delay s) / (s (lag s + 1)) at each level of throttle, and the curve through them.

    `str()` is a table with the firmwares' parameters; where the record holds too little of the
    curve it says what to fly. The numbers are those of `fit`, a `jq.identify.Fit` of all levels
    together: parameters `gain[0]`, ..., `lag` and `delay`. Gains are in the output's unit per s,
    per unit of input. `stretches` are, for each level, the starts and stops of its samples in the
    record's time, in s.
    """

    throttle: Levels  # mean of each level, 0 to 1
    low: Levels  # of the throttle within the level
    high: Levels
    seconds: Levels  # flown at each level
    fit: Fit
    flown: float = eqx.field(static=True)  # curve that the firmware inverted during the flight
    input_unit: str = eqx.field(static=True)
    output_unit: str = eqx.field(static=True)
    stretches: tuple[tuple[tuple[float, float], ...], ...] = eqx.field(static=True, default=())
    remarks: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def gain(self) -> Levels:
        """At each level."""
        return np.asarray(self.fit.values)[: self.throttle.size]

    @property
    def gain_errors(self) -> Levels:
        """Standard errors of `gain`."""
        return np.asarray(self.fit.standard_errors)[: self.throttle.size]

    def b0(self, level: int) -> Combination:
        """gain / lag at one level, in the output's unit per s^2 and unit of input.

        **Raises:** UndeterminedError if the record does not tell the lag from the delay.
        """
        self._require_lag()
        name = f"b0 at {self.throttle[level]:.2f}"
        return self.fit.derived(lambda model: model.gain[level] / model.lag, name)

    @property
    def curve(self) -> Combination | None:
        """f of the thrust curve t = f x^2 + (1 - f) x; None with fewer than two levels."""
        line = self._line()
        if line is None:
            return None
        (a, b), total = line.ends, line.ends[0] + line.ends[1] / 2
        slope = np.array([-b / 2, a / 2]) / total**2
        return self._combine("f", float(b / 2 / total), slope @ line.weights, 0.0)

    @property
    def straight_gain(self) -> Combination | None:
        """The gain at every throttle once the firmware inverts the curve; None as `curve`."""
        line = self._line()
        if line is None:
            return None
        half = np.array([1.0, 0.5])
        return self._combine("gain", float(half @ line.ends), half @ line.weights, 0.0)

    def over(self, throttle: Float[ArrayLike, " points"]) -> GainBand:
        """The gain by the thrust curve, at any throttle.

        **Raises:** UndeterminedError for fewer than two levels.
        """
        return self._band(throttle, over_lag=False)

    def b0_over(self, throttle: Float[ArrayLike, " points"]) -> GainBand:
        """gain / lag by the thrust curve, at any throttle; raises as `over` and `b0`."""
        self._require_lag()
        return self._band(throttle, over_lag=True)

    def draw(
        self, throttle: Float[ArrayLike, " throttles"], plants: int, *, seed: int = 0
    ) -> PlantsOverThrottle:
        """Draw so many plants from what the record leaves uncertain, at a throttle of 0 to 1.

        Each follows a thrust curve. Raises as `over` and `b0`.
        """
        line = self._line()
        if line is None:
            raise UndeterminedError(self.what_to_fly())
        self._require_lag()
        scores = np.random.default_rng(seed).standard_normal((len(self.fit.names), plants))
        models = draw_models(self.fit, jnp.asarray(scores))
        wide = lambda x: np.broadcast_to(np.asarray(x, float), (plants,))
        change = line.weights @ (np.asarray(models.gain) - self.gain[:, None])
        rows = self._rows(np.atleast_1d(throttle))
        gain = rows @ (line.ends[:, None] + line.widening * change)
        return PlantsOverThrottle(gain, wide(models.lag), wide(models.delay))

    def firmware_value(self, firmware: CurveFirmware) -> FirmwareValue:
        """The parameter with which a firmware makes the gain the same at every throttle.

        **Arguments:** `firmware`: `"px4"` (THR_MDL_FAC), `"ardupilot"` (MOT_THST_EXPO),
        `"betaflight"` (thrust_linear from 2026.6 on) or `"betaflight 2025.12"`, whose thrust_linear
        t (1 + e (1 - t)^2) is fitted to the inverse curve by least squares over 0 to 1.

        **Raises:**

        - `UndeterminedError`: the record holds too little of the curve; says what to fly.
        - `ValueError`: for another firmware.
        """
        (name, factor, least, most), curve = _parameter(firmware), self._sharp_curve
        if curve is None:
            raise UndeterminedError(f"{name}: {self.what_to_fly()}")
        convert = _cubic if firmware == "betaflight 2025.12" else float
        slope = (convert(curve.value + 1e-4) - convert(curve.value - 1e-4)) / 2e-4
        value, error = factor * convert(curve.value), factor * abs(slope) * curve.standard_error
        reach = reach_of_interval(curve.degrees_of_freedom) * error
        interval = (value - reach, value + reach)
        return FirmwareValue(name, float(np.clip(value, least, most)), error, interval)

    def adrc_b0(self, hover: float, *, largest: float = 3.0) -> ScaledB0:
        """adrc_b0 and the law over the throttle of Betaflight's proposed ADRC.

        **Arguments:**

        - `hover`: adrc_hover_throttle, 0 to 1.
        - `largest`: adrc_b0_scale_max; the least is 1, as adrc_b0_scale_min is by default.

        **Raises:**

        - `UndeterminedError`: as `b0_over`.
        - `ValueError`: the output's unit is neither deg/s nor rad/s, or `hover` not within 0 to 1.
        """
        if self.output_unit not in _DEGREES:
            raise ValueError(
                f"the output's unit is {self.output_unit or 'unknown'}: adrc_b0 needs deg/s or "
                "rad/s; give the record output_units="
            )
        if not 0 < hover <= 1:
            raise ValueError(f"hover is {hover}: give the throttle at hover, above 0 and up to 1")
        self._require_lag()
        factor = _DEGREES[self.output_unit]
        value, error, freedom = self._by_curve(hover, over_lag=True)[1:4]
        b0 = Combination("b0", factor * value, factor * error, freedom)
        grid = np.linspace(self.low.min(), self.high.max(), 41)
        measured = self.b0_over(grid).value / value
        deviations: dict[B0Law, float] = {}
        for law in B0_POWERS:
            scale = B0Schedule(law, hover, high=largest).scale(grid)
            deviations[law] = float(np.max(np.abs(scale / measured - 1)))
        outside = not self.low.min() <= hover <= self.high.max()
        return ScaledB0(hover, b0, min(deviations, key=deviations.__getitem__), deviations, outside)

    def what_to_fly(self) -> str:
        """In words: whether the record holds enough of the thrust curve, and what to fly if not."""
        seconds = float(np.median(self.seconds))
        first, last = float(self.throttle[0]), float(self.throttle[-1])
        curve = self.curve
        if curve is None:
            return (
                f"the log holds one level of throttle ({first:.2f}), which shows no curve: "
                f"{_advise_flight(first, 0.2, seconds)}"
            )
        reach = _reach(curve)
        if reach <= _SHARP:
            return f"the log holds enough of the thrust curve ({first:.2f} .. {last:.2f} throttle)"
        wanted = (last - first) * reach / _SHARP
        if wanted <= 0.6:
            middle = (first + last) / 2
            advice = _advise_flight(middle, wanted, seconds, "from {:.2f} to {:.2f}")
        else:
            advice = (
                f"fly from 0.20 to 0.80, with {wanted / 0.6:.1f} times the amplitude or "
                f"{(wanted / 0.6) ** 2:.1f} times as long"
            )
        return (
            f"the log holds too little of the thrust curve: {first:.2f} .. {last:.2f} throttle give"
            f" f = {curve.value:.2f} +- {reach:.2f} (95 %); {advice}"
        )

    def to_dict(self) -> dict[str, object]:
        """All numbers as JSON holds them: None for what is not finite or not determined."""
        curve, line = self.curve, self._line()
        content = lambda number: {**number.content(), "interval_95": number.interval}
        levels = [
            {
                "throttle": self.throttle[k],
                "range": [self.low[k], self.high[k]],
                "seconds": self.seconds[k],
                "gain": self.gain[k],
                "gain_standard_error": self.gain_errors[k],
                "gain_interval_95": self.fit.interval(f"gain[{k}]"),
                "b0": content(self.b0(k)) if self._knows_lag else None,
            }
            for k in range(self.throttle.size)
        ]
        return plain_content(
            {
                "input_unit": self.input_unit,
                "output_unit": self.output_unit,
                "levels": levels,
                "curve": None if curve is None else content(curve),
                "curve_flown": self.flown,
                "probability_of_curve": None if line is None else line.probability,
                "firmware": [value.content() for value in self._firmware_values()],
                "advice": self.what_to_fly(),
                "fit": self.fit.to_dict(),
                "remarks": self.remarks,
            }
        )

    def __str__(self) -> str:
        lines = [f"gain over throttle: {counted(self.throttle.size, 'level')}, {self._times()}"]
        per = f"{self.output_unit or 'output'} per s, per {self.input_unit or 'unit of input'}"
        lines.append(f"{'throttle':>8} {'from':>5} {'to':>5} {'s':>6} {'K':>10} {'+- 95 %':>9}"
                     f" {'K/lag':>10} {'+- 95 %':>9}   [K in {per}]")  # fmt: skip
        for k, row in enumerate(zip(self.throttle, self.low, self.high, self.seconds, strict=True)):
            middle, low, high, seconds = row
            reach = self.fit.interval(f"gain[{k}]")[1] - self.gain[k]
            cells = f"{middle:8.3f} {low:5.2f} {high:5.2f} {seconds:6.1f} {self.gain[k]:10.5g} "
            b0 = self.b0(k) if self._knows_lag else None
            end = f"{'-':>10} {'-':>9}" if b0 is None else f"{b0.value:10.5g} {_reach(b0):9.2g}"
            lines.append(f"{cells}{reach:9.2g} {end}")
        if (curve := self.curve) is not None:
            lines.append(f"thrust curve t = f x^2 + (1 - f) x: {curve}")
        if (line := self._line()) is not None and line.probability < 0.05:
            lines.append(
                f"! the curve does not pass through the gains within their errors (probability "
                f"{100 * line.probability:.2g} %): its errors are widened by the misfit"
            )
        lines += [self.what_to_fly(), *map(str, self._firmware_values())]
        return "\n".join(lines + [f"! {remark}" for remark in self.remarks])

    def _times(self) -> str:
        if not self._knows_lag:
            sums = [str(combination) for combination in self.fit.combinations]
            return "lag and delay not determined separately" + (f" ({sums[0]})" if sums else "")
        determined = [n for n in ("lag", "delay") if n not in self.fit.verdict.undetermined]
        times = []
        for name in determined:
            low, high = self.fit.interval(name)
            times.append(f"{name} {1e3 * self.fit[name]:.2f} +- {1e3 * ((high - low) / 2):.2g} ms")
        end = "" if "delay" in determined else ", delay not determined"
        return f"{', '.join(times)} (95 %){end}"

    def _firmware_values(self) -> list[FirmwareValue]:
        names = ("px4", "ardupilot", "betaflight") if self._sharp_curve is not None else ()
        return [self.firmware_value(name) for name in names]

    @property
    def _sharp_curve(self) -> Combination | None:
        """Where it is known well enough for a firmware's parameter."""
        return None if (curve := self.curve) is None or _reach(curve) > _SHARP else curve

    def _line(self) -> _Line | None:
        n = self.throttle.size
        if n < 2 or np.ptp(self.throttle) < 0.02 or not np.all(self.fit.determined[:n]):
            return None
        from scipy.special import chdtrc

        columns, covariance = self._rows(self.throttle), np.asarray(self.fit.covariance)[:n, :n]
        weighted = np.linalg.solve(covariance, columns)
        gather = np.linalg.solve(columns.T @ weighted, weighted.T)
        ends = gather @ self.gain
        rest = self.gain - columns @ ends
        misfit = float(rest @ np.linalg.solve(covariance, rest))
        probability = float(chdtrc(n - 2, misfit)) if n > 2 else 1.0
        return _Line(ends, gather, misfit, probability)

    def _rows(self, throttle: Float[ArrayLike, "..."]) -> Float[np.ndarray, "... 2"]:
        """The gain at a throttle is this times the line's ends."""
        x = actuator(throttle, self.flown)
        scale = 1 - self.flown + 2 * self.flown * x
        return np.stack([np.ones_like(x), x], axis=-1) / np.asarray(scale)[..., None]

    def _combine(self, name: str, value: float, by_gain: Levels, by_lag: float) -> Combination:
        """By the covariance of all parameters, widened where the law itself does not fit."""
        line = self._line()
        slope = np.concatenate([by_gain, [by_lag, 0.0]]) * self.fit.units
        error = float(np.sqrt(slope @ self.fit.relative_covariance @ slope))
        error *= 1.0 if line is None else line.widening
        return Combination(name, value, error, self.fit.freedom_of(slope))

    def _by_curve(self, throttle: float, *, over_lag: bool) -> Combination:
        """The gain at a throttle, or gain / lag."""
        line, lag = self._line(), self.fit["lag"] if over_lag else 1.0
        if line is None:
            raise UndeterminedError(self.what_to_fly())
        row = self._rows(throttle)
        value, by_gain = float(row @ line.ends) / lag, row @ line.weights / lag
        by_lag = -float(row @ line.ends) / lag**2 if over_lag else 0.0
        return self._combine("b0" if over_lag else "gain", value, by_gain, by_lag)

    def _band(self, throttle: Float[ArrayLike, " points"], *, over_lag: bool) -> GainBand:
        grid = np.atleast_1d(np.asarray(throttle, float))
        points = [self._by_curve(float(x), over_lag=over_lag) for x in grid]
        low, high = np.array([point.interval for point in points]).T
        return GainBand(grid, np.array([point.value for point in points]), low, high)

    @property
    def _knows_lag(self) -> bool:
        return "lag" not in self.fit.verdict.undetermined and self.fit["lag"] > 0

    def _require_lag(self) -> None:
        if not self._knows_lag:
            raise UndeterminedError(
                "b0 = gain / lag: the record does not tell the motors' lag from the delay. Excite "
                "up to three times the motors' corner 1/lag, usually to 30 Hz"
            )


def _advise_flight(
    middle: float, span: float, seconds: float, words: str = "{:.2f} and {:.2f} as well"
) -> str:
    lower = float(np.clip(middle - span / 2, 0.15, 0.85 - min(span, 0.7)))
    turns = ", in turns of about 8 s, as the vehicle sinks or climbs" if seconds > 10 else ""
    levels = words.format(lower, min(lower + span, 0.85))
    return f"fly {levels}, with the same excitation for {seconds:.0f} s at each{turns}"


def _reach(number: Combination) -> float:
    """Half of the 95 % interval."""
    low, high = number.interval
    return (high - low) / 2
