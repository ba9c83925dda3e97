"""Speed of a whole tune, beside scipy's L-BFGS-B on the same objective.

scipy gets value and gradient of what a user writes with `jq.simulate` and `jq.loops`, compiled.
"""

import jax
import numpy as np
import pytest
from scipy.optimize import minimize
from tuning_case import cost_at, ensemble, flight, loop, objective, start_of, STARTS

from jaxquad.tuning import tune


KEY, MEMBERS = jax.random.key(0), 64


@pytest.fixture(scope="module")
def gradient():
    """Value and gradient by z, from the start that is stable: scipy has no first phase."""
    members = ensemble().draw(loop(), MEMBERS, KEY)
    happens = members.flight(flight())
    cost = lambda z: cost_at(z, STARTS["slow"], members, happens)[0]
    run = jax.jit(jax.value_and_grad(cost))
    run(start_of(STARTS["slow"]))
    return lambda z: tuple(map(np.asarray, run(z)))


def test_gradient(benchmark, gradient):
    benchmark(gradient, start_of(STARTS["slow"]))


def test_tune_with_everything_compiled(benchmark, gradient):
    run = lambda: tune(
        loop(STARTS["certainty equivalence"]), ensemble(), flight(), objective=objective(), key=KEY,
        members=MEMBERS, fresh=None, progress=False,
    )  # fmt: skip
    found = run()
    assert found.converged
    benchmark.pedantic(run, rounds=3)
    # Its cost is that of the formula; what the tuner adds are barriers of a thousandth.
    assert abs(found.cost - gradient(start_of(found.controller))[0]) < 2e-3


def test_scipy_with_the_same_objective(benchmark, gradient):
    start = start_of(STARTS["slow"])
    run = lambda: minimize(gradient, start, jac=True, method="L-BFGS-B")
    benchmark.pedantic(run, rounds=3)
