"""Which parameters a record determines, decided from the Fisher information."""

import dataclasses
from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._accuracy import Matrix
from ._verdict import Bound, Combination, remedies_for, Verdict


KINDS = ("product", "sum")
LIMIT = 0.5  # standard error, relative, above which a parameter counts as undetermined
VAGUE = 0.3  # likewise of a combination
_MEMBER = 0.05  # share of a null direction from which a parameter takes part in it
_MOVE = 0.4  # finite relative change along a null direction, to test products against sums
_FLOOR = 1e-8  # of the largest singular value: below it lies rounding

Vector = Float[np.ndarray, " parameters"]
Directions = Float[np.ndarray, "_ parameters"]


def echelon(rows: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Reduced row echelon form with full pivoting: the same space, with many zeros."""
    rows, pivots = rows.copy(), []
    for k in range(len(rows)):
        rest = np.abs(rows[k:])
        rest[:, pivots] = 0
        i, j = np.unravel_index(np.argmax(rest), rest.shape)
        rows[[k, k + i]] = rows[[k + i, k]]
        rows[k] /= rows[k, j]
        others = [m for m in range(len(rows)) if m != k]
        rows[others] -= np.outer(rows[others, j], rows[k])
        pivots.append(j)
    return rows


class Named(NamedTuple):
    """What a combination is made of; `relative` is the covariance of changes over `units`."""

    names: tuple[str, ...]
    values: Vector
    units: Vector  # the value itself where its logarithm is fitted
    relative: Matrix

    def error(self, weights: Vector) -> float:
        """Standard error of a weighted sum of relative changes."""
        return float(np.sqrt(max(weights @ self.relative @ weights, 0.0)))


def combine(weights: Vector, named: Named, kinds: tuple[str, ...] = KINDS) -> Combination | None:
    """The product or sum, as a person would write it, that is as sharp as `weights`.

    Exponents are whole numbers up to 2, coefficients 1 or -1, and cost no more than a quarter in
    standard error. None where nothing of the kind is as sharp, or where its error is beyond 30 %.
    """

    def as_sharp(simple: Vector) -> bool:
        along = abs(float(simple @ weights)) / float(weights @ weights)
        return named.error(simple) <= 1.25 * named.error(weights) * along

    logarithmic = bool(np.all(named.units == named.values))
    powers = _simplest(weights, 2) if logarithmic and "product" in kinds else None
    sums = _simplest(weights / named.units, 1) if "sum" in kinds else None
    powers = powers if powers is not None and as_sharp(powers) else None
    sums = sums if sums is not None and as_sharp(sums * named.units) else None
    if sums is None and powers is None:
        return None
    # Times that only lower the response add up.
    if sums is not None and (
        powers is None or np.abs(sums).max() < np.abs(powers).max() or np.all(powers <= 0)
    ):
        combination = _sum(sums, named)
    else:
        assert powers is not None
        combination = _product(powers, named)
    precise = combination.standard_error <= VAGUE * abs(combination.value)
    return combination if precise else None


def _simplest(weights: Vector, largest: int) -> Vector | None:
    """The nearest vector of whole numbers up to `largest`, or None if there is none near."""
    unit = weights / np.max(np.abs(weights))
    parts = [Fraction(float(w)).limit_denominator(largest) for w in unit]
    exact = np.array([float(part) for part in parts])
    integers = exact * np.lcm.reduce([part.denominator for part in parts])
    near = np.max(np.abs(exact - unit)) < 0.25 and np.max(np.abs(integers)) <= largest
    return integers * np.sign(weights @ integers) if near else None


def _product(powers: Vector, named: Named) -> Combination:
    value = float(np.prod(np.abs(named.values) ** powers))
    power = lambda name, p: name if p == 1 else f"{name}^{p:g}"
    above = [power(n, p) for n, p in zip(named.names, powers, strict=True) if p > 0]
    below = [power(n, -p) for n, p in zip(named.names, powers, strict=True) if p < 0]
    name = " ".join(above) or "1"
    if below:
        name += " / " + (below[0] if len(below) == 1 else f"({' '.join(below)})")
    return Combination(name, value, value * named.error(powers))


def _sum(weights: Vector, named: Named) -> Combination:
    weights = weights * np.sign(weights[np.argmax(np.abs(weights * named.units))])
    value = float(np.sum(weights * named.values))
    name, terms = "", [(w, n) for w, n in zip(weights, named.names, strict=True) if w]
    for w, n in terms:
        sign = ("- " if w < 0 else "") if not name else (" - " if w < 0 else " + ")
        name += sign + (n if abs(w) == 1 else f"{abs(w):g} {n}")
    error = named.error(weights * named.units)
    return Combination(name, value, error, sum_of=tuple(n for _, n in terms))


class Information(NamedTuple):
    """All that the decision rests on: free parameters first, then the fixed ones.

    The fixed ones take part in names only: the arm L in L K_t / J_x. `root` holds derivatives of
    ln-magnitudes and phases (alternate rows), in units of their random error, with respect to
    relative changes; `covariance` is that of the free parameters' relative changes, and `by_noise`
    what of it the noise alone accounts for, if the model's error has a share in it; `order` is
    the model's own order of its parameters; `same` says whether other values of the free ones
    give the same responses.
    """

    root: Float[np.ndarray, "rows all"]
    covariance: Matrix
    names: tuple[str, ...]
    values: Float[np.ndarray, " all"]
    units: Float[np.ndarray, " all"]
    order: tuple[int, ...]
    same: Callable[[Vector], bool]
    by_noise: Matrix | None = None


def assess_identifiability(information: Information, bounds: tuple[Bound, ...] = ()) -> Verdict:
    """Null directions of the Fisher information, and the combinations outside them.

    Parameters with a bound are determined by it, and take part in no direction.
    """
    if not bounds:
        return _assess(information)
    count = len(information.covariance)
    at_zero = [information.names.index(bound.name) for bound in bounds]
    kept = np.setdiff1d(np.arange(len(information.names)), at_zero)
    free = kept[kept < count]
    some = np.ix_(free, free)

    def completed(values: np.ndarray) -> np.ndarray:
        """With the bounded ones where they are."""
        complete = information.values[:count].copy()
        complete[free] = values
        return complete

    verdict = _assess(
        Information(
            root=information.root[:, kept],
            covariance=information.covariance[some],
            names=tuple(information.names[k] for k in kept),
            values=information.values[kept],
            units=information.units[kept],
            order=tuple(information.order[k] for k in kept),
            same=lambda values: information.same(completed(values)),
            by_noise=None if information.by_noise is None else information.by_noise[some],
        )
    )
    exact = np.zeros((len(verdict.exact), count))
    exact[:, free] = verdict.exact
    alternatives = tuple(completed(values) for values in verdict.alternatives)
    return dataclasses.replace(verdict, exact=exact, alternatives=alternatives, bounds=bounds)


def _assess(information: Information) -> Verdict:
    names, covariance, by_noise = information.names, information.covariance, information.by_noise
    count = len(covariance)
    root = information.root[:, :count]
    # All rows of `right` are wanted, and of the other factor none.
    _, singular, right = np.linalg.svd(root, full_matrices=len(root) < count)
    singular = np.concatenate([singular, np.zeros(count - len(singular))])
    is_exact = singular <= _FLOOR * singular[0]
    null, exact = right[is_exact | (singular * LIMIT < 1)], right[is_exact]
    null = _sparse(null) if len(null) else null
    # What a record determines is a matter of its noise: a standard error beyond the limit; what is
    # unknown by all of its size even so, model error included, is of no use to anyone.
    parts = (covariance, covariance if by_noise is None else by_noise)
    errors = [np.sqrt(np.maximum(np.diagonal(part), 0.0)) for part in parts]
    imprecise = (errors[0] > 2 * LIMIT) | (errors[1] > LIMIT)
    lost = np.any(null, axis=0) | imprecise
    left = imprecise & ~np.any(null, axis=0)
    if left.any():  # the direction of most variance of an imprecise parameter that is in none
        spread, directions = np.linalg.eigh(covariance)
        most = {int(np.argmax(spread * directions[k] ** 2)) for k in np.flatnonzero(left)}
        null = _sparse(np.concatenate([null, directions.T[sorted(most)]]))
    undetermined = tuple(names[k] for k in np.flatnonzero(lost))
    combinations, alternatives, curved = _analyse_groups(null, exact, information)
    return Verdict(
        kind="not identifiable" if undetermined else "identifiable",
        undetermined=undetermined,
        combinations=tuple(combinations),
        null_directions=tuple(
            {names[k]: float(row[k]) for k in np.flatnonzero(row)} for row in null
        ),
        reasons=(),
        remedies=remedies_for(undetermined) if undetermined else (),
        exact=exact,
        alternatives=tuple(alternatives),
        curved=tuple(curved),
    )


def _sparse(null: Directions) -> Directions:
    """Unit directions spanning the same space, with small shares left out."""
    rows = echelon(null)
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return np.where(np.abs(rows) > _MEMBER, rows, 0.0)


def _analyse_groups(
    null: Directions, exact: Directions, information: Information
) -> tuple[list[Combination], list[Vector], list[str]]:
    """Of each group of parameters that share null directions: what of them is determined.

    Combinations of the kind, product or sum, that holds over a finite change; the values to which
    that change leads; and names of parameters of which neither kind holds.
    """
    combinations, alternatives, curved = [], [], []
    if not len(null):
        return combinations, alternatives, curved
    # A pseudo-inverse shows no variance along exact null directions.
    keep = np.eye(null.shape[1]) - exact.T @ exact
    covariance = keep @ information.covariance @ keep + 1e4 * exact.T @ exact
    information = information._replace(covariance=covariance)
    groups: list[set[int]] = []
    for row in null:
        group = set(np.flatnonzero(row).tolist())
        for other in [other for other in groups if other & group]:
            groups.remove(other)
            group |= other
        groups.append(group)
    sparse = _sparse(exact) if len(exact) else exact
    for block in (np.array(sorted(group)) for group in groups):
        mine = sparse[np.any(sparse[:, block], axis=1)]
        moved = {}
        if len(mine):  # a finite way along null directions, at constant products and sums
            shares = np.arange(1, len(mine) + 1)[:, None] / len(mine)
            change = _MOVE * np.sum(mine * shares, axis=0)
            values, units = information.values[: null.shape[1]], information.units[: null.shape[1]]
            moved = {"product": values * np.exp(change), "sum": values + units * change}
            moved = {kind: x for kind, x in moved.items() if information.same(x)}
        kinds = tuple(moved) if len(mine) else KINDS
        # Combinations of the members that no null direction moves.
        directions = null[:, block][np.any(null[:, block], axis=1)]
        _, singular, right = np.linalg.svd(directions, full_matrices=True)
        rows = echelon(right[int(np.sum(singular > 1e-6)) :])
        effects = information.root[:, block] @ np.linalg.pinv(rows) if len(rows) else rows.T
        for k, row in enumerate(rows) if kinds else ():
            combination = _describe(row, block, effects[:, k], information, kinds)
            combinations += [] if combination is None else [combination]
        alternatives += moved.values()
        curved += [information.names[k] for k in block] if not kinds and len(rows) else []
    return combinations, alternatives, curved


def _describe(
    row: np.ndarray,
    block: np.ndarray,
    effect: np.ndarray,
    information: Information,
    kinds: tuple[str, ...],
) -> Combination | None:
    """None if the record does not determine it, or if nobody would write it."""
    weights, count = np.zeros(len(information.values)), len(information.covariance)
    weights[block] = row
    if "product" in kinds:  # with fixed parameters that act just as the combination does
        for k in range(count, len(weights)):
            column = information.root[:, k]
            power = float(column @ effect) / max(float(effect @ effect), 1e-300)
            rest = np.linalg.norm(column - power * effect)
            if abs(power) > 0.1 and rest < 1e-6 * np.linalg.norm(column):
                weights[k] = power
        weights = -weights if np.sum(effect[::2]) < 0 else weights  # to raise the response
    used = np.array(sorted(np.flatnonzero(weights), key=lambda k: information.order[k]))
    relative = np.zeros((len(weights), len(weights)))
    relative[:count, :count] = information.covariance
    names, values = tuple(information.names[k] for k in used), information.values[used]
    named = Named(names, values, information.units[used], relative[np.ix_(used, used)])
    return combine(weights[used], named, kinds)
