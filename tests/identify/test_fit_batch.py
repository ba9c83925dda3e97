import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from sweep_logs import swept
from synthetic import response_of

import jaxquad as jq
from jaxquad._compile import evaluate_once
from jaxquad.identify import fit_batch, make_problem, residuals, select_parameters


OMEGA = jnp.asarray(np.geomspace(0.6, 40.0, 30))
START = jq.TransferFunction([8.0], [1.0, 4.0, 9.0], 0.02)
FREE = ("numerator[0]", "denominator[1]", "denominator[2]", "delay")
MEMBERS = 70  # more than one chunk, and not a multiple of it


def measured(seed=0, noise=0.02):
    """Responses of models that differ by 30 %, with noise."""
    rng = np.random.default_rng(seed)
    factors = np.exp(rng.uniform(-0.3, 0.3, (MEMBERS, 4)))
    s = 1j * np.asarray(OMEGA)
    truth = factors * [8.0, 4.0, 9.0, 0.02]
    exact = np.array([b * np.exp(-d * s) / (s**2 + a1 * s + a0) for b, a1, a0, d in truth])
    white = rng.standard_normal((*exact.shape, 2)) @ np.array([1.0, 1.0j])
    return truth, jnp.asarray(exact * (1 + noise * white))[..., None, None]


class Alike(eqx.Module):
    """All points in use count alike, whatever the model is."""

    def weights(self, points, ratio):
        return np.where(points.used, 50.0, 0.0)[..., None] * np.ones(2)


def frf_of(response, coherence: float | np.ndarray = 0.95):
    like = response_of(START, omega=np.asarray(OMEGA)[: len(response)])
    everywhere = jnp.broadcast_to(jnp.asarray(coherence), like.coherence.shape)
    return dataclasses.replace(like, response=jnp.asarray(response), coherence=everywhere)


def solved(responses, coherence: float | np.ndarray = 0.95, **options):
    frfs = [frf_of(each, coherence) for each in responses]
    return fit_batch(START, frfs, free=FREE, cost=Alike(), **options)


def one_by_one(response):
    """Optimistix' own Levenberg-Marquardt on one member."""
    problem = make_problem(START, select_parameters(START, FREE), [frf_of(response)])
    problem = problem.weighted([jnp.full((*response.shape, 2), 50.0)])
    solver = optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)
    z0 = jnp.asarray(problem.parameters.start[:4])
    found = optx.least_squares(residuals, solver, z0, args=problem, max_steps=256)
    return np.asarray(found.value), np.sum(np.asarray(residuals(found.value, problem)) ** 2)


@pytest.mark.slow
def test_every_member_is_at_the_minimum_that_optimistix_finds():
    _, responses = measured()
    found = solved(responses)
    assert np.all(found.converged) and np.all(found.decrements < 1e-12 * found.costs)
    for k in (0, 63, 69):
        z, cost = one_by_one(responses[k])
        np.testing.assert_allclose(found.z[k], z, atol=1e-8)
        assert found.costs[k] == pytest.approx(cost, rel=1e-12)


@pytest.mark.slow
def test_points_that_share_noise_count_together_as_in_one_fit():
    time, command, rate = swept(1)
    omega = np.geomspace(0.8, 30.0, 24)
    noise = np.random.default_rng(0).normal(0, 0.2, rate.size)
    records = [jq.Record(time, command, rate), jq.Record(time, command, rate + noise)]
    start = jq.LaggedIntegrator(60.0, 0.05, 0.01)
    frfs = [jq.frequency_response(record, omega) for record in records]
    batch = jq.identify.fit_batch(start, frfs)
    assert batch.points[0].correlations
    for k, frf in enumerate(frfs):
        one, member = jq.fit(start, frf), batch.fit(k)
        np.testing.assert_allclose(batch.values[k], one.values, rtol=1e-6)
        np.testing.assert_allclose(member.standard_errors, one.standard_errors, rtol=1e-5)
        assert batch.costs[k] == pytest.approx(one.cost, rel=1e-7)
        assert str(member.verdict) == str(one.verdict)


@pytest.mark.slow
def test_errors_intervals_and_verdicts_of_all_are_those_of_each():
    frfs = [response_of(START, seed=seed) for seed in range(3)]
    coherence = frfs[1].coherence.at[8:].set(0.0)  # slow points alone, which show no delay
    frfs[1] = dataclasses.replace(frfs[1], coherence=coherence)
    fit = lambda: jq.identify.fit_batch(START, frfs, free=FREE)
    batch, singly = fit(), fit()
    errors, determined, intervals = batch.standard_errors, batch.determined, batch.intervals
    for k in range(3):
        one = singly.fit(k)
        np.testing.assert_allclose(errors[k], one.standard_errors, rtol=1e-9)
        np.testing.assert_array_equal(determined[k], one.determined)
        assert str(batch.fit(k).verdict) == str(one.verdict)
        assert batch.fit(k).remarks == one.remarks
        ends = np.array([one.interval(name) for name in batch.names])
        ends[~one.determined] = np.nan
        np.testing.assert_allclose(intervals[k], ends, rtol=1e-9)
    assert determined[0].all() and determined[2].all() and not determined[1].all()
    table = batch.to_dataframe()
    assert table["delay"][0] == batch.values[0, 3] == pytest.approx(0.02, abs=0.01)
    assert table["delay low"][0] == intervals[0, 3, 0]
    assert list(table["verdict"]) == [str(one.verdict.kind) for one in batch.fits]
    np.testing.assert_array_equal(np.isnan(table["delay"]), ~determined[:, 3])


@pytest.mark.slow
def test_many_plain_fits_have_the_numbers_of_single_ones_beside_those_that_are_not_plain():
    frfs = [response_of(START, seed=k, correlation=0.5 * (k % 2)) for k in range(12)]
    omega, notched = np.asarray(frfs[3].omega), frfs[3].response
    notch = 1 - 0.6 / (1 + 1j * (omega / 6 - 6 / omega) / 0.2)
    frfs[3] = dataclasses.replace(frfs[3], response=notched * notch[:, None, None])
    frfs[5] = dataclasses.replace(frfs[5], random_error=8 * frfs[5].random_error)
    batch = jq.identify.fit_batch(START, frfs, free=FREE)
    errors, determined, intervals = batch.standard_errors, batch.determined, batch.intervals
    for k in range(12):
        one = batch.fit(k)
        np.testing.assert_allclose(errors[k], one.standard_errors, rtol=1e-12)
        np.testing.assert_array_equal(determined[k], one.determined)
        ends = np.array([one.interval(name) for name in batch.names])
        ends[~one.determined] = np.nan
        np.testing.assert_allclose(intervals[k], ends, rtol=1e-12)
    assert any("misfit" in remark for remark in batch.fit(3).remarks)
    # The notch is in the place of the natural frequency: what it may move is in no plain error.
    assert np.max(errors[3]) > 2 * np.median(np.max(errors, axis=1))


@pytest.mark.slow
def test_all_ways_to_the_normal_equations_end_at_the_same_minimum():
    frfs = [response_of(START, correlation=c, seed=k) for k, c in enumerate((0.6, 0.0, 0.3))]
    fit = lambda: jq.identify.fit_batch(START, frfs, free=FREE)
    kernels = fit()
    jq.engine(kernel="off")
    try:
        jax.clear_caches()
        plain = fit()
    finally:
        jq.engine(kernel="auto")
        jax.clear_caches()
    np.testing.assert_allclose(kernels.values, plain.values, rtol=1e-8)
    np.testing.assert_allclose(kernels.costs, plain.costs, rtol=1e-12)


@pytest.mark.slow
def test_state_spaces_are_fitted_as_single_ones_are():
    F, G = [[-1.0, 0.3], [0.2, -4.0]], [[2.0], [1.5]]
    truth = jq.StateSpace(F=F, G=G, H0=np.eye(2), input_delay=[0.05])
    start = jq.StateSpace(F=np.multiply(F, 1.2), G=G, H0=np.eye(2), input_delay=[0.04])
    free = ("F[0][0]", "F[1][1]", "G[0][0]", "G[1][0]", "input_delay[0]")
    frfs = [response_of(truth, seed=k) for k in range(3)]
    batch = jq.identify.fit_batch(start, frfs, free=free)
    for k, frf in enumerate(frfs):
        one = jq.fit(start, frf, free=free)
        np.testing.assert_allclose(batch.values[k], one.values, rtol=1e-7)
        assert batch.costs[k] == pytest.approx(one.cost, rel=1e-10)


class Accelerator:
    """As a GPU says of itself."""

    platform = "gpu"

    def __init__(self, gigabytes):
        self.bytes_limit = int(1e9 * gigabytes)

    def memory_stats(self):
        return {"bytes_limit": self.bytes_limit, "bytes_in_use": 0}


@pytest.mark.slow
@pytest.mark.parametrize("gigabytes", [80.0, 1e-5])  # all side by side, and by chunks
def test_all_side_by_side_as_on_an_accelerator_they_are_the_same_fits(monkeypatch, gigabytes):
    _, responses = measured()
    F, G = [[-1.0, 0.3], [0.2, -4.0]], [[2.0], [1.5]]
    states = jq.StateSpace(F=F, G=G, H0=np.eye(2), input_delay=[0.05])
    shared = [response_of(START, correlation=0.5, seed=k, omega=np.asarray(OMEGA)) for k in (0, 1)]

    def fits():
        free = ("F[0][0]", "G[0][0]", "input_delay[0]")
        several = fit_batch(states, [response_of(states, seed=k) for k in range(3)], free=free)
        return solved(responses), several, fit_batch(START, shared, free=FREE)

    mine = fits()
    device = Accelerator(gigabytes)
    monkeypatch.setattr("jaxquad.identify._fit_batch.default_device", lambda: device)
    for one, other in zip(mine, fits(), strict=True):
        np.testing.assert_allclose(one.values, other.values, rtol=1e-8)
        np.testing.assert_allclose(one.costs, other.costs, rtol=1e-10)
        assert np.array_equal(one.converged, other.converged)


@pytest.mark.slow
def test_other_numbers_of_members_and_frequencies_compile_nothing():
    _, responses = measured()
    compiled, responses = [], np.asarray(responses)

    def listen(event: str, duration_secs: float, **facts: str | int):
        if "backend_compile" in event:
            compiled.append(facts.get("fun_name"))

    cases = [(members, [frf_of(x[:frequencies]) for x in responses[:members]])
             for members, frequencies in ((1, 30), (7, 25), (65, 27), (MEMBERS, 30))]  # fmt: skip
    for some in (responses, responses[:2]):
        solved(some)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for members, frfs in cases:
            found = fit_batch(START, frfs, free=FREE, cost=Alike())
            assert len(found.z) == members and np.all(found.converged)
    finally:
        jax.monitoring.clear_event_listeners()
    assert not compiled


@pytest.mark.slow
def test_without_noise_the_truth_comes_back():
    truth, responses = measured(noise=0.0)
    np.testing.assert_allclose(solved(responses).values, truth, rtol=1e-9)


@pytest.mark.slow
def test_points_of_no_weight_may_hold_anything():
    _, responses = measured()
    coherence = np.where(np.arange(OMEGA.size) < 20, 0.95, 0.0)[:, None, None]
    spoilt = responses.at[:, 20:].set(jnp.nan)
    clean, dirty = solved(responses, coherence), solved(spoilt, coherence)
    np.testing.assert_array_equal(dirty.z, clean.z)


@pytest.mark.slow
def test_a_member_that_is_no_minimum_says_so():
    _, responses = measured()
    short = solved(responses, max_steps=1)
    assert not np.any(short.converged) and np.all(short.decrements > 1e-6 * short.costs)
    with np.errstate(divide="ignore", invalid="ignore"):
        spoilt = solved(responses.at[3, 5].set(0.0))
    assert not spoilt.converged[3] and np.sum(spoilt.converged) == MEMBERS - 1


class Detrended(eqx.Module):
    """A response that depends on which frequencies are asked for."""

    gain: jax.Array

    def frequency_response(self, omega):
        return (self.gain * (omega - jnp.mean(omega))).astype(complex)[:, None, None]


def test_input_that_means_nothing_is_refused():
    frfs = [frf_of(each) for each in measured()[1]]
    with pytest.raises(ValueError, match="frequencies"):
        fit_batch(START, [*frfs, frf_of(frfs[0].response[:9])], free=FREE)
    with pytest.raises(ValueError, match="depends on the other frequencies"):
        fit_batch(Detrended(jnp.asarray(2.0)), frfs)


def test_expensive_functions_evaluated_once_are_the_same_functions():
    x = jnp.asarray(np.random.default_rng(0).uniform(0.5, 2.0, (64, 32)))
    y = jax.lax.complex(x, 3 - x)

    def function(x, y):
        return jnp.exp(-y) / y, jnp.arctan2(x, 1 + x) + jnp.sqrt(x), y**-2, jnp.abs(y), x[:3] / 3

    for got, expected in zip(jax.jit(evaluate_once(function))(x, y), function(x, y), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-14)
