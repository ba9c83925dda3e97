"""Whether a stop is a minimum, and whether it is the only one."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._accuracy import Matrix
from ._problem import Problem, residuals
from ._solve import Solution
from ._starts import Minimum


_ASIDE = 0.05  # longest step to the side, relative
_NEAR = 1.5  # ratio of costs within which another minimum is a rival


def remarks_on_minima(
    problem: Problem, solution: Solution, bread: Matrix, minima: tuple[Minimum, ...]
) -> list[str]:
    """A saddle instead of a minimum, rivals of nearly the same cost, starts that got nowhere."""
    remarks = []
    if solution.converged and _falls_aside(problem, solution, bread):
        remarks.append(
            "stationary, but no minimum: the cost falls to one side; start elsewhere, or give "
            "starts=20"
        )
    found = [point for point in minima if point.is_minimum]
    rivals = [p for p in found[1:] if p.cost <= _NEAR * found[0].cost]
    if rivals:
        values = ", ".join(f"{x:.4g}" for x in rivals[0].values)
        remarks.append(
            f"{len(rivals)} other minima cost less than {_NEAR:g} times the best; the next costs "
            f"{rivals[0].cost:.4g} at {', '.join(problem.parameters.names)} = {values}: another "
            "record or a wider band would tell them apart"
        )
    return remarks


def _falls_aside(problem: Problem, solution: Solution, bread: Matrix) -> bool:
    """Whether the cost is lower a small step to either side along the weakest direction."""
    size = np.sqrt(np.maximum(np.diagonal(bread), 1e-300))
    values, vectors = np.linalg.eigh(bread / np.outer(size, size))
    weakest = vectors[:, 0] / size
    z, here = solution.z, float(_cost(solution.z, problem))
    step = np.sqrt(1e-2 * max(here, 1e-12) / max(values[0], 1e-12))
    step = min(step, _ASIDE / max(np.max(np.abs(weakest)), 1e-300))
    sides = [float(_cost(z + sign * jnp.asarray(step * weakest), problem)) for sign in (1, -1)]
    return min(sides) < here * (1 - 1e-6) - 1e-12


@eqx.filter_jit
def _cost(z: Float[Array, " parameters"], problem: Problem) -> Float[Array, ""]:
    return jnp.sum(residuals(z, problem) ** 2)
