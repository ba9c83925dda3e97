"""What is checked before anything is compiled."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxquad.ensembles import Ensemble, Members

from ._gauss_newton import GaussNewton, require_squares
from ._lbfgs import LBFGS
from ._objective import Limit, Objective
from ._problem import Problem, steps_of


def require_kinds(ensemble: Any, objective: Any, limits: Any, method: Any) -> None:
    """Raises ValueError for an argument of another kind, and for limits on no sum of squares."""
    if not isinstance(ensemble, Ensemble | Members):
        name = type(ensemble).__name__
        raise ValueError(
            f"ensemble is a {name}: give jq.Ensemble(plant, ...), or jq.ensembles.Members of it"
        )
    if not isinstance(objective, Objective):
        name = type(objective).__name__
        raise ValueError(f"objective is a {name}: give jq.Objective(terms={{'itae': 1.0}}, ...)")
    if not isinstance(limits, Sequence) or not all(isinstance(x, Limit) for x in limits):
        raise ValueError(f"limits are {limits}: give a list, as [jq.Limit('overshoot', at_most=5)]")
    if not isinstance(method, LBFGS | GaussNewton):
        raise ValueError(f"method is {method!r}: give jq.tuning.LBFGS() or jq.tuning.GaussNewton()")
    if isinstance(method, GaussNewton):
        require_squares(objective, limits)


def require_judges(fresh: Any, drawn: Members, peers: Mapping[str, Any] | None) -> None:
    """Raises ValueError for members that were tuned on, and for a peer of the design's name."""
    if "tuned" in (peers or {}):
        raise ValueError("a peer has the name 'tuned' of the design itself: call it otherwise")
    if isinstance(fresh, Members):
        data = [np.asarray(jax.random.key_data(x.keys)) for x in (fresh, drawn)]
        mine, theirs = ({tuple(row) for row in x} for x in data)
        if mine & theirs:
            raise ValueError(
                f"{len(mine & theirs)} of the fresh members are those that are tuned on: a "
                "certificate needs others, as ensemble.fresh(256, key) draws them"
            )


def require_steps(problem: Problem, wanted: Collection[str]) -> None:
    """Raises ValueError for an overshoot where there is no step."""
    if "overshoot" not in wanted:
        return
    if not np.any(np.asarray(steps_of(problem.flight.reference, problem.parts).known)):
        raise ValueError(
            "overshoot is wanted, but the reference makes no step from event to event: give a "
            "scenario with one, and its times as Objective(events=...)"
        )
