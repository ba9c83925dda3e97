"""The evaluations of a tune: kept, and printed while it runs."""

import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Evaluation(NamedTuple):
    """One evaluation of all problems, with arrays [problems]; NaN for those that have ended."""

    phase: str  # "stabilise" or "optimise"
    z: Float[np.ndarray, "problems n"]
    cost: Float[np.ndarray, " problems"]
    gradient_norm: Float[np.ndarray, " problems"]
    stable: Float[np.ndarray, " problems"]  # share of the members whose abscissa is below 0
    worst: Float[np.ndarray, " problems"]  # the member of the highest cost
    means: dict[str, Float[np.ndarray, " problems"]]  # over the members, of each quantity
    seconds: float  # since the start


Listener = Callable[[Evaluation], None]


class Progress:
    """Keeps every evaluation, and prints a line of it on a terminal."""

    def __init__(self, shown: bool | None, listener: Listener | None = None):
        self.history: list[Evaluation] = []
        self.begun = time.perf_counter()
        self.shown = sys.stderr.isatty() if shown is None else shown
        self.listener = listener

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.begun

    def say(self, text: str) -> None:
        if self.shown:
            print(text, file=sys.stderr, flush=True)

    def add(self, evaluation: Evaluation) -> None:
        self.history.append(evaluation)
        self.say(describe_evaluation(len(self.history), evaluation))
        if self.listener is not None:
            self.listener(evaluation)


def describe_evaluation(count: int, now: Evaluation) -> str:
    """One line of text of an evaluation; of several problems, the best one's numbers."""
    known = np.isfinite(now.cost)
    best = int(np.argmin(np.where(known, now.cost, np.inf)))
    parts = [f"{now.phase} {count:3d}", f"cost {now.cost[best]:9.5f}"]
    if known.size > 1:
        parts.append(f"(best of {known.sum()} running)")
    if "itae" in now.means and now.phase == "optimise":
        parts.append(f"ITAE {np.degrees(now.means['itae'][best]):.4g} deg s^2")
    parts.append(f"stable {100 * now.stable[best]:.3g} %")
    parts.append(f"worst member {now.worst[best]:.0f}")
    parts.append(f"|gradient| {now.gradient_norm[best]:.2g}")
    return "  ".join([*parts, f"{now.seconds:.1f} s"])
