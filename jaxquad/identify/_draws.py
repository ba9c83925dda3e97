"""Models drawn from what a fit knows: its calibrated covariance, in the coordinates of the fit."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ._accuracy import Matrix
from ._parameters import Parameters
from ._verdict import UndeterminedError


def draw_models(
    fit: Any, scores: Float[Array, "parameters members"], *, hold_undetermined: bool = False
) -> PyTree:
    """The models at standard normal `scores`; leaves with free or tied numbers get a last axis.

    Parameters that keep their sign are drawn as logarithms, so they keep it. Raises ValueError and
    UndeterminedError as `Fit.ensemble` does.
    """
    values = drawn_values(fit, scores, hold_undetermined=hold_undetermined)
    replaced = _replaced(fit.parameters, fit.model, values)
    places = (*fit.parameters.places[: len(fit.names)], *(p for p, _ in fit.parameters.ties))
    touched, structure = {place.leaf for place in places}, jax.tree.structure(fit.model)
    floating = [k for k, x in enumerate(jax.tree.leaves(fit.model)) if _is_inexact(x)]
    moved = {floating[leaf] for leaf in touched}
    pairs = zip(jax.tree.leaves(fit.model), jax.tree.leaves(replaced), strict=True)
    leaves = [jnp.moveaxis(new, 0, -1) if k in moved else x for k, (x, new) in enumerate(pairs)]
    return jax.tree.unflatten(structure, leaves)


@eqx.filter_jit
def _replaced(
    parameters: Parameters, model: PyTree, values: Float[Array, "parameters members"]
) -> PyTree:
    return jax.vmap(lambda v: parameters.replace(model, v))(values.T)


def drawn_values(
    fit: Any, scores: Float[Array, "parameters members"], *, hold_undetermined: bool = False
) -> Float[Array, "parameters members"]:
    """Physical values of the free parameters."""
    check_drawable(fit, hold_undetermined)
    moves = jnp.asarray(_root(known_covariance(fit))) @ scores
    here, units = jnp.asarray(fit.values)[:, None], jnp.asarray(fit.units)[:, None]
    logarithmic = np.array(fit.parameters.logarithmic[: len(fit.names)])[:, None]
    return jnp.where(logarithmic, here * jnp.exp(moves), here + units * moves)


def check_drawable(fit: Any, hold_undetermined: bool) -> None:
    """Raise ValueError for a fit that says nothing to draw from, UndeterminedError for a part."""
    if not fit.verdict.fitted:
        raise UndeterminedError(f"there is nothing to draw from: {fit.verdict.summary}")
    zeros = _ran_to_zero(fit)
    if zeros:
        raise ValueError(
            f"{', '.join(zeros)} ran to zero, where a logarithm has no spread to draw from: leave "
            "it out of free= (set it to 0), and fit again"
        )
    stopped = [remark for remark in fit.remarks if remark.startswith("no minimum")]
    if stopped:
        raise ValueError(
            f"the fit did not converge, so there is nothing to draw from: {stopped[0]}"
        )
    lost = fit.verdict.undetermined
    known = [fit.standard_errors[k] for k, name in enumerate(fit.names) if name not in lost]
    if not (np.all(np.isfinite(fit.relative_covariance)) and np.all(np.isfinite(known))):
        raise ValueError(
            "the fit's standard errors are not finite, so there is nothing to draw from: use a "
            "response with random errors, and fit again"
        )
    if lost and not hold_undetermined:
        raise UndeterminedError(_refusal(fit, lost))


def known_covariance(fit: Any) -> Matrix:
    """Of relative changes, with the directions held that the record does not determine.

    What depends on none of them keeps its variance.
    """
    held = held_directions(fit)
    keep = np.eye(len(fit.names)) - held.T @ held
    return keep @ fit.relative_covariance @ keep


def held_directions(fit: Any) -> Float[np.ndarray, "held parameters"]:
    """Orthonormal relative changes that the fit calls undetermined, exactly or by its noise."""
    verdict, names = fit.verdict, fit.names
    shares = [[row.get(name, 0.0) for name in names] for row in verdict.null_directions]
    null = np.array(shares).reshape(-1, len(names))
    open_ones = np.array([name in verdict.undetermined for name in names])
    alone = np.eye(len(names))[open_ones & ~np.any(null, axis=0)]
    # The printed directions leave small shares out; the exact ones must not.
    rest = null - null @ verdict.exact.T @ verdict.exact
    count = len(null) - len(verdict.exact)
    noisy = np.linalg.svd(rest, full_matrices=False)[2][:count] if count > 0 else rest[:0]
    return np.linalg.qr(np.concatenate([verdict.exact, noisy, alone]).T)[0].T


def _root(covariance: Matrix) -> Matrix:
    variances, directions = np.linalg.eigh(covariance)
    return directions * np.sqrt(np.maximum(variances, 0.0))


def _ran_to_zero(fit: Any) -> list[str]:
    """Parameters that keep their sign, whose errors are no longer relative to themselves."""
    logarithmic = fit.parameters.logarithmic[: len(fit.names)]
    apart = ~np.isclose(np.abs(fit.units), np.abs(fit.values), rtol=1e-6)
    lost = fit.verdict.undetermined
    rows = zip(fit.names, logarithmic, apart, strict=True)
    return [name for name, log, far in rows if log and far and name not in lost]


def _refusal(fit: Any, lost: tuple[str, ...]) -> str:
    names, known = ", ".join(lost), " and ".join(c.name for c in fit.combinations)
    determined = f" (only {known} is)" if known else ""
    return (
        f"the record does not determine {names}{determined}, which leaves nothing to draw them "
        "from: fix them at measured values as far as needed, give a jq.identify.Prior or a second record; "
        "or, for what depends on determined combinations alone, draw with hold_undetermined=True"
    )


def _is_inexact(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray) and jnp.issubdtype(x.dtype, jnp.inexact)
