"""Inputs that move together, and can then not be told apart."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


_TOGETHER = 0.5  # average coherence between inputs above which the textbook warns
_LOST = 0.9999


def remarks_on_inputs(
    omega: Float[np.ndarray, " frequencies"],
    coherence: Float[np.ndarray, "frequencies inputs"],
    names: Sequence[str],
) -> tuple[str, ...]:
    """`coherence` is the multiple coherence of each input with all others."""
    if len(names) < 2:
        return ()
    remarks = []
    for i, name in enumerate(names):
        lost = coherence[:, i] > _LOST
        if np.any(lost):
            span = omega[lost]
            remarks.append(
                f"input {name} cannot be told from the others at {lost.sum()} of {omega.size} "
                f"frequencies ({span[0]:.3g}..{span[-1]:.3g} rad/s), which are left out: move the "
                "inputs independently, one sweep after the other or with interleaved multisines"
            )
        elif np.mean(coherence[:, i]) > _TOGETHER:
            remarks.append(
                f"input {name} moves with the others: their coherence averages "
                f"{coherence[:, i].mean():.2f}, above 0.5; conditioned responses have larger errors"
            )
    return tuple(remarks)
