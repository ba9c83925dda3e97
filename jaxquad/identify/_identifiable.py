"""What a record can and cannot tell, decided from the Fisher information before any number."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._combination import Combination, combine, echelon, Named


LIMIT = 0.5  # standard error, relative, above which a combination counts as undetermined
_MEMBER = 0.05  # share of a null direction from which a parameter takes part in it
_FLOOR = 1e-8  # of the largest singular value: below it lies rounding


class NotIdentifiable(ValueError):
    """The record holds no usable response, or fewer points than there are parameters."""


class Identifiability(NamedTuple):
    """Names, directions and combinations; `undetermined` is empty where all is well."""

    undetermined: tuple[str, ...]
    null_directions: tuple[dict[str, float], ...]  # unit vectors of relative changes
    determined: tuple[Combination, ...]  # combinations of the undetermined ones
    exact: Float[np.ndarray, "null parameters"]  # those null directions that no noise explains


class Information(NamedTuple):
    """All that the decision rests on: free parameters first, then the fixed ones.

    The fixed ones take part in names only: the arm L in L K_t / J_x. `root` holds derivatives of
    ln-magnitudes and phases (alternate rows), in units of their random error, with respect to
    relative changes; `covariance` is that of the free parameters' relative changes; `order` is
    the model's own order of its parameters.
    """

    root: Float[np.ndarray, "rows all"]
    covariance: Float[np.ndarray, "parameters parameters"]
    names: tuple[str, ...]
    values: Float[np.ndarray, " all"]
    units: Float[np.ndarray, " all"]
    order: tuple[int, ...]


def decide(information: Information) -> Identifiability:
    """Null directions of the Fisher information, and what is left outside them."""
    count = len(information.covariance)
    _, singular, right = np.linalg.svd(information.root[:, :count], full_matrices=True)
    singular = np.pad(singular, (0, count - len(singular)))
    exact = singular <= _FLOOR * singular[0]
    null = right[exact | (singular * LIMIT < 1)]
    if not len(null):
        return Identifiability((), (), (), right[exact])
    null = _sparse(null)
    opened = _opened(information.covariance, right[exact])
    facts = information._replace(covariance=opened)
    determined = [
        combination for block in _blocks(null) for combination in _determined(null, block, facts)
    ]
    members = np.flatnonzero(np.any(null, axis=0))
    names = information.names
    directions = tuple({names[k]: float(row[k]) for k in np.flatnonzero(row)} for row in null)
    lost = tuple(names[k] for k in members)
    return Identifiability(lost, directions, tuple(determined), right[exact])


def _sparse(null: Float[np.ndarray, "null parameters"]) -> Float[np.ndarray, "null parameters"]:
    """Unit directions spanning the same space, with small shares left out."""
    rows = echelon(null)
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return np.where(np.abs(rows) > _MEMBER, rows, 0.0)


def _blocks(null: Float[np.ndarray, "null parameters"]) -> list[np.ndarray]:
    """Groups of parameters that share null directions."""
    groups: list[set[int]] = []
    for row in null:
        group = set(np.flatnonzero(row).tolist())
        for other in [other for other in groups if other & group]:
            groups.remove(other)
            group |= other
        groups.append(group)
    return [np.array(sorted(group)) for group in groups]


def _opened(covariance: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Covariance with a huge variance along exact null directions, where the inverse shows none."""
    keep = np.eye(len(covariance)) - exact.T @ exact
    return keep @ covariance @ keep + 1e4 * exact.T @ exact


def _determined(
    null: Float[np.ndarray, "null parameters"], block: np.ndarray, facts: Information
) -> list[Combination]:
    """Combinations of one group's members that no null direction moves."""
    inside = null[:, block]
    _, singular, right = np.linalg.svd(inside[np.any(inside, axis=1)], full_matrices=True)
    rows = echelon(right[int(np.sum(singular > 1e-6)) :])
    if not len(rows):
        return []
    effects = facts.root[:, block] @ np.linalg.pinv(rows)
    return [_named(row, block, effects[:, k], facts) for k, row in enumerate(rows)]


def _named(
    row: np.ndarray, block: np.ndarray, effect: np.ndarray, facts: Information
) -> Combination:
    weights = np.zeros(len(facts.values))
    weights[block] = row
    weights = _with_fixed(weights, effect, facts)
    used = np.array(sorted(np.flatnonzero(weights), key=lambda k: facts.order[k]))
    count = len(facts.covariance)
    relative = np.zeros((len(weights), len(weights)))
    relative[:count, :count] = facts.covariance
    names = tuple(facts.names[k] for k in used)
    named = Named(names, facts.values[used], facts.units[used], relative[np.ix_(used, used)])
    return combine(weights[used], named)


def _with_fixed(
    weights: Float[np.ndarray, " all"], effect: np.ndarray, facts: Information
) -> Float[np.ndarray, " all"]:
    """Adds fixed parameters that act just as the combination does; signed to raise the response."""
    weights = weights.copy()
    for k in range(len(facts.covariance), len(weights)):
        column = facts.root[:, k]
        power = float(column @ effect) / max(float(effect @ effect), 1e-300)
        rest = np.linalg.norm(column - power * effect)
        if abs(power) > 0.1 and rest < 1e-6 * np.linalg.norm(column):
            weights[k] = power
    return -weights if np.sum(effect[::2]) < 0 else weights
