"""The least-squares problem of an output-error fit."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxquad._core import Normal, solve_definite

from ..frequency_domain._parameters import Numbers
from ..frequency_domain._problem import prior_misfits, Problem
from ._known_loop import close_loop
from ._simulated import (
    band_filter,
    forced_response,
    free_response,
    integrate_plant,
    linear_model,
    Motions,
)
from ._whitening import Whitener


_RIDGE = 1e-10  # of the squared length of a column, and taken out again by refinement
_LOOSE = 1e-2  # standard errors per unit of initial state: holds what has no effect


class RecordTerm(eqx.Module):
    """A record as the fit sees it."""

    u: Float[Numbers, "samples inputs"]
    y: Float[Numbers, "samples outputs"]  # within the band
    weights: Float[Numbers, " outputs"]  # one over the residual's standard deviation
    gain: Float[Numbers, " bins"] | None  # of the band, over frequency
    motions: tuple[Float[Numbers, "states slow"], Float[Numbers, "states fast"]] | None
    start: Float[Numbers, " unknown"]  # units of an unknown initial state; none if it is eliminated
    dt: float = eqx.field(static=True)
    hold: str = eqx.field(static=True)
    whitener: Whitener | None = None  # of the noise, where it has a model
    feedback: Float[Numbers, " samples"] | None = None  # of a known loop, after a unit of output

    def weighted(
        self, x: Float[Numbers, "samples outputs *columns"]
    ) -> Float[Array, "samples outputs *columns"]:
        """What counts of outputs: within the band, unpredicted by the noise, in units of it."""
        x = jnp.asarray(x)
        seen = band_filter(x, self.gain) if self.whitener is None else self.whitener(x)
        return jnp.asarray(seen) * self.weights.reshape(1, -1, *(1,) * (x.ndim - 2))

    @property
    def measured(self) -> Float[Numbers, "samples outputs"]:
        """The measured output as `weighted` sees it."""
        return self.y * self.weights[None] if self.whitener is None else self.weighted(self.y)

    @property
    def counted(self) -> Int[np.ndarray, " outputs"]:
        """Samples of each output that the noise model predicts."""
        samples, outputs = self.y.shape
        unseen = np.zeros(outputs, int) if self.whitener is None else self.whitener.start
        return samples - np.asarray(unseen)


class OutputError(eqx.Module):
    """Residuals of all records as a function of the free parameters and the initial states."""

    base: Problem  # model, parameters and priors
    terms: tuple[RecordTerm, ...]
    zeros: tuple[int, ...] = eqx.field(static=True)  # arrays of the model that are known to be 0

    def reweighted(self, sizes: Sequence[Float[np.ndarray, " outputs"]]) -> "OutputError":
        """The same problem with its residuals divided by `sizes`."""
        terms = [
            dataclasses.replace(term, weights=np.asarray(term.weights) / size)
            for term, size in zip(self.terms, sizes, strict=True)
        ]
        return dataclasses.replace(self, terms=tuple(terms))

    @property
    def unknown(self) -> int:
        """How many initial states follow the parameters in z."""
        return sum(term.start.size for term in self.terms)


def split(z: Float[Numbers, " n"], problem: OutputError) -> list[Float[Numbers, " part"]]:
    """The parameters, and then each record's initial state."""
    ends = np.cumsum([0, *(term.start.size for term in problem.terms)])
    count = z.size - problem.unknown
    return [z[:count], *(z[count + a : count + b] for a, b in zip(ends, ends[1:], strict=False))]


def insert_parameters(z: Float[Numbers, " n"], problem: OutputError) -> PyTree:
    """The model at these parameters; what is 0 and fixed stays known to be 0 under jit."""
    model = problem.base.parameters.insert(problem.base.model, z)
    arrays, rest = eqx.partition(model, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
    for k in problem.zeros:
        leaves[k] = np.zeros(leaves[k].shape, leaves[k].dtype)
    return eqx.combine(jax.tree.unflatten(structure, leaves), rest)


def misfit_and_columns(
    model: PyTree, start: Float[Array, " unknown"], term: RecordTerm
) -> tuple[Float[Array, "samples outputs"], Float[Array, "samples outputs unknowns"]]:
    """Weighted misfit at zero start and trim, and what each unit of them adds to the output."""
    if term.motions is None:
        simulated = integrate_plant(model, term.u, term.start * start, term.dt, term.hold)
        shifts = jnp.eye(term.y.shape[1])[None]
        columns = jnp.broadcast_to(shifts, (*term.y.shape, term.y.shape[1]))
    else:
        plant = linear_model(model)
        simulated = forced_response(plant, term.u, term.dt, term.hold)
        motions = Motions(*term.motions, ())
        columns = free_response(plant, motions, len(term.u), term.dt)
        if (feedback := term.feedback) is not None:
            late = jnp.asarray(feedback)
            closed = lambda x: term.weighted(close_loop(plant, x, late, term.dt))
            return closed(term.y - simulated), closed(columns)
    return jnp.asarray(term.measured) - term.weighted(simulated), term.weighted(columns)


def project_out(
    found: Float[Array, "samples outputs"], columns: Float[Array, "samples outputs unknowns"]
) -> Float[Array, "samples outputs"]:
    """The misfit that no start, trim or shift explains (variable projection)."""
    flat = columns.reshape(found.size, -1)
    square = jax.lax.stop_gradient(jnp.sum(flat**2, axis=0))
    flat = flat / jnp.sqrt(jnp.where(square > 1e-20 * jnp.max(square), square, 1.0))[None]
    normal = jnp.dot(flat.T, flat, precision="highest")
    aim = flat.T @ found.reshape(-1)
    ridged = normal + _RIDGE * jnp.eye(aim.size)

    def refine(_, unknowns):
        return unknowns + solve_definite(ridged, aim - normal @ unknowns)[0]

    unknowns = jax.lax.fori_loop(0, 3, refine, jnp.zeros_like(aim))
    return found - (flat @ unknowns).reshape(found.shape)


class Evaluation(NamedTuple):
    """Misfits, slopes and columns at one place, record by record; all weighted."""

    misfits: Sequence[Float[Numbers, "samples outputs"]]
    slopes: Sequence[Float[Numbers, "samples outputs n"]]  # by parameters, then initial states
    columns: Sequence[Float[Numbers, "samples outputs unknowns"]]  # of start, trim and shift
    normal: Normal  # of these, of the priors and of a hold on the initial states

    def reweighted(self, sizes: Sequence[Float[np.ndarray, " outputs"]]) -> "Evaluation":
        """The same, divided by `sizes`; the normal equations as they were."""
        divided = lambda parts: [
            part / np.asarray(size).reshape(1, -1, *(1,) * (part.ndim - 2))
            for part, size in zip(parts, sizes, strict=True)
        ]
        parts = (divided(self.misfits), divided(self.slopes), divided(self.columns))
        return Evaluation(*parts, normal=self.normal)


@eqx.filter_jit
def evaluate_misfits(z: Float[Numbers, " n"], problem: OutputError) -> Evaluation:
    """Everything at the first parameters and the initial states `z`."""

    def simulated(z):
        values, *starts = map(jnp.asarray, split(z, problem))
        model = insert_parameters(values, problem)
        pairs = [
            misfit_and_columns(model, *each) for each in zip(starts, problem.terms, strict=True)
        ]
        left = [project_out(*pair) for pair in pairs]
        rest = [prior_misfits(values, problem.base), *(_LOOSE * start for start in starts)]
        return (left, rest), (left, rest, [columns for _, columns in pairs])

    (slopes, others), (left, rest, columns) = jax.jacfwd(simulated, has_aux=True)(z)
    r = jnp.concatenate([one.reshape(-1) for one in (*left, *rest)])
    J = jnp.concatenate([one.reshape(-1, z.size) for one in (*slopes, *others)])
    return Evaluation(left, slopes, columns, Normal(0.5 * jnp.sum(r**2), J.T @ r, J.T @ J))
