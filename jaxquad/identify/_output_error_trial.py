"""One record of an output-error fit: the outputs that a model would have had, and their misfit."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._core import Normal, solve_definite

from ._problem import prior_misfits, Problem
from ._simulated import filtered, forced, free, integrated, linear_model, Motions


_RIDGE = 1e-10  # of the squared length of a column, and taken out again by refinement
_LOOSE = 1e-2  # standard errors per unit of initial state: holds what has no effect


class Trial(eqx.Module):
    """A record as the fit sees it."""

    u: Float[Array, "samples inputs"]
    y: Float[Array, "samples outputs"]  # within the band
    weights: Float[Array, " outputs"]  # one over the residual's standard deviation
    gain: Float[Array, " bins"] | None  # of the band, over frequency
    motions: tuple[Float[Array, "states slow"], Float[Array, "states fast"]] | None
    start: Float[Array, " unknown"]  # units of an unknown initial state; none if it is eliminated
    dt: float = eqx.field(static=True)
    hold: str = eqx.field(static=True)


class OutputError(eqx.Module):
    """Residuals of all records as a function of the free parameters and the initial states."""

    base: Problem  # model, parameters and priors
    trials: tuple[Trial, ...]
    zeros: tuple[int, ...] = eqx.field(static=True)  # arrays of the model that are known to be 0

    def reweighted(self, sizes: Sequence[Float[np.ndarray, " outputs"]]) -> "OutputError":
        """The same problem with its residuals divided by `sizes`."""
        trials = [
            dataclasses.replace(trial, weights=trial.weights / jnp.asarray(size))
            for trial, size in zip(self.trials, sizes, strict=True)
        ]
        return dataclasses.replace(self, trials=tuple(trials))

    @property
    def unknown(self) -> int:
        """How many initial states follow the parameters in z."""
        return sum(trial.start.size for trial in self.trials)


def split(z: Float[Array, " n"], problem: OutputError) -> list[Float[Array, " part"]]:
    """The parameters, and then each record's initial state."""
    ends = np.cumsum([0, *(trial.start.size for trial in problem.trials)])
    count = z.size - problem.unknown
    return [z[:count], *(z[count + a : count + b] for a, b in zip(ends, ends[1:], strict=False))]


def inserted(z: Float[Array, " n"], problem: OutputError) -> PyTree:
    """The model at these parameters; what is 0 and fixed stays known to be 0 under jit."""
    model = problem.base.parameters.insert(problem.base.model, z)
    arrays, rest = eqx.partition(model, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
    for k in problem.zeros:
        leaves[k] = np.zeros(leaves[k].shape, leaves[k].dtype)
    return eqx.combine(jax.tree.unflatten(structure, leaves), rest)


def parts(
    model: PyTree, start: Float[Array, " unknown"], trial: Trial
) -> tuple[Float[Array, "samples outputs"], Float[Array, "samples outputs unknowns"]]:
    """Weighted misfit at zero start and trim, and what each unit of them adds to the output."""
    if trial.motions is None:
        simulated = integrated(model, trial.u, trial.start * start, trial.dt, trial.hold)
        shifts = jnp.eye(trial.y.shape[1])[None]
        columns = jnp.broadcast_to(shifts, (*trial.y.shape, trial.y.shape[1]))
    else:
        plant = linear_model(model)
        simulated = forced(plant, trial.u, trial.dt, trial.hold)
        motions = Motions(*trial.motions, ())
        columns = free(plant, motions, len(trial.u), trial.dt)
    weights = trial.weights[None]
    misfit = (trial.y - filtered(simulated, trial.gain)) * weights
    return misfit, filtered(columns, trial.gain) * weights[:, :, None]


def unexplained(
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


class Found(NamedTuple):
    """Misfits, slopes and columns at one place, record by record; all weighted."""

    misfits: list[Float[Array, "samples outputs"]]
    slopes: list[Float[Array, "samples outputs n"]]  # by parameters, then initial states
    columns: list[Float[Array, "samples outputs unknowns"]]  # of start, trim and shift
    normal: Normal  # of these, of the priors and of a hold on the initial states

    def reweighted(self, sizes: Sequence[Float[np.ndarray, " outputs"]]) -> "Found":
        """The same, divided by `sizes`; the normal equations as they were."""
        divided = lambda parts: [
            part / jnp.asarray(size).reshape(1, -1, *(1,) * (part.ndim - 2))
            for part, size in zip(parts, sizes, strict=True)
        ]
        parts = (divided(self.misfits), divided(self.slopes), divided(self.columns))
        return Found(*parts, normal=self.normal)


@eqx.filter_jit
def found_at(z: Float[Array, " n"], problem: OutputError) -> Found:
    """Everything at the first parameters and the initial states `z`."""

    def simulated(z):
        values, *starts = split(z, problem)
        model = inserted(values, problem)
        pairs = [parts(model, *each) for each in zip(starts, problem.trials, strict=True)]
        left = [unexplained(*pair) for pair in pairs]
        rest = [prior_misfits(values, problem.base), *(_LOOSE * start for start in starts)]
        return (left, rest), (left, rest, [columns for _, columns in pairs])

    (slopes, others), (left, rest, columns) = jax.jacfwd(simulated, has_aux=True)(z)
    r = jnp.concatenate([one.reshape(-1) for one in (*left, *rest)])
    J = jnp.concatenate([one.reshape(-1, z.size) for one in (*slopes, *others)])
    return Found(left, slopes, columns, Normal(0.5 * jnp.sum(r**2), J.T @ r, J.T @ J))
