"""Fits of models to frequency responses, by a weighted cost."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import PyTree

from jaxquad._core import concrete_values, is_traced, Message, one_blas_thread, require_x64
from jaxquad.models import LaggedIntegrator, with_arrays
from jaxquad.spectra import FrequencyResponse

from ..uncertainty._assess import assess, DOUBT, unfitted
from ..uncertainty._error_budget import weighting_at
from ..uncertainty._verdict import without_numbers
from ..uncertainty._zero_bounds import solve_within_bounds
from ._cost import (
    Band,
    Cost,
    describe_usable,
    least_coherence,
    MaximumLikelihood,
    mixings_of,
    Points,
    points_of,
    precise_points,
    usable,
    Weights,
    widen_band,
)
from ._derivatives import Descent, Inputs, with_derivatives
from ._parameters import Condition, Free, Numbers, select_parameters, Tie
from ._problem import (
    make_problem,
    Prior,
    Problem,
    require_model,
    require_model_response,
    require_priors,
)
from ._refits import Options, Origin
from ._result import Fit
from ._solve import Solution
from ._starts import solve_from_many, spread_starts


_SMALL = 256  # frequencies, up to which a second thread of BLAS waits longer than it works
_PRESENT = 0.2  # random error of a response that is there
_SETTLED = 0.1  # relative change of weights that moves no estimate by more than a fraction of it


def guess_lagged_integrator(frf: FrequencyResponse, integrators: int) -> LaggedIntegrator:
    """Starting values for K e^(-delay s) / (s^integrators (lag s + 1)) from a response's shape.

    K comes from the magnitude and the sign of the lower half of the coherent band, lag and delay
    half each from the slope of the phase. Good enough for `jq.fit` to start from.

    **Arguments:**

    - `frf`: a measured response; its first output and input count.
    - `integrators`: 1 from a moment to a rate, 2 to an angle.

    **Returns:**

    A `jq.LaggedIntegrator`.
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
    cost: Cost = MaximumLikelihood(),
    conditions: Sequence[Condition | None] | None = None,
    priors: Sequence[Prior] = (),
    band: Band = None,
    min_coherence: float | None = None,
    starts: int = 1,
    solver: eqx.Module | None = None,
    max_steps: int = 256,
) -> Fit:
    """Identify the `free` parameters of a model from one or several frequency responses.

    **Arguments:**

    - `model`: any `eqx.Module` with `frequency_response(omega)`; its values are the start.
    - `frf`: a `jq.spectra.FrequencyResponse`, or a list of them that share the parameters.
    - `free`: the parameters to fit, by name (`"J_x"`, `"numerator[0]"`,
        `jq.identify.Real("zero")`) or selected (`lambda m: (m.gain, m.delay)`); `None` for all
        but a damping of 0. A bare name keeps the sign of its start.
    - `tied`: parameters that follow from others: `{"F[1][0]": lambda m: -m.F[0, 1]}`.
    - `cost`: `jq.identify.MaximumLikelihood()`, or `jq.identify.CoherenceWeighted()`: Eq. (14),
        the paper's and CIFER's.
    - `conditions`: how the model differs in each response: `None` where it does not, a
        `jq.identify.Changed`, or a function from the model to the one that this record saw.
    - `priors`: known values with their standard errors, `jq.identify.Prior`.
    - `band`: (low, high) in rad/s. A mapping `{("q", "elevator"): (1.0, 30.0)}` gives single pairs
        of output and input a band of their own, or leaves them out with `None`.
    - `min_coherence`: frequencies with a lower coherence do not count; by default 0.05, which
        maximum likelihood can weigh, and 0.6 for other costs, for records with references and for
        responses that reach 0.6 at fewer than five frequencies. Those with a random error above
        30 % never count. Both are averaged over a third of an octave.
    - `starts`: how many starting points, spread around the model's values in a Latin hypercube.
        `Fit.minima` lists where they ended.
    - `solver`: any optimistix least-squares solver; Levenberg-Marquardt by default.
    - `max_steps`: of the solver.

    **Returns:**

    A `jq.identify.Fit`. Its `verdict` says what the record determines; where too few frequencies
    are usable to fit anything, the result holds the starting values.

    **Raises:**

    - `ValueError`: for names that the model does not have, options that make no sense, and a
        solver that diverged.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits; call `jq.enable_x64()` first.

    !!! example

        ```python
        fit = jq.fit(jq.LaggedIntegrator(gain=100.0, lag=0.03, delay=0.02), frf, band=(1.0, 30.0))
        print(fit)
        ```

    Source: docs/identification.md; Eq. (14) of the paper, as corrected in docs/equations.md.
    """
    require_x64("a fit")
    inputs = Inputs(model, frf, conditions, priors)
    if traced := is_traced(inputs):
        model, frf, conditions, priors = concrete_values(inputs, "jq.fit")
    require_model("fit", model)
    frfs = require_responses(frf)
    if conditions is None:
        require_model_response(model, frfs[0])
    check_options(cost, band, min_coherence, max_steps)
    options = Options(
        free, tied, cost, conditions, priors, band, min_coherence, starts, solver, max_steps
    )
    descents: list[Descent] = []
    fit = fit_with(model, frfs, options, descents=descents)
    return with_derivatives(fit, descents, inputs, cost) if traced else fit


def fit_with(
    model: PyTree,
    frfs: Sequence[FrequencyResponse],
    options: Options,
    *,
    rounds: int = 3,
    descents: list[Descent] | None = None,
) -> Fit:
    """Fit as `jq.fit` does.

    `rounds` is how often to solve again with what the model leaves unexplained as a floor on the
    random error; 0 for estimates under the noise alone, whose costs compare structures. `descents`
    gets those that were made.
    """
    small = all(np.size(frf.omega) <= _SMALL for frf in frfs)
    with one_blas_thread() if small else contextlib.nullcontext():
        return _fit(with_arrays(model), frfs, options, rounds, [] if descents is None else descents)


def _fit(
    model: PyTree,
    frfs: Sequence[FrequencyResponse],
    options: Options,
    rounds: int,
    descents: list[Descent],
) -> Fit:
    # The problem: points, parameters, priors.
    cost, band, solver, max_steps = options.cost, options.band, options.solver, options.max_steps
    parameters = select_parameters(model, options.free, options.tied)
    least = [least_coherence(options.min_coherence, cost, frf) for frf in frfs]
    usable_points = [usable(frf, band, limit) for frf, limit in zip(frfs, least, strict=True)]
    require_priors(model, options.priors)
    is_likelihood = isinstance(cost, MaximumLikelihood)
    if options.priors and not is_likelihood:
        raise ValueError(
            Message(
                "a prior needs a cost that knows the noise, and that of Eq. (14) does not: "
                "leave «cost=» at its default, jq.identify.MaximumLikelihood()"
            )
        )
    count, needed = sum(int(mask.sum()) for mask in usable_points), parameters.count + 2
    if count < needed:
        reason = (
            f"{describe_usable(frfs, count, max(least))}{f' (band {band} rad/s)' if band else ''}, "
            f"and {parameters.count} parameters need at least {needed}"
        )
        wider = widen_band(frfs, [precise_points(frf) for frf in frfs]) if band is None else None
        remedies = ("excite the axis («jq.sweep»), record longer, or use a longer window",)
        if wider:
            fewer = "fit fewer parameters (free=): a delay, say, known from another source"
            remedies = (wider, fewer)
        verdict = without_numbers("too few points", parameters.names, reason, *remedies)
        remarks = dict.fromkeys(remark for frf in frfs for remark in frf.remarks)
        return unfitted(model, parameters, verdict, tuple(remarks))
    problem = make_problem(model, parameters, frfs, options.conditions, options.priors)
    pairs = zip(usable_points, problem.silences, strict=True)
    points = points_of(frfs, [mask & ~silent for mask, silent in pairs])

    def weigh(points: Sequence[Points], solution: Solution | None) -> list[Weights]:
        """By the ratio of model to measurement at a solution; 1 before there is one."""
        ratios = [np.ones(one.used.shape) for one in points]
        if solution is not None:
            ratios = [np.exp(part[..., 0]) for part in solution.sensitivity.misfits]
        weights = type(cost).weights  # a bound method of an `eqx.Module` is made like a model
        return [weights(cost, *pair) for pair in zip(points, ratios, strict=True)]

    def weighted(points: Sequence[Points], weights: Sequence[Weights]) -> Problem:
        """Only a likelihood knows what it would mean that points share noise."""
        return problem.weighted(weights, mixings_of(points, weights) if is_likelihood else None)

    def are_close(old: Sequence[Numbers], new: Sequence[Weights], share: float) -> bool:
        both = zip(map(np.asarray, old), new, strict=True)
        return all(np.all(np.abs(one - other) <= share * np.abs(other)) for one, other in both)

    # Starts and descent; where the weights depend on the model, again under those of the solution.
    weights, minima = weigh(points, None), ()
    problem = weighted(points, weights)
    if options.starts == 1:
        z = np.asarray(parameters.start)[: parameters.count]
        solution = solve_within_bounds(problem, z, solver, max_steps)
    else:
        fastest = max(float(one.frf.omega[-1]) for one in points)
        starts = spread_starts(parameters, options.starts, fastest=fastest)
        solution, minima = solve_from_many(problem, starts, solver, max_steps)
        solution = solve_within_bounds(problem, solution, solver, max_steps)
    descents.append(Descent(problem, points, solution))
    again = weigh(points, solution)
    if not are_close(weights, again, 1e-4):
        problem = weighted(points, again)
        solution = solve_within_bounds(problem, solution.z, solver, max_steps)
        descents.append(Descent(problem, points, solution))
    _check_finite(solution)
    check_priors(problem, solution)
    # Again with what the model leaves unexplained as a floor on the random error, where it does
    # leave something: for a right model a floor costs efficiency.
    weighting, lifted = weighting_at(problem, points, solution), False
    for _ in range(rounds if weighting.budget.mixtures[0].none < DOUBT else 0):
        floor = weighting.budget.mixtures[0].amplitude
        raised = [replace(one, floor=np.full(one.used.shape, floor)) for one in points]
        weights = weigh(raised, solution)
        if are_close(problem.weights, weights, _SETTLED):
            break
        problem, lifted = weighted(raised, weights), True
        solution = solve_within_bounds(problem, solution.z, solver, max_steps)
        descents.append(Descent(problem, raised, solution))
        _check_finite(solution)
        weighting = weighting_at(problem, points, solution)
    if lifted:
        weighting = weighting._replace(by_noise=weighted(points, weigh(points, solution)))
    # Responses that were measured, and that the model has none of.
    remarks = []
    for frf, mask, pairs in zip(frfs, usable_points, problem.silent, strict=True):
        for o, i in pairs:
            error = np.asarray(frf.random_error)[mask[:, o, i], o, i]
            if not error.size or np.mean(error < _PRESENT) < 0.5:
                continue
            pair = (frf.output_names[o], frf.input_names[i])
            text = (
                f"{pair[0]} answers to {pair[1]} (random error {100 * np.median(error):.2g} % at "
                f"{error.size} frequencies), but the model's response is zero: these points are "
                f"left out; free what joins the two, or say band={{{pair}: None}}"
            )
            remarks.append(Message(text, "no response"))
    origin = Origin(fit_with, tuple(points), options)
    return assess(problem, weighting, solution, minima, further=remarks, origin=origin)


def require_responses(frf: object) -> list[FrequencyResponse]:
    """One response or several, as a list. Raise ValueError for anything else, and for repeats."""
    items = list(frf) if isinstance(frf, Sequence) else [frf]
    frfs = [one for one in items if isinstance(one, FrequencyResponse)]
    if not items or len(frfs) < len(items):
        kinds = ", ".join(sorted({type(one).__name__ for one in items})) or "nothing"
        raise ValueError(
            f"a fit needs a jq.spectra.FrequencyResponse or a list of them, not {kinds}: make one "
            "with jq.frequency_response(record), and call jq.fit(model, response)"
        )
    for k, one in enumerate(frfs):
        for other in frfs[:k]:
            if np.array_equal(np.asarray(one.response), np.asarray(other.response)):
                raise ValueError(f"response {k} of {len(frfs)} is given twice: leave it out once")
    return frfs


def check_options(cost: PyTree, band: PyTree, min_coherence: float | None, max_steps: int) -> None:
    """Check `cost`, `band`, `min_coherence` and `max_steps`; raise ValueError."""
    if isinstance(cost, type) or not isinstance(cost, Cost):
        raise ValueError(
            f"cost={cost!r}: pass an object, jq.identify.MaximumLikelihood() or "
            "jq.identify.CoherenceWeighted()"
        )
    for limits in band.values() if isinstance(band, Mapping) else [band]:
        if limits is not None and np.shape(limits) != (2,):
            raise ValueError(f"band={limits!r}: give two frequencies in rad/s, (low, high)")
    if min_coherence is not None and not 0 < min_coherence < 1:
        raise ValueError(
            f"min_coherence is {min_coherence}: give a number between 0 and 1, or None for what "
            "goes with the cost"
        )
    if max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}: give at least 1")


def _check_finite(solution: Solution) -> None:
    """Raise ValueError where the solver diverged."""
    finite = all(np.all(np.isfinite(np.asarray(part))) for part in solution.sensitivity.misfits)
    if not (finite and np.all(np.isfinite(np.asarray(solution.z)))):
        raise ValueError(
            Message(
                "the fit diverged: "
                f"{solution.message or 'the response of the model is not finite'}; «start from "
                "other values, or leave solver= at its default»"
            )
        )


def check_priors(problem: Problem, solution: Solution) -> None:
    """Raise ValueError for a prior on a quantity that no free parameter changes."""
    slopes = np.asarray(solution.sensitivity.prior_slopes)[:, : problem.parameters.count]
    idle = np.flatnonzero(~np.any(slopes, axis=1))
    if idle.size:
        raise ValueError(
            f"prior {idle[0] + 1} is on a quantity that no free parameter changes: free its "
            f"parameter, or leave the prior out; free are {', '.join(problem.parameters.names)}"
        )
