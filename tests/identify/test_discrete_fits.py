"""Discrete transfer functions: fitted, refined, verified and predicted."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, signal

import jaxquad as jq
from jaxquad.identify import ARMA, guess_discrete
from jaxquad.models import DiscreteTransferFunction


DT = 0.01
TRUTH = DiscreteTransferFunction([0.6, -0.56], [1.0, -1.93, 0.942], DT, delay=2)
FREE = ("numerator", "denominator[1]", "denominator[2]")
VALUES = np.array([0.6, -0.56, -1.93, 0.942])
ROUGH = DiscreteTransferFunction([0.5, -0.45], [1.0, -1.9, 0.92], DT, delay=2)


def clean(u, values=VALUES):
    """The output by scipy, from rest: three samples late, two of them by the delay."""
    return np.asarray(signal.lfilter([0.0, 0.0, 0.0, *values[:2]], [1.0, *values[2:]], u))


def by_scipy(b, a, omega):
    return signal.freqz(b, a, omega * DT)[1]  # pyright: ignore


def fly(seed, noise=0.0, colour=((1.0,), (1.0,)), samples=3000, hold=DT):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=samples // 3), 3)
    below, above = colour[1], colour[0]
    y = clean(u) + 0.3 + np.asarray(signal.lfilter(above, below, noise * rng.normal(size=samples)))
    return jq.Record(DT * np.arange(samples), u, y, hold=hold)


def test_an_exact_record_gives_the_exact_values():
    """In one direct step, by output error from a rough start, and past a start in motion."""
    record = fly(0)
    guess = guess_discrete(record, zeros=1, poles=2, delay=2)
    found = np.concatenate([guess.numerator, guess.denominator[1:]])
    np.testing.assert_allclose(found, VALUES, rtol=1e-9)
    assert guess.dt == DT and guess.delay == 2
    moving = jq.records.trim(record, start=4.995, stop=25.0)  # u stood for three samples
    fit = jq.refine(ROUGH, moving, free=FREE)
    np.testing.assert_allclose(fit.values, VALUES, rtol=1e-7)
    check = jq.verify(fit, jq.records.trim(fly(1), start=3.015, stop=20.0))
    assert check.fit_percent > 99.999


def test_coefficients_cross_zero_in_a_fit():
    start = dataclasses.replace(ROUGH, numerator=jnp.array([-0.01, 0.05]))
    fit = jq.refine(start, jq.records.trim(fly(0), start=4.995), free=FREE)
    np.testing.assert_allclose(fit.values, VALUES, rtol=1e-7)


@pytest.mark.parametrize("hold", [DT, 0.0, None])
def test_a_response_of_samples_is_fitted_without_another_hold(hold):
    omega = np.linspace(2.0, 0.98 * np.pi / DT, 50)
    response = by_scipy([0.0, 0.0, 0.0, 0.6, -0.56], [1.0, -1.93, 0.942], omega)
    from_table = jq.FrequencyResponse.from_table
    frf = from_table(omega, response, random_error=0.01, dt=DT, hold=hold)
    fit = jq.fit(ROUGH, frf, free=FREE)
    np.testing.assert_allclose(fit.values, VALUES, rtol=1e-6)
    assert not any(remark.kind == "hold" for remark in fit.remarks)
    if hold == DT:  # the plant before the hold, from the same response
        plant = TRUTH.to_continuous()
        start = jq.TransferFunction(1.1 * plant.numerator, plant.denominator, plant.delay)
        free = ("numerator", "denominator[1]", "denominator[2]")
        other = jq.fit(start, frf, free=free).model
        np.testing.assert_allclose(other.numerator, plant.numerator, rtol=1e-5)
        np.testing.assert_allclose(other.denominator, plant.denominator, rtol=1e-5)


def test_output_error_is_that_of_scipy_over_all_unknowns():
    record = fly(2, noise=0.5, samples=1500)
    u, y = np.asarray(record.inputs)[:, 0], np.asarray(record.outputs)[:, 0]

    def misfit(x):
        # Offset and the free motion of the two poles beside the four coefficients.
        motion = signal.lfilter(x[5:], [1.0, *x[2:4]], np.eye(1, u.size)[0])
        return y - clean(u - u[0], x[:4]) - x[4] - motion

    best = optimize.least_squares(misfit, [*VALUES, 0.3, 0.1, 0.1], x_scale="jac", xtol=1e-14)
    fit = jq.refine(TRUTH, record, free=FREE)
    spread = np.linalg.inv(best.jac.T @ best.jac)[:4, :4] * np.mean(best.fun**2)
    errors = np.sqrt(np.diagonal(spread))
    assert np.all(np.abs(fit.values - best.x[:4]) < 1e-3 * errors)


def test_a_start_in_noise_is_nearer_than_arx():
    """Least squares of y[k] on its past is biased by noise of the output; by 1 / A less."""
    record = fly(3, noise=1.0)
    u, y = np.asarray(record.inputs)[:, 0], np.asarray(record.outputs)[:, 0]
    late = lambda x, n: x[4 - n : len(x) - n]
    columns = [late(u, 3), late(u, 4), -late(y, 1), -late(y, 2), np.ones(len(u) - 4)]
    arx = np.linalg.lstsq(np.column_stack(columns), y[4:], rcond=None)[0][:4]
    guess = guess_discrete(record, zeros=1, poles=2, delay=2)
    off = np.concatenate([guess.numerator, guess.denominator[1:]]) - VALUES
    assert np.max(np.abs(arx - VALUES)) > 0.3 > 0.03 > np.max(np.abs(off))


class Butterworth(eqx.Module):
    """A low-pass of second order by the bilinear transform, of which the cutoff is free."""

    cutoff: float  # rad/s
    dt: float = eqx.field(static=True, default=DT)

    def transfer_function(self):
        w = jnp.tan(self.cutoff * DT / 2)
        above = w**2 * jnp.array([1.0, 2.0, 1.0])
        below = jnp.stack([1 + 2**0.5 * w + w**2, 2 * w**2 - 2, 1 - 2**0.5 * w + w**2])
        return DiscreteTransferFunction(above, below, DT)

    def frequency_response(self, omega):
        return self.transfer_function().frequency_response(omega)


class Unsaid(Butterworth):
    """The same, which does not say that it is discrete."""

    dt: None = eqx.field(static=True, default=None)


def test_a_discrete_model_of_ones_own_is_fitted_and_refined():
    b, a = signal.butter(2, 50.0, fs=2 * np.pi / DT, output="ba")  # pyright: ignore
    u = np.random.default_rng(4).normal(size=2000)
    record = jq.Record(DT * np.arange(2000), u, signal.lfilter(b, a, u), hold=DT)
    fit = jq.refine(Butterworth(80.0), record)
    assert fit["cutoff"] == pytest.approx(50.0, rel=1e-6)
    omega = np.linspace(2.0, 200.0, 40)
    measured = by_scipy(b, a, omega)
    frf = jq.FrequencyResponse.from_table(omega, measured, random_error=0.01, dt=DT, hold=DT)
    assert jq.fit(Butterworth(80.0), frf)["cutoff"] == pytest.approx(50.0, rel=1e-6)
    for attempt in (lambda: jq.fit(Unsaid(80.0), frf), lambda: jq.refine(Unsaid(80.0), record)):
        with pytest.raises(ValueError, match="give it the field dt: float"):
            attempt()


def test_an_unstable_model_is_predicted_ahead():
    """y[k] = 1.02 y[k-1] + 0.1 u[k-1] + noise under proportional feedback."""
    rng, samples = np.random.default_rng(5), 4000
    push, noise, y = rng.normal(size=samples), 0.01 * rng.normal(size=samples), np.zeros(samples)
    u = np.zeros(samples)
    for k in range(samples):
        y[k] = 1.02 * y[k - 1] + 0.1 * u[k - 1] + noise[k] if k else 0.0
        u[k] = push[k] - 2.0 * y[k]
    record = jq.Record(DT * np.arange(samples), u, y, hold=DT)
    model = DiscreteTransferFunction([0.1], [1.0, -1.02], DT)
    check = jq.verify(model, record)
    assert check.prediction is not None and check.verdict.kind == jq.identify.AGREES
    one = jq.predict(model, record).prediction
    assert one is not None
    assert one.deviation == pytest.approx(0.01, rel=0.1)
    assert one.coverage == pytest.approx(0.95, abs=0.02)


def test_what_does_not_go_with_its_samples_is_refused():
    record, fast = fly(6, samples=300), dataclasses.replace(ROUGH, dt=DT / 2)
    flat = lambda *omega, **more: jq.FrequencyResponse.from_table(
        np.array(omega), np.ones(len(omega), complex), random_error=0.1, **more
    )
    frf, high = flat(*np.arange(1.0, 21.0), dt=DT), flat(*np.linspace(20.0, 400.0, 20))
    twice = jq.Record(record.time, np.tile(record.inputs, 2), record.outputs)
    for attempt, message in (
        (lambda: jq.refine(ROUGH, record, free=FREE, hold="zero"), "has its hold in it"),
        (lambda: jq.verify(ROUGH, record, hold="first"), "has its hold in it"),
        (lambda: jq.refine(fast, record, free=FREE), "the data have one every 0.01 s"),
        (lambda: jq.predict(fast, record), "the data have one every 0.01 s"),
        (lambda: jq.fit(fast, frf, free=FREE), "the data have one every 0.01 s"),
        (lambda: jq.fit(ROUGH, high, free=FREE), "above Nyquist's, pi / dt"),
        (lambda: guess_discrete(twice, 1, 2), "jq.records.select"),
        (lambda: guess_discrete(record, 3, 2), "give at least one pole"),
        (lambda: guess_discrete(fly(6, samples=18), 3, 4), "record longer"),
    ):
        with pytest.raises(ValueError, match=message):
            attempt()


def coverage(fits, model_error=True):
    intervals = [[fit.interval(n, model_error=model_error) for n in fit.names] for fit in fits]
    low, high = np.moveaxis(np.array(intervals), 2, 0)
    values = np.array([fit.values for fit in fits])
    covariance = [
        fit.relative_covariance if model_error else fit.relative_noise_covariance for fit in fits
    ]
    errors = np.sqrt([np.diagonal(one) for one in covariance]) * [fit.units for fit in fits]
    errors = np.abs(errors)
    ratio = np.sqrt(np.mean(errors**2, axis=0)) / np.std(values, axis=0)
    bias = (np.mean(values, axis=0) - VALUES) / np.mean(errors, axis=0)
    return np.mean((low <= VALUES) & (high >= VALUES)), ratio, bias


@pytest.mark.slow
def test_intervals_of_a_fitted_response_hold_the_truth():
    omega, error = np.linspace(4.0, 250.0, 30), 0.01
    exact = np.asarray(TRUTH.frequency_response(omega))[:, 0, 0]
    fits = []
    for k in range(150):
        noise = np.random.default_rng(k).normal(size=(2, omega.size))
        measured = exact * (1 + error * (noise[0] + 1j * noise[1]))
        frf = jq.FrequencyResponse.from_table(omega, measured, random_error=error, dt=DT, hold=DT)
        fits.append(jq.fit(TRUTH, frf, free=FREE))
    share, ratio, bias = coverage(fits, model_error=False)
    assert 0.92 < share < 0.98  # 150 draws know it to 1.5 %
    assert np.all(np.abs(ratio - 1) < 0.2) and np.all(np.abs(bias) < 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("colour", [((1.0,), (1.0,)), ((1.0, 0.3), (1.0, -0.8))])
def test_intervals_of_output_error_hold_the_truth_in_95_percent(colour):
    """400 draws know a coverage of 4 correlated numbers to 1 %."""
    fits = [jq.refine(TRUTH, fly(k, 0.5, colour), free=FREE) for k in range(400)]
    share, ratio, bias = coverage(fits)
    assert 0.93 < share < 0.97
    assert np.all(np.abs(ratio - 1) < 0.12) and np.all(np.abs(bias) < 0.2)


@pytest.mark.slow
def test_intervals_of_box_jenkins_hold_the_truth_and_are_the_narrower_ones():
    records = [fly(k, 0.5, ((1.0, 0.3), (1.0, -0.8))) for k in range(100)]
    fits = [jq.refine(TRUTH, one, free=FREE, noise=ARMA(1, 1)) for one in records]
    plain = jq.refine(TRUTH, records[0], free=FREE)
    share, ratio, bias = coverage(fits)
    assert 0.92 < share < 0.98
    assert np.all(np.abs(ratio - 1) < 0.22) and np.all(np.abs(bias) < 0.35)
    assert np.all(fits[0].standard_errors < plain.standard_errors)
    assert np.all(fits[0].standard_errors[:2] < 0.8 * plain.standard_errors[:2])
