"""The log density of a fit's parameters, for samplers: the default error bars, and the tails.

A fit sets as many combinations of the misfits r to zero as it has parameters, J'W r = 0. At the
true parameters these have the covariance J'W (N + D) W J, of noise and model error. So they have a
likelihood; the rest of r, orthogonal to them, has that of the weights:

    -2 ln p(z) = d' C^-1 d + (r'Wr - d'Bd),   d(z) = B^-1 J'W r(z),   B = J'WJ

with J and W at the fit, and C the covariance of `Fit.covariance`. Under W = (N + D)^-1 this is the
Gaussian likelihood of all log-responses, r' (N + D)^-1 r. As the noise is an estimate of n degrees
of freedom, the first term is (n + p) ln(1 + d' C^-1 d / n), which makes intervals Student's.
Source: Kim (2002), Limited information likelihood and Bayesian analysis; Chandler & Bate (2007),
Inference for clustered data using the independence loglikelihood.
"""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float
from numpy.linalg import matrix_rank

from jaxquad._core import Message, pytree_node, require_x64

from ..frequency_domain._cost import MaximumLikelihood
from ..frequency_domain._parameters import Numbers
from ..frequency_domain._problem import Problem, residuals
from ._derived import check_drawable
from ._error_budget import ErrorBudget, Matrix, scaled_inverse
from ._verdict import pooled_freedom, UndeterminedError


if TYPE_CHECKING:
    from ..frequency_domain._result import Fit


_SHARE = 1e-3  # of a parameter in a null direction, by which its prior bounds it
_NEAR = 6.0  # standard errors to zero, within which a density is flat in the value


@runtime_checkable
class PriorDensity(Protocol):
    """A distribution of `jq.ensembles`, or anything with these."""

    @property
    def support(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and the greatest value."""
        ...

    @property
    def relative(self) -> bool:
        """Whether its numbers are in units of a nominal value."""
        ...

    def log_density(self, x: Float[Array, ""]) -> Float[Array, ""]:
        """The natural logarithm of the density at `x`."""
        ...


@pytree_node
class Evidence:
    """The problem of a fit under its last weights, with slopes and covariances at its solution, by
    relative changes; no bound at zero cuts these off."""

    problem: Problem
    rows: Float[np.ndarray, "residuals parameters"]  # in the order of `residuals`
    covariance: Matrix
    by_noise: Matrix


def evidence_of(problem: Problem, budget: ErrorBudget) -> Evidence:
    """What a fit that was assessed by this budget says of its parameters."""
    count = budget.count
    rows = [
        np.moveaxis(x.rows[..., :count], (3, 0), (0, 3)).reshape(-1, count) for x in budget.records
    ]
    rows = np.concatenate([*rows, budget.prior.slopes[:, :count]])
    return Evidence(problem, rows, budget.covariance, budget.by_noise)


class LogDensity(eqx.Module):
    """The log density of a fit as a value, with `fit.log_density` as its call.

    A sampler that is compiled with it as an argument samples all fits of one structure by one
    program.

    **Arguments:**

    - `fit`, `prior`, `model_error`: as of `jq.identify.Fit.log_density`, which says what is raised.
    """

    problem: Problem
    estimate: Float[Numbers, "parameters residuals"]  # relative changes that misfits amount to
    bread: Float[Numbers, "parameters parameters"]
    information: Float[Numbers, "parameters parameters"]  # inverse of the covariance
    freedom: Float[Numbers, ""]  # of the noise estimate
    flat: Bool[Numbers, " parameters"]  # flat in the value, not in its logarithm
    prior: tuple[PriorDensity | None, ...]

    def __init__(
        self,
        fit: "Fit",
        prior: Mapping[str, PriorDensity] | None = None,
        *,
        model_error: bool = True,
    ):
        require_x64("the log density of a fit")
        evidence, prior = _require_evidence(fit), {} if prior is None else prior
        _require_proper(fit, prior)
        covariance = evidence.covariance if model_error else evidence.by_noise
        self.problem, self.bread = evidence.problem, evidence.rows.T @ evidence.rows
        self.estimate = scaled_inverse(self.bread) @ evidence.rows.T
        self.information = scaled_inverse(covariance)
        self.freedom = np.asarray(pooled_freedom(fit.degrees_of_freedom, np.ones(len(fit.names))))
        self.prior = tuple(prior.get(name) for name in fit.names)
        others = np.array([density is None for density in self.prior])
        near = np.abs(fit.values) <= _NEAR * fit.standard_errors
        self.flat = np.array(fit.parameters.logarithmic[: len(fit.names)]) & near & others

    def __call__(self, z: Float[ArrayLike, " parameters"]) -> Float[Array, ""]:
        """The logarithm of the density at `z`, as `fit.coordinates`."""
        names, place = self.problem.parameters.names, jnp.asarray(z, dtype=float)
        if place.shape != (len(names),):
            raise ValueError(
                f"z has the shape {place.shape}, but the fit has {len(names)} free parameters "
                f"({', '.join(names)}): give one coordinate for each, as fit.coordinates; jax.vmap "
                "maps over many"
            )
        return _evaluate(self, place)


@eqx.filter_jit
def _evaluate(density: LogDensity, z: Float[Array, " parameters"]) -> Float[Array, ""]:
    misfits, parameters = residuals(z, density.problem), density.problem.parameters
    change = density.estimate @ misfits
    rest = misfits @ misfits - change @ density.bread @ change
    explained, finite = change @ density.information @ change, jnp.isfinite(density.freedom)
    freedom = jnp.where(finite, density.freedom, 1.0)
    student = (freedom + z.size) * jnp.log1p(explained / freedom)
    total = -0.5 * (rest + jnp.where(finite, student, explained))
    # Densities of the values, times the values' slopes.
    values, slopes = parameters.values(z), jnp.log(jnp.abs(parameters.slopes(z)))
    total += jnp.sum(jnp.where(density.flat, slopes, 0.0))
    for k, prior in enumerate(density.prior):
        if prior is not None:
            total += prior.log_density(values[k]) + slopes[k]
    return total


def _require_evidence(fit: "Fit") -> Evidence:
    check_drawable(fit, hold_undetermined=True)
    if fit.evidence is None:
        raise ValueError(
            "the fit has no frequency responses, as one of jq.refine: the log density is that of a "
            "fit of jq.fit"
        )
    if fit.origin is not None and not isinstance(fit.origin.options.cost, MaximumLikelihood):
        raise ValueError(
            Message(
                "a log density needs a cost that knows the noise: leave «cost=» of jq.fit at its "
                "default, jq.identify.MaximumLikelihood()"
            )
        )
    return fit.evidence


def _require_proper(fit: "Fit", prior: Mapping[str, PriorDensity]) -> None:
    """Raise where a prior is none, and where no prior bounds what the record does not determine."""
    for name, density in prior.items():
        k = fit.names.index(name) if name in fit.names else None
        if k is None:
            raise KeyError(f"no free parameter {name!r} for a prior: {', '.join(fit.names)}")
        if (
            not hasattr(density, "log_density")
            or density.relative
            or np.size(density.support[0]) > 1
        ):
            raise ValueError(
                f"the prior of {name} is {density!r}: give one distribution in the parameter's "
                "unit, such as jq.ensembles.Normal(deviation, mean=...) or "
                "jq.ensembles.Uniform(low, high)"
            )
        sign = float(np.sign(np.asarray(fit.parameters.scale)[k]))
        low, high = sorted(sign * float(end) for end in density.support)
        if fit.parameters.logarithmic[k] and not high > 0:
            raise ValueError(
                f"the prior of {name} ends at {sign * high:.4g}, but its fit keeps the sign of "
                f"{float(fit.values[k]):.4g}: give a prior of this sign, or fit it with "
                f"jq.identify.Real({name!r})"
            )
    shares = [[row.get(name, 0.0) for name in fit.names] for row in fit.verdict.null_directions]
    null = np.concatenate([np.reshape(shares, (-1, len(fit.names))), fit.verdict.exact])
    single = np.eye(len(fit.names))[~fit.determined & ~np.any(null, axis=0)]
    null = np.concatenate([null, single])
    bounded = np.array([name in prior for name in fit.names])
    if matrix_rank(null[:, bounded], tol=_SHARE) < matrix_rank(null, tol=_SHARE):
        names = ", ".join(fit.verdict.undetermined)
        raise UndeterminedError(
            f"the record does not determine {names}, so the posterior has no finite integral: "
            "add prior={name: jq.ensembles.LogNormal(deviation, median)}, or "
            "fit with a jq.identify.Prior or a second record"
        )
