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
    values: Float[np.ndarray, " parameters"]
    units: Float[np.ndarray, " parameters"]  # the value itself where its logarithm is fitted
    relative: Matrix


def combine(
    weights: Float[np.ndarray, " parameters"],
    named: Named,
    kinds: tuple[str, ...] = KINDS,
) -> Combination | None:
    """The product or sum, as a person would write it, that is as sharp as `weights`.

    Exponents are whole numbers up to 2, coefficients 1 or -1, and cost no more than a quarter in
    standard error. None where nothing of the kind is as sharp, or where its error is beyond 30 %.
    """
    logarithmic = bool(np.all(named.units == named.values))
    powers = _simple(weights, 2) if logarithmic and "product" in kinds else None
    sums = _simple(weights / named.units, 1) if "sum" in kinds else None
    if powers is not None and not _as_sharp(powers, weights, named):
        powers = None
    if sums is not None and not _as_sharp(sums * named.units, weights, named):
        sums = None
    if sums is not None and (powers is None or _simpler(sums, powers)):
        found = _sum(sums, named)
    elif powers is not None:
        found = _product(powers, named)
    else:
        return None
    return found if found.standard_error <= VAGUE * abs(found.value) else None


def _simpler(sums: np.ndarray, powers: np.ndarray) -> bool:
    """Whether to take the sum of the two; times that only lower the response add up."""
    return bool(np.abs(sums).max() < np.abs(powers).max() or np.all(powers <= 0))


def _as_sharp(simple: np.ndarray, weights: np.ndarray, named: Named) -> bool:
    limit = 1.25 * _spread(weights, named)
    return _spread(simple, named) <= limit * _length(simple, weights)


def _spread(weights: np.ndarray, named: Named) -> float:
    return float(np.sqrt(max(weights @ named.relative @ weights, 0.0)))


def _length(weights: np.ndarray, like: np.ndarray) -> float:
    """Size of one combination beside another, along the latter's direction."""
    return abs(float(weights @ like)) / float(like @ like)


def _simple(
    weights: Float[np.ndarray, " parameters"], largest: int
) -> Float[np.ndarray, " parameters"] | None:
    """The nearest vector of whole numbers up to `largest`, or None if there is none near."""
    unit = weights / np.max(np.abs(weights))
    parts = [Fraction(float(w)).limit_denominator(largest) for w in unit]
    exact = np.array([float(part) for part in parts])
    whole = exact * np.lcm.reduce([part.denominator for part in parts])
    near = np.max(np.abs(exact - unit)) < 0.25
    return whole * np.sign(weights @ whole) if near and np.max(np.abs(whole)) <= largest else None


def _product(powers: Float[np.ndarray, " parameters"], named: Named) -> Combination:
    value = float(np.prod(np.abs(named.values) ** powers))
    above = [_power(n, p) for n, p in zip(named.names, powers, strict=True) if p > 0]
    below = [_power(n, -p) for n, p in zip(named.names, powers, strict=True) if p < 0]
    name = " ".join(above) or "1"
    if below:
        name += " / " + (below[0] if len(below) == 1 else f"({' '.join(below)})")
    return Combination(name, value, value * _spread(powers, named))


def _power(name: str, power: float) -> str:
    return name if power == 1 else f"{name}^{power:g}"


def _sum(weights: Float[np.ndarray, " parameters"], named: Named) -> Combination:
    weights = weights * np.sign(weights[np.argmax(np.abs(weights * named.units))])
    value = float(np.sum(weights * named.values))
    name, terms = "", [(w, n) for w, n in zip(weights, named.names, strict=True) if w]
    for w, n in terms:
        sign = ("- " if w < 0 else "") if not name else (" - " if w < 0 else " + ")
        name += sign + (n if abs(w) == 1 else f"{abs(w):g} {n}")
    error = _spread(weights * named.units, named)
    return Combination(name, value, error, sum_of=tuple(n for _, n in terms))


LIMIT = 0.5  # standard error, relative, above which a parameter counts as undetermined
VAGUE = 0.3  # likewise of a combination
_MEMBER = 0.05  # share of a null direction from which a parameter takes part in it
_MOVE = 0.4  # finite relative change along a null direction, to test products against sums
_FLOOR = 1e-8  # of the largest singular value: below it lies rounding


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
    covariance: Float[np.ndarray, "parameters parameters"]
    names: tuple[str, ...]
    values: Float[np.ndarray, " all"]
    units: Float[np.ndarray, " all"]
    order: tuple[int, ...]
    same: Callable[[Float[np.ndarray, " parameters"]], bool]
    by_noise: Float[np.ndarray, "parameters parameters"] | None = None


class _Group(NamedTuple):
    """Parameters that share null directions, and the combinations of them that are determined."""

    members: np.ndarray
    combinations: list[Combination]
    alternatives: list[np.ndarray]
    curved: bool


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
        whole = information.values[:count].copy()
        whole[free] = values
        return whole

    def widened(rows: np.ndarray) -> np.ndarray:
        """Directions that do not move the bounded ones."""
        whole = np.zeros((len(rows), count))
        whole[:, free] = rows
        return whole

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
    return dataclasses.replace(
        verdict,
        exact=widened(verdict.exact),
        alternatives=tuple(completed(values) for values in verdict.alternatives),
        bounds=bounds,
    )


def _assess(information: Information) -> Verdict:
    count = len(information.covariance)
    root = information.root[:, :count]
    # All rows of `right` are wanted, and of the other factor none.
    _, singular, right = np.linalg.svd(root, full_matrices=len(root) < count)
    singular = np.concatenate([singular, np.zeros(count - len(singular))])
    exact = singular <= _FLOOR * singular[0]
    null = right[exact | (singular * LIMIT < 1)]
    null = _sparse(null) if len(null) else null
    imprecise = _imprecise(information)
    lost = np.any(null, axis=0) | imprecise
    null = _with_causes(null, information.covariance, imprecise)
    groups = _analyse_groups(null, right[exact], information)
    names = information.names
    undetermined = tuple(names[k] for k in np.flatnonzero(lost))
    return Verdict(
        kind="not identifiable" if undetermined else "identifiable",
        undetermined=undetermined,
        combinations=tuple(each for group in groups for each in group.combinations),
        null_directions=tuple(
            {names[k]: float(row[k]) for k in np.flatnonzero(row)} for row in null
        ),
        reasons=(),
        remedies=remedies_for(undetermined) if undetermined else (),
        exact=right[exact],
        alternatives=tuple(values for group in groups for values in group.alternatives),
        curved=tuple(names[k] for group in groups if group.curved for k in group.members),
    )


def _imprecise(information: Information) -> np.ndarray:
    """Parameters with a standard error beyond the limit, or beyond twice that with model error.

    What a record determines is a matter of its noise; what is unknown by all of its size even so
    is of no use to anyone.
    """
    covariance, by_noise = information.covariance, information.by_noise
    parts = (covariance, covariance) if by_noise is None else (covariance, by_noise)
    errors = [np.sqrt(np.maximum(np.diagonal(part), 0.0)) for part in parts]
    return (errors[0] > 2 * LIMIT) | (errors[1] > LIMIT)


def _with_causes(
    null: Float[np.ndarray, "null parameters"], covariance: np.ndarray, imprecise: np.ndarray
) -> Float[np.ndarray, "more parameters"]:
    """`null`, and the direction of most variance of each imprecise parameter in none of them."""
    left = imprecise & ~np.any(null, axis=0)
    if not left.any():
        return null
    spread, directions = np.linalg.eigh(covariance)
    most = {int(np.argmax(spread * directions[k] ** 2)) for k in np.flatnonzero(left)}
    return _sparse(np.concatenate([null, directions.T[sorted(most)]]))


def _sparse(null: Float[np.ndarray, "null parameters"]) -> Float[np.ndarray, "null parameters"]:
    """Unit directions spanning the same space, with small shares left out."""
    rows = echelon(null)
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return np.where(np.abs(rows) > _MEMBER, rows, 0.0)


def _group_members(null: Float[np.ndarray, "null parameters"]) -> list[np.ndarray]:
    """Groups of parameters that share null directions."""
    groups: list[set[int]] = []
    for row in null:
        group = set(np.flatnonzero(row).tolist())
        for other in [other for other in groups if other & group]:
            groups.remove(other)
            group |= other
        groups.append(group)
    return [np.array(sorted(group)) for group in groups]


def _with_null_variance(covariance: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Covariance with a large variance along exact null directions; a pseudo-inverse has none."""
    keep = np.eye(len(covariance)) - exact.T @ exact
    return keep @ covariance @ keep + 1e4 * exact.T @ exact


def _analyse_groups(
    null: Float[np.ndarray, "null parameters"],
    exact: Float[np.ndarray, "exact parameters"],
    information: Information,
) -> list[_Group]:
    """One for all parameters that share null directions."""
    if not len(null):
        return []
    sure = _sparse(exact) if len(exact) else exact
    covariance = _with_null_variance(information.covariance, exact)
    information = information._replace(covariance=covariance)
    return [_analyse_group(null, sure, block, information) for block in _group_members(null)]


def _analyse_group(
    null: Float[np.ndarray, "null parameters"],
    sure: Float[np.ndarray, "exact parameters"],
    block: np.ndarray,
    information: Information,
) -> _Group:
    """Determined combinations of one group, of the kind that holds over a finite change."""
    sure = sure[np.any(sure[:, block], axis=1)]
    kept: list[tuple[str, np.ndarray]] = []
    for kind in KINDS if len(sure) else ():
        values = _moved_along(sure, kind, information)
        kept += [(kind, values)] if information.same(values) else []
    kinds = tuple(kind for kind, _ in kept) if len(sure) else KINDS
    rows = _complement(null[:, block])
    effects = information.root[:, block] @ np.linalg.pinv(rows) if len(rows) else rows.T
    found = [
        _describe(row, block, effects[:, k], information, kinds)
        for k, row in enumerate(rows)
        if kinds
    ]
    found = [one for one in found if one is not None]
    return _Group(block, found, [values for _, values in kept], not kinds and len(rows) > 0)


def _moved_along(
    sure: Float[np.ndarray, "exact parameters"], kind: str, information: Information
) -> Float[np.ndarray, " parameters"]:
    """Values a finite way along the null directions, at constant products or at constant sums."""
    count = len(information.covariance)
    direction = _MOVE * np.sum(sure * np.arange(1, len(sure) + 1)[:, None] / len(sure), axis=0)
    values, units = information.values[:count], information.units[:count]
    return values * np.exp(direction) if kind == "product" else values + units * direction


def _complement(null: Float[np.ndarray, "null members"]) -> Float[np.ndarray, "rows members"]:
    """Combinations of the members that no null direction moves."""
    _, singular, right = np.linalg.svd(null[np.any(null, axis=1)], full_matrices=True)
    return echelon(right[int(np.sum(singular > 1e-6)) :])


def _describe(
    row: np.ndarray,
    block: np.ndarray,
    effect: np.ndarray,
    information: Information,
    kinds: tuple[str, ...],
) -> Combination | None:
    """None if the record does not determine it, or if nobody would write it."""
    weights = np.zeros(len(information.values))
    weights[block] = row
    weights = _with_fixed(weights, effect, information) if "product" in kinds else weights
    used = np.array(sorted(np.flatnonzero(weights), key=lambda k: information.order[k]))
    count = len(information.covariance)
    relative = np.zeros((len(weights), len(weights)))
    relative[:count, :count] = information.covariance
    names = tuple(information.names[k] for k in used)
    named = Named(
        names, information.values[used], information.units[used], relative[np.ix_(used, used)]
    )
    return combine(weights[used], named, kinds)


def _with_fixed(
    weights: Float[np.ndarray, " all"], effect: np.ndarray, information: Information
) -> Float[np.ndarray, " all"]:
    """Adds fixed parameters that act just as the combination does; signed to raise the response."""
    weights = weights.copy()
    for k in range(len(information.covariance), len(weights)):
        column = information.root[:, k]
        power = float(column @ effect) / max(float(effect @ effect), 1e-300)
        rest = np.linalg.norm(column - power * effect)
        if abs(power) > 0.1 and rest < 1e-6 * np.linalg.norm(column):
            weights[k] = power
    return -weights if np.sum(effect[::2]) < 0 else weights
