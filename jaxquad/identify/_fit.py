from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxquad._core import require_x64
from jaxquad.models import LaggedIntegrator, with_arrays
from jaxquad.spectra import FrequencyResponse

from ._assess import assess, unfitted
from ._cost import Band, CoherenceWeighted, Cost, Mask, MaximumLikelihood, Ratio, usable, Weights
from ._parameters import Free, name_places, Parameters, select_parameters, Tie
from ._problem import Condition, make_problem, Prior, Problem
from ._result import Fit
from ._solve import Solution, solve
from ._starts import Minimum, solve_from_many, spread_starts
from ._verdict import Verdict, without_numbers


def guess_lagged_integrator(frf: FrequencyResponse, integrators: int) -> LaggedIntegrator:
    """Starting values for K e^(-delay s) / (s^integrators (lag s + 1)) from a response's shape.

    K from the magnitude and the phase in the lower half of the coherent band,
    lag and delay from the slope of the phase, half each. Good enough for a fit to start from.
    """
    omega, response = np.asarray(frf.omega), np.asarray(frf.response)[:, 0, 0]
    coherence = np.asarray(frf.coherence)[:, 0, 0]
    good = coherence >= min(0.6, 0.9 * float(coherence.max()))
    flat = (response * (1j * omega) ** integrators)[good]
    slow = flat[: max(flat.size // 2, 1)]
    sign = 1.0 if np.real(np.sum(slow / np.abs(slow))) >= 0 else -1.0
    turns = np.angle(flat[1:] / flat[:-1])
    steps = np.diff(omega[good])
    slope = -float(np.sum(turns * steps) / np.sum(steps**2)) if steps.size else 0.0
    late = max(slope, 0.05 / float(omega[good][-1]))
    return LaggedIntegrator(sign * float(np.median(np.abs(slow))), late / 2, late / 2, integrators)


def fit(
    model: PyTree,
    frf: FrequencyResponse | Sequence[FrequencyResponse],
    *,
    free: Free = None,
    tied: Mapping[str, Tie] | None = None,
    cost: Cost = CoherenceWeighted(),
    conditions: Sequence[Condition | None] | None = None,
    priors: Sequence[Prior] = (),
    band: Band = None,
    min_coherence: float = 0.6,
    starts: int = 1,
    solver: Any = None,
    max_steps: int = 256,
) -> Fit:
    """Identify the `free` parameters of a model from one or several frequency responses.

    `model` is any `eqx.Module` with `frequency_response(omega)`; its values are the start. `free`
    names parameters (`"J_x"`, `"numerator[0]"`, `jq.identify.Real("zero")`), selects them
    (`lambda m: (m.gain, m.delay)`), or is `None` for all. A bare name keeps the sign of its start.
    `tied` are numbers that follow from others: `{"F[1][0]": lambda m: -m.F[0, 1]}`.
    With several responses, `conditions` says how the model differs in each record, for instance
    `(None, lambda m: m.with_added_inertia(0.03))`. `priors` are known values with standard errors.
    Only frequencies within `band` (rad/s) with a coherence of at least `min_coherence` count; a
    mapping `{("q", "elevator"): (1.0, 30.0)}` gives single pairs a band of their own, or `None` to
    leave them out. With several `starts`, a Latin hypercube around the given one is solved side by
    side, and `Fit.minima` lists all distinct stops with their costs.
    `solver` is any optimistix least-squares solver, Levenberg-Marquardt by default.

    What the record does not determine is said by `Fit.verdict`; where too few frequencies are
    usable to fit anything, the result holds the starting values. Raises `ValueError` for names
    that the model does not have and for a solver that diverged, `PrecisionError` in 32 bits.
    Source: Eq. (14), corrected.
    """
    require_x64("a fit")
    frfs = checked_responses(frf)
    check_options(cost, band, min_coherence, max_steps)
    model = with_arrays(model)
    parameters = select_parameters(model, free, tied)
    used = [usable(one, band, min_coherence) for one in frfs]
    check_knowledge(model, priors, cost)
    too_few = _too_few_points(frfs, used, parameters, min_coherence, band)
    if too_few is not None:
        remarks = dict.fromkeys(remark for one in frfs for remark in one.remarks)
        return unfitted(model, parameters, too_few, tuple(remarks))
    problem = make_problem(model, parameters, frfs, conditions, priors)
    problem, solution, minima = _solved(problem, frfs, used, cost, (starts, solver, max_steps))
    check_finite(solution)
    check_priors(problem, solution)
    return assess(problem, frfs, solution, minima)


def _too_few_points(
    frfs: Sequence[FrequencyResponse],
    used: Sequence[Mask],
    parameters: Parameters,
    least: float,
    band: Band,
) -> Verdict | None:
    points = sum(int(mask.sum()) for mask in used)
    needed = parameters.count + 2
    if points >= needed:
        return None
    best = max(float(np.max(np.asarray(frf.coherence))) for frf in frfs)
    total = sum(mask.size for mask in used)
    reason = (
        f"coherence reaches {least:g} at {points} of {total} frequencies"
        f"{f' (band {band} rad/s)' if band else ''}, its maximum is {best:.2f}, and "
        f"{parameters.count} parameters need at least {needed}"
    )
    remedy = "excite the axis (jq.sweep), record longer, or use a longer window"
    return without_numbers("too few points", parameters.names, reason, remedy)


def _solved(
    problem: Problem,
    frfs: Sequence[FrequencyResponse],
    used: Sequence[Mask],
    cost: Cost,
    how: tuple[int, Any, int],
) -> tuple[Problem, Solution, tuple[Minimum, ...]]:
    """Solve, and once more where the weights depend on the model that came out."""
    starts, solver, max_steps = how
    weights = _weights(cost, frfs, used, [np.ones(mask.shape) for mask in used])
    problem = problem.weighted([jnp.asarray(each) for each in weights])
    z, minima = jnp.asarray(np.asarray(problem.parameters.start)[: problem.parameters.count]), ()
    if starts == 1:
        solution = solve(problem, z, solver, max_steps)
    else:
        fastest = max(float(frf.omega[-1]) for frf in frfs)
        spread = spread_starts(problem.parameters, starts, fastest=fastest)
        solution, minima = solve_from_many(problem, spread, solver, max_steps)
    again = _weights(cost, frfs, used, ratios(solution))
    if all(np.allclose(old, new, rtol=1e-4) for old, new in zip(weights, again, strict=True)):
        return problem, solution, minima
    problem = problem.weighted([jnp.asarray(each) for each in again])
    return problem, solve(problem, solution.z, solver, max_steps), minima


def _weights(cost: Cost, frfs, used, ratios) -> list[Weights]:
    return [cost.weights(*each) for each in zip(frfs, used, ratios, strict=True)]


def ratios(solution: Solution) -> list[Ratio]:
    """|model / measurement| at a solution."""
    return [np.exp(np.asarray(part)[..., 0]) for part in solution.sensitivity.misfits]


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
