"""The minimisation of a fit alone, which is all that a call of scipy does."""

import numpy as np

from jaxquad.identify import make_problem, MaximumLikelihood, select_parameters
from jaxquad.identify.frequency_domain._solve import solve


class OneSolve(MaximumLikelihood):
    """Maximum likelihood without the second solve under the model's own weights."""

    def weights(self, points, ratio):
        return super().weights(points, np.ones_like(ratio))


def problem_of(model, free, frf, error):
    """The misfits of a response whose random error is the same everywhere."""
    problem = make_problem(model, select_parameters(model, free), [frf])
    return problem.weighted([np.full((*frf.response.shape, 2), 1 / error)])


def descend(problem):
    """`z` at the minimum."""
    parameters = problem.parameters
    return solve(problem, np.asarray(parameters.start[: parameters.count]), None, 256).z
