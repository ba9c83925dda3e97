"""Standard errors and intervals of many fits of one response at once, as far as they are plain."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..frequency_domain._cost import Mixing, Points, unmixed
from ..frequency_domain._parameters import Parameters
from ..frequency_domain._solve import Stops
from ._assess import NO_MODEL, UNFINISHED
from ._discrepancy import find_discrepancy
from ._error_budget import ErrorBudget, scaled_inverse
from ._misfit import may_have_local_misfits
from ._profiles import WEAK
from ._resonance import with_resonance
from ._response_term import diagonal, PriorRows, Responses, ResponseTerm
from ._verdict import LIMIT, REACH, USUAL


_CLEAR = 1e-10  # of the largest eigenvalue: no null direction of a plain fit is near
_AT_ONCE = 64  # fits whose rows stay within a processor's cache
_MARGIN = 1.001  # to a limit, for what is rounded in another way

Weights = Float[np.ndarray, "members frequencies outputs inputs 2"]


class Assessment(NamedTuple):
    """Which parameters each fit determines, their standard errors and their 95 % intervals."""

    determined: Bool[np.ndarray, "members parameters"]
    standard_errors: Float[np.ndarray, "members parameters"]
    intervals: Float[np.ndarray, "members parameters 2"]


def assess_many(
    parameters: Parameters,
    points: Sequence[Points],
    weights: Weights,
    mixings: Sequence[Mixing | None],
    stops: Stops,
) -> Assessment:
    """Those numbers of `assess` that nothing but arrays is needed for: of plain fits, which stopped
    at a minimum and determine all of their parameters, far from zero and not moved by a local
    misfit. No parameter counts as determined of fits that are not plain.

    Fits are those that converged, of responses at the same frequencies, without priors.
    """
    count = parameters.count
    finite = [np.all(np.isfinite(part.reshape(len(part), -1)), axis=1) for part in stops[:-1]]
    some = np.flatnonzero(np.all(finite, axis=0))
    errors = np.full((len(points), count), np.inf)
    plain = np.zeros(errors.shape, bool)
    intervals = np.full((*errors.shape, 2), np.nan)
    for few in np.split(some, range(_AT_ONCE, some.size, _AT_ONCE)) if some.size else ():
        here = Stops(*(part[few] for part in stops))
        mine, mixed = [points[k] for k in few.tolist()], [mixings[k] for k in few.tolist()]
        with np.errstate(all="ignore"):  # of fits that are not plain
            parts = _numbers(parameters, mine, mixed, weights[few], here)
        plain[few], errors[few], intervals[few] = parts
    return Assessment(plain, errors, intervals)


def _numbers(
    parameters: Parameters,
    points: Sequence[Points],
    mixings: Sequence[Mixing | None],
    weights: Weights,
    stops: Stops,
) -> Assessment:
    from scipy.special import stdtrit

    count, shared = parameters.count, np.stack([one.shared for one in points])
    record = ResponseTerm(
        Responses([one.frf for one in points]), stops.misfits, stops.misfit_slopes,
        weights, _together(mixings, weights.shape[1:-1]), count,
    )  # fmt: skip
    prior = PriorRows(np.zeros((len(points), 0)), np.zeros((len(points), *stops.values[:0].shape)))
    mixtures = find_discrepancy([record], [shared], prior, range(count))
    budget = with_resonance(ErrorBudget([record], prior, count, mixtures))
    step = np.squeeze(scaled_inverse(budget.bread) @ budget.gradient[..., None], axis=-1)
    decrement = 0.5 * np.sum(budget.gradient * step, axis=-1)
    variances, by_noise = diagonal(budget.covariance), diagonal(budget.by_noise)
    # Parameters that keep their sign may be near zero, and others not determined.
    weak = np.where(parameters.logarithmic[:count], 1 / WEAK, LIMIT) / _MARGIN
    scale = np.sqrt(diagonal(budget.bread))
    curvature = np.linalg.eigvalsh(budget.bread / (scale[..., :, None] * scale[..., None, :]))
    root = budget.root[..., :count]
    information = np.linalg.eigvalsh(np.swapaxes(root, -1, -2) @ root)
    far = [0.0 if not x.frf.remarks else np.sum(x.frf.of_controller & x.used) for x in points]
    plain = (
        np.all((variances < weak**2) & (by_noise > 0), axis=-1)
        & (curvature[..., 0] > _CLEAR * curvature[..., -1])
        & (information[..., 0] > np.maximum(_MARGIN / LIMIT**2, _CLEAR * information[..., -1]))
        & (decrement < UNFINISHED * np.maximum(budget.cost, 1e-9) / _MARGIN)
        & (mixtures[0].amplitude < NO_MODEL / _MARGIN)
        & (2 * np.array(far) <= np.sum(record.used, axis=(1, 2, 3)))
        & ~may_have_local_misfits(budget, shared)
    )
    units, values = stops.slopes[:, :count], stops.values[:, :count]
    errors = np.sqrt(variances * (units * units))
    freedom = budget.degrees_of_freedom
    reach = errors * np.where(np.isinf(freedom), REACH, stdtrit(freedom, 0.5 + USUAL / 2))
    ends = np.stack([values - reach, values + reach], axis=-1)
    # Logarithmic ones keep their sign.
    kept = np.array(parameters.logarithmic[:count])[:, None]
    positive = np.where(kept & (values > 0)[..., None], np.maximum(ends, 0.0), ends)
    ends = np.where(kept & (values < 0)[..., None], np.minimum(ends, 0.0), positive)
    return Assessment(np.repeat(plain[:, None], count, axis=1), errors, ends)


def _together(mixings: Sequence[Mixing | None], shape: tuple[int, ...]) -> Mixing | None:
    """With members on a first axis."""
    if not any(mixings):
        return None
    complete = [mixing or unmixed(shape) for mixing in mixings]
    factor, correlation, *across = (
        None if parts[0] is None else np.stack(parts) for parts in zip(*complete, strict=True)
    )
    assert factor is not None and correlation is not None
    return Mixing(factor, correlation, *across)
