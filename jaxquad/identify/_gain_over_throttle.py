"""The gain over the throttle: levels of throttle in records, one lag and delay, a gain for each."""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

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

from ._curve_parameters import relative_slope
from ._known_filters import KnownFilter, without_filters
from ._thrust_curve import GainOverThrottle, ThrottleLevels
from .frequency_domain._cost import usable
from .frequency_domain._fit import fit, guess_lagged_integrator
from .frequency_domain._result import Fit


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


class _Signals(NamedTuple):
    """Command, rate and references of a record on one clock, beside the throttle from 0 to 1."""

    record: Record
    throttle: Float[np.ndarray, " samples"]


class _Piece(NamedTuple):
    """Samples `first` to before `end` of the signals, at almost one throttle."""

    signals: _Signals
    first: int
    end: int

    @property
    def throttle(self) -> Float[np.ndarray, " samples"]:
        return self.signals.throttle[self.first : self.end]

    @property
    def span(self) -> tuple[float, float]:
        """In the record's time, in s."""
        time = self.signals.record.time
        return float(time[self.first]), float(time[self.end - 1])

    @property
    def seconds(self) -> float:
        return (self.end - self.first) * self.signals.record.dt

    @property
    def drive(self) -> float:
        """Standard deviation of the reference, of the input where there is none."""
        record = self.signals.record
        moved = record.references if record.reference_names else record.inputs
        return float(moved[self.first : self.end].std())


_Level = list[_Piece]


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

    **Returns:**

    A `jq.identify.GainOverThrottle`: gains, thrust curve, the firmwares' parameters.

    **Raises:**

    - `ValueError`: the records lack the channels, the throttle leaves 0 to 1, or it stayed at no
        level with an excitation.

    !!! example

        ```python
        found = jq.identify.gain_over_throttle(record, throttle_range=(0.0, 1000.0))
        print(found, found.adrc_b0(hover=0.3), sep="\\n")
        ```
    """
    records = [record] if isinstance(record, Record) else list(record)
    _check(records, throttle_range, flown_curve, width, shortest)
    fastest = records[0].sample_rate
    high = 2 * np.pi * min(45.0, fastest / 8) if band is None else band[1]
    rate = min(fastest, _OVERSAMPLED * high / (2 * np.pi))
    signals = [_on_one_clock(each, throttle, throttle_range, rate) for each in records]
    pieces = [piece for each in signals for piece in _pieces(each, width, shortest)]
    levels, remarks = _levels(pieces, width, shortest)
    brief = min(piece.seconds for level in levels for piece in level)
    low = 2 * np.pi * max(1.5, 3 / brief) if band is None else band[0]
    omega = np.geomspace(low, high, _LINES)
    chosen = estimator or _default(records[0], throttle)
    respond = lambda level, curve: _respond(level, omega, chosen, filters, curve, flown_curve)
    heard, unheard = [], []
    for level in levels:
        response = respond(level, flown_curve)
        enough = usable(response, None, 0.6).sum() >= _FEWEST
        (heard if enough else unheard).append((level, response))
    if unheard:
        remarks += (_inaudible([level for level, _ in unheard]),)
    if not heard:
        raise ValueError(f"no level of throttle determines a gain: {remarks[-1]}")
    levels = [level for level, _ in heard]
    found = _result(levels, [response for _, response in heard], flown_curve, remarks)
    if found.curve is None or found.curve.standard_error > 1:
        return found
    curve = float(np.clip(found.curve.value, -0.9, 0.95))
    return _result(levels, [respond(level, curve) for level in levels], flown_curve, remarks)


def throttle_levels(
    record: Record | Sequence[Record],
    *,
    throttle: str = "throttle",
    throttle_range: tuple[float, float] = (0.0, 1.0),
    width: float = 0.1,
    shortest: float = 3.0,
) -> ThrottleLevels:
    """The levels of throttle with an excitation, as `gain_over_throttle` finds them.

    **Arguments:** as there.

    **Returns:** a `jq.identify.ThrottleLevels`.

    **Raises:**

    - `ValueError`: as there.
    """
    records = [record] if isinstance(record, Record) else list(record)
    _check(records, throttle_range, 0.0, width, shortest)
    signals = [_on_one_clock(each, throttle, throttle_range, _SLOW_RATE) for each in records]
    pieces = [piece for each in signals for piece in _pieces(each, width, shortest)]
    return _extent(_levels(pieces, width, shortest)[0])


def _extent(levels: Sequence[_Level]) -> ThrottleLevels:
    throttle = [np.concatenate([piece.throttle for piece in level]) for level in levels]
    return ThrottleLevels(
        np.array([each.mean() for each in throttle]),
        np.array([each.min() for each in throttle]),
        np.array([each.max() for each in throttle]),
        np.array([sum(piece.seconds for piece in level) for level in levels]),
    )


def _default(record: Record, throttle: str) -> Estimator:
    """In a loop transients are short and need no model of the whole record, as 1/s alone does."""
    if set(record.reference_names) - {throttle}:
        return JointInputOutput(LocalPolynomial(global_order=0))
    return LocalPolynomial()


def _check(
    records: Sequence[Record],
    span: tuple[float, float],
    curve: float,
    width: float,
    shortest: float,
) -> None:
    """Raise ValueError for options that make no sense."""
    if not records:
        raise ValueError("gain_over_throttle needs a jq.Record or several, and got none")
    if span[0] == span[1]:
        raise ValueError(f"throttle_range is {span}: give the values at no and at full throttle")
    if not -1 <= curve <= 1:
        raise ValueError(f"flown_curve is {curve}: give -1 to 1; thrust_linear over 100")
    if not (0 < width <= 0.5 and shortest > 0):
        raise ValueError(
            f"width is {width} and shortest {shortest} s: give a part of full throttle up to 0.5, "
            "and a time above 0"
        )


def _on_one_clock(
    record: Record, throttle: str, span: tuple[float, float], rate: float
) -> _Signals:
    """Command, rate and reference apart from the throttle, at a lower sample rate."""
    level = (record.channel(throttle) - span[0]) / (span[1] - span[0])
    if not (-0.05 <= level.min() and level.max() <= 1.05):
        raise ValueError(
            f"the throttle {throttle!r} runs from {level.min():.4g} to {level.max():.4g}: give "
            "throttle_range=, its values at no and at full throttle, such as (0.0, 1000.0)"
        )
    without = lambda names: tuple(name for name in names if name != throttle)
    sides = [without(each) for each in (record.input_names, record.output_names)]
    referred = without(record.reference_names)
    if len(sides[0]) != 1 or len(sides[1]) != 1 or len(referred) > 1:
        raise ValueError(
            f"gain_over_throttle needs one input, one output and at most one reference beside "
            f"{throttle!r}, but the record has {sides[0]}, {sides[1]} and {referred}: choose "
            "channels with jq.records.select"
        )
    kept = select(record, inputs=sides[0], outputs=sides[1], references=referred)
    kept = _copied(kept, kept.time, np.concatenate(_blocks(kept), axis=1), record.hold)
    if record.sample_rate <= 1.2 * rate:
        return _Signals(kept, level)
    columns = [*np.concatenate(_blocks(kept), axis=1).T, level]
    channels = [Channel(str(k), kept.time, each) for k, each in enumerate(columns)]
    time, values = resample(channels, rate)
    return _Signals(_copied(kept, time, values[:, :-1], record.hold), values[:, -1])


def _blocks(record: Record) -> tuple[Float[np.ndarray, "samples channels"], ...]:
    return record.inputs, record.outputs, record.references


def _copied(
    like: Record, time: np.ndarray, columns: Float[np.ndarray, "samples channels"], hold
) -> Record:
    """A record with the names of another, whose channels are these columns."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordWarning)  # of what was repaired or is constant
        return Record(
            time,
            columns[:, :1],
            columns[:, 1:2],
            columns[:, 2:],
            input_names=like.input_names,
            output_names=like.output_names,
            reference_names=like.reference_names,
            input_units=like.input_units,
            output_units=like.output_units,
            reference_units=like.reference_units,
            source=like.source,
            hold=hold,
            time_unit="s",
        )


def _pieces(signals: _Signals, width: float, shortest: float) -> list[_Piece]:
    """Stretches of at least `shortest` s within which the throttle moves by at most `width`."""
    values, found, first = signals.throttle, [], 0
    low = high = values[0]
    for k, value in enumerate(values):
        low, high = min(low, value), max(high, value)
        if high - low > width:
            found.append(_Piece(signals, first, k))
            first, low, high = k, value, value
    found.append(_Piece(signals, first, values.size))
    return [piece for piece in found if piece.seconds >= shortest]


def _levels(
    pieces: Sequence[_Piece], width: float, shortest: float
) -> tuple[list[_Level], tuple[str, ...]]:
    """Pieces of nearly the same mean together, in the order of throttle; and what was left out."""
    if not pieces:
        raise ValueError(
            f"the throttle never stayed within {width:g} for {shortest:g} s: hold it at two or "
            f"three levels between 0.2 and 0.8 for 5 to 10 s each with an excitation, or give "
            "width= and shortest="
        )
    strongest = max(piece.drive for piece in pieces)
    driven = [piece for piece in pieces if piece.drive > _QUIET * strongest]
    if not driven:
        raise ValueError(
            "nothing excited the axis at any level of throttle: its reference or input is constant "
            "there. Fly a chirp, or stick doublets"
        )
    levels: list[_Level] = []
    for piece in sorted(driven, key=lambda each: each.throttle.mean()):
        middle = piece.throttle.mean()
        if levels and middle - levels[-1][0].throttle.mean() <= width / 2:
            levels[-1].append(piece)
        else:
            levels.append([piece])
    return levels, _left_out(len(pieces) - len(driven))


def _left_out(count: int) -> tuple[str, ...]:
    text = f"{count} stretches of steady throttle had no excitation and are left out"
    return (text,) if count else ()


def _inaudible(levels: Sequence[_Level]) -> str:
    middles = ", ".join(f"{_mean(level):.2f}" for level in levels)
    return (
        f"the excitation at throttle {middles} is too weak for a gain (fewer than {_FEWEST} "
        "frequencies with a coherence of 0.6): excite more or longer there"
    )


def _mean(level: _Level) -> float:
    return float(np.concatenate([piece.throttle for piece in level]).mean())


def _respond(
    level: _Level,
    omega: Float[np.ndarray, " frequencies"],
    estimator: Estimator,
    filters: Sequence[KnownFilter],
    curve: float,
    flown: float,
) -> FrequencyResponse:
    """The response at one level, with the command weighted by the curve around its mean."""
    middle = relative_slope(_mean(level), curve, flown)
    records = []
    for piece in level:
        record, inside = piece.signals.record, slice(piece.first, piece.end)
        columns = np.concatenate(_blocks(record), axis=1)[inside]
        columns[:, 0] *= relative_slope(piece.throttle, curve, flown) / middle
        records.append(_copied(record, record.time[inside], columns, record.hold))
    found = frequency_response(records, omega, estimator=estimator)
    return without_filters(found, filters)


def _result(
    levels: Sequence[_Level],
    responses: Sequence[FrequencyResponse],
    flown: float,
    remarks: tuple[str, ...],
) -> GainOverThrottle:
    found = _fitted(responses)
    record = levels[0][0].signals.record
    return GainOverThrottle(
        **_extent(levels)._asdict(),
        fit=found,
        flown=flown,
        input_unit=record.input_units[0],
        output_unit=record.output_units[0],
        stretches=tuple(tuple(piece.span for piece in level) for level in levels),
        remarks=remarks + found.remarks,
    )


def _fitted(responses: Sequence[FrequencyResponse]) -> Fit:
    guesses = [guess_lagged_integrator(each, 1) for each in responses]
    middle = lambda name: float(np.median([float(vars(each)[name]) for each in guesses]))
    start = ThrottledIntegrator(
        np.array([float(each.gain) for each in guesses]), middle("lag"), middle("delay")
    )
    conditions = [_AtLevel(k) for k in range(len(responses))]
    return fit(start, list(responses), conditions=conditions)
