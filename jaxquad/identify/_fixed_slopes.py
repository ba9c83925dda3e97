import dataclasses

import jax.numpy as jnp
import numpy as np

from ._output_error_descent import Descent
from ._trial import Found, found_at


_STEP = 1e-5  # relative; its square is the error


def with_fixed_slopes(descent: Descent) -> Found:
    """The misfits' slopes by the free parameters, then the fixed, then the initial states.

    Central differences: they serve for names alone, and compile nothing anew.
    """
    parameters, found = descent.problem.base.parameters, descent.found
    count, values = parameters.count, np.asarray(descent.solution.values)
    fixed = [_slopes(descent, k, values) for k in range(count, values.size)]
    slopes = [
        jnp.concatenate([mine[:, :, :count], jnp.stack(others, axis=2), mine[:, :, count:]], axis=2)
        for mine, *others in zip(found.slopes, *fixed, strict=True)
    ]
    return found._replace(slopes=slopes)


def _slopes(descent: Descent, k: int, values: np.ndarray) -> list:
    problem = descent.problem
    ends = []
    for step in (_STEP, -_STEP):
        moved = values.copy()
        moved[k] *= np.exp(step)
        model = problem.base.parameters.replace(problem.base.model, jnp.asarray(moved))
        base = dataclasses.replace(problem.base, model=model)
        ends.append(found_at(descent.z, dataclasses.replace(problem, base=base)).misfits)
    return [(after - before) / (2 * _STEP) for after, before in zip(*ends, strict=True)]
