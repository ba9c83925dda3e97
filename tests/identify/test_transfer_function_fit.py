"""Transfer functions of given orders from a response alone (CIFER's NAVFIT)."""

import importlib.util
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT
from scipy.optimize import least_squares
from synthetic import response_of

import jaxquad as jq
from jaxquad.identify import factors, fit_transfer_function, guess_transfer_function


OMEGA = np.geomspace(0.3, 60.0, 60)
K, LAG, ZETA, WN, DELAY = 18.0, 0.045, 0.55, 7.0, 0.018
DENOMINATOR = np.convolve([1.0, 2 * ZETA * WN, WN**2], [1.0, 1 / LAG])
EQ_14 = jq.identify.CoherenceWeighted()
PLANT = jq.TransferFunction([K * WN**2 / LAG], DENOMINATOR, DELAY)
COEFFICIENTS = np.concatenate([[K * WN**2 / LAG], DENOMINATOR[1:], [DELAY]])


def model_of(zeros, poles, gain=1.0, delay=0.0):
    above, below = (np.real(np.poly(roots)) for roots in (zeros, poles))
    return jq.TransferFunction(gain * np.atleast_1d(above), np.atleast_1d(below), delay)


def pair_of(zeta, omega):
    root = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
    return [root, np.conj(root)]


def log_ratio(model, frf):
    """`ln|T/T^|` and the wrapped phase of T/T^, with numpy alone."""
    s = 1j * np.asarray(frf.omega)
    above, below = (np.polyval(np.asarray(c), s) for c in (model.numerator, model.denominator))
    ratio = above / below * np.exp(-float(model.delay) * s) / np.asarray(frf.response)[:, 0, 0]
    return np.log(np.abs(ratio)), np.angle(ratio)


def residual_14(model, frf):
    """Roots of the terms of Eq. (14)."""
    magnitude, phase = log_ratio(model, frf)
    trust = 1.58 * (1 - np.exp(-np.asarray(frf.coherence)[:, 0, 0]))
    parts = [20 / np.log(10) * magnitude, np.sqrt(0.01745) * np.degrees(phase)]
    return np.concatenate([np.sqrt(20 / magnitude.size) * trust * part for part in parts])


def scipy_minimum(start, frf, *, delay):
    """An independent minimum of Eq. (14) from the same start, coefficients over their size."""
    count = np.asarray(start.numerator).size
    own = [np.asarray(start.numerator), np.asarray(start.denominator)[1:]]
    size = np.concatenate([*own, [float(start.delay)] if delay else []])

    def model(x):
        values = x * size
        below = np.concatenate([[1.0], values[count : count + own[1].size]])
        late = values[-1] if delay else float(start.delay)
        return PlainModel(values[:count], below, late)

    peer = least_squares(
        lambda x: residual_14(model(x), frf), np.ones(size.size), method="lm",
        xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=5000,
    )  # fmt: skip
    return peer.x * size, 2 * peer.cost


class PlainModel:
    """A transfer function without checks, so that a peer may step where it likes."""

    def __init__(self, numerator, denominator, delay):
        self.numerator, self.denominator, self.delay = numerator, denominator, delay


# Each is recovered from its response alone: zeros, poles, gain, delay, fixed integrators, range.
PLANTS = {
    "unstable": model_of([], [2.0, -20.0], 30.0, 0.02),
    "non-minimum-phase": model_of([5.0], [-1.0, -20.0], -4.0, 0.01),
    "double integrator with lag": model_of([], [0.0, 0.0, -30.0], 900.0, 0.015),
    "repeated poles": model_of([], [-6.0, -6.0, -6.0], 200.0),
    "lightly damped": model_of(pair_of(0.01, 9.0), pair_of(0.005, 12.0) + [-3.0], 2.0, 0.005),
    "long delay": model_of([], [-2.0], 3.0, 0.4),
    "high order": model_of(
        [-0.5, *pair_of(0.05, 8.0), *pair_of(0.1, 25.0), 70.0],
        [*pair_of(0.2, 0.9), *pair_of(0.04, 10.0), *pair_of(0.03, 30.0), -15.0, -40.0],
        500.0,
    ),
    "static gain": model_of([], [], -2.5, 0.1),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANTS)
def test_a_plant_is_recovered_from_its_response_alone(name):
    truth = PLANTS[name]
    zeros, poles = len(truth.zeros), len(truth.poles)
    frf = response_of(truth, omega=OMEGA)
    guess = guess_transfer_function(frf, zeros, poles)
    # Converged to rounding; coefficients of roots that lie together cost some digits.
    assert max(np.max(np.abs(part)) for part in log_ratio(guess, frf)) < 1e-8
    np.testing.assert_allclose(guess.numerator, truth.numerator, rtol=1e-6)
    largest = np.max(np.abs(np.asarray(truth.denominator)))
    np.testing.assert_allclose(guess.denominator, truth.denominator, rtol=1e-6, atol=1e-7 * largest)
    assert float(guess.delay) == pytest.approx(float(truth.delay), abs=1e-8)


@pytest.mark.slow
def test_six_decades_of_frequency_and_of_magnitude_are_no_obstacle():
    truth = model_of([-0.1, -30.0], [-0.004, *pair_of(0.3, 3.0), -800.0], 5e4)
    frf = response_of(truth, omega=np.geomspace(1e-3, 1e3, 120))
    guess = guess_transfer_function(frf, 2, 4)
    np.testing.assert_allclose(np.sort(guess.poles), np.sort(truth.poles), rtol=1e-6)
    np.testing.assert_allclose(np.sort(guess.zeros), np.sort(truth.zeros), rtol=1e-6)
    double = response_of(model_of([], [0.0, 0.0, -50.0], 1e3), omega=np.geomspace(0.01, 1e3, 120))
    held = guess_transfer_function(double, 0, 3, integrators=2)
    np.testing.assert_allclose(held.denominator, [1.0, 50.0, 0.0, 0.0], rtol=1e-8)


def test_a_partly_coherent_noisy_response_gives_a_start_near_the_truth():
    frf = response_of(PLANT, error=0.07, seed=3, omega=OMEGA)  # 20 dB: 0.1 of each response
    spoilt = (OMEGA > 4.0) & (OMEGA < 6.0) | (OMEGA > 45.0)
    response = np.where(spoilt, 37.0 - 5j, np.asarray(frf.response)[:, 0, 0])
    coherence = np.where(spoilt, 0.05, 0.9)
    frf = replaced(frf, response=response, coherence=coherence)
    guess = guess_transfer_function(frf, 0, 3)
    magnitude, phase = log_ratio(guess, response_of(PLANT, omega=OMEGA))
    # 40 points, 0.07 each, 5 unknowns: the fitted response is uncertain by 0.025 on average.
    assert np.sqrt(np.mean(magnitude**2 + phase**2)) < 0.1


def replaced(frf, *, response, coherence):
    import dataclasses

    shape = frf.response.shape
    return dataclasses.replace(
        frf,
        response=jnp.asarray(response.reshape(shape)),
        coherence=jnp.asarray(coherence.reshape(shape)),
    )


def random_plant(rng, order):
    """Stable and unstable, damped and not, minimum-phase and not, late and not."""

    def roots(count, unstable):
        found = []
        while len(found) < count:
            if count - len(found) >= 2 and rng.random() < 0.5:
                found += pair_of(rng.uniform(0.03, 0.9), 10 ** rng.uniform(-0.3, 1.3))
            else:
                side = 1.0 if rng.random() < unstable else -1.0
                found.append(side * 10 ** rng.uniform(-0.5, 1.5))
        return found

    zeros, poles = roots(rng.integers(0, order), 0.3), roots(order, 0.25)
    delay = rng.uniform(0.0, 0.1) if rng.random() < 0.6 else 0.0
    return model_of(zeros, poles, 10 ** rng.uniform(-2, 2) * rng.choice([1.0, -1.0]), delay)


@pytest.mark.slow
def test_automatic_starts_reach_the_lowest_minimum_of_random_plants():
    rng, reached = np.random.default_rng(7), []
    for k in range(20):
        truth = random_plant(rng, 1 + k % 6)
        frf = response_of(truth, error=0.05, seed=k, omega=OMEGA)
        guess = guess_transfer_function(frf, len(truth.zeros), len(truth.poles), cost=EQ_14)
        late = float(truth.delay) > 0
        reference = scipy_minimum(truth, frf, delay=late)[1]
        # A guess whose delay stopped at 0 may be above a peer's that went below it.
        reached.append(np.sum(residual_14(guess, frf) ** 2) <= reference * (1 + 1e-4))
    assert np.mean(reached) >= 0.95


@pytest.mark.slow
@pytest.mark.parametrize("seed", [None, 0])
def test_the_minimum_is_that_of_scipy_and_the_plant_is_recovered(seed):
    frf = response_of(PLANT, seed=seed, omega=OMEGA)
    fit = fit_transfer_function(frf, zeros=0, poles=3, cost=EQ_14)
    start = jq.TransferFunction(1.1 * COEFFICIENTS[:1], PLANT.denominator, 1.1 * DELAY)
    values, cost = scipy_minimum(start, frf, delay=True)
    np.testing.assert_allclose(fit.values, values, rtol=1e-6)
    assert fit.cost == pytest.approx(cost, rel=1e-6, abs=1e-15)
    assert fit.identifiable and not fit.remarks
    assert fit.names[0] == "numerator[0]" and fit.names[-1] == "delay"
    off = fit.values - COEFFICIENTS
    limit = 1e-6 * np.abs(COEFFICIENTS) if seed is None else 3 * fit.standard_errors
    assert np.all(np.abs(off) < limit)


@pytest.mark.slow
def test_errors_of_the_roots_are_those_of_repeated_noise():
    exact = fit_transfer_function(response_of(PLANT, omega=OMEGA), 0, 3)
    found = factors(exact)
    pair, lag = found.poles
    assert pair.values == pytest.approx((ZETA, WN), rel=1e-6)
    assert lag.values == pytest.approx((1 / LAG,), rel=1e-6)
    drawn = []
    for seed in range(30):
        guess = guess_transfer_function(response_of(PLANT, seed=seed, omega=OMEGA), 0, 3)
        poles = guess.poles
        upper, real = poles[np.imag(poles) > 0][0], poles[np.imag(poles) == 0][0]
        size = abs(upper)
        drawn.append([-upper.real / size, size, -real.real, guess.numerator[0], guess.delay])
    spread = np.std(np.array(drawn), axis=0, ddof=1)
    told = [*pair.standard_errors, *lag.standard_errors]
    told += [found.gain.standard_error, found.delay.standard_error]
    # A standard deviation from 30 draws is itself uncertain by 13 %.
    np.testing.assert_allclose(told, spread, rtol=0.4)
    assert "[0.55 +- 0.0042, 7 +- 0.031] (22.22 +- 0.36)" in str(found)


@pytest.mark.slow
def test_a_pole_and_a_zero_that_cancel_are_not_identifiable():
    frf = response_of(PLANT, seed=1, omega=OMEGA)
    fit = fit_transfer_function(frf, zeros=1, poles=4)
    text = str(fit)
    assert not fit.identifiable and text.startswith("NOT IDENTIFIABLE")
    assert not fit.determined.any() and np.isfinite(fit.values).all()
    assert "zeros=0, poles=3 explain the response as well" in text
    with pytest.raises(jq.identify.UndeterminedError, match="zeros=0, poles=3"):
        factors(fit)


@pytest.mark.slow
def test_a_pole_that_leaves_the_band_takes_the_gain_along():
    slow = response_of(model_of([], pair_of(0.4, 5.0), 20.0, 0.02), seed=2, omega=OMEGA)
    fit = fit_transfer_function(slow, zeros=0, poles=3)
    assert not fit.identifiable and not fit.determined[0]
    assert "zeros=0, poles=2 are enough" in fit.verdict.reasons[0]
    assert np.isnan(factors(fit).gain.value)
    pair = next(pole for pole in factors(fit).poles if len(pole.values) == 2)
    error = pair.standard_errors[1]
    assert abs(pair.values[1] - 5.0) < 3 * error < 0.5


@pytest.mark.slow
def test_repeated_roots_are_flagged_and_have_no_error():
    triple = model_of([], [-6.0, -6.0, -6.0], 200.0, 0.01)
    found = factors(fit_transfer_function(response_of(triple, seed=1, omega=OMEGA), 0, 3))
    assert all(pole.repeated and np.isnan(pole.standard_errors).all() for pole in found.poles)
    assert "~" in str(found) and "repeated within its error" in str(found)


@pytest.mark.slow
def test_a_delay_that_runs_to_zero_is_fixed_there_and_so_are_integrators():
    early = model_of([], [0.0, -9.0], 40.0)
    frf = response_of(early, omega=OMEGA)
    ahead = np.asarray(frf.response)[:, 0, 0] * np.exp(0.002j * OMEGA)
    frf = replaced(frf, response=ahead, coherence=np.full(OMEGA.size, 0.95))
    fit = fit_transfer_function(frf, zeros=0, poles=2, integrators=1)
    assert float(fit.model.delay) == 0 and fit.names == ("numerator[0]", "denominator[1]")
    assert "/ ((0) (" in str(factors(fit)) and "exp" not in str(factors(fit))
    assert "the delay ran to zero: it is fixed at 0" in fit.remarks
    assert np.isfinite(fit.values).all()
    with pytest.raises(ValueError, match="fit a jq.TransferFunction"):
        factors(jq.fit(jq.LaggedIntegrator(20.0, 0.1, 0.01), frf))


@pytest.mark.slow
def test_the_cessna_agrees_with_cifer(data):
    path = ROOT / "fits" / "cessna_navfit.py"
    spec = importlib.util.spec_from_file_location("cessna_navfit", path)
    assert spec and spec.loader
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jq.records.RecordWarning)  # of 20 to 50 ms between samples
        (file,) = (data / "cessna_xplane").glob("*.npy")
        frf, fit = script.identify(script.read_sweep(file))
    found = factors(fit)
    pair = next(pole for pole in found.poles if len(pole.values) == 2)
    assert pair.values == pytest.approx((0.6259, 6.1057), rel=0.02)  # as CIFER printed
    assert found.gain.value == pytest.approx(-7.02929, rel=0.05)
    assert found.zeros[0].values[0] == pytest.approx(2.8899, rel=0.05)
    assert fit.cost < 2.943
    values, cost = scipy_minimum(fit.model, frf, delay=False)
    np.testing.assert_allclose(fit.values, values, rtol=1e-6)
    assert fit.cost == pytest.approx(cost, rel=1e-6)
    assert "CIFER" in script.compared(fit)


@pytest.mark.parametrize(
    "options, message",
    [
        (dict(zeros=2, poles=1), "at most as many zeros"),
        (dict(zeros=0, poles=1, integrators=2), "integrators count among"),
        (dict(zeros=-1, poles=1), "zeros=-1: give a whole number"),
        (dict(zeros=0, poles=1, delay=-0.1), 'delay=-0.1: give "free"'),
        (dict(zeros=0, poles=1, output="p"), "output='p'"),
        (dict(zeros=30, poles=30), "61 coefficients|62 coefficients"),
        (dict(zeros=0, poles=1, band=(100.0, 200.0)), "holds none"),
    ],
)
def test_orders_that_mean_nothing_are_refused(options, message):
    frf = response_of(PLANT, omega=OMEGA)
    with pytest.raises(ValueError, match=message):
        guess_transfer_function(frf, **options)


@pytest.mark.slow
def test_one_pair_of_several_is_picked_with_its_own_errors():
    axes = response_of(PLANT, error=0.03, omega=OMEGA)
    two = two_outputs(axes)
    guess = guess_transfer_function(two, 0, 3, output="y1")
    np.testing.assert_allclose(guess.numerator, 2 * COEFFICIENTS[:1], rtol=1e-8)
    fits = [fit_transfer_function(axes, 0, 3), fit_transfer_function(two, 0, 3, output=1)]
    errors = [fit.standard_errors / np.abs(fit.values) for fit in fits]
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-6)


def two_outputs(frf):
    import dataclasses

    def both(x, factor=1.0):
        return jnp.concatenate([x, factor * x], axis=1)

    variance = both(2 * frf.random_error**2 * jnp.abs(frf.response) ** 2, 4.0)
    return dataclasses.replace(
        frf,
        response=both(frf.response, 2.0),
        coherence=both(frf.coherence),
        random_error=both(frf.random_error),
        errors=jq.spectra.independent_errors(frf.omega, variance),
        direct_coherence=both(frf.direct_coherence),
        multiple_coherence=both(frf.multiple_coherence),
        output_names=("y0", "y1"),
    )
