"""What a resonance that the model lacks may move.

A notch or a mode within the band bends the phase far below its frequency, as a delay does: the
delay may be wrong by ten standard errors where the misfit is hardly more than the noise. So one is
tried over the band, as a pair of zeros beside its poles, by the first order: a Gauss-Newton step
with its two coefficients as further parameters, under a normal prior. The better it explains the
misfit, the more probable it is, and intervals hold what it would move.
Source: Hoeting, Madigan, Raftery & Volinsky (1999), Bayesian Model Averaging.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from ..frequency_domain._cost import mix_pair
from ._error_budget import ErrorBudget, FOLLOWS, scaled_inverse
from ._response_term import ResponseTerm


_SOME = 0.2  # the prior's mass at a resonance
_SIZE = 0.3  # of its coefficients, standard deviation: those of a deep notch are twice its damping
_PLACES, _DAMPINGS = 10, (0.1, 0.3)
_WITHIN, _BEYOND = 1.3, 1.3  # times the ends of the band; lower ones look like another gain
_LIKELY = 0.5  # probability from which it is remarked
_EXCESS = 500.0  # largest logarithm of odds
_KNOWN = 1e9  # degrees of freedom of a noise that is known

Moves = Float[np.ndarray, "*members resonances parameters"]
LogEvidence = Float[np.ndarray, "*members resonances"]


def with_resonance(budget: ErrorBudget, *, certain: bool = False) -> ErrorBudget:
    """With what a resonance would move, as probable as it is; `certain` where a misfit is beyond
    the noise."""
    pairs = [(record, pair) for record in budget.records for pair in record.pairs]
    moves, evidence = zip(*(_resonances(budget, *one) for one in pairs), strict=True)
    moves, evidence = np.concatenate(moves, axis=-2), np.concatenate(evidence, axis=-1)
    highest = np.max(evidence, axis=-1, keepdims=True)
    shares = np.exp(evidence - highest)
    odds = np.log(np.mean(shares, axis=-1)) + highest[..., 0] + np.log(_SOME / (1 - _SOME))
    probability = 1.0 if certain else 1 / (1 + np.exp(-np.clip(odds, -_EXCESS, _EXCESS)))
    shares *= (probability / np.sum(shares, axis=-1))[..., None]
    moved = np.swapaxes(moves, -1, -2) @ (shares[..., None] * moves)
    return dataclasses.replace(budget, moved=moved, resonance=probability)


def likely_resonance(budget: ErrorBudget) -> str | None:
    """In words, where it is more likely than not and widens an interval."""
    if not budget.resonance > _LIKELY:
        return None
    variances, moved = np.diagonal(budget.covariance), np.diagonal(np.asarray(budget.moved))
    times = float(np.sqrt(np.max(variances / np.maximum(variances - moved, 1e-300))))
    if times < FOLLOWS:
        return None
    return (
        f"the plant has a notch or a mode that the model lacks, with a probability of "
        f"{100 * budget.resonance:.0f} %: intervals hold what it may move, and are up to "
        f"{times:.1f} times as wide; add it («Fit.explain()» tries one)"
    )


def _resonances(
    budget: ErrorBudget, record: ResponseTerm, pair: tuple[int, int]
) -> tuple[Moves, LogEvidence]:
    """How each would move the parameters, and the logarithm of its evidence over that of none."""
    members, count = record.misfit.shape[:-4], budget.count
    used = record.used[..., *pair]
    if members and np.all(used == used[:1]):
        used = used[0]
    columns = _logarithms(np.asarray(record.frf.omega), used)
    columns = record.weights[..., *pair, :, None] * columns
    if record.mixing is None:
        rows = np.zeros((*record.misfit.shape, columns.shape[-1]))
        rows[..., *pair, :, :] = columns
    else:
        rows = mix_pair(record.mixing, columns, pair)
    flat = lambda rows: np.asarray(rows).reshape(*members, -1, rows.shape[-1])
    rows, inverse = flat(rows), scaled_inverse(budget.bread)
    across = np.swapaxes(rows, -1, -2)
    split = lambda x: x.reshape(*members, -1, 2, x.shape[-1])
    along = across @ flat(record.rows[..., :count])
    moves, gradient = along @ inverse, budget.gradient[..., None]
    pull = split(across @ flat(record.residual[..., None]) - moves @ gradient)
    both = split(across)
    curvature = both @ np.swapaxes(both, -1, -2)
    curvature = curvature - split(moves) @ np.swapaxes(split(along), -1, -2)
    # The noise as the parameters see it, and as well as it is known.
    scale = np.maximum(np.asarray(budget.fitted_noise) / count, 1.0)[..., None, None, None]
    freedom = np.minimum(np.min(budget.degrees_of_freedom, axis=-1), _KNOWN)[..., None]
    information = curvature / scale + np.eye(2) / _SIZE**2
    size = np.linalg.solve(information, pull / scale)
    lowered = np.sum(pull / scale * size, axis=(-2, -1))  # chi-squared of two degrees of freedom
    clear = 0.5 * freedom * np.log1p(lowered / freedom)
    volume = np.linalg.slogdet(_SIZE**2 * information)[1]
    return np.sum(split(moves) * size, axis=-2), clear - 0.5 * volume


def _logarithms(
    omega: Float[np.ndarray, " frequencies"], used: Bool[np.ndarray, "*members frequencies"]
) -> Float[np.ndarray, "*members frequencies 2 coefficients"]:
    """Of magnitude and phase, by the two coefficients of each: of s and of 1 in its numerator."""
    low = _WITHIN * np.min(np.where(used, omega, np.inf), axis=-1)
    high = _BEYOND * np.max(np.where(used, omega, 0.0), axis=-1)
    place = np.geomspace(low, high, _PLACES, axis=-1)[..., None, :, None]
    s = 1j * omega[:, None, None] / place
    pole = 1 / (s**2 + 2 * np.array(_DAMPINGS) * s + 1)
    logs = np.stack([s * pole, pole - 1], axis=-1).reshape(*used.shape, -1)
    return np.stack([np.real(logs), np.imag(logs)], axis=-2)
