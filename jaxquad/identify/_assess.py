"""From a solver's stop to a result that states what it is worth."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxquad.spectra import FrequencyResponse

from ._accuracy import (
    Block,
    calibrated_covariance,
    condition_number,
    cramer_rao,
    gauss_newton,
    information_root,
    insensitivity,
    Known,
    scaled_inverse,
)
from ._identifiable import decide, Identifiability, Information
from ._problem import Problem
from ._result import Fit
from ._solve import Solution


_FAR = 7.0  # in ln: a parameter that moved by a factor of 1000 ran for zero or infinity


def assess(problem: Problem, frfs: Sequence[FrequencyResponse], solution: Solution) -> Fit:
    """Costs, bounds, calibrated covariance and identifiability at the solution."""
    parameters, count = problem.parameters, problem.parameters.count
    blocks, known = _blocks(problem, frfs, solution), _known(solution)
    bread, gradient = gauss_newton(blocks, known, count)
    covariance = calibrated_covariance(blocks, known, count)
    z = np.asarray(solution.z)
    values = np.asarray(parameters.values(parameters.start.at[:count].set(solution.z)))
    slopes = np.asarray(parameters.slopes(parameters.start.at[:count].set(solution.z)))
    names = tuple(place.name for place in parameters.places)
    root = information_root(blocks)
    facts = Information(root, covariance, names, values, slopes)
    full = facts._replace(root=np.concatenate([np.repeat(known.slopes, 2, 0) / np.sqrt(2), root]))
    verdict, by_data = decide(full), decide(facts)
    free = slice(0, count)
    physical = covariance * np.outer(slopes[free], slopes[free])
    lost = np.array([name in verdict.undetermined for name in parameters.names])
    physical[lost, :] = physical[:, lost] = np.nan
    percent = 100 * np.abs(slopes[free] / np.where(values[free] == 0, np.nan, values[free]))
    cost = sum(float(np.sum((block.weights * block.misfit) ** 2)) for block in blocks)
    cost += float(np.sum(known.misfit**2))
    decrement = 0.5 * float(gradient @ scaled_inverse(bread) @ gradient)
    model = parameters.insert(problem.model, solution.z)
    return Fit(
        model=model,
        names=parameters.names,
        values=np.where(lost, np.nan, values[free]),
        standard_errors=np.where(lost, np.inf, np.sqrt(np.diagonal(physical))),
        covariance=physical,
        cramer_rao=np.where(lost, np.inf, cramer_rao(bread) * percent),
        insensitivity=insensitivity(bread) * percent,
        cost=cost,
        average_cost=cost / len(blocks),
        chi_squared=_chi_squared(blocks, known, count),
        newton_decrement=decrement,
        condition=condition_number(bread),
        points=sum(int(np.sum(block.weights[:, 0] > 0)) for block in blocks),
        steps=solution.steps,
        identifiability=verdict,
        remarks=_remarks(frfs, solution, decrement, cost, parameters, z, verdict, by_data, blocks, known),
    )


def _blocks(problem: Problem, frfs: Sequence[FrequencyResponse], solution: Solution) -> list[Block]:
    blocks = []
    derivatives = solution.sensitivity
    for k, frf in enumerate(frfs):
        misfit, slopes = np.asarray(derivatives.misfits[k]), np.asarray(derivatives.slopes[k])
        weights = np.asarray(problem.weights[k])
        for o, i in np.ndindex(misfit.shape[1:3]):
            # The error relative to the model: measurement over model is exp(-misfit).
            ratio = np.exp(-misfit[:, o, i, 0] - 1j * misfit[:, o, i, 1])
            covariance = np.asarray(frf.relative_covariance)[o, i] * np.outer(ratio, ratio.conj())
            error = np.maximum(np.asarray(frf.random_error)[:, o, i] * np.abs(ratio), 1e-7)
            blocks.append(
                Block(misfit[:, o, i], slopes[:, o, i], weights[:, o, i], error, covariance)
            )
    return [block for block in blocks if np.any(block.weights)]


def _known(solution: Solution) -> Known:
    derivatives = solution.sensitivity
    return Known(np.asarray(derivatives.prior_misfits), np.asarray(derivatives.prior_slopes))


def _chi_squared(blocks: Sequence[Block], known: Known, count: int) -> float:
    used = [block.weights > 0 for block in blocks]
    terms = [
        np.sum((block.misfit / block.error[:, None])[mask] ** 2)
        for block, mask in zip(blocks, used, strict=True)
    ]
    freedom = sum(int(mask.sum()) for mask in used) + len(known.misfit) - count
    return float((sum(terms) + np.sum(known.misfit**2)) / max(freedom, 1))


def _remarks(frfs, solution, decrement, cost, parameters, z, verdict, by_data, blocks, known):
    remarks = [remark for frf in frfs for remark in frf.remarks]
    if not solution.converged:
        remarks.append(f"the solver stopped early: {solution.message.strip()}")
    if not decrement <= 1e-3 * max(cost, 1e-9):
        remarks.append(
            f"no minimum: one more Gauss-Newton step would lower the cost by {decrement:.3g} "
            f"of {cost:.4g}; try other starting values"
        )
    moved = np.abs(z - np.asarray(parameters.start)[: len(z)])
    for name, far, log in zip(parameters.names, moved, parameters.logarithmic, strict=False):
        if log and far > _FAR:
            remarks.append(
                f"{name} ran to {'zero or infinity'}: leave it out, or let its sign change with "
                f"jq.Real({name!r})"
            )
    chi_squared = _chi_squared(blocks, known, parameters.count)
    if chi_squared > 2:
        remarks.append(
            f"the misfit is {np.sqrt(chi_squared):.1f} times the random error: the model's structure does "
            "not explain the response, and no standard error below contains that"
        )
    resolved = [name for name in by_data.undetermined if name not in verdict.undetermined]
    if resolved:
        remarks.append(
            f"{' and '.join(resolved)} are told apart by the prior alone: the record determines only "
            + ", ".join(combination.name for combination in by_data.determined)
        )
    return tuple(dict.fromkeys(remarks))
