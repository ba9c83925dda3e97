"""From an estimate by relative changes to a `Fit` in physical units."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, PyTree

from jaxquad._core import as_messages

from ..frequency_domain._parameters import Parameters
from ..frequency_domain._problem import on_device, Problem
from ..frequency_domain._refits import Origin
from ..frequency_domain._result import Fit
from ..frequency_domain._solve import Solution
from ..frequency_domain._starts import Minimum
from ..output_error._noise import NoiseModel
from ._accuracy import condition_number, cramer_rao, insensitivity, Matrix
from ._discrepancy import Discrepancy
from ._fit_remarks import is_fed_back, runaways
from ._identifiability import LIMIT
from ._verdict import pooled_freedom, Verdict


class Estimate(NamedTuple):
    """What the derivatives at the solution say about the parameters."""

    bread: Matrix  # J'J
    covariance: Matrix  # of relative changes, with what the model leaves unexplained
    noise: Matrix  # of relative changes, by the measured noise alone
    units: Float[np.ndarray, " parameters"]  # what relative changes are relative to
    verdict: Verdict
    decrement: float


class Costs(NamedTuple):
    """As in `Fit`."""

    cost: float
    average_cost: float
    information: float
    chi_squared: float


def make_fit(
    problem: Problem,
    solution: Solution,
    estimate: Estimate,
    costs: Costs,
    *,
    points: int,
    remarks: tuple[str, ...],
    minima: tuple[Minimum, ...] = (),
    freedom: Float[np.ndarray, " parameters"] | None = None,
    discrepancy: Discrepancy | None = None,
    origin: Origin | None = None,
    noise_models: tuple[tuple[NoiseModel, ...], ...] = (),
) -> Fit:
    """A result in physical units; `freedom` is that of the noise estimate, infinite without."""
    bread, covariance, _, units, verdict, decrement = estimate
    names, values = problem.parameters.names, np.asarray(solution.values)[: units.size]
    freedom = np.full(units.size, np.inf) if freedom is None else freedom
    verdict = _with_freedom(verdict, pooled_freedom(freedom, np.ones(units.size)))
    if runaways(problem, solution, verdict) and not is_fed_back(verdict):
        verdict = dataclasses.replace(verdict, remedies=())  # the remarks say what to do
    physical, unbounded = _physical_covariance(covariance, units, names, verdict)
    with np.errstate(divide="ignore"):
        percent = np.where(values == 0, np.nan, 100 * np.abs(units / values))
    return Fit(
        model=on_device(solution.model),
        names=names,
        values=values,
        standard_errors=np.where(unbounded, np.inf, np.sqrt(np.diagonal(physical))),
        covariance=physical,
        noise_covariance=_in_units(estimate.noise, units, unbounded),
        cramer_rao=np.where(unbounded, np.inf, cramer_rao(bread) * percent),
        insensitivity=insensitivity(bread) * percent,
        cost=costs.cost,
        average_cost=costs.average_cost,
        information=costs.information,
        chi_squared=costs.chi_squared,
        newton_decrement=decrement,
        condition=condition_number(bread),
        points=points,
        steps=solution.steps,
        verdict=verdict,
        remarks=as_messages(remarks),
        parameters=problem.parameters,
        units=units,
        relative_covariance=covariance,
        relative_noise_covariance=estimate.noise,
        minima=minima,
        degrees_of_freedom=freedom,
        discrepancy=discrepancy,
        noise_models=noise_models,
        origin=origin,
    )


def _with_freedom(verdict: Verdict, freedom: float) -> Verdict:
    """The verdict whose combinations have intervals of these degrees of freedom."""
    known = verdict.combinations
    if not known:
        return verdict
    combinations = tuple(each._replace(degrees_of_freedom=freedom) for each in known)
    return dataclasses.replace(verdict, combinations=combinations)


def _physical_covariance(
    relative: Float[np.ndarray, "parameters parameters"],
    slopes: Float[np.ndarray, " parameters"],
    names: tuple[str, ...],
    verdict: Verdict,
) -> tuple[Float[np.ndarray, "parameters parameters"], Bool[np.ndarray, " parameters"]]:
    """The covariance in physical units, nan where it is unbounded, and of which parameters.

    A pseudo-inverse shows no variance along a null direction: there it is unbounded.
    """
    if not verdict.undetermined:
        none = np.zeros(len(names), dtype=bool)
        return _in_units(relative, slopes, none), none
    rows = [[row.get(name, 0.0) for name in names] for row in verdict.null_directions]
    hidden = [row for row in np.array(rows) if row @ relative @ row < (0.5 * LIMIT) ** 2]
    lost = np.array([name in verdict.undetermined for name in names])
    unbounded = lost & np.any(
        np.abs(np.reshape([*hidden, *verdict.exact], (-1, len(names)))) > 1e-6, axis=0
    )
    return _in_units(relative, slopes, unbounded), unbounded


def _in_units(
    relative: Matrix, slopes: Float[np.ndarray, " parameters"], unbounded: np.ndarray
) -> Matrix:
    """A covariance of relative changes in physical units, nan where it is unbounded."""
    physical = relative * np.outer(slopes, slopes)
    if unbounded.any():
        physical[unbounded, :] = physical[:, unbounded] = np.nan
    return physical


def unfitted(
    model: PyTree, parameters: Parameters, verdict: Verdict, remarks: tuple[str, ...] = ()
) -> Fit:
    """What a fit returns where there is nothing to fit: the starting values, all marked."""
    count = parameters.count
    infinite = np.full(count, np.inf)
    values = np.asarray(parameters.values(parameters.start[:count]))
    return Fit(
        model=model,
        names=parameters.names,
        values=values,
        standard_errors=infinite,
        covariance=np.full((count, count), np.nan),
        noise_covariance=np.full((count, count), np.nan),
        cramer_rao=infinite,
        insensitivity=infinite,
        degrees_of_freedom=infinite,
        cost=np.nan,
        average_cost=np.nan,
        information=np.nan,
        chi_squared=np.nan,
        newton_decrement=np.nan,
        condition=np.inf,
        points=0,
        steps=0,
        verdict=verdict,
        remarks=as_messages(remarks),
        parameters=parameters,
        units=np.asarray(parameters.slopes(parameters.start[:count])),
        relative_covariance=np.full((count, count), np.nan),
        relative_noise_covariance=np.full((count, count), np.nan),
    )
