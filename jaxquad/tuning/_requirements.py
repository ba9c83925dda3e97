"""What a tuning needs of its arguments."""

from collections.abc import Mapping, Sequence

import jax
import numpy as np
from jaxtyping import PyTree

from jaxquad.ensembles import Ensemble, Members
from jaxquad.loops import Loop
from jaxquad.simulation import find_steps, Scenario

from ._gauss_newton import GaussNewton, require_squares
from ._lbfgs import LBFGS
from ._objective import Limit, Objective
from ._problem import Problem


def require_kinds(
    loop: object,
    ensemble: object,
    scenario: object,
    objective: object,
    limits: object,
    method: object,
) -> None:
    """Raise ValueError for an argument of another kind, and for limits on no sum of squares."""
    if not isinstance(loop, Loop):
        raise ValueError(
            f"loop is a {type(loop).__name__}: give jq.Loop(plant, controller, ...), whose "
            "controller is the start"
        )
    if not isinstance(ensemble, Ensemble | Members):
        raise ValueError(
            f"ensemble is a {type(ensemble).__name__}: give jq.Ensemble(inertia=...), or "
            "jq.ensembles.Members of it"
        )
    if not isinstance(scenario, Scenario):
        raise ValueError(
            f"scenario is a {type(scenario).__name__}: give jq.scenario(duration=..., ...)"
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


def require_fresh(fresh: object, drawn: Members, peers: Mapping[str, PyTree] | None) -> None:
    """Raise ValueError for members that are tuned on, and for a peer of the design's name."""
    if "tuned" in (peers or {}):
        raise ValueError("a peer has the name 'tuned' of the design itself: rename it")
    if isinstance(fresh, Members):
        data = [np.asarray(jax.random.key_data(x.keys)) for x in (fresh, drawn)]
        mine, theirs = ({tuple(row) for row in x} for x in data)
        if mine & theirs:
            raise ValueError(
                f"{len(mine & theirs)} of the fresh members are those that are tuned on: a "
                "certificate needs others, as ensemble.fresh(loop, 256, key) draws them"
            )


def require_steps(problem: Problem, wanted: frozenset[str]) -> None:
    """Raise ValueError for an overshoot where there is no step."""
    if "overshoot" not in wanted:
        return
    steps = find_steps(problem.flight.reference, problem.parts)
    if not np.any(np.asarray(steps.is_single & (steps.target != steps.before))):
        raise ValueError(
            "overshoot is wanted, but the reference makes no step from event to event: give a "
            "scenario with one, and its times as Objective(events=...)"
        )
