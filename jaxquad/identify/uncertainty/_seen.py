"""What the derivatives at a solution say: errors of the parameters, and limits of those at zero."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad.spectra import FrequencyResponse

from ..frequency_domain._bounds import (
    apart_at_zero,
    changes_up_to,
    inflation_at_zero,
    one_sided,
    one_sided_limits,
)
from ..frequency_domain._problem import Problem
from ..frequency_domain._solve import Solution
from ._accuracy import (
    Block,
    blocks_of,
    calibrated_covariance,
    gauss_newton,
    Matrix,
    Noise,
    noise_effect,
    PriorRows,
    ResponseTerm,
    scaled_inverse,
)
from ._discrepancy import describe_discrepancy, Discrepancy, discrepancy_effect, Mixture
from ._identifiability import LIMIT
from ._verdict import Bound


class Seen(NamedTuple):
    """Derivatives and errors at a solution, by changes relative to some units."""

    records: list[ResponseTerm]
    blocks: list[Block]
    prior: PriorRows
    bread: Matrix
    gradient: Float[np.ndarray, " parameters"]
    noise: Noise
    by_noise: Matrix
    covariance: Matrix
    discrepancy: Discrepancy


def see(
    records: list[ResponseTerm],
    found: tuple[Mixture, Mixture],
    solution: Solution,
    units: Float[np.ndarray, " all"],
) -> Seen:
    """All of it, with the discrepancy `found`; changes are relative to `units`."""
    count = solution.z.size
    blocks, prior = blocks_of(records), prior_rows(solution, units)
    bread, gradient = gauss_newton(blocks, prior, count)
    noise = noise_effect(records, blocks, prior, count)
    by_noise = calibrated_covariance(bread, noise)
    effect = discrepancy_effect(records, count)
    discrepancy, added = describe_discrepancy(found, bread, by_noise, effect)
    covariance = by_noise + added
    return Seen(records, blocks, prior, bread, gradient, noise, by_noise, covariance, discrepancy)


class NearZero(NamedTuple):
    """A parameter that may be zero, how far from it the data allow, and what it does up to there.

    `changes` are those of the misfits by its value, as the way to the limit has them on average,
    where the slopes at the value itself say little about the rest of the way; else None. `slight`
    is whether all of that way moves the responses by little.
    """

    k: int
    bound: Bound
    changes: list[Float[np.ndarray, "frequencies outputs inputs 2"]] | None
    slight: bool


# A tenth of the magnitude and 6 deg of phase are less than a design's margins leave open, so what a
# parameter does to the loop is known well enough, whatever its share of it.
_SLIGHT = 0.1
_FEW = 0.1  # of the limit: below it the slopes at a value say little about the way to the limit


def near_zeros(
    problem: Problem, solution: Solution, seen: Seen, units: Float[np.ndarray, " all"]
) -> list[NearZero]:
    """Parameters that may be zero, with the limits of their one-sided 95 % intervals."""
    near = []
    curvature, names = scaled_inverse(seen.bread), problem.parameters.names
    for k in _possible_zeros(problem, solution, seen):
        others = [j for j in solution.at_zero if j != k]
        parts = seen.covariance, seen.by_noise
        if others:
            inflation = [inflation_at_zero(part, seen.bread, k, others) for part in parts]
        else:
            inflation = [float(part[k, k] / curvature[k, k]) for part in parts]
        (limit, by_noise), beyond = one_sided_limits(problem, solution, k, inflation)
        value = float(np.asarray(solution.values)[k])
        bound = Bound(names[k], value, limit, by_noise, beyond)
        if not np.isfinite(limit):
            near.append(NearZero(k, bound, None, slight=False))
            continue
        changes = changes_up_to(problem, solution, k, limit)
        used = (record.weights > 0 for record in seen.records)
        pairs = zip(changes, used, strict=True)
        largest = max(float(np.max(np.abs(change[mine]), initial=0.0)) for change, mine in pairs)
        few = abs(value) < _FEW * abs(limit)
        slight = largest * abs(limit) < _SLIGHT
        near.append(NearZero(k, bound, changes if few else None, slight))
    return near


def with_changes(
    records: Sequence[ResponseTerm], near: Sequence[NearZero], units: Float[np.ndarray, " all"]
) -> list[ResponseTerm]:
    """The records with slopes that hold up to the limits of parameters near zero."""
    changed = []
    for number, record in enumerate(records):
        slopes = record.slopes.copy()
        for one in near:
            if one.changes is not None:
                slopes[..., one.k] = units[one.k] * one.changes[number]
        changed.append(dataclasses.replace(record, slopes=slopes))
    return changed


def bounds_among(
    near: Sequence[NearZero], seen: Seen, solution: Solution, units: Float[np.ndarray, " all"]
) -> tuple[tuple[Bound, ...], dict[int, float]]:
    """Those that a limit determines, and those at zero that are mixed up with others.

    That is where another one would change by too much if this one had a value up to its limit; by
    how much, as a share of that other one.
    """
    bounds, tangled = [], {}
    slight = [one.k for one in near if one.slight]
    for one in near:
        moved = _along(seen, one.k) * abs(one.bound.limit / units[one.k])
        moved[[one.k, *(solution.at_zero if one.k in solution.at_zero else ())]] = 0.0
        moved[slight if one.slight else []] = 0.0
        if np.all(moved <= LIMIT):
            bounds.append(one.bound)
        elif one.k in solution.at_zero or one.changes is not None:
            tangled[one.k] = moved
    others = [j for j in range(len(seen.bread)) if j not in tangled]
    shares = {k: float(np.max(moved[others], initial=0.0)) for k, moved in tangled.items()}
    return tuple(bounds), shares


_ONE_SIDED = 1.645  # standard errors that reach from the middle of a one-sided 95 % interval


def _possible_zeros(problem: Problem, solution: Solution, seen: Seen) -> list[int]:
    """Parameters that keep their sign, at zero or so near it that the data allow it."""
    count = problem.parameters.count
    near = np.sqrt(np.diagonal(seen.covariance)) * _ONE_SIDED > 1
    near |= np.sqrt(np.diagonal(seen.by_noise)) > LIMIT
    near &= np.array(problem.parameters.logarithmic[:count])
    near[list(solution.at_zero)] = True
    return np.flatnonzero(near & (np.diagonal(seen.bread) > 0)).tolist()


def _along(seen: Seen, k: int) -> Float[np.ndarray, " parameters"]:
    """How far the others go with a change of parameter k, all relative to their units."""
    return np.abs(seen.covariance[:, k] / seen.covariance[k, k])


def with_tangled(
    units: Float[np.ndarray, " all"], near: Sequence[NearZero], tangled: Mapping[int, float]
) -> Float[np.ndarray, " all"]:
    """Units of parameters at zero that count as much as the parameter they are mixed up with."""
    units = units.copy()
    for one in near:
        if one.k in tangled and np.isfinite(one.bound.limit):
            share = tangled[one.k]
            units[one.k] = one.bound.limit / (share if share > LIMIT else 1.0)
    return units


def halved(
    covariance: Matrix, seen: Seen, names: tuple[str, ...], bounds: Sequence[Bound]
) -> Matrix:
    """The covariance with what the bounds of parameters at zero cut off taken away."""
    covariance, steps = _at_zero(covariance, seen, names, bounds)
    for k, step in steps.items():
        covariance = one_sided(covariance, k, step)
    return covariance


def _at_zero(
    covariance: Matrix, seen: Seen, names: tuple[str, ...], bounds: Sequence[Bound]
) -> tuple[Matrix, dict[int, float]]:
    """The covariance without bounds, and where these parameters at zero would go without them."""
    zeros = [names.index(bound.name) for bound in bounds if not bound.value]
    if len(zeros) > 1:
        return apart_at_zero(covariance, seen.bread, seen.gradient, zeros)
    step = -scaled_inverse(seen.bread) @ seen.gradient
    return covariance, {k: float(step[k]) for k in zeros}


def pulled_beyond(seen: Seen, names: tuple[str, ...], bounds: Sequence[Bound]) -> dict[str, float]:
    """How far beyond zero the data want parameters at zero, in random errors."""
    covariance, steps = _at_zero(seen.by_noise, seen, names, bounds)
    errors = {k: float(np.sqrt(max(covariance[k, k], 1e-300))) for k in steps}
    return {names[k]: -step / errors[k] for k, step in steps.items()}


def units_of(solution: Solution) -> Float[np.ndarray, " all"]:
    """What relative changes are relative to: the value, or the change that shows of one at zero.

    Relative to itself, a lag at zero would look as if it had no effect, while in truth it trades
    off with the delay.
    """
    units = np.asarray(solution.slopes).copy()
    units[list(solution.at_zero)] = solution.units_at_zero
    return units


def rescale(solution: Solution, units: Float[np.ndarray, " all"]) -> Float[np.ndarray, " all"]:
    """From derivatives by z to derivatives by changes relative to `units`."""
    slopes = np.asarray(solution.slopes)
    return np.where(slopes == 0, 1.0, units / np.where(slopes == 0, 1.0, slopes))


def records_of(
    problem: Problem,
    frfs: Sequence[FrequencyResponse],
    solution: Solution,
    units: Float[np.ndarray, " all"],
) -> list[ResponseTerm]:
    """Misfits and slopes of each response, by changes relative to `units`."""
    scale, parts = rescale(solution, units), solution.sensitivity
    weights = [np.asarray(each) for each in problem.weights]
    misfits = [np.asarray(each) for each in parts.misfits]
    slopes = [np.asarray(each) * scale for each in parts.slopes]
    terms = zip(frfs, misfits, slopes, weights, problem.mixings, strict=True)
    return [ResponseTerm(*each, problem.parameters.count) for each in terms]


def prior_rows(solution: Solution, units: Float[np.ndarray, " all"]) -> PriorRows:
    """Those of the priors, likewise."""
    derivatives = solution.sensitivity
    slopes = np.asarray(derivatives.prior_slopes) * rescale(solution, units)
    return PriorRows(np.asarray(derivatives.prior_misfits), slopes)
