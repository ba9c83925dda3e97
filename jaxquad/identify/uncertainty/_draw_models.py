"""Models drawn from a fit."""

from typing import NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from jaxquad._core import as_array

from ..frequency_domain._parameters import Parameters
from ._error_budget import Matrix
from ._verdict import NO_MINIMUM, UndeterminedError


if TYPE_CHECKING:
    from ..frequency_domain._result import Fit


def draw_models(
    fit: "Fit", scores: Float[ArrayLike, "parameters members"], *, hold_undetermined: bool = False
) -> PyTree:
    """Draw models from a fit at given standard normal numbers, as `Fit.ensemble` does.

    **Arguments:**

    - `fit`: what to draw from.
    - `scores`: one column for each model.
    - `hold_undetermined`: as in `Fit.ensemble`.

    **Raises:**

    - `UndeterminedError`, `ValueError`: as `Fit.ensemble`.
    """
    check_drawable(fit, hold_undetermined)
    covariance = known_covariance(fit)
    logarithmic = np.array(fit.parameters.logarithmic[: len(fit.names)])
    here, units = np.asarray(fit.values), np.asarray(fit.units)
    at_zero = [fit.names.index(bound.name) for bound in fit.verdict.bounds]
    along = covariance[at_zero] / np.diagonal(covariance)[at_zero, None]
    # In other units than its value a parameter is mixed up with others near zero.
    scaled = logarithmic & (here != 0) & ~np.isclose(units, here, rtol=1e-9, atol=0.0)
    mixed_up = np.setdiff1d(np.flatnonzero(scaled), at_zero)
    relative = np.asarray(fit.relative_covariance)[mixed_up]
    along = np.concatenate([along, relative / relative[np.arange(len(relative)), mixed_up, None]])
    at_zero += mixed_up.tolist()
    logarithmic[at_zero] = False
    variances, directions = np.linalg.eigh(covariance)
    root = directions * np.sqrt(np.maximum(variances, 0.0))
    spread = _Spread(root, tuple(at_zero), along, here, units, logarithmic)
    drawn = jax.tree.leaves(_drawn(fit.parameters, fit.model, spread, as_array(scores)))
    places = (*fit.parameters.places[: len(fit.names)], *(p for p, _ in fit.parameters.ties))
    leaves, structure = jax.tree.flatten(fit.model)
    floating = [
        k
        for k, x in enumerate(leaves)
        if isinstance(x, jax.Array | np.ndarray) and jnp.issubdtype(x.dtype, jnp.inexact)
    ]
    for k in {floating[place.leaf] for place in places}:
        leaves[k] = drawn[k]
    return jax.tree.unflatten(structure, leaves)


class _Spread(NamedTuple):
    """How the free parameters of a fit are drawn."""

    root: Matrix  # of the covariance of relative changes
    at_zero: tuple[int, ...]  # parameters at or near their bound
    along: Float[np.ndarray, "bounds parameters"]  # what changes with each of these
    here: Float[np.ndarray, " parameters"]
    units: Float[np.ndarray, " parameters"]
    logarithmic: Bool[np.ndarray, " parameters"]


@eqx.filter_jit  # as one program: eager, it would be half a dozen for each number of members
def _drawn(
    parameters: Parameters,
    model: PyTree,
    spread: _Spread,
    scores: Float[Array, "parameters members"],
) -> PyTree:
    """The models, with the members on the last axis of every array."""
    changes = spread.root @ scores
    here, units = spread.here[:, None], spread.units[:, None]
    for k, along in zip(spread.at_zero, spread.along, strict=True):
        # Folded to one side of zero, with what goes along with it: they keep their sign.
        drawn = spread.here[k] / spread.units[k] + changes[k]
        folded = jnp.abs(drawn) - drawn
        changes += along[:, None] * folded[None]
    linear = here + units * changes
    # Several that go along with each other may have pushed one back.
    near = np.isin(np.arange(len(linear)), spread.at_zero)[:, None]
    linear = jnp.where(near, jnp.copysign(linear, units), linear)
    values = jnp.where(spread.logarithmic[:, None], here * jnp.exp(changes), linear)
    return jax.vmap(lambda v: parameters.replace(model, v), in_axes=-1, out_axes=-1)(values)


def check_drawable(fit: "Fit", hold_undetermined: bool) -> None:
    """Raise ValueError for a fit that cannot be drawn from, as `Fit.ensemble` says."""
    if not fit.verdict.fitted:
        raise UndeterminedError(f"there is nothing to draw from: {fit.verdict.summary}")
    stopped = [remark for remark in fit.remarks if remark.kind == NO_MINIMUM]
    if stopped:
        raise ValueError(
            f"the fit did not converge, so there is nothing to draw from: {stopped[0]}"
        )
    errors = fit.standard_errors[fit.determined]
    if not (np.all(np.isfinite(fit.relative_covariance)) and np.all(np.isfinite(errors))):
        raise ValueError(
            "the fit's standard errors are not finite, so there is nothing to draw from: use a "
            "response with random errors, and fit again"
        )
    lost = fit.verdict.undetermined
    if lost and not hold_undetermined:
        names, sums = ", ".join(lost), " and ".join(c.name for c in fit.combinations)
        raise UndeterminedError(
            f"the record does not determine {names}{f' (only {sums} is)' if sums else ''}, so they "
            "cannot be drawn: fix them at measured values as far as needed, give a "
            "jq.identify.Prior or a second record; or, for quantities that depend on determined "
            "combinations alone, give hold_undetermined=True"
        )


def known_covariance(fit: "Fit") -> Matrix:
    """The covariance of relative changes, without the directions that are not determined.

    These are undetermined exactly or by the noise; quantities that depend on none of them keep
    their variance.
    """
    verdict, names = fit.verdict, fit.names
    shares = [[row.get(name, 0.0) for name in names] for row in verdict.null_directions]
    null = np.array(shares).reshape(-1, len(names))
    single = np.eye(len(names))[~fit.determined & ~np.any(null, axis=0)]
    # The printed directions leave small shares out; the exact ones must not.
    rest = null - null @ verdict.exact.T @ verdict.exact
    count = len(null) - len(verdict.exact)
    noisy = np.linalg.svd(rest, full_matrices=False)[2][:count] if count > 0 else rest[:0]
    lost = np.linalg.qr(np.concatenate([verdict.exact, noisy, single]).T)[0].T
    keep = np.eye(len(names)) - lost.T @ lost
    return keep @ fit.relative_covariance @ keep
