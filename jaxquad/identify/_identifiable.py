"""What a record can and cannot tell, decided from the Fisher information before any number."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._combination import combine, Combination, echelon, Named


LIMIT = 0.5  # standard error, relative, above which a combination counts as undetermined
_MEMBER = 0.1  # share of a null direction from which a parameter takes part in it
_EXACT = 1e3  # standard error from which a direction is taken as exactly null
_FLOOR = 1e-8  # of the largest singular value: below it lies rounding


class Identifiability(NamedTuple):
    """Names, directions and combinations; `undetermined` is empty where all is well."""

    undetermined: tuple[str, ...]
    null_directions: tuple[dict[str, float], ...]  # unit vectors of relative changes
    determined: tuple[Combination, ...]  # combinations of the undetermined ones


class Information(NamedTuple):
    """All that the decision rests on: free parameters first, then the fixed ones.

    The fixed ones take part in names only: the arm L in L K_t / J_x. `root` holds derivatives of
    ln-magnitudes and phases (alternate rows), in units of their random error, with respect to
    relative changes; `covariance` is that of the free parameters' relative changes.
    """

    root: Float[np.ndarray, "rows all"]
    covariance: Float[np.ndarray, "parameters parameters"]
    names: tuple[str, ...]
    values: Float[np.ndarray, " all"]
    units: Float[np.ndarray, " all"]


def decide(information: Information) -> Identifiability:
    """Null directions of the Fisher information, and what is left outside them."""
    count = len(information.covariance)
    _, singular, right = np.linalg.svd(information.root[:, :count], full_matrices=True)
    singular = np.pad(singular, (0, count - len(singular)))
    spread = 1 / np.maximum(singular, max(_FLOOR * singular[0], 1e-300))
    null = right[spread > LIMIT]
    if not len(null):
        return Identifiability((), (), ())
    members = np.flatnonzero(np.linalg.norm(null, axis=0) > _MEMBER)
    covariance = _opened(information.covariance, right[spread > _EXACT])
    rows = _outside(null[:, members])
    effects = information.root[:, members] @ np.linalg.pinv(rows) if len(rows) else None
    determined = []
    for k, row in enumerate(rows):
        weights = _with_fixed(row, members, effects[:, k], information)
        used = np.flatnonzero(weights)
        spread_of = np.zeros((len(weights), len(weights)))
        spread_of[:count, :count] = covariance
        named = Named(
            tuple(information.names[u] for u in used),
            information.values[used],
            information.units[used],
            spread_of[np.ix_(used, used)],
        )
        determined.append(combine(weights[used], named))
    directions = _directions(null, members, information.names)
    return Identifiability(
        tuple(information.names[k] for k in members), directions, tuple(determined)
    )


def _opened(covariance: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Covariance with a huge variance along exact null directions, where the inverse shows none."""
    keep = np.eye(len(covariance)) - exact.T @ exact
    return keep @ covariance @ keep + 1e4 * exact.T @ exact


def _outside(null: Float[np.ndarray, "null members"]) -> Float[np.ndarray, "rows members"]:
    """Combinations of the members that no null direction moves."""
    _, singular, right = np.linalg.svd(null, full_matrices=True)
    return echelon(right[int(np.sum(singular > 1e-6)) :])


def _with_fixed(
    row: np.ndarray, members: np.ndarray, effect: np.ndarray, information: Information
) -> Float[np.ndarray, " all"]:
    """Adds fixed parameters that act just as the combination does; signed to raise the response."""
    weights = np.zeros(len(information.values))
    weights[members] = row
    for k in range(len(information.covariance), len(weights)):
        column = information.root[:, k]
        power = float(column @ effect) / max(float(effect @ effect), 1e-300)
        if abs(power) > 0.1 and np.linalg.norm(column - power * effect) < 1e-6 * np.linalg.norm(column):
            weights[k] = power
    return -weights if np.sum(effect[::2]) < 0 else weights


def _directions(
    null: np.ndarray, members: np.ndarray, names: tuple[str, ...]
) -> tuple[dict[str, float], ...]:
    rows = echelon(null)
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return tuple({names[k]: float(row[k]) for k in members if abs(row[k]) > 0.01} for row in rows)
