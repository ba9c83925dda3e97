"""Whether a pole and a zero of a fit do no more than follow the noise."""

import dataclasses

import numpy as np
from numpy.polynomial.polynomial import polyfromroots, polyroots

from jaxquad.spectra import FrequencyResponse

from ._band import Band
from ._cost import MaximumLikelihood
from ._descent import descend
from ._identifiable import Identifiability
from ._rational import Rational, Samples
from ._remarks import FEWER
from ._result import Fit
from ._transfer_function_guess import search, Structure, usable_samples


# A pair takes two numbers, but may settle on any frequency: noise alone, at 30 or 100 points,
# lowers the squared misfit by 9 in 1 of 100 cases, and by 13.5 at most in 200.
_CHANCE = 15.0
_BEYOND = 20.0  # times the highest frequency, from which a pole is a constant


def idle_pair(
    pair: FrequencyResponse,
    samples: Samples,
    structure: Structure,
    best: Rational,
    band: Band,
    min_coherence: float,
) -> str | None:
    """What to say where one zero and one pole fewer explain the response within its noise."""
    if structure.zeros == 0 or structure.poles == structure.integrators:
        return None
    smaller = structure._replace(zeros=structure.zeros - 1, poles=structure.poles - 1)
    likelihood = MaximumLikelihood()
    samples = usable_samples(pair, structure, likelihood, band, min_coherence)
    full = descend(samples, best, steps=200, free_delay=structure.delay is None)
    less = search(samples, smaller, (_without_nearest(full),))
    freedom = max(2 * samples.s.size - structure.unknowns, 1)
    # A misfit beyond the noise counts as noise here, as it does in the standard errors.
    noise = max(full.cost / freedom, 1.0) * _shared(pair)
    gained = (less.cost - full.cost) / noise
    if gained > _CHANCE:
        return None
    return (
        f"a zero and a pole cancel: zeros={smaller.zeros}, poles={smaller.poles} explain the "
        f"response as well (the pair lowers the misfit by {max(gained, 0.0):.2g} squared random "
        f"errors; noise alone gives up to {_CHANCE:g}): {FEWER}"
    )


def far_pole(fit: Fit, highest: float) -> str | None:
    """What to say of a fit that is not identifiable because a pole left the band (rad/s)."""
    poles = fit.model.poles
    if fit.identifiable or not poles.size or np.max(np.abs(poles)) < _BEYOND * highest:
        return None
    far = poles[np.argmax(np.abs(poles))]
    zeros = len(fit.model.zeros)
    return (
        f"a pole at {far.real:.2g} rad/s is so far above the highest frequency, {highest:.3g} "
        f"rad/s, that it cannot be told from a gain: zeros={min(zeros, poles.size - 1)}, "
        f"poles={poles.size - 1} are enough: {FEWER}"
    )


def refused(fit: Fit, reason: str) -> Fit:
    """The same fit with no number for any parameter."""
    verdict, lost = fit.identifiability, np.full(len(fit.names), np.inf)
    names = fit.names
    return dataclasses.replace(
        fit,
        values=np.full(len(names), np.nan),
        standard_errors=lost,
        covariance=np.full(fit.covariance.shape, np.nan),
        cramer_rao=lost,
        identifiability=Identifiability(
            names, verdict.null_directions, (), verdict.exact, verdict.alternatives, names
        ),
        remarks=(reason, *fit.remarks),
    )


def _without_nearest(model: Rational) -> Rational:
    """The model without the zero and the real pole nearest to each other."""
    zeros, poles = polyroots(model.above), polyroots(model.below)
    apart = np.abs(zeros[:, None].real - poles[None, :].real)
    z, p = np.unravel_index(np.argmin(apart), apart.shape)
    above = model.above[-1] * np.real(polyfromroots(np.delete(zeros, z)))
    return Rational(above, np.real(polyfromroots(np.delete(poles, p))), model.delay)


def _shared(pair: FrequencyResponse) -> float:
    """How many neighbouring frequencies share their noise."""
    covariance = pair.relative_covariance()
    size = np.sqrt(np.maximum(np.real(np.diagonal(covariance)), 1e-300))
    correlation = np.abs(covariance / np.outer(size, size)) ** 2
    return float(np.nanmean(np.nansum(correlation, axis=1)))
