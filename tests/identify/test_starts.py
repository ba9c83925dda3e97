import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares
from synthetic import OMEGA, response_of

import jaxquad as jq
from jaxquad.identify import (
    make_problem,
    residuals,
    select_parameters,
    solve_from_many,
    spread_starts,
)


TRUTH = jq.LaggedIntegrator(280.0, 0.016, 0.011)
FAR = jq.LaggedIntegrator(1e4, 1.0, 1.0)


def problem_of(model, frf, free=None):
    problem = make_problem(model, select_parameters(model, free), [frf])
    return problem.weighted([jnp.full((*frf.response.shape, 2), 50.0)])


def test_the_given_start_is_the_first_and_the_others_fill_every_layer():
    parameters = select_parameters(jq.LaggedIntegrator(-280.0, 0.016, 0.011), None)
    starts = spread_starts(parameters, 17, fastest=20.0, factor=5.0)
    np.testing.assert_array_equal(starts[0], np.asarray(parameters.start)[:3])
    layers = np.sort(np.floor((starts[1:, 0] - starts[0, 0] + np.log(5)) / np.log(25) * 16))
    np.testing.assert_array_equal(layers, np.arange(16))
    assert np.all(np.asarray(jax.vmap(parameters.values)(jnp.asarray(starts)))[:, 0] < 0)


def test_delays_stay_below_half_a_turn_and_starts_repeat():
    parameters = select_parameters(jq.LaggedIntegrator(280.0, 0.016, 0.1), None)
    one, two = (spread_starts(parameters, 33, fastest=20.0) for _ in range(2))
    np.testing.assert_array_equal(one, two)
    assert np.all(np.exp(one[1:, 2]) <= np.pi / 20 * (1 + 1e-12))


@pytest.mark.parametrize(
    "options, message", [({"count": 0}, "starts is 0"), ({"factor": 1.0}, "factor 1.0")]
)
def test_starts_that_mean_nothing_are_refused(options, message):
    parameters = select_parameters(TRUTH, None)
    with pytest.raises(ValueError, match=message):
        spread_starts(parameters, **{"count": 4, "fastest": 20.0, **options})


@pytest.mark.slow
def test_many_starts_find_the_minimum_that_one_misses_and_list_the_local_ones():
    frf = response_of(TRUTH, seed=0)
    problem = problem_of(FAR, frf)
    starts = spread_starts(problem.parameters, 64, fastest=20.0, factor=1000.0)
    best, minima = solve_from_many(problem, starts, None, 256)
    costs = [point.cost for point in minima]
    assert costs == sorted(costs) and best.converged
    assert sorted(k for point in minima for k in point.starts) == list(range(64))
    assert 0 not in minima[0].starts and len(minima) > 1  # the given start leads elsewhere
    assert minima[0].is_minimum and minima[0].decrement < 1e-9 * minima[0].cost
    np.testing.assert_allclose(minima[0].values, [280.0, 0.016, 0.011], rtol=0.2)

    def peer(z):
        return np.asarray(residuals(jnp.asarray(z), problem))

    # The same minimum as MINPACK's from the truth; scipy's own tolerance is 1e-8.
    exact = least_squares(peer, np.log([280.0, 0.016, 0.011]), method="lm")
    assert minima[0].cost == pytest.approx(2 * exact.cost, rel=1e-9)


class Folded(eqx.Module):
    """A response that is stationary in `b` at 1, where the misfit is largest, not least."""

    b: jax.Array

    def frequency_response(self, omega):
        log = 1 - (self.b - 1) ** 2
        return jnp.exp(log * jnp.ones_like(omega)).astype(complex)[:, None, None]


class Walled(Folded):
    """Not finite above `b` = 2, towards which the misfit falls."""

    def frequency_response(self, omega):
        log = jnp.where(self.b < 2, 3 - self.b, jnp.nan)
        return jnp.exp(log * jnp.ones_like(omega)).astype(complex)[:, None, None]


def constant_response(correlation=0.0):
    frf = response_of(TRUTH, correlation=correlation)
    return eqx.tree_at(lambda f: f.response, frf, jnp.ones_like(frf.response))


@pytest.mark.slow
def test_a_stationary_point_that_is_no_minimum_says_so():
    problem = problem_of(Folded(jnp.asarray(1.0)), constant_response(), (jq.identify.Real("b"),))
    best, points = solve_from_many(problem, np.array([[1.0], [1.5], [0.4]]), None, 256)
    kinds = {start: point.kind for point in points for start in point.starts}
    assert kinds[0].startswith("stationary, but no minimum")
    assert kinds[1] == kinds[2] == "minimum"
    assert abs(abs(best.values[0] - 1.0) - 1.0) < 1e-6


@pytest.mark.parametrize("correlation", [0.0, 0.6], ids=["independent", "shared"])
def test_a_fit_that_stays_on_a_saddle_says_so(correlation):
    at, free = Folded(jnp.asarray(1.0)), (jq.identify.Real("b"),)
    fit = jq.fit(at, constant_response(correlation), free=free)
    assert fit.values == [1.0]
    assert any("no minimum: the cost falls to one side" in remark for remark in fit.remarks)


@pytest.mark.slow
def test_a_stop_at_a_wall_says_so_and_is_not_converged():
    problem = problem_of(Walled(jnp.asarray(1.0)), constant_response(), (jq.identify.Real("b"),))
    best, points = solve_from_many(problem, np.array([[1.0], [0.5], [3.0]]), None, 256)
    *points, nowhere = points
    assert nowhere.starts == (2,) and nowhere.kind.startswith("the model is not finite")
    assert not best.converged and "not finite or not smooth nearby" in best.message
    assert all(
        point.kind.startswith("no minimum: no shorter step") and not point.is_minimum
        for point in points
    )


@pytest.mark.slow
def test_no_finite_start_at_all_is_refused():
    problem = problem_of(Walled(jnp.asarray(1.0)), constant_response(), (jq.identify.Real("b"),))
    with pytest.raises(ValueError, match="not finite at any of 3 starts"):
        solve_from_many(problem, np.array([[3.0], [4.0], [5.0]]), None, 256)


@pytest.mark.slow
def test_an_optimistix_solver_runs_from_every_start_too():
    frf = response_of(TRUTH, seed=0)
    problem = problem_of(jq.LaggedIntegrator(150.0, 0.03, 0.02), frf)
    starts = spread_starts(problem.parameters, 4, fastest=20.0, factor=1.5)
    solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
    ours, _ = solve_from_many(problem, starts, None, 256)
    theirs, _ = solve_from_many(problem, starts, solver, 256)
    np.testing.assert_allclose(theirs.values[:3], ours.values[:3], rtol=1e-7)


class Solved(eqx.Module):
    """A model that solves a linear system by LAPACK at every frequency."""

    rate: jax.Array
    damping: jax.Array

    def frequency_response(self, omega):
        zero, one = jnp.zeros_like(self.rate), jnp.ones_like(self.rate)
        matrix = jnp.stack([jnp.stack([zero, one]), jnp.stack([-self.rate, -self.damping])])
        s = jax.lax.complex(jnp.zeros_like(omega), omega)
        system = s[:, None, None] * jnp.eye(2, dtype=complex)[None] - matrix.astype(complex)[None]
        force = jnp.broadcast_to(jnp.asarray([[0.0], [1.0]], complex), (omega.size, 2, 1))
        return jnp.linalg.solve(system, force)[:, :1]


@pytest.mark.slow
@pytest.mark.timeout(60)
def test_64_starts_of_a_model_that_calls_lapack_do_not_hang():
    truth = Solved(jnp.asarray(20.0), jnp.asarray(3.0))
    problem = problem_of(Solved(jnp.asarray(30.0), jnp.asarray(2.0)), response_of(truth))
    starts = spread_starts(problem.parameters, 64, fastest=float(OMEGA[-1]), factor=2.0)
    best, minima = solve_from_many(problem, starts, None, 256)
    np.testing.assert_allclose(best.values[:2], [20.0, 3.0], rtol=1e-8)
    assert len(minima[0].starts) > 50
