"""What a fit refuses, before and after it is solved."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import PyTree

from jaxquad.spectra import FrequencyResponse

from ._cost import Cost, MaximumLikelihood
from ._parameters import name_places
from ._problem import Prior, Problem
from ._solve import Solution


def checked_responses(frf: Any) -> list[FrequencyResponse]:
    """One response or several, each measured on its own."""
    frfs = list(frf) if isinstance(frf, Sequence) else [frf]
    if not frfs or not all(isinstance(one, FrequencyResponse) for one in frfs):
        kinds = ", ".join(sorted({type(one).__name__ for one in frfs})) or "nothing"
        raise ValueError(
            f"a fit needs a jq.spectra.FrequencyResponse or a list of them, not {kinds}: make one with "
            "jq.frequency_response(record), and call jq.fit(model, response)"
        )
    for k, one in enumerate(frfs):
        for other in frfs[:k]:
            if np.array_equal(np.asarray(one.response), np.asarray(other.response)):
                raise ValueError(f"response {k} of {len(frfs)} is there twice: it counts once")
    return frfs


def check_options(cost: Any, band: Any, min_coherence: float, max_steps: int) -> None:
    """Values that mean nothing."""
    if isinstance(cost, type) or not isinstance(cost, Cost):
        raise ValueError(
            f"cost={cost!r}: pass an object, jq.identify.CoherenceWeighted() or jq.identify.MaximumLikelihood()"
        )
    for limits in band.values() if isinstance(band, Mapping) else [band]:
        if limits is not None and np.shape(limits) != (2,):
            raise ValueError(f"band={limits!r}: give two frequencies in rad/s, (low, high)")
    if not 0 < min_coherence < 1:
        raise ValueError(f"min_coherence is {min_coherence}: it lies between 0 and 1, usually 0.6")
    if max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}: give at least 1")


def check_knowledge(model: PyTree, priors: Sequence[Prior], cost: Cost) -> None:
    """Priors that the cost cannot weigh, or that speak of what the model does not have."""
    if priors and not isinstance(cost, MaximumLikelihood):
        raise ValueError(
            "a prior has a standard error, but the cost (14) has no noise to weigh it against: "
            "pass cost=jq.identify.MaximumLikelihood()"
        )
    known = [place.name for place in name_places(model)] if priors else []
    for prior in priors:
        if isinstance(prior.quantity, str) and prior.quantity not in known:
            raise ValueError(f"no parameter {prior.quantity!r} for a prior; there are: {known}")


def check_finite(solution: Solution) -> None:
    """A solver that diverged."""
    finite = all(np.all(np.isfinite(np.asarray(part))) for part in solution.sensitivity.misfits)
    if not (finite and np.all(np.isfinite(np.asarray(solution.z)))):
        raise ValueError(
            f"the fit diverged: {solution.message or 'the model has no finite response there'}; "
            "start nearer to the answer, or leave solver= at its damped default"
        )


def check_priors(problem: Problem, solution: Solution) -> None:
    """A prior on something that nothing free moves."""
    slopes = np.asarray(solution.sensitivity.prior_slopes)[:, : problem.parameters.count]
    idle = np.flatnonzero(~np.any(slopes, axis=1))
    if idle.size:
        raise ValueError(
            f"prior {idle[0] + 1} speaks of nothing that is free: free its parameter, or leave "
            f"the prior out; free are {', '.join(problem.parameters.names)}"
        )
