"""Models of python-control and scipy.signal, recognised by their parts."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ._state_space import StateSpace
from ._transfer_function import (
    coefficients_of,
    HasCoefficients,
    require_continuous,
    TransferFunction,
)


_INDEPENDENT = 1e-8  # smallest singular value of the columns of B, beside the largest


@runtime_checkable
class HasMatrices(Protocol):
    """A state space of python-control or scipy.signal."""

    @property
    def A(self) -> np.ndarray: ...

    @property
    def B(self) -> np.ndarray: ...

    @property
    def C(self) -> np.ndarray: ...

    @property
    def D(self) -> np.ndarray: ...

    @property
    def dt(self) -> float | int | bool | None: ...  # s; None or 0 where it is continuous


def from_control(system: HasCoefficients | HasMatrices) -> TransferFunction | StateSpace:
    """A continuous model of python-control or scipy.signal.

    A direct passage from input to output, which H0 x + H1 x' does not have, becomes a share of x';
    where the inputs drive no states of their own, each gets one that cancels in the response. A
    transfer function of several inputs or outputs becomes a state space with states of their own
    for each pair.

    !!! example

        ```python
        model = jq.models.from_control(control.tf([10.0], [1.0, 4.0, 0.0]))
        ```

    **Arguments:**

    - `system`: a `TransferFunction` or a `StateSpace` of python-control or scipy.signal. Neither
        has delays: put them in with `dataclasses.replace`.

    **Returns:**

    A `jq.TransferFunction` for a ratio of polynomials with one input and one output, otherwise a
    `jq.StateSpace`.

    **Raises:**

    - `ValueError`: the system is sampled, improper, or of another kind.
    """
    if isinstance(system, HasMatrices):
        require_continuous(system.dt)
        return _with_passage(
            *(np.asarray(x, float) for x in (system.A, system.B, system.C, system.D))
        )
    if isinstance(system, HasCoefficients):
        require_continuous(system.dt)
        above, below = coefficients_of(system)
        if len(above) == len(above[0]) == 1:
            return TransferFunction(above[0][0], below[0][0])
        return _pairs(above, below)
    remedy = "TransferFunction or a StateSpace of python-control or scipy.signal (control.tf)"
    if hasattr(system, "frdata"):
        remedy += "; data go to jq.spectra.FrequencyResponse.from_table(system, random_error=0.02)"
    raise ValueError(f"from_control cannot convert a {type(system).__name__}: give a {remedy}.")


def _pairs(
    above: Sequence[Sequence[np.ndarray]], below: Sequence[Sequence[np.ndarray]]
) -> StateSpace:
    """A bank of transfer functions, outputs per inputs."""
    outputs, inputs = len(above), len(above[0])
    parts, D = [], np.zeros((outputs, inputs))
    for row in range(outputs):
        for column in range(inputs):
            A, b, c, D[row, column] = _companion(above[row][column], below[row][column])
            parts.append(
                (A, np.outer(b, np.eye(inputs)[column]), np.outer(np.eye(outputs)[row], c))
            )
    from scipy.linalg import block_diag

    A = np.asarray(block_diag(*(part[0] for part in parts)))
    B = np.concatenate([part[1] for part in parts])
    return _with_passage(A, B, np.concatenate([part[2] for part in parts], axis=1), D)


def _companion(
    above: Float[np.ndarray, " zeros"], below: Float[np.ndarray, " poles"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """A, b, c, d of one pair: the controllable canonical form; no states for a response of 0."""
    model = TransferFunction(above, below)
    if not np.any(model.numerator):
        return np.zeros((0, 0)), np.zeros(0), np.zeros(0), 0.0
    a, states = below[1:] / below[0], below.size - 1
    b = np.concatenate([np.zeros(below.size - above.size), above]) / below[0]
    first = np.eye(states, 1)[:, 0]
    A = np.eye(states, k=-1) - np.outer(first, a)
    return A, first, b[1:] - b[0] * a, float(b[0])


def _with_passage(
    A: Float[np.ndarray, "states states"],
    B: Float[np.ndarray, "states inputs"],
    C: Float[np.ndarray, "outputs states"],
    D: Float[np.ndarray, "outputs inputs"],
) -> StateSpace:
    """H0 x + H1 x' that equals C x + D u."""
    if not np.any(D) and len(A):
        return StateSpace(F=A, G=B, H0=C)
    H1 = D @ np.linalg.pinv(B, rcond=_INDEPENDENT)
    if not np.allclose(H1 @ B, D, rtol=0, atol=1e-13 * np.max(np.abs(D), initial=0.0)):
        A, B, C, H1 = _with_cancelling_states(A, B, C, D)
    return StateSpace(F=A, G=B, H0=C - H1 @ A, H1=H1)


def _with_cancelling_states(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One more state z' = u - a z for each input: H1 reads z', and H0 adds a z."""
    inputs = D.shape[1]
    speed = float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0)) or 1.0  # a, rad/s
    across = np.zeros((len(A), inputs))
    A = np.block([[A, across], [across.T, -speed * np.eye(inputs)]])
    B = np.concatenate([B, np.eye(inputs)])
    C = np.concatenate([C, np.zeros_like(D)], axis=1)
    return A, B, C, np.concatenate([np.zeros((len(D), len(across))), D], axis=1)
