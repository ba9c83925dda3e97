"""Speed of a gradient through the closed loops, and of a whole tune, beside scipy's L-BFGS-B."""

import jax
import pytest
from tuning_case import ensemble, evaluator, flight, loop, objective, STARTS

from jaxquad.tuning import tune


KEY, START = jax.random.key(0), STARTS["certainty equivalence"]


@pytest.mark.parametrize("flown", [True, False], ids=["flights", "linear loops"])
@pytest.mark.parametrize("members", [64, 256])
def test_gradient(benchmark, members, flown):
    cost, start = evaluator(START, members=members, fly=flown)
    cost(start)
    benchmark(cost, start)


def test_tune_with_everything_compiled(benchmark):
    run = lambda: tune(
        loop(START),
        ensemble(),
        flight(),
        objective=objective(),
        key=KEY,
        fresh=None,
        progress=False,
    )
    found = run()
    assert found.converged
    benchmark.pedantic(run, rounds=3)


def test_scipy_with_the_same_gradient(benchmark):
    from scipy.optimize import minimize

    cost, z = evaluator(STARTS["slow"])  # scipy has no first phase: this start is stable
    cost(z)
    benchmark.pedantic(lambda: minimize(cost, z, jac=True, method="L-BFGS-B"), rounds=3)
