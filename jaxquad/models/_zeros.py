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
        held = int(np.sum(size > limit))
        if not held:
            return A, B, free, D
        A, B, free = right @ A @ right.T, right @ B, free @ right.T
        C = np.vstack([A[:held, held:], free[:, held:]])
        D = np.vstack([B[:held], D])
        A, B = A[held:, held:], B[held:]


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
