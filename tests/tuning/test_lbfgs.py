"""The L-BFGS that runs many problems in lockstep, beside scipy's."""

import numpy as np
import pytest
from scipy.optimize import minimize

from jaxquad.tuning import LBFGS
from jaxquad.tuning._descent import minimise


ROUGH = LBFGS(evaluations=200, tolerance=1e-12, gradient_tolerance=1e-8, longest_step=10.0)


def rosenbrock(z):
    x, y = z[:-1], z[1:]
    gradient = np.zeros_like(z)
    gradient[:-1] = -400 * x * (y - x**2) - 2 * (1 - x)
    gradient[1:] += 200 * (y - x**2)
    return np.sum(100 * (y - x**2) ** 2 + (1 - x) ** 2), gradient


def walled(z):
    """A bowl that is not a number beyond a wall near its bottom."""
    with np.errstate(invalid="ignore", divide="ignore"):
        value = np.sum(z**2) - 0.01 * np.log(0.1 + z[0])
        gradient = 2 * z
        gradient[0] -= 0.01 / (0.1 + z[0])
    return value, gradient * (np.nan if np.isnan(value) else 1.0)


def together(*functions):
    """Of one function for each problem, and a count of calls for each."""
    calls = np.zeros(len(functions), int)

    def evaluate(z, on):
        calls[:] += on
        both = [f(x) if o else (0.0, 0 * x) for f, x, o in zip(functions, z, on, strict=True)]
        return np.array([b[0] for b in both]), np.stack([b[1] for b in both])

    return evaluate, calls


def starts(count=6, size=5):
    return np.random.default_rng(3).normal(size=(count, size))


def test_it_finds_the_minima_that_scipy_finds_in_about_as_many_evaluations():
    z = starts()
    evaluate, calls = together(*[rosenbrock] * len(z))
    found = minimise(evaluate, z, ROUGH)
    scipys = [
        minimize(rosenbrock, x, jac=True, method="L-BFGS-B", options={"ftol": 1e-14, "gtol": 1e-8})
        for x in z
    ]
    # Of Rosenbrock's function in five dimensions there are two minima: each start has its own.
    np.testing.assert_allclose(found.value, [s.fun for s in scipys], atol=1e-7)
    assert found.converged.all() and np.all(calls == found.evaluations)
    assert np.mean(found.evaluations) < 1.3 * np.mean([s.nfev for s in scipys])


def test_problems_in_lockstep_end_where_each_ends_alone():
    z = starts(3)
    functions = rosenbrock, walled, lambda x: (np.sum((x - 1) ** 4), 4 * (x - 1) ** 3)
    both = minimise(together(*functions)[0], z, ROUGH)
    for k, f in enumerate(functions):
        alone = minimise(together(f)[0], z[k : k + 1], ROUGH)
        np.testing.assert_array_equal(alone.z[0], both.z[k])
        assert alone.evaluations[0] == both.evaluations[k]


def test_a_trial_without_a_finite_cost_is_taken_back():
    z = np.array([[4.0, 3.0]])
    found = minimise(together(walled)[0], z, ROUGH)
    reference = minimize(lambda x: walled(x)[0], z[0], method="Nelder-Mead")
    assert np.all(np.isfinite(found.z)) and found.converged[0]
    assert found.value[0] <= reference.fun + 1e-6
    lost = minimise(together(lambda x: (np.nan, x))[0], z, ROUGH)
    assert "not finite" in lost.reasons[0] and lost.evaluations[0] == 1


def test_no_parameter_moves_further_than_it_may_at_once():
    seen = []

    def steep(x):
        seen.append(x.copy())
        return -1e6 * x[0], np.array([-1e6, 0.0])

    found = minimise(together(steep)[0], np.zeros((1, 2)), LBFGS(evaluations=20))
    assert np.max(np.abs(np.diff(seen, axis=0))) <= 0.5 + 1e-12
    assert found.z[0, 0] > 2.5  # yet it goes on
    assert not found.converged[0] and "20" in found.reasons[0]


def test_what_is_off_stays_and_what_is_enough_stops():
    z = starts(3)
    evaluate, calls = together(*[rosenbrock] * 3)
    enough = lambda problem, value: problem == 2 and value < 10.0
    found = minimise(evaluate, z, ROUGH, on=np.array([True, False, True]), enough=enough)
    np.testing.assert_array_equal(found.z[1], z[1])
    assert calls[1] == 0 and found.evaluations[1] == 0 and not found.converged[1]
    assert found.converged[2] and 1e-3 < found.value[2] < 10.0
    assert found.value[0] < 1e-6 or found.value[0] == pytest.approx(3.93, abs=0.01)
    # The same from the minimum itself: one evaluation tells.
    assert minimise(together(rosenbrock)[0], np.ones((1, 5)), ROUGH).evaluations[0] == 1


def test_options_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="evaluations is 0"):
        LBFGS(evaluations=0)
    with pytest.raises(ValueError, match="longest_step is 0.0"):
        LBFGS(longest_step=0.0)
