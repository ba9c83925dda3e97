"""Signs that a controller, and not the plant, made the coherence between input and output."""

import numpy as np
from jaxtyping import Bool, Float


COHERENT = 0.6  # magnitude-squared coherence from which a frequency is commonly used
_TOP = 4.0  # ratio of frequencies, at the top of the coherent band, over which the phase must fall

DIRECT = (
    "direct estimate (H1): where a controller feeds the output back to this input it is biased "
    "towards -1/C; an outside reference (references=[...]) gives the unbiased joint estimate"
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
    """Whether the phase rises, beyond two standard errors, at the top of the coherent band.

    Every actuator lags, so a plant's phase falls there. That of -1/C, with a controller that
    filters and delays, rises.
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
    """What a reader of the response has to know about feedback, in words."""
    remarks = [DIRECT] if method == "direct" else []
    for o in range(direct.shape[1]):
        if method == "joint":
            remarks += _explained_by_reference(omega, coherence[:, o], direct[:, o])
        elif phase_rises(omega, phase[:, o], error[:, o], coherence[:, o]):
            remarks.append(
                "feedback-dominated: the phase rises with frequency at the top of the coherent "
                "band, as that of -1/C does and no actuator's; the coherence there comes from the "
                "controller"
            )
    return tuple(dict.fromkeys(remarks))


def _explained_by_reference(
    omega: Float[np.ndarray, " frequencies"],
    coherence: Float[np.ndarray, " frequencies"],
    direct: Float[np.ndarray, " frequencies"],
) -> list[str]:
    mine = dominated_by_feedback(direct, coherence)
    if 2 * np.sum(mine) <= np.sum(direct >= COHERENT):
        return []
    span = omega[mine]
    return [
        f"feedback-dominated: input and output are coherent at {np.sum(direct >= COHERENT)} "
        f"frequencies, but at {np.sum(mine)} of them ({span[0]:.3g}..{span[-1]:.3g} rad/s) the "
        "reference explains neither: there the controller feeds noise back, and nothing tells "
        "about the plant"
    ]
