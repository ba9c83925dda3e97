"""One evaluation of a cost by two programs at once, where limits are kept on many linear loops.

What such limits add to the cost is a sum apart from that of the flights. XLA runs a loop on one
core, so the two programs run in two threads.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxquad._core import as_array, begin_in_thread

from ._cost import CostResult, evaluate_cost, evaluate_limits, Multipliers, Subproblem
from ._parameters import Coordinates
from ._problem import Problem
from ._quantities import QUANTITIES


class _Parts(NamedTuple):
    """Arguments of `evaluate_cost`, and those of `evaluate_limits` with the places of its limits.

    Without such limits, and on several devices, the first ones are of the whole.
    """

    flown: tuple[Any, ...]
    analysed: tuple[Any, ...] | None
    places: tuple[int, ...]


def start_costs(
    z: Float[Array, "problems n"],
    on: Bool[Array, " problems"],
    coordinates: Coordinates,
    problem: Problem,
    subproblem: Subproblem,
) -> Callable[[], CostResult]:
    """Begin an `evaluate_cost`; what is returned waits for it, in arrays of NumPy."""
    parts = _take_apart(z, on, coordinates, problem, subproblem)
    given, running = parts.analysed, evaluate_cost(*parts.flown)
    if given is None:
        return lambda: _on_host(running)
    added = begin_in_thread(lambda: _on_host(evaluate_limits(*given)))
    return lambda: _joined(_on_host(running), added(), parts.places)


def trace_costs(*given: Any) -> None:
    """Trace and lower the programs of `start_costs`, which the first one compiles."""
    parts = _take_apart(*given)
    evaluate_cost.begin(*parts.flown)
    if parts.analysed is not None:
        evaluate_limits.begin(*parts.analysed)


def _take_apart(
    z: Float[Array, "problems n"],
    on: Bool[Array, " problems"],
    coordinates: Coordinates,
    problem: Problem,
    subproblem: Subproblem,
) -> _Parts:
    linear = [QUANTITIES[limit.quantity].linear for limit in subproblem.limits]
    whole = z, on, coordinates, problem, subproblem
    if problem.limited is None or not any(linear) or len(problem.linear.devices) > 1:
        return _Parts(whole, None, ())
    alone = dataclasses.replace(problem, limited=None)
    far = tuple(np.flatnonzero(linear).tolist())
    near = [k for k in range(len(linear)) if k not in far]
    return _Parts(
        (z, on, coordinates, alone, _with_limits(subproblem, near)),
        (z, on, coordinates, problem.limited, _with_limits(subproblem, far)),
        far,
    )


def _with_limits(subproblem: Subproblem, places: Sequence[int]) -> Subproblem:
    """With some of the limits."""
    values, stiffness = subproblem.multipliers
    kept = Multipliers(
        tuple(values[k] for k in places), as_array(np.asarray(stiffness)[:, list(places)])
    )
    limits = tuple(subproblem.limits[k] for k in places)
    return subproblem._replace(limits=limits, multipliers=kept)


def _on_host(result: Any) -> Any:
    """Wait for it, in NumPy's arrays, which compile nothing for what follows."""
    return jax.tree.map(np.asarray, result)


def _joined(found: CostResult, added: Any, places: Sequence[int]) -> CostResult:
    """The whole, with limits in their order."""
    limited, beyond = list(found.limited), list(found.beyond)
    for k, place in enumerate(places):  # which rise
        limited.insert(place, added.limited[k])
        beyond.insert(place, added.beyond[k])
    return found._replace(
        value=found.value + added.value,
        gradient=found.gradient + added.gradient,
        limited=tuple(limited),
        beyond=tuple(beyond),
    )
