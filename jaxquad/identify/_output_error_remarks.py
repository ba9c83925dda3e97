"""What a reader has to know about an output-error fit before using its numbers."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxquad.records import Record

from ._accuracy import Matrix, scaled_inverse
from ._problem import Problem
from ._remarks import _runaways
from ._solve import Solution


_LEFT = 1e-2  # share of what the noise moves that a step may still save


def remarks_on_output_error(
    base: Problem, solution: Solution, records: Sequence[Record], decrement: float, taken: float
) -> list[str]:
    """Runaway parameters, missing convergence, and feedback."""
    remarks, no_minimum = _runaways(base, solution), decrement > _LEFT * max(taken, 1.0)
    if not solution.converged and (no_minimum or not remarks):
        remarks.append(f"the solver stopped early: {solution.message}")
    if no_minimum:
        remarks.append(
            f"no minimum: one more Gauss-Newton step would lower the cost by {decrement:.3g}, "
            f"where the noise alone accounts for {taken:.3g}; start nearer, for instance from a "
            "frequency-domain fit"
        )
    fed = dict.fromkeys(name for record in records for name in record.reference_names)
    if fed:
        remarks.append(
            f"the record has references ({', '.join(fed)}), so a loop may have been closed: output "
            "error is biased where feedback returns the noise to the input; simulate the loop, or "
            "fit the joint estimate, jq.frequency_response(..., estimator=jq.JointInputOutput())"
        )
    remarks.append(
        "the noise level is that of the residuals, which makes the misfit beside it 1: judge the "
        "model by jq.verify on another record"
    )
    return remarks


def remarks_on_colour(
    misfits: Sequence[Float[np.ndarray, "samples outputs"]], bread: Matrix, covariance: Matrix
) -> list[str]:
    """Residuals so coloured that it matters."""
    white = np.diagonal(scaled_inverse(bread))
    ratio = np.sqrt(np.diagonal(covariance) / np.maximum(white, 1e-300))
    ratio = ratio[ratio > 1e-3]  # what nothing determines has none
    most = float(ratio[np.argmax(np.abs(np.log(ratio)))]) if ratio.size else 1.0
    if 0.67 < most < 1.5:
        return []
    pairs = [np.sum(one[1:] * one[:-1], axis=0) / np.sum(one**2, axis=0) for one in misfits]
    correlation = max(np.concatenate(pairs), key=abs)
    return [
        f"the residuals are coloured (lag-one correlation {correlation:.2f}): standard errors "
        f"allow for it, and are up to {most:.2g} times those under white noise"
    ]
