"""Prediction error: the descent of an output-error problem under models of its noise."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._descent import (
    descend,
    descend_by_turns,
    Descent,
    describe_stop,
    message_of,
    Point,
    RecordNoise,
    sizes_of,
)
from ._noise_model import (
    ARMA,
    AutoRegressive,
    estimate_noise,
    Noise,
    NoiseModel,
    shock_slopes,
    shocks_of,
)
from ._problem import evaluate_misfits, Evaluation, OutputError
from ._whitening import make_whitener, white


_TURNS = 40  # of noise models and parameters, at most
_FREE = 2  # turns that choose the orders; later ones keep them
_NEAR = 1e-4  # last step of each turn's descent; Gauss-Newton leaves about its square
_STILL = 0.01  # standard errors: a change of the estimate that no longer matters
_NEXT = 0.3  # standard errors between ends of turns that are taken for one

Residuals = list[Float[np.ndarray, "samples outputs"]]  # of each record
Models = list[list[NoiseModel]]  # of each output of each record


def descend_with_noise(
    problem: OutputError, noise: Noise, max_steps: int, *, near: bool
) -> Descent:
    """Parameters and noise models by turns: the least mean square of one-step prediction errors.

    They begin with the noise that the starting values leave. If these are not known to be `near`,
    they begin once more with what output error leaves, and the likelier end counts: far off, a
    noise model takes for noise what the values do not explain, and in a closed loop output error
    is far off itself.
    Source: Ljung, System Identification, sec. 7.2 and 13.4 (direct method in a closed loop).
    """
    begin = (_at_start,) if near else (_at_start, _after_output_error)
    ends: list[_End] = []
    for each in begin:
        ends.append(_by_turns(each(problem, max_steps), noise, max_steps, ends))
    return _described(min(ends, key=_criterion))


class _Start(NamedTuple):
    """A problem whose residuals have unit size at `z`."""

    problem: OutputError
    z: Float[np.ndarray, " n"]
    found: Evaluation
    steps: int


class _End(NamedTuple):
    """Where the turns ended."""

    plain: OutputError  # the problem of the residuals themselves
    problem: OutputError  # that of their shocks
    stop: Point
    steps: int
    message: str
    residuals: Residuals
    models: Models


def _by_turns(start: _Start, noise: Noise, max_steps: int, known: Sequence[_End]) -> _End:
    """The end of the turns from a start; a known one, if the first turn leads next to it."""
    plain, z, found, steps = start
    kinds: list[list[Noise]] = [[noise] * term.y.shape[1] for term in plain.terms]
    residuals = _first_residuals(found)
    for turn in range(_TURNS):
        models = _estimated(residuals, kinds)
        kinds = kinds if turn < _FREE else _orders(models)
        problem = _under(plain, models)
        stop, status, taken = descend(problem, z, max_steps, _NEAR)
        change, steps, message = stop.z - z, steps + taken, message_of(status, taken)
        z = stop.z
        for end in () if turn else known:
            if _distance(stop, z - end.stop.z) < _NEXT:
                return end
        residuals = _residuals(evaluate_misfits(np.asarray(z), plain), models)
        if message or (turn and _distance(stop, change) < _STILL):
            break
    else:
        message = f"the noise model still changed after {_TURNS} turns"
    return _End(plain, problem, stop, steps, message, residuals, models)


def _distance(stop: Point, change: Float[np.ndarray, " n"]) -> float:
    """Of a change of z, in standard errors."""
    return float(np.sqrt(max(change @ stop.slopes()[1] @ change, 0.0)))


def _criterion(end: _End) -> float:
    """Akaike's, with the deviation of all samples' shocks that of those that are predicted."""
    total = 0.0
    sizes = sizes_of(end.problem, end.stop.found)
    for term, size, models in zip(end.problem.terms, sizes, end.models, strict=True):
        total += 2 * len(term.y) * float(np.sum(np.log(size / np.asarray(term.weights))))
        total += 2 * sum(sum(model.order) for model in models)
    return total if np.isfinite(total) else np.inf


def _described(end: _End) -> Descent:
    plain, problem, stop, steps, message, residuals, models = end
    sizes = sizes_of(problem, stop.found)
    solution = describe_stop(problem.base, stop.z, message, steps)
    found, noises = stop.found.reweighted(sizes), _noises(plain, residuals, models)
    return Descent(problem.reweighted(sizes), np.asarray(stop.z), solution, found, noises)


def _at_start(plain: OutputError, max_steps: int) -> _Start:
    parameters = plain.base.parameters
    z = np.zeros(parameters.count + plain.unknown)
    z[: parameters.count] = np.asarray(parameters.start)[: parameters.count]
    found = evaluate_misfits(np.asarray(z), plain)
    if not all(np.all(np.isfinite(misfit)) for misfit in found.misfits):
        return _after_output_error(plain, max_steps)
    sizes = sizes_of(plain, found)
    return _Start(plain.reweighted(sizes), z, found.reweighted(sizes), 0)


def _after_output_error(plain: OutputError, max_steps: int) -> _Start:
    first = descend_by_turns(plain, max_steps, _NEAR)
    return _Start(first.problem, np.asarray(first.z), first.found, first.solution.steps)


def _under(problem: OutputError, models: Sequence[Sequence[NoiseModel]]) -> OutputError:
    """The problem of the shocks, each in units of its deviation."""
    terms = [
        dataclasses.replace(
            term,
            whitener=make_whitener(each, len(term.y)),
            weights=term.weights / np.array([model.deviation for model in each]),
        )
        for term, each in zip(problem.terms, models, strict=True)
    ]
    return dataclasses.replace(problem, terms=tuple(terms))


def _estimated(residuals: Residuals, kinds: list[list[Noise]]) -> Models:
    return [
        [_estimate(v, kind) for v, kind in zip(residual.T, each, strict=True)]
        for residual, each in zip(residuals, kinds, strict=True)
    ]


def _estimate(v: Float[np.ndarray, " samples"], kind: Noise) -> NoiseModel:
    # Residuals have unit size, unless the record is exact and they are rounding.
    return estimate_noise(v, kind) if np.mean(v**2) > 0.25 else white(1)[0]


def _orders(models: Models) -> list[list[Noise]]:
    return [
        [ARMA(*model.order) if model.order[1] else AutoRegressive(model.order[0]) for model in each]
        for each in models
    ]


def _first_residuals(found: Evaluation) -> Residuals:
    """Residuals of an initial state that suits coloured noise.

    Least squares alone makes it follow slow noise, at the price of a jump in the first samples.
    """
    residuals = [np.asarray(misfit) for misfit in found.misfits]
    kinds: list[list[Noise]] = [[AutoRegressive()] * each.shape[1] for each in residuals]
    return _residuals(found, _estimated(residuals, kinds))


def _residuals(plain: Evaluation, models: Models) -> Residuals:
    """Residuals with initial state, trim and shift as the noise models weigh them."""
    return [
        _without(np.asarray(misfit), np.asarray(columns), each)
        for misfit, columns, each in zip(plain.misfits, plain.columns, models, strict=True)
    ]


def _without(
    misfit: Float[np.ndarray, "samples outputs"],
    columns: Float[np.ndarray, "samples outputs unknowns"],
    models: Sequence[NoiseModel],
) -> Float[np.ndarray, "samples outputs"]:
    shocks = [shocks_of(v, m) / m.deviation for v, m in zip(misfit.T, models, strict=True)]
    ways = [shocks_of(columns[:, o], model) / model.deviation for o, model in enumerate(models)]
    ways = np.concatenate(ways)
    scale = np.maximum(np.linalg.norm(ways, axis=0), 1e-300)
    unknowns = np.linalg.lstsq(ways / scale, np.concatenate(shocks), rcond=1e-9)[0] / scale
    return misfit - columns @ unknowns


def _noises(plain: OutputError, residuals: Residuals, models: Models) -> tuple[RecordNoise, ...]:
    noises = []
    for term, residual, each in zip(plain.terms, residuals, models, strict=True):
        blocks = [shock_slopes(v, model) for v, model in zip(residual.T, each, strict=True)]
        slopes, at = np.zeros((*residual.shape, sum(block.shape[1] for block in blocks))), 0
        for output, block in enumerate(blocks):
            slopes[:, output, at : at + block.shape[1]] = block
            at += block.shape[1]
        sizes = np.array([model.deviation for model in each]) / np.asarray(term.weights)
        known = [
            dataclasses.replace(model, deviation=float(size))
            for model, size in zip(each, sizes, strict=True)
        ]
        noises.append(RecordNoise(tuple(known), slopes))
    return tuple(noises)
