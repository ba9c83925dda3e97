"""Multipliers of the limits, from one descent to the next."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._copies import one_of
from ._cost import Pull, Told
from ._limit import Limit
from ._problem import Problem
from ._quantities import OF_THE_LOOP


MET = 2e-3  # beyond a limit, as a level: 0.2 %
_STIFFNESS, _STIFFER = 4.0, 4.0


def no_pull(problem: Problem, limits: Sequence[Limit], problems: int) -> Pull:
    """Before anything is known of the limits."""
    sizes = [_constraints(problem, limit) for limit in limits]
    multipliers = tuple(jnp.zeros((problems, size)) for size in sizes)
    return Pull(multipliers, jnp.full((problems, len(sizes)), _STIFFNESS))


def pulled(
    limits: Sequence[Limit],
    told: Told,
    pull: Pull,
    before: Float[np.ndarray, "problems limits"],
    on: Bool[np.ndarray, " problems"],
) -> tuple[Pull, Float[np.ndarray, "problems limits"]]:
    """The next multipliers for problems that are `on`, and how far each limit is missed.

    Where a limit is missed by more than a quarter of what it was `before`, it becomes stiffer.
    """
    keep, multipliers, most = jnp.asarray(on)[:, None], [], []
    for k, beyond in enumerate(_beyond(limits, told)):
        raised = jnp.maximum(pull.multipliers[k] + pull.stiffness[:, k : k + 1] * beyond, 0)
        multipliers.append(jnp.where(keep, raised, pull.multipliers[k]))
        most.append(np.asarray(beyond.max(axis=1)))
    missed = np.stack(most, axis=1)
    slow = jnp.asarray(missed > np.maximum(0.25 * before, MET))
    return Pull(tuple(multipliers), jnp.where(slow & keep, _STIFFER, 1.0) * pull.stiffness), missed


def _constraints(problem: Problem, limit: Limit) -> int:
    """One for each member that a limit is kept on."""
    wide = problem.wide if limit.quantity in OF_THE_LOOP else None
    return problem.members if wide is None else wide.members


def _beyond(limits: Sequence[Limit], told: Told) -> list[Float[Array, "problems members"]]:
    """How far each member is beyond each limit, as levels."""
    problems = range(len(told.value))
    return [
        jnp.stack([one_of(limit, k).beyond(values[k]) for k in problems])
        for limit, values in zip(limits, told.bounded, strict=True)
    ]
