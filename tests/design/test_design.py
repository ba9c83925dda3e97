"""Designs against closed forms, a general convex solver, and simulated flights."""

import functools as ft
from typing import Any

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from synthetic import response_of

import jaxquad as jq
from jaxquad._core import as_float
from jaxquad.design import (
    AOptimal,
    certify_powers,
    DOptimal,
    information_per_energy,
    LargestError,
    least_peak_phases,
    MeasuredNoise,
    multisine_peaks,
    multisine_signals,
    noise_covariance,
    optimal_multisine,
    optimal_powers,
    PowerProblem,
    Powers,
    predict_accuracy,
)


D_OPTIMAL = DOptimal()
RATE, PERIOD, DENSITY = 50.0, 10.0, 2e-4
PLANT = jq.LaggedIntegrator(8.0, 0.1, 0.03, integrators=0)
BAND = (0.6, 20.0)
design_of = ft.partial(
    optimal_multisine, noise=DENSITY, amplitude=1.0, period=PERIOD, sample_rate=RATE, band=BAND
)


def signal_output(plant: Any, time: Any, signal: Any) -> Any:
    return control.forced_response(plant, time, signal).outputs


class Line(eqx.Module):
    """gain + slope omega: a straight line, whose D-optimal design is known."""

    gain: jax.Array = eqx.field(converter=as_float)
    slope: jax.Array = eqx.field(converter=as_float)

    def frequency_response(self, omega):
        value = self.gain + self.slope * omega
        return jax.lax.complex(value, jnp.zeros_like(value))[:, None, None]


class TwoOutputs(eqx.Module):
    """The same plant seen through a mixing of its response and of its response to 1/(s+1)."""

    plant: jq.LaggedIntegrator
    mixing: jax.Array = eqx.field(converter=as_float)

    def frequency_response(self, omega):
        one = self.plant.frequency_response(omega)
        other = jq.TransferFunction([1.0], [1.0, 1.0]).frequency_response(omega)
        both = jnp.concatenate([one, one * other], axis=1)
        return jnp.einsum("ab,fbi->fai", self.mixing.astype(both.dtype), both)


@pytest.fixture(scope="module")
def sharp():
    return design_of(PLANT, lines=1)


def plant_problem(models=1, limits=2):
    """Information per power, and limits, of a few lines."""
    omega = np.linspace(1.0, 20.0, 12)
    rng = np.random.default_rng(3)
    root = rng.standard_normal((models, omega.size, 2, 3))
    costs = np.stack([np.ones(omega.size), (omega / 8) ** 2])[:limits]
    return np.swapaxes(root, 2, 3) @ root, costs


def solve(per_power, costs, criterion=D_OPTIMAL, lines=1):
    share = jnp.asarray(1 / lines, dtype=float)
    options = (criterion, ("a", "b", "c"), share)
    problem = PowerProblem(jnp.asarray(per_power), jnp.asarray(costs), *options)
    found = optimal_powers(problem)
    proof = certify_powers(found, problem)
    return np.asarray(found.power), np.asarray(proof.dispersion), float(proof.gap)


def test_a_straight_line_gets_its_two_ends_in_equal_parts():
    found = design_of(Line(1.0, 0.1), lines=1)
    strong = found.power > 0.1 * found.power.max()
    np.testing.assert_array_equal(found.omega[strong], found.offered[[0, -1]])
    # The powers stop within 3e-4 of the best flight time, and lines next to the ends are near it.
    np.testing.assert_allclose(found.power[strong] / found.power.sum(), 0.5, atol=0.05)


@pytest.mark.slow
def test_the_equivalence_theorem_certifies_the_design(sharp):
    assert sharp.dispersion.max() == pytest.approx(3.0, rel=2e-3)
    used = np.isin(sharp.offered, sharp.omega)
    strong = sharp.power > 0.1 * sharp.power.max()
    np.testing.assert_allclose(sharp.dispersion[used][strong], 3.0, rtol=0.02)
    assert 0.99 < sharp.efficiency <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("models", "limits", "criterion", "lines"),
    [
        (3, 2, DOptimal(), 6),
        (1, 2, AOptimal(), 1),
        (3, 2, LargestError(power=4), 6),
    ],
    ids=["D, three models, two limits, capped", "A, two limits", "worst error, all of it"],
)
def test_powers_are_those_of_a_general_solver(models, limits, criterion, lines):
    per_power, costs = plant_problem(models, limits)
    power, _, gap = solve(per_power, costs, criterion, lines)
    cap = 1 / (lines * costs.max(axis=0))
    assert (costs @ power <= 1 + 1e-9).all() and (power <= cap * (1 + 1e-9)).all()

    def loss(p):
        totals = np.einsum("f,mfpq->mpq", p, per_power)
        inverse = np.linalg.inv(totals)
        if isinstance(criterion, DOptimal):
            return -np.mean(np.linalg.slogdet(totals)[1]) / 3
        norm = 1 if isinstance(criterion, AOptimal) else criterion.power
        variances = np.diagonal(inverse, axis1=1, axis2=2)
        return np.mean(np.log(np.sum(variances**norm, axis=1)) / norm)

    limit = {"type": "ineq", "fun": lambda p: 1 - costs @ p, "jac": lambda p: -costs}
    peer = minimize(loss, power, method="SLSQP", bounds=[(0, c) for c in cap],
                    constraints=[limit], options=dict(maxiter=300, ftol=1e-12))  # fmt: skip
    assert loss(power) - peer.fun <= gap + 1e-8
    assert gap < 4e-4


def test_the_certificate_bounds_bad_powers_too():
    per_power, costs = plant_problem(limits=1)
    best, _, _ = solve(per_power, costs)
    value = lambda p: np.linalg.slogdet(np.einsum("f,fpq->pq", p, per_power[0]))[1] / 3
    options = (DOptimal(), ("a", "b", "c"), jnp.asarray(1.0, dtype=float))
    problem = PowerProblem(jnp.asarray(per_power), jnp.asarray(costs), *options)
    rng = np.random.default_rng(0)
    for other in rng.dirichlet(np.ones(best.size), size=5):
        bad = Powers(jnp.asarray(other), jnp.ones(1))
        gap = float(certify_powers(bad, problem).gap)
        assert 0 < value(best) - value(other) < gap


@pytest.mark.slow
def test_peaks_reach_but_never_pass_the_limits():
    found = design_of(PLANT, rate=6.0, output_amplitude=4.0, lines=8)
    shares = [peak / limit for peak, limit in found.limits.values()]
    assert max(shares) == pytest.approx(1.0, rel=1e-9)
    signal = found.excitation.signal
    assert np.abs(signal).max() <= 1.0 and np.abs(np.diff(signal)).max() * RATE <= 6.0
    plant = control.tf([8.0], [0.1, 1.0])
    time = found.excitation.time
    output = signal_output(plant, time, signal)[time > PERIOD]
    # Straight lines between 50 samples/s lower the output by less than 1 %; the delay shifts it.
    assert np.abs(output).max() == pytest.approx(found.limits["output"][0], rel=0.01)


@pytest.mark.slow
def test_a_rate_limit_moves_power_to_lower_lines_and_costs_information():
    free, slow = (
        design_of(PLANT, lines=8, rate=rate, output_amplitude=100.0) for rate in (100.0, 4.0)
    )
    assert slow.log_determinant < free.log_determinant
    assert (slow.power * slow.omega**2).sum() < (free.power * free.omega**2).sum()


@pytest.mark.slow
def test_lines_sets_how_many_share_the_power():
    found = design_of(PLANT, lines=10)
    assert found.omega.size >= 10
    # Lines too faint to fly are left out, which raises the share of the others.
    assert found.power.max() <= 0.1 * found.power.sum() * 1.02
    assert f"{found.omega.size} of 31 lines" in str(found) and "(lines=10)" in str(found)


@pytest.mark.slow
def test_a_design_for_one_parameter_is_sharpest_there():
    region, delay = (
        design_of(PLANT, lines=8, criterion=each) for each in (DOptimal(), AOptimal(("delay",)))
    )
    k = region.prediction.names.index("delay")
    # Per mean square: the few lines of such a design peak more.
    errors = [each.standard_errors[k] * np.sqrt(each.power.sum()) for each in (region, delay)]
    assert errors[1] < 0.95 * errors[0]
    assert delay.log_determinant < region.log_determinant


def test_phases_peak_less_than_equal_sines_of_schroeder():
    orders = np.arange(3, 40)
    equal = np.full((1, orders.size), 1.0 + 0j)
    phase = least_peak_phases(orders, equal, seed=0)
    index = np.arange(orders.size)
    schroeder = -np.pi * index * (index - 1) / orders.size
    crest = [
        multisine_peaks(orders, each, equal)[0] * np.sqrt(2 / orders.size)
        for each in (phase, schroeder)
    ]
    assert crest[0] < 1.5 < crest[1]


def test_no_peak_hides_between_the_points_that_are_looked_at():
    orders, phase = np.array([1, 7, 16]), np.array([0.3, 1.0, 2.0])
    amplitudes = np.array([[1.0, 0.5, 2.0]]) + 0j
    finest = np.abs(multisine_signals(orders, phase, amplitudes, 100_000)).max()
    assert finest <= multisine_peaks(orders, phase, amplitudes)[0] <= 1.0013 * finest


def test_information_is_that_of_white_noise_in_the_time_domain():
    sigma = 0.3
    signal = jq.multisine(
        jq.excitation.harmonics(*BAND, period=PERIOD, lines=8), period=PERIOD, periods=2,
        sample_rate=RATE, amplitude=1.0,
    )  # fmt: skip
    found = predict_accuracy(PLANT, signal, noise=2 * sigma**2 / RATE)
    spectrum = np.fft.rfft(signal.signal)
    omega = jnp.asarray(2 * np.pi * np.fft.rfftfreq(signal.samples, 1 / RATE))

    def output(change):
        model = jq.LaggedIntegrator(*(np.array([8.0, 0.1, 0.03]) * np.exp(change)), integrators=0)
        response = np.asarray(model.frequency_response(omega))[:, 0, 0]
        return np.fft.irfft(spectrum * response, signal.samples)

    step = 1e-5
    slopes = np.stack([(output(step * e) - output(-step * e)) / (2 * step) for e in np.eye(3)])
    np.testing.assert_allclose(
        found.information, slopes @ slopes.T / sigma**2, rtol=1e-7, atol=1e-5
    )


@pytest.mark.slow
def test_cramer_rao_is_what_a_maximum_likelihood_fit_prints():
    omega = jq.excitation.harmonics(*BAND, period=PERIOD, lines=8)
    signal = jq.multisine(omega, period=PERIOD, periods=2, sample_rate=RATE, amplitude=1.0)
    line_power = 2 * np.abs(np.fft.rfft(signal.signal)[np.round(omega * 20 / 2 / np.pi).astype(int)]
                            / signal.samples) ** 2  # fmt: skip
    error = 0.01
    response = np.abs(np.asarray(PLANT.frequency_response(jnp.asarray(omega))))[:, 0, 0]
    # One-sided noise of the same relative random error at each line.
    density = 2 * 20.0 * line_power * (error * response) ** 2
    found = predict_accuracy(PLANT, signal, noise=lambda w: np.interp(w, omega, density))
    fit = jq.fit(PLANT, response_of(PLANT, error=error, omega=omega))
    np.testing.assert_allclose(found.cramer_rao, fit.cramer_rao, rtol=1e-6)


def test_mixing_the_outputs_and_their_noise_changes_nothing():
    omega = np.linspace(1.0, 10.0, 5)
    mixing = np.array([[1.0, 0.5], [-0.3, 2.0]])
    cross = np.array([[1.0, 0.4 + 0.2j], [0.4 - 0.2j, 2.0]])
    lines = jq.excitation.harmonics(1.0, 10.0, period=PERIOD)
    signal = jq.multisine(lines, period=PERIOD, periods=1, sample_rate=RATE, amplitude=1.0)
    one, other = (
        predict_accuracy(
            TwoOutputs(PLANT, m), signal, free=("plant.gain", "plant.lag"),
            noise=lambda w, m=m: np.broadcast_to(m @ cross @ m.T, (w.size, 2, 2)),
        ).information
        for m in (np.eye(2), mixing)
    )  # fmt: skip
    np.testing.assert_allclose(one, other, rtol=1e-10)
    assert noise_covariance([1.0, 2.0], omega, 2).shape == (5, 2, 2)


def test_noise_is_taken_from_what_an_input_does_not_explain():
    rng = np.random.default_rng(5)
    u, v = rng.standard_normal((2, 20000))
    record = jq.Record(np.arange(u.size) / RATE, u, 3.0 * u + 0.2 * v)
    density = jq.spectra.spectral_density(record, np.geomspace(2.0, 100.0, 20))
    noise = MeasuredNoise(density, ("y",), removed=("u",))
    levels = np.real(noise(np.linspace(3.0, 90.0, 7))[:, 0, 0])
    # White noise of 0.2 at 50 Hz; 80 windows of half the samples leave a scatter of 15 %.
    np.testing.assert_allclose(np.mean(levels), 2 * 0.04 / RATE, rtol=0.2)
    with pytest.raises(ValueError, match="the noise is known from 2 to 100 rad/s, not at 1 rad/s"):
        noise(np.array([1.0]))


@pytest.mark.slow
def test_an_ensemble_serves_a_member_better_than_the_wrong_guess_does():
    wrong = jq.LaggedIntegrator(8.0, 0.01, 0.03, integrators=0)
    one, both = design_of(wrong, lines=1), design_of([wrong, PLANT], lines=1)
    truth = ft.partial(predict_accuracy, PLANT, noise=DENSITY)
    gain = truth(both.excitation).log_determinant - truth(one.excitation).log_determinant
    assert gain > 0.05
    assert len(both.predictions) == 2 and "2 models" in str(both)


@pytest.mark.slow
def test_simulated_flights_scatter_as_predicted():
    sigma, draws = 0.6, 40
    found = design_of(PLANT, noise=2 * sigma**2 / RATE, lines=8, periods=5)
    wave = found.excitation.signal
    spectrum = np.fft.rfft(wave)
    omega = jnp.asarray(2 * np.pi * np.fft.rfftfreq(wave.size, 1 / RATE))
    clean = np.fft.irfft(spectrum * np.asarray(PLANT.frequency_response(omega))[:, 0, 0], wave.size)
    rng, values = np.random.default_rng(0), []
    for _ in range(draws):
        noisy = clean + sigma * rng.standard_normal(wave.size)
        record = jq.Record(found.excitation.time, wave, noisy)
        frf = jq.frequency_response(record, estimator=jq.spectra.Periodic(PERIOD, discard=0))
        options = dict(cost=jq.identify.MaximumLikelihood(), min_coherence=0.01)
        values.append(jq.fit(PLANT, frf, **options).values)  # pyright: ignore
    scatter = np.std(values, axis=0, ddof=1) / np.array([8.0, 0.1, 0.03])
    # 40 draws: 11 %, three of them; weights from five periods cost a few per cent more.
    np.testing.assert_allclose(scatter / found.standard_errors, 1.08, atol=0.35)


@pytest.mark.slow
def test_the_signal_repeats_and_starts_near_zero(sharp):
    wave = sharp.excitation.signal.reshape(4, -1)
    np.testing.assert_array_equal(wave[0], wave[3])
    assert abs(wave[0, 0]) < 0.1
    power = 2 * np.abs(np.fft.rfft(wave[0]) / wave[0].size) ** 2
    bins = np.round(sharp.omega * PERIOD / (2 * np.pi)).astype(int)
    np.testing.assert_allclose(power[bins], sharp.power, rtol=1e-9)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (dict(amplitude=0.0), "amplitude is 0.0, but it must be above 0"),
        (dict(rate=-1.0), "the limit of rate is -1.0"),
        (dict(output_amplitude=[1.0, 2.0]), "output_amplitude has 2 values for 1 outputs"),
        (dict(noise=0.0), "the noise density at .* is 0 units"),
        (dict(noise=[1.0, 2.0]), "noise of shape .* and 1 outputs"),
        (dict(lines=500), "lines is 500, but 31 lines are offered"),
        (dict(band=None), "give either band=.* or omega="),
        (dict(period=10.01), "period of 10.01 s is 500.5 samples"),
        (dict(periods=0), "periods is 0"),
        (dict(input=1), "input is 1: the model has inputs 0 to 0"),
        (dict(criterion=AOptimal(("mass",))), "'mass' is no free parameter"),
    ],
)
def test_a_design_refuses(changes, said):
    with pytest.raises(ValueError, match=said):
        design_of(PLANT, **changes)


def test_what_no_excitation_can_tell_apart_is_named():
    axis = jq.models.AttitudeAxis(0.2, 0.12, 0.055, lag=0.02)
    with pytest.raises(ValueError, match="determines L, J_x one by one: fix one of "):
        design_of(axis, free=("L", "J_x", "lag"))
    with pytest.raises(ValueError, match="the list of models is empty"):
        design_of([])


@pytest.mark.slow
def test_information_grows_with_the_length_of_the_flight(sharp):
    slopes = np.ones((2, 1, 1), complex)
    unit = information_per_energy(slopes, np.full((2, 1, 1), 4.0 + 0j))
    np.testing.assert_allclose(unit[:, 0, 0], 0.5)
    short, long = sharp.prediction, design_of(PLANT, lines=1, periods=16).prediction
    np.testing.assert_allclose(long.standard_errors, short.standard_errors / 2, rtol=1e-9)
    np.testing.assert_allclose(long.seconds_for(short.standard_errors), short.seconds, rtol=1e-9)
