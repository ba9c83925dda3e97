"""Models without delays, as packages need them whose models have none: Pade approximations."""

import importlib
import math
from types import ModuleType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


_MOST = 10  # above it the coefficients lose digits
_PHASE = math.radians(1.0)


class Explicit(NamedTuple):
    """x' = A x + B u, y = C x + D u."""

    A: Float[np.ndarray, "states states"]
    B: Float[np.ndarray, "states inputs"]
    C: Float[np.ndarray, "outputs states"]
    D: Float[np.ndarray, "outputs inputs"]


def require_package(name: str) -> ModuleType:
    """A package of the extra `interop`; ImportError with the line that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f"{name} is not installed: run pip install 'jaxquad[interop]', or pip install {name}."
        ) from error


def check_order(delay: Float[np.ndarray, "..."], pade: int | None) -> None:
    """Raise ValueError for delays without an order, and for an order that loses digits."""
    if pade is not None and not 1 <= pade <= _MOST:
        raise ValueError(f"pade is {pade}: give an order of 1 to {_MOST}, or None for no delay.")
    longest = float(np.max(delay, initial=0.0))
    if longest and pade is None:
        limit = _accurate_below(3) / longest
        raise ValueError(
            f"The model has a delay of {longest:.4g} s, and a rational model has none: give the "
            f"order of a Pade approximation. pade=3 is within 1 deg of it up to {limit:.3g} rad/s "
            f"({limit / (2 * math.pi):.3g} Hz). Or set the delay to 0 with dataclasses.replace."
        )


def _accurate_below(order: int) -> float:
    """omega times delay at which the approximation's phase is 1 deg off, by its first term."""
    first = math.factorial(order) ** 2 / (math.factorial(2 * order) * math.factorial(2 * order + 1))
    return (_PHASE / first) ** (1 / (2 * order + 1))


def pade_coefficients(
    delay: float, order: int
) -> tuple[Float[np.ndarray, " powers"], Float[np.ndarray, " powers"]]:
    """Numerator and denominator of exp(-delay s), the highest power of s first.

    Source: Golub & Van Loan, Matrix Computations, section 9.3.1.
    """
    counts = np.arange(order, -1, -1)
    choose = lambda k: math.comb(order, k) * math.factorial(2 * order - k)
    terms = np.array([choose(int(k)) / math.factorial(2 * order) for k in counts])
    below = terms * delay**counts
    return below * (-1.0) ** counts, below


def without_delays(
    model: Explicit,
    by_input: Float[np.ndarray, " inputs"],
    by_output: Float[np.ndarray, " outputs"],
    order: int,
) -> Explicit:
    """The model between approximations of its delays (s)."""
    return _series(_series(_bank(by_input, order), model), _bank(by_output, order))


def _bank(delays: Float[np.ndarray, " channels"], order: int) -> Explicit:
    """Approximations side by side; no states where there is no delay."""
    late = np.flatnonzero(delays)
    count = late.size * order
    A, B, C = (
        np.zeros((count, count)),
        np.zeros((count, delays.size)),
        np.zeros((delays.size, count)),
    )
    for k, channel in enumerate(late):
        block = slice(k * order, (k + 1) * order)
        A[block, block], B[block, channel], C[channel, block] = _realised(delays[channel], order)
    D = np.eye(delays.size)
    D[late, late] = (-1.0) ** order
    return Explicit(A, B, C, D)


def _realised(delay: float, order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B, C of one approximation in time measured in delays, so that no digit is lost."""
    above, below = pade_coefficients(1.0, order)
    above, below = above / below[0], below / below[0]
    first = np.eye(order)[0]
    A = np.eye(order, k=-1) - np.outer(first, below[1:])
    return A / delay, first / delay, above[1:] - above[0] * below[1:]


def _series(first: Explicit, second: Explicit) -> Explicit:
    """The outputs of `first` drive the inputs of `second`."""
    none = np.zeros((len(first.A), len(second.A)))
    return Explicit(
        np.block([[first.A, none], [second.B @ first.C, second.A]]),
        np.concatenate([first.B, second.B @ first.D]),
        np.concatenate([second.D @ first.C, second.C], axis=1),
        second.D @ first.D,
    )
