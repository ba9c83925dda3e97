"""Whether a stationary point is a saddle: the cost a small step to either side of it."""

import functools as ft
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import solve_definite

from ..uncertainty._accuracy import Matrix
from ._evaluate import as_residuals, start_each
from ._parameters import namespace_of, Numbers
from ._problem import Problem, residuals, weigh_parts


_LONGEST = 0.05  # relative step


def look_aside(
    problem: Problem,
    z: Float[np.ndarray, " parameters"],
    here: float,
    bread: Matrix,
    costs: Float[np.ndarray, " sides"] | None,
) -> Callable[[], bool]:
    """Whether the cost is lower than `here`, at `z`, on either side of it.

    Without their `costs` both sides are begun at once; what is returned waits for them.
    """
    later = (lambda: costs) if costs is not None else _begin(problem, z, here, bread)
    return lambda: bool(np.min(later()) < here * (1 - 1e-6) - 1e-12)


def _begin(
    problem: Problem, z: Float[np.ndarray, " parameters"], here: float, bread: Matrix
) -> Callable[[], list[float]]:
    found = start_each(problem, list(_sides(z, bread, np.asarray(here))))

    def costs() -> list[float]:
        with np.errstate(invalid="ignore", over="ignore"):
            return [float(np.sum(as_residuals(problem, each.misfits) ** 2)) for each in found()]

    return costs


def costs_aside(
    z: Float[Array, " parameters"],
    problem: Problem,
    misfits: Float[Array, " residuals"],
    slopes: Float[Array, "all residuals"],
) -> Float[Array, " sides"]:
    """The costs to either side of `z`, from misfits and slopes there, of a single record in JAX."""
    both = jnp.concatenate([misfits[None], slopes[: z.size]])
    parts = both.reshape(len(both), 2, *jnp.moveaxis(problem.measured[0], 0, -1).shape)
    weighed = jax.vmap(ft.partial(weigh_parts, problem, 0))(parts[:, 0], parts[:, 1])
    rows = jnp.concatenate([part.reshape(len(both), -1) for part in weighed], axis=1)
    sides = _sides(z, rows[1:] @ rows[1:].T, rows[0] @ rows[0])
    return jax.vmap(lambda z: jnp.sum(residuals(z, problem) ** 2))(sides)


def _sides(
    z: Float[Numbers, " parameters"],
    bread: Float[Numbers, "parameters parameters"],
    here: Float[Numbers, ""],
) -> Float[Numbers, "sides parameters"]:
    """A small step from `z` to either side along the weakest direction of `bread`."""
    xp = namespace_of(z)
    size = xp.sqrt(xp.maximum(xp.diagonal(bread), 1e-300))
    weakest, curvature = _weakest(bread / (size[:, None] * size[None]))
    weakest = weakest / size
    step = xp.sqrt(1e-2 * xp.maximum(here, 1e-12) / xp.maximum(curvature, 1e-12))
    step = xp.minimum(step, _LONGEST / xp.maximum(xp.max(xp.abs(weakest)), 1e-300))
    return xp.stack([z + step * weakest, z - step * weakest])


_RIDGE = 1e-12  # of a matrix with ones on its diagonal, so that it has an inverse


def _weakest(
    matrix: Float[Numbers, "parameters parameters"],
) -> tuple[Float[Numbers, " parameters"], Float[Numbers, ""]]:
    """The eigenvector of the smallest eigenvalue, and that value."""
    if isinstance(matrix, np.ndarray):
        values, vectors = np.linalg.eigh(matrix)
        return vectors[:, 0], np.asarray(values[0])
    # A kept program that calls LAPACK crashes in a process that has not traced it. So: the 32nd
    # power of the inverse, in whose columns nothing is left but the weakest direction.
    unit = jnp.eye(len(matrix), dtype=matrix.dtype)
    ridged = jnp.broadcast_to((matrix + _RIDGE * unit)[..., None], (*matrix.shape, len(matrix)))
    inverse = solve_definite(ridged, unit)[0]
    power = inverse / jnp.trace(inverse)
    for _ in range(5):
        power = power @ power
    column = power[:, jnp.argmax(jnp.diagonal(power))]
    vector = column / jnp.sqrt(column @ column)
    return vector, vector @ matrix @ vector
