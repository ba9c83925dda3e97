"""What the fits of a batch are worth: errors, intervals and verdicts of all of them."""

import dataclasses
import functools as ft
from collections.abc import Sequence
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int, PyTree

from jaxquad._core import pytree_node, STALLED

from .frequency_domain._cost import mixing_of, Points
from .frequency_domain._parameters import Parameters
from .frequency_domain._problem import make_problem, Problem
from .frequency_domain._result import Fit
from .frequency_domain._solve import (
    Solution,
    solution_at,
    solutions_at,
    stopped_early,
    stops_at,
)
from .uncertainty._assess import assess
from .uncertainty._assess_many import assess_many, Assessment
from .uncertainty._error_budget import weighting_at


if TYPE_CHECKING:
    import pandas


_TOGETHER = 64  # members, whose arrays fit the cache


@pytree_node
class BatchFit:
    """Fits of one model to many responses.

    Where solvers stopped is known at once; errors, intervals and what is determined are computed
    for all responses when one of them is first asked for: at once for fits that determine all
    parameters well, and one by one, in 2 ms each, for others. `fit(k)` is the whole result for
    response k.

    Standard errors count what the model leaves unexplained. Values are those of the batch, where
    that is no floor on the random error as it is in `jq.fit`: it would take each response through
    a solution of its own.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[np.ndarray, "batch parameters"]
    costs: Float[np.ndarray, " batch"]
    decrements: Float[np.ndarray, " batch"]  # what one more step would save of half the cost
    steps: Int[np.ndarray, " batch"]
    converged: Bool[np.ndarray, " batch"]
    model: PyTree
    parameters: Parameters
    points: tuple[Points, ...]
    weights: Float[np.ndarray, "batch frequencies outputs inputs 2"]
    mixed: bool = eqx.field(static=True)  # whether points that share noise count together
    z: Float[np.ndarray, "batch parameters"]

    def fit(self, k: int) -> Fit:
        """The fit of response k, with standard errors, verdict and remarks."""
        if "fits" in vars(self):
            return self.fits[k]
        problem = self._problems([k])[0]
        solution = solution_at(problem, self.z[k], self._message(k), int(self.steps[k]))
        return self._assessed(k, problem, solution)

    @ft.cached_property
    def fits(self) -> tuple[Fit, ...]:
        """All of `fit(k)`."""
        return self._fits(list(range(len(self.values))))

    def _fits(self, members: list[int]) -> tuple[Fit, ...]:
        if not members or "fits" in vars(self):
            return tuple(self.fits[k] for k in members)
        problems, messages = self._problems(members), [self._message(k) for k in members]
        steps = self.steps[members].tolist()
        solutions = solutions_at(problems, self.z[members], messages, steps)
        return tuple(map(self._assessed, members, problems, solutions))

    @ft.cached_property
    def _numbers(self) -> Assessment:
        """Of plain fits at once, and of the others one by one."""
        members, parts = np.arange(len(self.values)), []
        for here in np.split(members, members[_TOGETHER::_TOGETHER]):
            problems, points = self._problems(here.tolist()), [self.points[k] for k in here]
            mixings = [problem.mixings[0] for problem in problems]
            stops = stops_at(problems, self.z[here])
            parts.append(assess_many(self.parameters, points, self.weights[here], mixings, stops))
        determined, errors, intervals = map(np.concatenate, zip(*parts, strict=True))
        others = np.flatnonzero(~(determined[:, 0] & self.converged)).tolist()
        for k, fit in zip(others, self._fits(others), strict=True):
            determined[k], errors[k] = fit.determined, fit.standard_errors
            ends = np.array([fit.interval(name) for name in self.names])
            intervals[k] = np.where(fit.determined[:, None], ends, np.nan)
        return Assessment(determined, errors, intervals)

    def _problems(self, members: Sequence[int]) -> list[Problem]:
        """Of responses on the same frequencies: alike but for what was measured."""
        like, problems = make_problem(self.model, self.parameters, [self.points[0].frf]), []
        for k in members:
            points, weights = self.points[k], self.weights[k]
            response = np.asarray(points.frf.response)
            measured = np.where(np.isfinite(response), response, 1.0)
            problem = dataclasses.replace(like, measured=(measured,))
            mixing = mixing_of(points, weights) if self.mixed else None
            problems.append(problem.weighted([weights], [mixing]))
        return problems

    def _message(self, k: int) -> str:
        return "" if self.converged[k] else stopped_early(STALLED, int(self.steps[k]))

    def _assessed(self, k: int, problem: Problem, solution: Solution) -> Fit:
        return assess(problem, weighting_at(problem, [self.points[k]], solution), solution)

    @property
    def standard_errors(self) -> Float[np.ndarray, "batch parameters"]:
        """In the parameters' units; infinite where a parameter has no effect of its own."""
        return self._numbers.standard_errors

    @property
    def determined(self) -> Bool[np.ndarray, "batch parameters"]:
        """Which parameters each response determines individually."""
        return self._numbers.determined

    @property
    def intervals(self) -> Float[np.ndarray, "batch parameters 2"]:
        """The lower and the upper end of the 95 % intervals; nan of what is not determined."""
        return self._numbers.intervals

    def to_dataframe(self) -> "pandas.DataFrame":
        """A table of pandas (extra `interop`): a row per response.

        Each parameter has its value and the ends of its 95 % interval, nan where the response does
        not determine it; `misfit` is the ratio of misfit to random error, `verdict` the kind of
        verdict, and `remarks` what is wrong and what to do.
        """
        import pandas

        values = np.where(self.determined, self.values, np.nan)
        columns = np.concatenate([values[..., None], self.intervals], axis=2)
        suffixes = ("", " low", " high")
        table: dict[str, object] = {
            f"{name}{suffix}": columns[:, k, which]
            for k, name in enumerate(self.names)
            for which, suffix in enumerate(suffixes)
        }
        table["misfit"] = [np.sqrt(fit.chi_squared) for fit in self.fits]
        table["verdict"] = [fit.verdict.kind for fit in self.fits]
        table["remarks"] = ["; ".join(fit.remarks) for fit in self.fits]
        return pandas.DataFrame(table)

    def __str__(self) -> str:
        lost = int(np.sum(~self.converged))
        lines = [f"{len(self.values)} fits; {lost} of them reached no minimum"]
        good = self.values[self.converged]
        if len(good):
            low, middle, high = np.percentile(good, [5, 50, 95], axis=0)
            for row in zip(self.names, middle, low, high, strict=True):
                lines.append("{:<16} median {:11.5g}, 5 to 95 %: {:.5g} .. {:.5g}".format(*row))
        return "\n".join(lines)
