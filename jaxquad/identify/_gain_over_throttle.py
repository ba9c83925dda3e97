"""The gain over the throttle: levels of throttle in records, one lag and delay, a gain for each."""

import dataclasses
import functools as ft
import warnings
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import as_float, pytree_node
from jaxquad.models import LaggedIntegrator
from jaxquad.records import Channel, Record, RecordWarning, resample, select
from jaxquad.spectra import (
    Estimator,
    frequency_response,
    FrequencyResponse,
    JointInputOutput,
    LocalPolynomial,
)

from ._known_filters import KnownFilter, without_filters
from ._thrust_curve import GainOverThrottle, relative_slope, ThrottleLevels
from .frequency_domain._cost import usable
from .frequency_domain._fit import fit, guess_lagged_integrator


_FEWEST = 8  # usable frequencies of a level
_LINES = 40  # frequencies of a response
_QUIET = 0.03  # of the strongest excitation, below which a level holds none
_SLOW_RATE = 100.0  # Hz, enough for levels alone
_OVERSAMPLED = 5.0  # samples per cycle of the highest frequency


class ThrottledIntegrator(eqx.Module):
    """gain[k] e^(-delay s) / (s (lag s + 1)) at throttle level k: one lag and delay for all."""

    gain: Float[Array, " levels"] = eqx.field(converter=as_float)
    lag: Float[Array, ""] = eqx.field(converter=as_float)  # s
    delay: Float[Array, ""] = eqx.field(converter=as_float)  # s

    def at(self, level: int) -> LaggedIntegrator:
        """The plant at one level."""
        return LaggedIntegrator(self.gain[level], self.lag, self.delay)


@pytree_node
class _AtLevel:
    """The condition of a record that was flown at one throttle level."""

    level: int = eqx.field(static=True)

    def __call__(self, model: ThrottledIntegrator) -> LaggedIntegrator:
        return model.at(self.level)


@dataclasses.dataclass(frozen=True, eq=False)
class _Segment:
    """Samples `first` to before `end` of a record on one clock, at almost one throttle."""

    record: Record  # command, rate and references
    flown: Float[np.ndarray, " samples"]  # throttle of the whole record, 0 to 1
    first: int
    end: int

    @property
    def throttle(self) -> Float[np.ndarray, " samples"]:
        return self.flown[self.first : self.end]

    @property
    def seconds(self) -> float:
        return (self.end - self.first) * self.record.dt

    @property
    def excitation(self) -> float:
        """Standard deviation of the reference, of the input where there is none."""
        record = self.record
        signal = record.references if record.reference_names else record.inputs
        return float(signal[self.first : self.end].std())


_Level = list[_Segment]


def _mean(level: _Level) -> float:
    return float(np.concatenate([segment.throttle for segment in level]).mean())


def gain_over_throttle(
    record: Record | Sequence[Record],
    *,
    throttle: str = "throttle",
    throttle_range: tuple[float, float] = (0.0, 1.0),
    band: tuple[float, float] | None = None,
    filters: Sequence[KnownFilter] = (),
    flown_curve: float = 0.0,
    width: float = 0.1,
    shortest: float = 3.0,
    estimator: Estimator | None = None,
) -> GainOverThrottle:
    """Identify the gain of an axis at each level of throttle that was flown, and the thrust curve.

    The records are cut where the throttle leaves a level. One fit takes all levels: a gain for
    each, lag and delay for all. It is made twice: the second time the command is weighted by the
    slope of the thrust curve of the first, so that the throttle may move within a level. Source:
    docs/autopilots.md.

    **Arguments:**

    - `record`: one or several, each with a command, a rate, a channel of throttle and, in flight,
        the external reference.
    - `throttle`: the name of its channel, whatever its role in the record.
    - `throttle_range`: the channel's values at no and at full throttle.
    - `band`: (low, high) in rad/s; by default from 3 cycles of the shortest level, at least 1.5 Hz,
        to 45 Hz or an eighth of the sample rate.
    - `filters`: those that the rate passed in the firmware before it was logged. Their response
        is divided out; otherwise lag and delay contain them.
    - `flown_curve`: THR_MDL_FAC, MOT_THST_EXPO or thrust_linear / 100 that flew.
    - `width`: of a level of throttle; `shortest`: how long it lasts at least, in s.
    - `estimator`: as in `jq.frequency_response`; by default local polynomials, with a reference
        by the joint method and without a rational model of the whole record.

    **Returns:** A `jq.identify.GainOverThrottle`: gains, thrust curve, the firmwares' parameters.

    **Raises:** `ValueError`: the records lack the channels, the throttle leaves 0 to 1, or it
    stayed at no level with an excitation.

    !!! example

        ```python
        found = jq.identify.gain_over_throttle(record, throttle_range=(0.0, 1000.0))
        print(found, found.adrc_b0(hover=0.3), sep="\\n")
        ```
    """
    records = _require_records(record)
    if not -1 <= flown_curve <= 1:
        raise ValueError(f"flown_curve is {flown_curve}: give -1 to 1; thrust_linear over 100")
    fastest = records[0].sample_rate
    high = 2 * np.pi * min(45.0, fastest / 8) if band is None else band[1]
    rate = min(fastest, _OVERSAMPLED * high / (2 * np.pi))
    levels, remarks = _find_levels(records, throttle, throttle_range, rate, width, shortest)
    brief = min(segment.seconds for level in levels for segment in level)
    low = 2 * np.pi * max(1.5, 3 / brief) if band is None else band[0]
    omega = np.geomspace(low, high, _LINES)
    if estimator is None and set(records[0].reference_names) - {throttle}:
        # In a loop transients are short and need no model of the whole record, as 1/s alone does.
        estimator = JointInputOutput(LocalPolynomial(global_order=0))
    estimator = estimator or LocalPolynomial()

    def respond(level: _Level, curve: float) -> FrequencyResponse:
        """The response at one level, with the command weighted by the curve around its mean."""
        slope, parts = ft.partial(relative_slope, curve=curve, flown=flown_curve), []
        for segment in level:
            one, inside = segment.record, slice(segment.first, segment.end)
            columns = _columns(one)[inside]
            columns[:, 0] *= slope(segment.throttle) / slope(_mean(level))
            parts.append(_with_columns(one, one.time[inside], columns))
        return without_filters(frequency_response(parts, omega, estimator=estimator), filters)

    responses = [respond(level, flown_curve) for level in levels]
    enough = [usable(response, None, 0.6).sum() >= _FEWEST for response in responses]
    if not all(enough):
        weak = (level for level, clear in zip(levels, enough, strict=True) if not clear)
        remark = (
            f"the excitation at throttle {', '.join(f'{_mean(level):.2f}' for level in weak)} is "
            f"too weak for a gain (fewer than {_FEWEST} frequencies with a coherence of 0.6): "
            "excite more or longer there"
        )
        if not any(enough):
            raise ValueError(f"no level of throttle determines a gain: {remark}")
        remarks += (remark,)
    levels = [level for level, clear in zip(levels, enough, strict=True) if clear]
    responses = [response for response, clear in zip(responses, enough, strict=True) if clear]
    result = _fit_levels(levels, responses, flown_curve, remarks)
    if result.curve is None or result.curve.standard_error > 1:
        return result
    curve = float(np.clip(result.curve.value, -0.9, 0.95))
    return _fit_levels(levels, [respond(level, curve) for level in levels], flown_curve, remarks)


def throttle_levels(
    record: Record | Sequence[Record],
    *,
    throttle: str = "throttle",
    throttle_range: tuple[float, float] = (0.0, 1.0),
    width: float = 0.1,
    shortest: float = 3.0,
) -> ThrottleLevels:
    """The levels of throttle with an excitation, as `gain_over_throttle` finds them.

    Arguments and errors are those; the result is a `jq.identify.ThrottleLevels`.
    """
    options = (throttle, throttle_range, _SLOW_RATE, width, shortest)
    return _extent(_find_levels(_require_records(record), *options)[0])


def _require_records(record: Record | Sequence[Record]) -> list[Record]:
    if not (records := [record] if isinstance(record, Record) else list(record)):
        raise ValueError("gain_over_throttle needs a jq.Record or several, and got none")
    return records


def _extent(levels: Sequence[_Level]) -> ThrottleLevels:
    throttle = [np.concatenate([segment.throttle for segment in level]) for level in levels]
    return ThrottleLevels(
        np.array([values.mean() for values in throttle]),
        np.array([values.min() for values in throttle]),
        np.array([values.max() for values in throttle]),
        np.array([sum(segment.seconds for segment in level) for level in levels]),
    )


def _columns(record: Record) -> Float[np.ndarray, "samples channels"]:
    return np.concatenate((record.inputs, record.outputs, record.references), axis=1)


def _with_columns(
    record: Record, time: np.ndarray, columns: Float[np.ndarray, "samples channels"]
) -> Record:
    parts = {"inputs": columns[:, :1], "outputs": columns[:, 1:2], "references": columns[:, 2:]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordWarning)  # of what was repaired or is constant
        return dataclasses.replace(record, time=time, time_unit="s", repaired=None, **parts)


def _find_levels(
    records: Sequence[Record], throttle: str, span: tuple[float, float], rate: float, width: float,
    shortest: float,
) -> tuple[list[_Level], tuple[str, ...]]:  # fmt: skip
    """Segments of nearly the same mean together, in the order of throttle, without its channel and
    at no more than `rate`; and what is left out."""
    if span[0] == span[1]:
        raise ValueError(f"throttle_range is {span}: give the values at no and at full throttle")
    if not (0 < width <= 0.5 and shortest > 0):
        raise ValueError(
            f"width is {width} and shortest {shortest} s: give a part of full throttle up to 0.5, "
            "and a time above 0"
        )
    segments: list[_Segment] = []
    for record in records:
        values = (record.channel(throttle) - span[0]) / (span[1] - span[0])
        if not (-0.05 <= values.min() and values.max() <= 1.05):
            raise ValueError(
                f"the throttle {throttle!r} runs from {values.min():.4g} to {values.max():.4g}: "
                "give throttle_range=, its values at no and at full throttle, such as (0.0, 1000.0)"
            )
        names = (record.input_names, record.output_names, record.reference_names)
        sides = [tuple(name for name in side if name != throttle) for side in names]
        if len(sides[0]) != 1 or len(sides[1]) != 1 or len(sides[2]) > 1:
            raise ValueError(
                f"gain_over_throttle needs one input, one output and at most one reference beside "
                f"{throttle!r}, but the record has {sides[0]}, {sides[1]} and {sides[2]}: choose "
                "channels with jq.records.select"
            )
        axis = select(record, inputs=sides[0], outputs=sides[1], references=sides[2])
        axis = _with_columns(axis, axis.time, _columns(axis))
        if record.sample_rate > 1.2 * rate:
            columns = [*_columns(axis).T, values]
            channels = [Channel(str(k), axis.time, column) for k, column in enumerate(columns)]
            time, resampled = resample(channels, rate)
            axis, values = _with_columns(axis, time, resampled[:, :-1]), resampled[:, -1]
        first, low, high = 0, values[0], values[0]
        for k, value in enumerate(values):
            low, high = min(low, value), max(high, value)
            if high - low > width:
                segments.append(_Segment(axis, values, first, k))
                first, low, high = k, value, value
        segments.append(_Segment(axis, values, first, values.size))
    segments = [segment for segment in segments if segment.seconds >= shortest]
    if not segments:
        raise ValueError(
            f"the throttle never stayed within {width:g} for {shortest:g} s: hold it at two or "
            f"three levels between 0.2 and 0.8 for 5 to 10 s each with an excitation, or give "
            "width= and shortest="
        )
    strongest = max(segment.excitation for segment in segments)
    excited = [segment for segment in segments if segment.excitation > _QUIET * strongest]
    if not excited:
        raise ValueError(
            "nothing excited the axis at any level of throttle: its reference or input is constant "
            "there. Fly a chirp, or stick doublets"
        )
    levels: list[_Level] = []
    for segment in sorted(excited, key=lambda segment: segment.throttle.mean()):
        if levels and segment.throttle.mean() - levels[-1][0].throttle.mean() <= width / 2:
            levels[-1].append(segment)
        else:
            levels.append([segment])
    count = len(segments) - len(excited)
    text = f"{count} stretches of steady throttle had no excitation and are left out"
    return levels, (text,) if count else ()


def _fit_levels(
    levels: Sequence[_Level],
    responses: Sequence[FrequencyResponse],
    flown: float,
    remarks: tuple[str, ...],
) -> GainOverThrottle:
    """One fit of all levels, from guesses of each."""
    guesses = [guess_lagged_integrator(response, 1) for response in responses]
    middle = lambda name: float(np.median([float(vars(guess)[name]) for guess in guesses]))
    gains = np.array([float(guess.gain) for guess in guesses])
    start = ThrottledIntegrator(gains, middle("lag"), middle("delay"))
    conditions = [_AtLevel(k) for k in range(len(responses))]
    result = fit(start, list(responses), conditions=conditions)
    span = lambda one: (float(one.record.time[one.first]), float(one.record.time[one.end - 1]))
    return GainOverThrottle(
        **_extent(levels)._asdict(),
        fit=result,
        flown=flown,
        input_unit=levels[0][0].record.input_units[0],
        output_unit=levels[0][0].record.output_units[0],
        stretches=tuple(tuple(span(segment) for segment in level) for level in levels),
        remarks=remarks + result.remarks,
    )
