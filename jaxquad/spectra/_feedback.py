"""Signs that a controller, and not the plant, made the coherence between input and output."""

import numpy as np
from jaxtyping import Bool, Float

from ._checks import in_hertz


COHERENT = 0.6  # magnitude-squared coherence from which a frequency is commonly used
_TOP = 4.0  # ratio of frequencies, at the top of the coherent band, over which the phase must fall

DIRECT = (
    "direct estimate (H1): if a controller C feeds the output back to this input, the estimate is "
    "biased towards -1/C. Name an external reference (references=, --reference) for the joint "
    "estimate, which is unbiased"
)


def dominated_by_feedback(
    direct: Float[np.ndarray, " frequencies"], by_reference: Float[np.ndarray, " frequencies"]
) -> Bool[np.ndarray, " frequencies"]:
    """Where input and output are coherent although the reference explains neither."""
    return (direct >= COHERENT) & (by_reference < COHERENT)


def phase_rises(
    omega: Float[np.ndarray, " frequencies"],
    phase: Float[np.ndarray, " frequencies"],
    error: Float[np.ndarray, " frequencies"],
    coherence: Float[np.ndarray, " frequencies"],
) -> bool:
    """Whether the phase increases, by two standard errors, at the top of the coherent band.

    Every actuator lags, so a plant's phase decreases there. That of -1/C, with a controller that
    filters and delays, increases.
    """
    good = np.flatnonzero(coherence >= COHERENT)
    top = good[omega[good] >= omega[good[-1]] / _TOP] if len(good) else good
    if len(top) < 8:
        return False
    weight = 1 / np.maximum(error[top], 1e-3) ** 2
    weight = np.minimum(weight, 4 * np.median(weight))
    centred = omega[top] - np.average(omega[top], weights=weight)
    level = np.unwrap(phase)[top]
    level = level - np.average(level, weights=weight)
    spread = np.sum(weight * centred**2)
    slope = np.sum(weight * centred * level) / spread
    scatter = np.sum(weight * (level - slope * centred) ** 2) / (len(top) - 2)
    return bool(slope * np.sqrt(spread / max(scatter, 1.0)) > 2)


def remarks_on_feedback(
    method: str,
    omega: Float[np.ndarray, " frequencies"],
    phase: Float[np.ndarray, "frequencies outputs"],
    error: Float[np.ndarray, "frequencies outputs"],
    coherence: Float[np.ndarray, "frequencies outputs"],
    direct: Float[np.ndarray, "frequencies outputs"],
) -> tuple[str, ...]:
    """Remarks on feedback that a user of the response has to know."""
    remarks = [DIRECT] if method == "direct" else []
    for o in range(direct.shape[1]):
        if method == "joint":
            remarks += _explained_by_reference(omega, coherence[:, o], direct[:, o])
        elif phase_rises(omega, phase[:, o], error[:, o], coherence[:, o]):
            remarks.append(
                "feedback-dominated: the phase increases with frequency at the top of the coherent "
                "band, like that of -1/C and unlike that of any actuator; the coherence there "
                "comes from the controller. Add excitation, and name it as the reference"
            )
    return tuple(dict.fromkeys(remarks))


def _explained_by_reference(
    omega: Float[np.ndarray, " frequencies"],
    coherence: Float[np.ndarray, " frequencies"],
    direct: Float[np.ndarray, " frequencies"],
) -> list[str]:
    dominated = dominated_by_feedback(direct, coherence)
    if 2 * np.sum(dominated) <= np.sum(direct >= COHERENT):
        return []
    span = omega[dominated]
    return [
        f"feedback-dominated: input and output are coherent at {np.sum(direct >= COHERENT)} "
        f"frequencies, but at {np.sum(dominated)} of them, {in_hertz(span)}, the reference "
        "explains neither. There the controller feeds back noise, and the record holds no "
        "information on the plant. Excite these frequencies by the reference"
    ]
