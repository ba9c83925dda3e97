"""What a model leaves unexplained: intervals that count it, halves of the band, further terms."""

import dataclasses
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import OMEGA, response_of

import jaxquad as jq
from jaxquad.identify.uncertainty import _discrepancy


TRUTH = jq.LaggedIntegrator(80.0, 0.06, 0.03)
START = jq.LaggedIntegrator(60.0, 0.04, 0.04)


DAMPED = jq.LaggedIntegrator(80.0, 0.06, 0.03, damping=0.3)  # which the model of the fit lacks


def total(fit, model_error=True):
    """Lag + delay and its standard error."""
    covariance = fit.covariance if model_error else fit.noise_covariance
    ones = np.array([0.0, 1.0, 1.0])
    return ones @ fit.values, np.sqrt(ones @ covariance @ ones)


@pytest.fixture(scope="module")
def right():
    return [jq.fit(START, response_of(TRUTH, seed=k)) for k in range(25)]


@pytest.fixture(scope="module")
def wrong():
    return [jq.fit(START, response_of(DAMPED, seed=k)) for k in range(25)]


def test_a_right_model_costs_little_more_than_its_noise(right):
    ratios = [fit.standard_errors / fit.noise_standard_errors for fit in right]
    assert np.all(np.median(ratios, axis=0) < 1.4) and np.min(ratios) >= 1
    assert np.median([fit.discrepancy.none for fit in right]) > 0.5
    assert np.all(np.diff(right[0].interval("gain")) > np.diff(noise_interval(right[0])))


def noise_interval(fit):
    return fit.interval("gain", model_error=False)


def test_a_wrong_model_is_covered_with_its_error_and_not_by_the_noise(wrong):
    def covered(model_error):
        found = [total(fit, model_error) for fit in wrong]
        inside = [abs(value - 0.09) < 1.96 * error for value, error in found]
        gains = [fit.interval("gain", model_error=model_error) for fit in wrong]
        return np.mean(inside), np.mean([low < 80.0 < high for low, high in gains])

    assert np.all(np.array(covered(False)) < 0.5)
    assert np.all(np.array(covered(True)) > 0.9)
    assert all(fit.chi_squared > 1.5**2 and fit.discrepancy.none < 0.01 for fit in wrong)
    assert "prior" in str(wrong[0]) or "data" in str(wrong[0])


def test_both_costs_and_both_halves_of_the_band_agree_with_model_error():
    frf = response_of(DAMPED, seed=1)
    by_likelihood, by_14 = (
        jq.fit(START, frf, cost=cost)
        for cost in (jq.identify.MaximumLikelihood(), jq.identify.CoherenceWeighted())
    )
    for name in by_likelihood.names:
        (low, high), (other_low, other_high) = (
            fit.interval(name) for fit in (by_likelihood, by_14)
        )
        assert low < other_high and other_low < high
    bands = by_likelihood.bands()
    assert bands.split == pytest.approx(np.sqrt(OMEGA[0] * OMEGA[-1]))
    assert not any(bands.overlap(name) is False for name in by_likelihood.names)
    assert "0.5 .. 3.16 rad/s" in str(bands)


def test_what_the_model_lacks_makes_its_points_count_alike():
    """The floor: a point of a tenth of the random error does not count a hundredfold any more."""
    frf = response_of(DAMPED, error=0.001, seed=0)
    every = np.ones(frf.response.shape)
    points = jq.identify.Points(frf, every > 0, every, 0.1 * every)
    weights = jq.identify.MaximumLikelihood().weights(points, np.ones(frf.response.shape))
    np.testing.assert_allclose(weights, 1 / np.hypot(0.001, 0.1))


@pytest.mark.parametrize("divided", [0.0, 1.0])
def test_a_point_counts_alike_whichever_way_its_noise_turned_out(divided):
    """1 + n in the numerator or, of a joint estimate, in the denominator: 0.02 of the truth."""
    luck = np.linspace(0.7, 1.4, OMEGA.size)[:, None, None]
    frf = response_of(TRUTH, error=0.02)
    measured = dataclasses.replace(
        frf,
        response=jnp.asarray(np.asarray(frf.response) * luck ** (1 - 2 * divided)),
        random_error=jnp.asarray(0.02 / luck),  # over what came out: numerator or denominator
        divided=np.full(luck.shape, divided),
    )
    every = np.ones(luck.shape)
    points = jq.identify.Points(measured, every > 0, every, 0.0 * every)
    ratio = np.abs(np.asarray(frf.response) / np.asarray(measured.response))
    np.testing.assert_allclose(jq.identify.MaximumLikelihood().weights(points, ratio), 1 / 0.02)


def test_points_that_share_their_noise_count_by_what_is_their_own():
    """Of pairs of frequencies with the same error, each counts half."""
    apart = np.repeat(OMEGA[::2], 2) * np.tile([1.0, 1.0001], 15)
    frf = response_of(TRUTH, omega=apart)
    noise = np.kron(np.eye(15), np.ones((2, 1)))
    effect = jnp.asarray(0.02 * np.asarray(frf.response)[:, :, 0] * noise)[:, None, :]
    errors = jq.spectra.ErrorCovariance(frf.omega, effect, jnp.ones((30, 1, 1), complex))
    fit = jq.fit(START, dataclasses.replace(frf, errors=errors))
    assert fit.origin is not None
    np.testing.assert_allclose(fit.origin.points[0].shared, 2.0, rtol=1e-6)


def test_where_nothing_was_fitted_nothing_is_fitted_again():
    nothing = jq.fit(START, response_of(TRUTH, error=1.0))
    assert nothing.verdict.kind == "too few points"
    with pytest.raises(ValueError, match="cannot be made again"):
        nothing.bands()


@pytest.mark.slow
def test_the_missing_term_is_found_and_a_right_model_is_left_alone(right, wrong):
    found = wrong[0].explain()
    assert found.candidates[0].title == "rate damping" and found.best is not None
    assert abs(found.best.values[-1] - 0.3) < 3 * found.best.standard_errors[-1]
    assert "d = 0." in found.summary and "lacks rate damping" in str(found)
    assert right[0].explain().best is None


@pytest.mark.parametrize("count", [40, 257])
def test_kernels_have_the_same_roots_with_and_without_a_matrix(count, monkeypatch):
    omega = np.random.default_rng(3).permutation(np.geomspace(0.6, 60.0, count))
    bases = []
    for dense in (count, count - 1):
        monkeypatch.setattr(_discrepancy, "_DENSE", dense)
        bases.append(_discrepancy.kernel_basis.__wrapped__(omega.tobytes()))
    for one, other in zip(*bases, strict=True):
        np.testing.assert_allclose(one @ one.T, other @ other.T, atol=1e-10)


def test_many_frequencies_may_hold_one_twice():
    # The inverse of their kernel does not exist.
    omega = np.append(np.geomspace(0.6, 60.0, 299), 60.0)
    for root in _discrepancy.kernel_basis(omega.tobytes()):
        np.testing.assert_allclose(root[-2], root[-1], atol=1e-9)


class Notched(eqx.Module):
    """A model behind a notch."""

    model: jq.LaggedIntegrator
    frequency: float  # rad/s
    quality: float

    def frequency_response(self, omega):
        s = jax.lax.complex(jnp.zeros_like(omega), omega) / self.frequency
        factor = (s**2 + 1) / (s**2 + s / self.quality + 1)
        return self.model.frequency_response(omega) * factor[:, None, None]


def flown_notch(seed, noise=0.09):
    """Sharp where it is slow, as a sweep through an integrator in white noise."""
    omega = np.geomspace(2.0, 70.0, 60)
    plant = Notched(jq.LaggedIntegrator(40.0, 0.03, 0.01), 90.0, 3.0)
    error = (noise * (omega / 70) ** 2)[:, None, None]
    frf = response_of(plant, omega=omega)
    exact, white = np.asarray(frf.response), np.random.default_rng(seed).standard_normal((2, 60))
    response = exact * (1 + error * (white[0] + 1j * white[1])[:, None, None])
    errors = jq.spectra.independent_errors(frf.omega, 2 * (error * np.abs(exact)) ** 2)
    return dataclasses.replace(
        frf, response=jnp.asarray(response), random_error=jnp.asarray(error), errors=errors
    )


def test_a_notch_is_remarked_where_it_is_and_intervals_hold_what_it_moves():
    for seed in range(4):
        fit = jq.fit(jq.LaggedIntegrator(48.0, 0.024, 0.011), flown_notch(seed))
        assert fit.discrepancy is not None
        assert fit.discrepancy.none > 0.05, "a stationary discrepancy does not see it"
        (text,) = (text for text in fit.remarks if text.kind == "misfit")
        assert " times from " in text and " to 70 rad/s" in text
        low, high = fit.interval("delay")
        assert low < 0.01 < high, (seed, low, high)
        assert fit.interval("delay", model_error=False)[0] > 0.01


def test_a_notch_within_the_noise_is_likely_and_intervals_hold_what_it_moves():
    """By the noise alone, the delay is off by 13 to 16 standard errors."""
    likely = []
    for seed in range(8):
        fit = jq.fit(jq.LaggedIntegrator(48.0, 0.024, 0.011), flown_notch(seed, noise=0.2))
        likely += [text for text in fit.remarks if text.kind == "resonance"]
        late = fit.values[2] - 0.01
        assert fit.chi_squared < 1.25**2 and late > 10 * fit.noise_standard_errors[2]
        assert late < 3 * fit.standard_errors[2]
    assert len(likely) > 4
    assert " with a probability of " in likely[0] and " times as wide" in likely[0]


def test_a_right_model_has_no_local_misfit_and_no_likely_resonance(right):
    kinds = {remark.kind for fit in right for remark in fit.remarks}
    assert not kinds & {"misfit", "resonance"}


def refitted(fit, **found):
    """The fit, with refits that end with these misfits by the number of the term's parameters."""

    def run(model, frfs, options, rounds, by_slopes):
        extra = getattr(model, "extra", np.zeros(0))
        chi_squared = found.get(f"of_{len(extra)}", fit.chi_squared)
        values, cost = np.concatenate([fit.values, extra]), chi_squared * 2 * fit.points
        return types.SimpleNamespace(model=model, values=values, cost=cost, chi_squared=chi_squared)

    origin = dataclasses.replace(fit.origin, run=run)
    return dataclasses.replace(fit, origin=origin, cost=fit.chi_squared * 2 * fit.points)


def test_no_further_term_is_named_whose_misfit_is_larger():
    """Refits that end in a poorer minimum, as does the refit without a term."""
    fit = jq.fit(START, response_of(DAMPED, seed=1))
    worse = refitted(fit, of_0=9e4, of_1=8e4, of_2=7e4, of_3=6e4).explain()
    assert worse.best is None and "None of" in worse.summary


def test_the_simplest_of_terms_that_explain_a_misfit_alike_is_named():
    """Without noise, the costs of those that explain all of it differ by rounding."""
    fit = jq.fit(START, response_of(DAMPED, error=1e-7))
    alike = refitted(fit, of_1=1.0, of_2=0.9, of_3=0.1).explain()
    assert len(alike.best.model.term.names) == 1, str(alike)
    assert "to 1.0 random errors" in alike.summary


@pytest.mark.slow
def test_a_notch_in_the_plant_is_named_with_its_frequency():
    s, rng = 1j * OMEGA, np.random.default_rng(5)
    notch = (s**2 + 3.0 * s + 225.0) / (s**2 + 15.0 * s + 225.0)
    noise = rng.standard_normal((2, OMEGA.size)) / np.sqrt(2)
    true = np.asarray(TRUTH.frequency_response(OMEGA))[:, 0, 0] * notch
    measured = true * (1 + 0.01 * (noise[0] + 1j * noise[1]))
    frf = jq.FrequencyResponse.from_table(OMEGA, measured, random_error=np.full(OMEGA.size, 0.01))
    found = jq.fit(START, frf).explain()
    assert found.candidates[0].title == "a notch"
    off = (found.best.values[3:] - [15.0, 0.1, 0.5]) / found.best.standard_errors[3:]
    assert np.all(np.abs(off) < 4)
    assert found.best.chi_squared < 1.5
