"""Output-error slopes of all records, brought to as many rows as there are parameters."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._accuracy import Known, Matrix, Noise
from ._coloured import orthonormal, projected_noise
from ._trial import Found, OutputError, Trial


class Seen(NamedTuple):
    """One record at the solution, without what its initial state and trim can explain."""

    misfit: Float[np.ndarray, "samples outputs"]
    slopes: Float[np.ndarray, "samples outputs all"]  # of the misfit, by relative changes
    nuisance: Float[np.ndarray, "samples outputs unknowns"]  # orthonormal


class Reduced(NamedTuple):
    """In the coordinates of orthonormal combinations of the slopes; free parameters first."""

    root: Float[np.ndarray, "all all"]  # slopes
    aim: Float[np.ndarray, " all"]  # misfit
    noise: Float[np.ndarray, "all all"]  # covariance of the noise in the misfit
    output: Float[np.ndarray, " all"]  # measured output


def seen_records(
    problem: OutputError, found: Found, rescale: Float[np.ndarray, " all"]
) -> list[Seen]:
    """The records with slopes by relative changes, clear of the initial states."""
    seen, at = [], rescale.size
    parts = zip(problem.trials, found.misfits, found.slopes, found.columns, strict=True)
    for trial, misfit, slopes, columns in parts:
        slopes, states = np.asarray(slopes), trial.start.size
        own = np.concatenate([np.asarray(columns), slopes[:, :, at : at + states]], axis=2)
        basis = orthonormal(own)
        mine = slopes[:, :, : rescale.size] * rescale
        share = np.einsum("tok,toa->ka", basis, mine)
        seen.append(Seen(np.asarray(misfit), mine - basis @ share, basis))
        at += states
    return seen


def reduced_rows(seen: Sequence[Seen], trials: Sequence[Trial], count: int) -> Reduced:
    """One orthonormal basis of the slopes of all records, and everything else as it shows in it."""
    every = seen[0].slopes.shape[2]
    stacked = np.concatenate([one.slopes.reshape(-1, every) for one in seen])
    basis, root = np.linalg.qr(np.concatenate([stacked, np.zeros((every, every))]))
    aim, output, noise, at = np.zeros(every), np.zeros(every), np.zeros((every, every)), 0
    for one, trial in zip(seen, trials, strict=True):
        mine = basis[at : at + one.misfit.size].reshape(one.slopes.shape)
        measured = np.asarray(trial.y * trial.weights[None])
        aim += np.einsum("tok,to->k", mine, one.misfit)
        output += np.einsum("tok,to->k", mine, measured)
        fitted = np.concatenate([mine[:, :, :count], one.nuisance], axis=2)
        noise += projected_noise(mine, one.misfit, fitted)
        at += one.misfit.size
    return Reduced(root, aim, noise, output)


def gauss_newton(reduced: Reduced, known: Known, count: int) -> tuple[Matrix, np.ndarray, Noise]:
    """`J'J` and `J'r` over the free parameters, and what the noise does to the latter."""
    root, prior = reduced.root[:, :count], known.slopes[:, :count]
    bread = root.T @ root + prior.T @ prior
    gradient = root.T @ reduced.aim + prior.T @ known.misfit
    return bread, gradient, Noise(root.T @ reduced.noise @ root, prior.T @ prior, 0.0)


def signed_root(reduced: Reduced) -> Float[np.ndarray, "rows all"]:
    """Slopes of the output in units of their noise, whose even rows tell the way of the response.

    The first row is the part along the measured output; zeros stand for the other even ones.
    """
    values, vectors = np.linalg.eigh(reduced.noise)
    values = np.maximum(values, max(1e-12 * values[-1], 1e-30))
    whitened = vectors / np.sqrt(values)
    root, along = -whitened.T @ reduced.root, whitened.T @ reduced.output
    turned = np.linalg.qr(np.column_stack([along, np.eye(along.size)]))[0]
    turned[:, 0] *= np.sign(turned[:, 0] @ along) or 1.0
    rows = turned.T @ root
    spaced = np.zeros((2 * len(rows), rows.shape[1]))
    spaced[0], spaced[1 : 2 * len(rows) - 2 : 2] = rows[0], rows[1:]
    return spaced
