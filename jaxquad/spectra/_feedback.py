"""Signs that a controller, and not the plant, made the coherence between input and output."""

import functools as ft
import itertools
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from jaxquad.records import Record

from ._checks import in_hertz
from ._directed import Share, share_from_output
from ._error_covariance import ErrorCovariance
from ._remarks import DOMINATED, EARLY, Remark


Grid = Float[np.ndarray, " frequencies"]
Pairs = Float[np.ndarray, "frequencies outputs inputs"]


COHERENT = 0.6  # magnitude-squared coherence from which a frequency is commonly used
_CHANCE = 1.35e-3  # of calling the phase of any pair rising: 3 standard errors of a single slope
_FALLS = 0.35  # rad over the top of the coherent band: less than an actuator's phase falls there
_LESS = 0.05  # power of 1/omega by which a lag's magnitude falls there
_NEARLY_ALL, _MORE = 0.9, 0.5  # median shares of the input's power, output first and input first
_FEWEST = 8  # frequencies for a slope
_TOP = 4.0  # ratio of frequencies, at the top of the coherent band, over which the phase must fall


def dominated_by_feedback(
    direct: Float[np.ndarray, " frequencies"], by_reference: Float[np.ndarray, " frequencies"]
) -> Bool[np.ndarray, " frequencies"]:
    """Where input and output are coherent although the reference explains neither."""
    return (direct >= COHERENT) & (by_reference < COHERENT)


Covariance = Callable[[], Complex[np.ndarray, "frequencies frequencies"]]


class _Slope(NamedTuple):
    """That of the phase over the top of the coherent band, in rad per rad/s."""

    top: Int[np.ndarray, " top"]  # places of the frequencies
    pull: Float[np.ndarray, " top"]  # from their phases to the slope
    value: float
    variance: float  # were their errors independent
    span: float  # rad/s
    order: float  # of the magnitude: -1 where it falls as 1/omega


def phase_rises(
    omega: Grid,
    response: Complex[np.ndarray, " frequencies"],
    error: Grid,
    coherence: Grid,
    covariance: Covariance | None = None,
    clear: float = 3.0,
) -> bool:
    """Whether the phase increases, by `clear` standard errors, at the top of the coherent band.

    Every actuator lags, so a plant's phase decreases there. That of -1/C, with a controller that
    filters and delays, increases. Neighbours share noise, which makes a slope less certain than its
    many points say: the response's `covariance` is asked for where these say that it rises.
    """
    slope = _slope_at_top(omega, response, error, coherence)
    return slope is not None and _is_rise(slope, response, covariance, clear)


def _slope_at_top(
    omega: Grid, response: Complex[np.ndarray, " frequencies"], error: Grid, coherence: Grid
) -> _Slope | None:
    top = _top(omega, np.flatnonzero(coherence >= COHERENT))
    if top is None:
        return None
    weight = 1 / np.maximum(error[top], 1e-3) ** 2
    weight = np.minimum(weight, 4 * np.median(weight))
    centred = omega[top] - np.average(omega[top], weights=weight)
    level = np.unwrap(np.angle(response[top]))
    level = level - np.average(level, weights=weight)
    spread = np.sum(weight * centred**2)
    pull = weight * centred / spread
    slope = float(pull @ level)
    scatter = np.sum(weight * (level - slope * centred) ** 2) / (len(top) - 2)
    variance = max(float(scatter), 1.0) / spread
    span = float(omega[top[-1]] - omega[top[0]])
    order = np.polyfit(np.log(omega[top]), np.log(np.abs(response[top])), 1, w=np.sqrt(weight))[0]
    return _Slope(top, pull, slope, float(variance), span, float(order))


def _top(omega: Grid, good: Int[np.ndarray, " good"]) -> Int[np.ndarray, " top"] | None:
    """The highest of the good places that has enough others below it, and these."""
    for end in range(len(good), _FEWEST - 1, -1):
        top = good[:end][omega[good[:end]] >= omega[good[end - 1]] / _TOP]
        if len(top) >= _FEWEST:
            return top
    return None


def _is_rise(
    slope: _Slope,
    response: Complex[np.ndarray, " frequencies"],
    covariance: Covariance | None,
    clear: float,
) -> bool:
    variance, top = slope.variance, slope.top
    if covariance is not None and slope.value > clear * np.sqrt(variance):
        turned = slope.pull / np.conj(response[top])
        shared = turned.conj() @ covariance()[np.ix_(top, top)] @ turned
        variance = max(variance, 0.5 * float(np.real(shared)))
    return bool(slope.value > clear * np.sqrt(variance))


class _Pair(NamedTuple):
    """One output and one input: names, places, and the response between them."""

    names: tuple[str, str]
    place: tuple[int, int]
    omega: Grid
    response: Complex[np.ndarray, " frequencies"]  # 1 where unknown
    error: Grid
    coherence: Grid  # 0 where unknown

    @property
    def coherent(self) -> Grid:
        return self.omega[self.coherence >= COHERENT]


def remarks_on_feedback(
    records: Sequence[Record],
    method: Literal["direct", "joint"],
    omega: Grid,
    response: Complex[np.ndarray, "frequencies outputs inputs"],
    error: Pairs,
    coherence: Pairs,
    direct: Pairs,
    names: tuple[Sequence[str], Sequence[str]],
    errors: ErrorCovariance | None = None,
) -> tuple[Remark, ...]:
    """Remarks on feedback that a user of the response has to know; `names` of outputs and inputs.

    `direct` is the coherence from input to output, `coherence` that of the estimate, `errors` those
    of the response; without them, its points count as independent.
    """
    from scipy.special import ndtri

    remarks, clear = [], float(ndtri(1 - _CHANCE / (len(names[0]) * len(names[1]))))
    for (o, output), (i, source) in itertools.product(*map(enumerate, names)):
        known = np.isfinite(response[:, o, i])
        pair = _Pair(
            (output, source),
            (o, i),
            omega,
            np.where(known, response[:, o, i], 1.0),
            np.where(known, error[:, o, i], np.inf),
            np.where(known, coherence[:, o, i], 0.0),
        )
        if method == "joint":
            explained = coherence[:, o, i], direct[:, o, i]
            remarks += _explained_by_reference(omega, *explained, pair.names)
        remarks += _remarks_on_phase(records, method, pair, errors, clear)
    return tuple(dict.fromkeys(remarks))


def _remarks_on_phase(
    records: Sequence[Record],
    method: Literal["direct", "joint"],
    pair: _Pair,
    errors: ErrorCovariance | None,
    clear: float,
) -> list[Remark]:
    """What the phase at the top of the coherent band says, where it falls as no actuator's does."""
    slope = _slope_at_top(pair.omega, pair.response, pair.error, pair.coherence)
    if slope is None:
        return []
    covariance = None if errors is None else ft.partial(errors.between, pair.place, pair.place)
    rises = _is_rise(slope, pair.response, covariance, clear)
    if method == "joint":
        text = _EARLY.format(lead=1e3 * slope.value)
        return [Remark(text, pair.coherent, pair.names, EARLY)] if rises else []
    share = _share_from_output(records, pair)
    made = _is_made_by_controller(pair, share)
    if rises:
        text = _RISES.format(lead=1e3 * slope.value)
        omega = pair.coherent if made else pair.omega[slope.top]
        return [Remark(text, omega, pair.names, DOMINATED)]
    text = _FED_BACK.format(share=100 * np.median(share.output_first), where="{where}")
    return [Remark(text, pair.coherent, pair.names, DOMINATED)] if made else []


def _share_from_output(records: Sequence[Record], pair: _Pair) -> Share:
    """At the coherent frequencies."""
    o, i = pair.place
    signals = [np.stack([x.outputs[:, o], x.inputs[:, i]]) for x in records]
    return share_from_output(signals, records[0].dt, pair.coherent)


def _is_made_by_controller(pair: _Pair, share: Share) -> bool:
    """Whether the output makes nearly all of the input at most of the coherent frequencies.

    The same holds of a plant whose answer is logged beside its cause, as far as nothing else moves
    either. It lags: where the output makes the input, its phase and magnitude fall. Where they do,
    the input's past must follow the output's, too.
    """
    if np.median(share.output_first) <= _NEARLY_ALL:
        return False
    if np.median(share.input_first) > _MORE:
        return True
    level = np.zeros(pair.omega.size)
    level[pair.coherence >= COHERENT] = share.output_first > _NEARLY_ALL
    slope = _slope_at_top(pair.omega, pair.response, pair.error, level)
    return slope is not None and slope.value * slope.span >= -_FALLS and slope.order >= -_LESS


_RISES = (
    "feedback-dominated: the phase increases with frequency at the top of the coherent "
    "band, like that of -1/C and unlike that of any actuator; the coherence there "
    "comes from the controller. Add excitation, and name it as the reference. Without a "
    "controller, input and output are swapped, or the output's time stamps are at least "
    "{lead:.2g} ms early"
)
_EARLY = (
    "the phase increases with frequency at the top of the coherent band, unlike that of any "
    "actuator, as if the output came at least {lead:.2g} ms before the input: exchange input and "
    "output if they are swapped, or correct their time stamps"
)
_FED_BACK = (
    "feedback-dominated: {share:.0f} % of the input's power (median) {where} comes from the "
    "output's own disturbances and noise: most of the response there is -1/C, that of the "
    "controller, and not the plant's (one without any lag in this band would look alike). Name the "
    "external reference; without one, excite the axis, and record what excites it"
)


def _explained_by_reference(
    omega: Grid, coherence: Grid, direct: Grid, pair: tuple[str, str]
) -> list[Remark]:
    dominated = dominated_by_feedback(direct, coherence)
    if 2 * np.sum(dominated) <= np.sum(direct >= COHERENT):
        return []
    text = (
        f"feedback-dominated: input and output are coherent at {np.sum(direct >= COHERENT)} "
        f"frequencies, but at {np.sum(dominated)} of them, {in_hertz(omega[dominated])}, the "
        "reference explains neither. There the controller feeds back noise, and the record holds "
        "no information on the plant. Excite these frequencies by the reference"
    )
    return [Remark(text, pair=pair, kind=DOMINATED)]
