"""What a tune says of limits and of members on which it failed."""

from collections.abc import Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ._lag_text import lag_remark
from ._limit import Limit
from ._phases import Solution
from ._problem import Problem
from ._tuned import Kept


_ACTIVE = 1e-3  # the multiplier's sum above which a limit costs something


def kept_limits(limits: Sequence[Limit], solution: Solution, index: int) -> tuple[Kept, ...]:
    """Each limit as it was given, on the members that were tuned on."""
    kept = []
    for k, limit in enumerate(limits):
        values = jnp.asarray(solution.told.bounded[k][index])
        excess = float(limit.excess(values))
        found = float(limit.bound) + limit.sign * excess
        acts = float(solution.pull.multipliers[k][index].sum()) > _ACTIVE
        kept.append(Kept(limit, found, excess <= 0, acts))
    return tuple(kept)


def remarks_of(
    controller: Any, problem: Problem, solution: Solution, index: int, kept: Sequence[Kept]
) -> Iterator[str]:
    slowest = np.asarray(solution.told.numbers["abscissa"][index])
    if not solution.able[index]:
        count = int(np.sum(slowest >= 0))
        yield (
            f"{count} of the {slowest.size} members that were tuned on cannot be stabilised from "
            f"here (slowest pole {slowest.max():+.3g} 1/s), so nothing was optimised: start "
            "slower, or narrow the ensemble"
        )
    elif not solution.stabilised[index]:
        yield f"the slowest pole of a member decays at {-slowest.max():.3g} 1/s only"
    missed = [one for one in kept if not one.met]
    for one in missed:
        yield f"the limit on {one.limit} cannot be met: {one.found:.4g} at best"
    if missed or not solution.able[index]:
        remark = lag_remark(controller, problem.loops.delay, problem.loops.axes.lag)
        if remark is not None:
            yield remark
    if solution.refusal and not solution.converged[index]:
        yield f"steps were taken back where the controller refuses its gains: {solution.refusal}"
    if not solution.converged[index] and solution.able[index]:
        yield f"the descent has not converged: {solution.reasons[index]}"
