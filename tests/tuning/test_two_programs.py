"""An evaluation by two programs is that of the one that does all."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tuning_case import ensemble, equivalent, EVENTS, flight, loop, objective

from jaxquad.tuning import Limit
from jaxquad.tuning._cost import evaluate_cost, stack_copies, Subproblem
from jaxquad.tuning._evaluate import start_costs, trace_costs
from jaxquad.tuning._multipliers import initial_multipliers
from jaxquad.tuning._parameters import select_coordinates
from jaxquad.tuning._problem import make_problem, TimeSpan


pytestmark = pytest.mark.usefixtures("compiled_quickly")

LIMITS = (
    Limit("abscissa", at_most=-0.4),
    Limit("overshoot", at_most=0.2),
    Limit("sensitivity_peak", at_most=1.6),
)


@pytest.mark.slow
def test_flights_and_limits_on_more_loops_are_evaluated_side_by_side():
    controller = equivalent(10.0, 30.0)
    draw = lambda count: ensemble().draw(loop(), count, jax.random.key(count))
    problem = make_problem(controller, draw(4), flight(), draw(12), span=TimeSpan(EVENTS))
    coordinates = select_coordinates(controller)
    multipliers = initial_multipliers(problem, LIMITS, 3)
    assert [x.shape for x in multipliers.values] == [(3, 12), (3, 4), (3, 12)]
    multipliers = multipliers._replace(values=tuple(x + 0.3 for x in multipliers.values))
    fly = jnp.array([True, False, True])
    stacked = (stack_copies(x, 3) for x in (objective(), LIMITS))
    subproblem = Subproblem(*stacked, multipliers, fly, jnp.full(3, -0.75))
    z = coordinates.start + 0.1 * np.arange(3)[:, None]
    given = jnp.asarray(z), jnp.array([True, True, False]), coordinates, problem, subproblem
    trace_costs(*given)
    found, whole = start_costs(*given)(), evaluate_cost(*given)
    for mine, its in zip(jax.tree.leaves(found), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(mine, its, rtol=1e-9, atol=1e-12)
    assert np.all(found.value[:2] > 0) and np.all(np.max(found.beyond[2][:2], axis=1) > 0)
