from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Inexact


_RANK = 1e-10  # of the norm, after balancing: below it a singular value is rounding


def transmission_zeros(
    A: Float[np.ndarray, "states states"],
    B: Float[np.ndarray, "states inputs"],
    C: Float[np.ndarray, "outputs states"],
    D: Float[np.ndarray, "outputs inputs"],
) -> Inexact[np.ndarray, " zeros"]:
    """Where the response from all inputs to all outputs loses rank, rad/s.

    Zeros at infinity are taken out beforehand: an eigenvalue solver would scatter them over large
    finite values. Source: Emami-Naeini & Van Dooren, Automatica 18 (1982), p. 415.
    """
    A, B, C, D = _balanced(A, B, C, D)
    limit = _RANK * float(np.linalg.norm(np.block([[A, B], [C, D]])))
    A, B, C, D = _without_rows(A, B, C, D, limit)
    A, C, B, D = (part.T for part in _without_rows(A.T, C.T, B.T, D.T, limit))
    return np.linalg.eigvals(A - B @ np.linalg.solve(D, C))


def _without_rows(A, B, C, D, limit):
    """The system with the same finite zeros whose D has independent rows."""
    while True:
        left, size, _ = np.linalg.svd(D)
        rank = int(np.sum(size > limit))
        C, D = left.T @ C, (left.T @ D)[:rank]
        free, bound = C[:rank], C[rank:]  # an output of 0 that no input reaches binds states
        if not bound.size:
            return A, B, free, D
        _, size, right = np.linalg.svd(bound)
        bound_count = int(np.sum(size > limit))
        if not bound_count:
            return A, B, free, D
        A, B, free = right @ A @ right.T, right @ B, free @ right.T
        C = np.vstack([A[:bound_count, bound_count:], free[:, bound_count:]])
        D = np.vstack([B[:bound_count], D])
        A, B = A[bound_count:, bound_count:], B[bound_count:]


def _balanced(A, B, C, D):
    """The same system in units of states, inputs and outputs that make its numbers alike."""
    from scipy.linalg import matrix_balance

    (states, inputs), outputs = B.shape, len(C)
    loop = np.block(
        [
            [A, B, np.zeros((states, outputs))],
            [np.zeros((inputs, states + inputs)), np.ones((inputs, outputs))],
            [C, D, np.zeros((outputs, outputs))],
        ]
    )
    unit = np.asarray(matrix_balance(loop, permute=False, separate=True)[1][0])
    x, u, y = np.split(unit, [states, states + inputs])
    return A * x / x[:, None], B * u / x[:, None], C * x / y[:, None], D * u / y[:, None]


@runtime_checkable
class HasPoles(Protocol):
    """A linear model."""

    @property
    def poles(self) -> np.ndarray: ...


class Mode(NamedTuple):
    """A real pole, or a pair of complex ones, of which the upper is named."""

    pole: complex  # rad/s
    frequency: float  # |pole|, rad/s
    damping: float  # - Re pole / |pole|; NaN for an integrator
    time_constant: float  # - 1 / Re pole, s; negative if unstable, infinite on the imaginary axis

    def __str__(self) -> str:
        if self.pole.imag:
            shape = f"zeta {self.damping:.3g}, omega {self.frequency:.4g} rad/s"
        else:
            shape = f"real, {self.pole.real:.4g} rad/s"
        return f"{shape}, time constant {self.time_constant:.4g} s"


def modes(model: HasPoles) -> tuple[Mode, ...]:
    """Frequency, damping and time constant of each mode of a linear model, slowest first.

    **Arguments:**

    - `model`: has `poles` in rad/s. They are computed by NumPy, so not under jit.

    **Returns:**

    One `Mode` for each real pole and each pair of complex ones.
    """
    poles = [complex(pole) for pole in np.asarray(model.poles)]
    upper = [pole for pole in poles if pole.imag >= 0]
    return tuple(_mode(pole) for pole in sorted(upper, key=lambda pole: (abs(pole), pole.real)))


def _mode(pole: complex) -> Mode:
    size = abs(pole)
    damping = -pole.real / size if size else float("nan")
    return Mode(pole, size, damping, -1 / pole.real if pole.real else float("inf"))
