"""Signs that a controller, and not the plant, made the coherence between input and output."""

import functools as ft
import itertools
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Complex, Float

from ._checks import in_hertz
from ._error_covariance import ErrorCovariance
from ._remarks import Remark


Grid = Float[np.ndarray, " frequencies"]
Pairs = Float[np.ndarray, "frequencies outputs inputs"]


COHERENT = 0.6  # magnitude-squared coherence from which a frequency is commonly used
_CHANCE = 1.35e-3  # of calling the phase of any pair rising: 3 standard errors of a single slope
_TOP = 4.0  # ratio of frequencies, at the top of the coherent band, over which the phase must fall


def dominated_by_feedback(
    direct: Float[np.ndarray, " frequencies"], by_reference: Float[np.ndarray, " frequencies"]
) -> Bool[np.ndarray, " frequencies"]:
    """Where input and output are coherent although the reference explains neither."""
    return (direct >= COHERENT) & (by_reference < COHERENT)


Covariance = Callable[[], Complex[np.ndarray, "frequencies frequencies"]]


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
    good = np.flatnonzero(coherence >= COHERENT)
    top = good[omega[good] >= omega[good[-1]] / _TOP] if len(good) else good
    if len(top) < 8:
        return False
    weight = 1 / np.maximum(error[top], 1e-3) ** 2
    weight = np.minimum(weight, 4 * np.median(weight))
    centred = omega[top] - np.average(omega[top], weights=weight)
    level = np.unwrap(np.angle(response))[top]
    level = level - np.average(level, weights=weight)
    spread = np.sum(weight * centred**2)
    pull = weight * centred / spread
    slope = float(pull @ level)
    scatter = np.sum(weight * (level - slope * centred) ** 2) / (len(top) - 2)
    variance = max(float(scatter), 1.0) / spread
    if covariance is not None and slope > clear * np.sqrt(variance):
        turned = pull / np.conj(response[top])
        shared = turned.conj() @ covariance()[np.ix_(top, top)] @ turned
        variance = max(variance, 0.5 * float(np.real(shared)))
    return bool(slope > clear * np.sqrt(variance))


def remarks_on_feedback(
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
        pair, known = (output, source), np.isfinite(response[:, o, i])
        if method == "joint":
            remarks += _explained_by_reference(omega, coherence[:, o, i], direct[:, o, i], pair)
            continue
        here = np.where(known, response[:, o, i], 1.0)
        error_here = np.where(known, error[:, o, i], np.inf)
        level = np.where(known, coherence[:, o, i], 0.0)
        covariance = None if errors is None else ft.partial(errors.between, (o, i), (o, i))
        if phase_rises(omega, here, error_here, level, covariance, clear):
            remarks.append(Remark(_RISES, omega[coherence[:, o, i] >= COHERENT], pair))
    return tuple(dict.fromkeys(remarks))


_RISES = (
    "feedback-dominated: the phase increases with frequency at the top of the coherent "
    "band, like that of -1/C and unlike that of any actuator; the coherence there "
    "comes from the controller. Add excitation, and name it as the reference"
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
    return [Remark(text, pair=pair)]
