"""Fits of models to frequency responses, by a weighted cost, from one start or from many."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from jaxquad._core import (
    concrete_values,
    CONVERGED,
    decrement,
    is_traced,
    Message,
    minimise,
    one_blas_thread,
    require_x64,
    RUNNING,
    STALLED,
    TOLERANCE,
)
from jaxquad.models import LaggedIntegrator, with_arrays
from jaxquad.spectra import FrequencyResponse

from ..uncertainty._assess import assess, unfitted
from ..uncertainty._error_budget import weighting_at
from ..uncertainty._misfit import DOUBT
from ..uncertainty._verdict import without_numbers
from ..uncertainty._zero_bounds import linearise, solve_within_bounds
from ._cost import (
    Band,
    Cost,
    describe_usable,
    least_coherence,
    MaximumLikelihood,
    mixing_of,
    Points,
    points_of,
    precise_points,
    usable,
    Weights,
    widen_band,
)
from ._derivatives import Descent, Inputs, with_derivatives
from ._feedthrough import (
    find_samples,
    free_delays,
    limited,
    remarks_on_samples,
    sample_limits,
    Solved,
    unsampled,
)
from ._parameters import Condition, Free, Numbers, Parameters, select_parameters, Tie
from ._problem import (
    make_problem,
    Prior,
    Problem,
    problem_normal,
    require_model,
    require_model_response,
    require_priors,
    residuals,
)
from ._refits import check_options, Options, Origin, require_responses
from ._result import Fit
from ._solve import (
    FLAT,
    least_squares,
    MINIMUM,
    Minimum,
    NOT_FINITE,
    SADDLE,
    Solution,
    solution_at,
    stopped_early,
    UNFINISHED,
    WALL,
)


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

    Within `jax.grad`, `jvp`, `jacrev`, `jacfwd` and `hessian` its model and values have derivatives
    by responses, their random errors and coherences, fixed parameters, priors and conditions: those
    of fitting again, by the implicit function theorem with the cost's whole Hessian. Frequencies
    and the correlation of errors count as constant, and so does which points are in use.

    **Raises:**

    - `ValueError`: for names that the model does not have, options that make no sense, and a
        solver that diverged; within `jax.jit` and `vmap`, and for derivatives without a minimum.
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
    by_slopes: bool = False,
    descents: list[Descent] | None = None,
) -> Fit:
    """Fit as `jq.fit` does, and up to `rounds` times more with what the model leaves unexplained as
    a floor on the random error; without, costs compare structures. With `by_slopes` no parameter is
    followed along the cost, which a remark says. `descents` gets all of them."""
    small = all(np.size(frf.omega) <= _SMALL for frf in frfs)
    descents = [] if descents is None else descents
    with one_blas_thread() if small else contextlib.nullcontext():
        return _fit(with_arrays(model), frfs, options, rounds, by_slopes, descents)


def _fit(
    model: PyTree,
    frfs: Sequence[FrequencyResponse],
    options: Options,
    rounds: int,
    by_slopes: bool,
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
    masks = (mask & ~silent for mask, silent in pairs)
    points = [points_of(*pair) for pair in zip(frfs, masks, strict=True)]
    delays = free_delays(problem)
    if delays:
        problem = unsampled(problem, delays)

    def weigh(points: Sequence[Points], solution: Solution | None) -> list[Weights]:
        """By the ratio of model to measurement at a solution; 1 before there is one."""
        ratios = [np.ones(one.used.shape) for one in points]
        if solution is not None:
            ratios = [np.exp(part[..., 0]) for part in solution.sensitivity.misfits]
        weights = type(cost).weights  # a bound method of an `eqx.Module` is made like a model
        return [weights(cost, *pair) for pair in zip(points, ratios, strict=True)]

    def weighted(points: Sequence[Points], weights: Sequence[Weights]) -> Problem:
        """Only a likelihood knows what it would mean that points share noise."""
        pairs = zip(points, weights, strict=True)
        return problem.weighted(weights, [mixing_of(*x) for x in pairs] if is_likelihood else None)

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

    def solve_from(problem: Problem, z: Numbers) -> Solved:
        end = solve_within_bounds(problem, np.asarray(z), solver, max_steps)
        local = linearise(problem, end)
        return Solved(end, end.z, local.cost, local.jacobian.T @ local.jacobian)

    if delays:
        problem, sampled = find_samples(problem, solution.z, delays, solve_from)
        solution = sampled.solution
    descents.append(Descent(problem, points, solution))
    again = weigh(points, solution)
    if not are_close(weights, again, 1e-4):
        problem = weighted(points, again)
        solution = solve_within_bounds(problem, solution.z, solver, max_steps)
        descents.append(Descent(problem, points, solution))
    _check_finite(solution, solver)
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
        _check_finite(solution, solver)
        weighting = weighting_at(problem, points, solution)
    limits, z = sample_limits(problem, solution.z, delays, solve_from)
    if limits:
        problem = limited(problem, limits)
        descents.clear()  # what limits a delay to its sample has no derivative
        solution = solve_from(problem, z).solution
        weighting = weighting_at(problem, points, solution)
    if lifted:
        weighting = weighting._replace(by_noise=weighted(points, weigh(points, solution)))
    remarks = remarks_on_samples(problem, limits, frfs)
    # Responses that were measured, and that the model has none of.
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
    if by_slopes:
        text = "one of several structures: its intervals are by slopes alone"
        remarks.append(Message(text, "by slopes"))
    origin = Origin(fit_with, tuple(points), options)
    return assess(
        problem, weighting, solution, minima, further=remarks, origin=origin, by_slopes=by_slopes
    )


def _check_finite(solution: Solution, solver: eqx.Module | None) -> None:
    """Raise ValueError where the solver diverged."""
    parts, count = solution.sensitivity, solution.z.size
    numbers = [solution.z, *parts.misfits, *(part[..., :count] for part in parts.slopes)]
    with np.errstate(over="ignore"):  # the squares count, too
        finite = all(np.all(np.isfinite(np.square(np.asarray(part)))) for part in numbers)
    if not finite:
        reason = solution.message or "the response of the model is not finite"
        remedy = "«start from other values, or fit fewer parameters (free=)»"
        if solver is not None:
            remedy = "start from other values, or leave solver= at its default"
        raise ValueError(Message(f"the fit diverged: {reason}; {remedy}"))


def check_priors(problem: Problem, solution: Solution) -> None:
    """Raise ValueError for a prior on a quantity that no free parameter changes."""
    slopes = np.asarray(solution.sensitivity.prior_slopes)[:, : problem.parameters.count]
    idle = np.flatnonzero(~np.any(slopes, axis=1))
    if idle.size:
        raise ValueError(
            f"prior {idle[0] + 1} is on a quantity that no free parameter changes: free its "
            f"parameter, or leave the prior out; free are {', '.join(problem.parameters.names)}"
        )


def spread_starts(
    parameters: Parameters, count: int, *, fastest: float, factor: float = 5.0, seed: int = 0
) -> Float[np.ndarray, "starts parameters"]:
    """Starting vectors `z`: the given start, then a Latin hypercube around it.

    Parameters that keep their sign spread evenly in the logarithm, those that may cross zero over
    twice their scale. A parameter whose name ends in `delay` stays below half a turn at the fastest
    frequency, beyond which minima repeat with each turn.

    **Arguments:**

    - `fastest`: the highest frequency in rad/s.
    - `factor`: how far to spread to both sides, above 1.

    **Raises:** ValueError for no starts, or a factor that spreads nothing.
    """
    if count < 1:
        raise ValueError(f"starts is {count}: give 1 for the given start alone, or more")
    if not (1 < factor < np.inf and 0 < fastest < np.inf):
        raise ValueError(
            f"factor {factor} and fastest frequency {fastest} rad/s: give a finite factor above 1, "
            "for instance 5, and a positive frequency"
        )
    n, rng = parameters.count, np.random.default_rng(seed)
    start, scale = (np.asarray(x)[:n] for x in (parameters.start, parameters.scale))
    cells = np.stack([rng.permutation(count - 1) for _ in range(n)], axis=1).reshape(count - 1, n)
    unit = (cells + rng.uniform(size=cells.shape)) / max(count - 1, 1)
    logarithmic = np.array(parameters.logarithmic[:n])
    reach = np.where(logarithmic, np.log(factor), 2.0)
    low, high = start - reach, start + reach
    for k, name in enumerate(parameters.names):
        if name.split(".")[-1].split("[")[0].endswith("delay") and logarithmic[k]:
            most = max(np.log(np.pi / fastest / abs(scale[k])), start[k])
            high[k] = min(high[k], most)
    return np.concatenate([start[None], low + (high - low) * unit])


def solve_from_many(
    problem: Problem,
    starts: Float[np.ndarray, "starts parameters"],
    solver: eqx.Module | None,
    max_steps: int,
) -> tuple[Solution, tuple[Minimum, ...]]:
    """Solve from every start in one call.

    Starts of the default solver run side by side, those of an optimistix solver one by one, since
    its LAPACK calls can hang under `vmap`.

    **Returns:** the best solution, a minimum before a lower point that is none; and all distinct
    points, sorted by cost.

    **Raises:** ValueError where no start has a finite response.
    """
    stops = jax.tree.map(np.asarray, _solve_all(problem, np.asarray(starts), solver, max_steps))
    z, status, steps, normal, left, bent = stops
    costs, groups = normal.cost, list[list[int]]()

    def same(one: int, other: int) -> bool:
        """Those within a millionth of the cost are one."""
        floor, difference = 1e-6 * (costs[one] + 1e-6), np.asarray(z[one] - z[other])
        if abs(costs[other] - costs[one]) > floor:
            return False
        near = bool(np.max(np.abs(difference)) <= 1e-4)
        return near or bool(0.5 * difference @ normal.hessian[one] @ difference <= floor)

    for k in (int(k) for k in np.argsort(costs) if np.isfinite(costs[k])):
        group = next((group for group in groups if same(group[0], k)), None)
        groups.append([k]) if group is None else group.append(k)
    if not groups:
        raise ValueError(
            f"the model's response is not finite at any of {len(starts)} starts: check the model "
            "at its starting values with model.frequency_response(omega)"
        )
    minima = []
    for k, *others in groups:
        curvature, cost = -np.inf, float(costs[k])
        if np.all(np.isfinite(bent[k])):
            size = np.sqrt(np.maximum(np.abs(np.diagonal(bent[k])), 1e-300))
            curvature = float(np.linalg.eigvalsh(bent[k] / np.outer(size, size))[0])
        # Noise-free data leave a cost of rounding errors, of which no share means anything.
        if left[k] > 1e-6 * cost + 1e-12:
            kind = UNFINISHED if status[k] == RUNNING else WALL
        elif curvature < -1e-6:
            kind = SADDLE
        else:
            kind = MINIMUM if curvature > 1e-9 else FLAT
        values, led = np.asarray(problem.parameters.values(z[k])), tuple(sorted([k, *others]))
        minima.append(Minimum(2 * cost, z[k], values, led, float(left[k]), curvature, kind))
    best = min(minima, key=lambda point: (not point.is_minimum, point.cost))
    if lost := tuple(k for k in range(len(z)) if not np.isfinite(costs[k])):
        values = np.asarray(problem.parameters.values(z[lost[0]]))
        minima.append(Minimum(np.inf, z[lost[0]], values, lost, np.inf, -np.inf, NOT_FINITE))
    reason, count = (int(part[best.starts[0]]) for part in (status, steps))
    message = "" if best.is_minimum else best.kind
    if message and reason in (RUNNING, STALLED):
        message = stopped_early(reason, count)
    return solution_at(problem, best.z, message, count), tuple(minima)


@eqx.filter_jit
def _solve_all(problem, starts, solver, max_steps) -> tuple:
    """Of every start: `z`, status and steps of its stop; there the normal equations, the Newton
    decrement, and second derivatives of half the cost."""

    def normal_at(z):
        return problem_normal(z, problem)

    if solver is None:
        side_by_side = jax.vmap(normal_at, in_axes=-1, out_axes=-1)
        state = minimise(side_by_side, starts.T, max_steps, TOLERANCE)
        z, status, steps = state.z.T, state.status, state.steps
    else:
        solve = lambda z0: least_squares(residuals, z0, problem, solver=solver, max_steps=max_steps)
        stop = jax.lax.map(solve, starts)
        z, steps = stop.z, stop.steps
        status = jnp.where(stop.converged, CONVERGED, RUNNING)
    normal = jax.vmap(normal_at)(z)
    # Forward over forward: a model need not support reverse differentiation.
    bent = jax.vmap(jax.jacfwd(lambda z: normal_at(z).gradient))(z)
    return z, status, steps, normal, jax.vmap(decrement)(normal), bent
