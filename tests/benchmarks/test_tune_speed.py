"""Speed of a gradient through the closed loops, and of a whole tune, beside scipy's L-BFGS-B."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tuning_case import ensemble, EVENTS, flight, objective, STARTS

from jaxquad.tuning import tune
from jaxquad.tuning._copies import copies
from jaxquad.tuning._cost import Aim, evaluate
from jaxquad.tuning._parameters import coordinates
from jaxquad.tuning._phases import no_pull
from jaxquad.tuning._problem import problem_of


KEY, START = jax.random.key(0), STARTS["certainty equivalence"]


def gradient(members, flown=True):
    """A function of z that tells value and gradient, over flights or the linear loops alone."""
    problem = problem_of(START, ensemble().draw(members, KEY), flight(), events=EVENTS)
    at, on = coordinates(START), jnp.array([True])
    aim = Aim(
        copies(objective(), 1), (), no_pull(problem, (), 1), jnp.array([flown]), jnp.full(1, -0.75)
    )

    def told(z):
        found = evaluate(jnp.asarray(z)[None], on, at, problem, aim)
        return float(found.value[0]), np.asarray(found.gradient[0])

    return told, at.start


@pytest.mark.parametrize("flown", [True, False], ids=["flights", "linear loops"])
@pytest.mark.parametrize("members", [64, 256])
def test_gradient(benchmark, members, flown):
    told, start = gradient(members, flown)
    told(start)
    benchmark(told, start)


def test_tune_with_everything_compiled(benchmark):
    run = lambda: tune(
        START, ensemble(), flight(), objective=objective(), key=KEY, fresh=None, progress=False
    )
    found = run()
    assert found.converged
    benchmark.pedantic(run, rounds=3)


def test_scipy_with_the_same_gradient(benchmark):
    from scipy.optimize import minimize

    told, _ = gradient(64)
    z = coordinates(STARTS["slow"]).start  # scipy has no first phase: this start is stable
    told(z)
    benchmark.pedantic(lambda: minimize(told, z, jac=True, method="L-BFGS-B"), rounds=3)
