from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PyTree

from jaxquad.spectra import FrequencyResponse, require_x64

from ._assess import assess
from ._band import Range, usable
from ._batch import BatchSolution, solve_batch
from ._checks import check_options
from ._cost import CoherenceWeighted, Cost, Mask
from ._parameters import Free, Parameters, select_parameters, Tie
from ._problem import make_problem
from ._result import Fit
from ._solve import describe, solution_at, Stop


class BatchFit(eqx.Module):
    """Fits of one structure to many responses; `fit(k)` is that of response k with its doubts."""

    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[np.ndarray, "batch parameters"]
    costs: Float[np.ndarray, " batch"]
    decrements: Float[np.ndarray, " batch"]  # what one more step would save of half the cost
    steps: Int[np.ndarray, " batch"]
    converged: Bool[np.ndarray, " batch"]
    model: PyTree
    parameters: Parameters
    frfs: tuple[FrequencyResponse, ...]
    weights: Float[np.ndarray, "batch frequencies outputs inputs 2"]
    z: Float[np.ndarray, "batch parameters"]

    def fit(self, k: int) -> Fit:
        """Response k: standard errors, identifiability, remarks."""
        frf, z = self.frfs[k], jnp.asarray(self.z[k])
        problem = make_problem(self.model, self.parameters, [frf])
        problem = problem.weighted([jnp.asarray(self.weights[k])])
        reason = jnp.asarray(1 if self.converged[k] else 2)
        stop = Stop(z, jnp.asarray(self.converged[k]), reason, jnp.asarray(self.steps[k]))
        return assess(problem, [frf], solution_at(stop, *_describe(z, problem)))

    def __str__(self) -> str:
        lost = int(np.sum(~self.converged))
        lines = [f"{len(self.values)} fits, {lost} of which reached no minimum"]
        good = self.values[self.converged]
        if len(good):
            low, middle, high = np.percentile(good, [5, 50, 95], axis=0)
            for row in zip(self.names, middle, low, high, strict=True):
                lines.append("{:<16} median {:11.5g}, 5 to 95 %: {:.5g} .. {:.5g}".format(*row))
        return "\n".join(lines)


_describe = eqx.filter_jit(describe)


class _Data(NamedTuple):
    """The responses on common arrays."""

    omega: Float[np.ndarray, " frequencies"]
    measured: np.ndarray
    used: list[Mask]


def fit_batch(
    model: PyTree,
    frfs: Sequence[FrequencyResponse],
    *,
    free: Free = None,
    tied: dict[str, Tie] | None = None,
    cost: Cost = CoherenceWeighted(),
    band: Range | None = None,
    min_coherence: float = 0.6,
    max_steps: int = 64,
) -> BatchFit:
    """Fit one model to each of many responses on the same frequencies, in one compiled call.

    For fleets, Monte Carlo studies and sliding windows: 1000 fits of five parameters take about as
    long as 20 of scipy's. All start from the model's values, by Levenberg-Marquardt. Options are
    those of `jq.fit`. Raises `ValueError` for responses on different frequencies or channels.
    """
    require_x64("a fit")
    frfs = list(frfs)
    if not frfs or not all(isinstance(frf, FrequencyResponse) for frf in frfs):
        raise ValueError("a batch needs one jq.FrequencyResponse or more: fit_batch(model, frfs)")
    check_options(cost, band, min_coherence, max_steps)
    parameters = select_parameters(model, free, tied)
    data = _common(frfs, band, min_coherence)
    ones = [np.ones(mask.shape) for mask in data.used]
    weights = _weights(cost, frfs, data, ones)
    found = _solve(model, parameters, data, weights, max_steps)
    again = _weights(cost, frfs, data, _ratios(model, parameters, data, found))
    if not np.allclose(weights, again, rtol=1e-4):
        weights, found = again, _solve(model, parameters, data, again, max_steps)
    facts = (found.values, found.cost, found.decrement, found.steps, found.converged)
    return BatchFit(
        parameters.names, *(np.asarray(part) for part in facts),
        model=model, parameters=parameters, frfs=tuple(frfs), weights=weights,
        z=np.asarray(found.z),
    )  # fmt: skip


def _common(frfs: Sequence[FrequencyResponse], band: Range | None, least: float) -> _Data:
    omega, shape = np.asarray(frfs[0].omega), frfs[0].response.shape
    for k, frf in enumerate(frfs):
        if frf.response.shape != shape or not np.allclose(np.asarray(frf.omega), omega):
            raise ValueError(
                f"response {k} has shape {frf.response.shape} or other frequencies than the first "
                f"({shape}): estimate all at one omega, or fit them one by one with jq.fit"
            )
    used = [usable(frf, band, least) for frf in frfs]
    poor = [k for k, mask in enumerate(used) if not np.any(mask)]
    if poor:
        raise ValueError(
            f"{len(poor)} of {len(frfs)} responses have no usable frequency, the first is number "
            f"{poor[0]}: leave them out, or lower min_coherence"
        )
    measured = [np.asarray(frf.response) for frf in frfs]
    kept = [np.where(mask, each, 1.0) for mask, each in zip(used, measured, strict=True)]
    return _Data(omega, np.stack(kept), used)


def _weights(cost: Cost, frfs, data: _Data, ratios) -> np.ndarray:
    rows = zip(frfs, data.used, ratios, strict=True)
    return np.stack([cost.weights(*row) for row in rows])


def _solve(
    model: PyTree, parameters: Parameters, data: _Data, weights: np.ndarray, max_steps: int
) -> BatchSolution:
    arrays = (jnp.asarray(data.omega), jnp.asarray(data.measured), jnp.asarray(weights))
    return solve_batch(model, parameters, *arrays, max_steps=max_steps)


@eqx.filter_jit
def _responses(model, parameters, z, omega):
    return eqx.filter_vmap(lambda each: parameters.insert(model, each).frequency_response(omega))(z)


def _ratios(
    model: PyTree, parameters: Parameters, data: _Data, found: BatchSolution
) -> Float[np.ndarray, "batch frequencies outputs inputs"]:
    """|model / measurement| of every member; 1 where a fit ran away."""
    responses = _responses(model, parameters, found.z, jnp.asarray(data.omega))
    ratios = np.abs(np.asarray(responses) / data.measured)
    return np.where(np.isfinite(ratios) & (ratios > 0), ratios, 1.0)
