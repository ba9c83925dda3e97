"""The log density of a fit is its default error bars, for samplers; priors have their Jacobians."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from conftest import ROOT
from scipy.integrate import cumulative_trapezoid
from synthetic import OMEGA, response_of

import jaxquad as jq
from jaxquad.ensembles import Choice, LogNormal, LogUniform, Normal, Uniform


TRUTH = jq.LaggedIntegrator(gain=40.0, lag=0.05, delay=0.02)
START = jq.LaggedIntegrator(gain=30.0, lag=0.03, delay=0.03)
FRF = response_of(TRUTH, seed=2)


@pytest.fixture(scope="module")
def fit():
    return jq.fit(START, response_of(TRUTH, correlation=0.5, seed=1))


@pytest.fixture(scope="module")
def pair():
    """Gain and lag, from errors that share nothing."""
    return jq.fit(dataclasses.replace(START, delay=TRUTH.delay), FRF, free=("gain", "lag"))


@pytest.fixture(scope="module")
def at_zero():
    """The delay is 0, and the noise leaves it there."""
    truth = jq.LaggedIntegrator(gain=40.0, lag=0.05, delay=0.0)
    return jq.fit(
        dataclasses.replace(START, gain=truth.gain),
        response_of(truth, seed=3),
        free=("lag", "delay"),
    )


def test_its_gradient_is_that_of_finite_differences(fit):
    z = fit.coordinates + np.array([0.002, -0.02, 0.03])
    slopes = jax.grad(fit.log_density)(z)
    for k, step in enumerate(1e-6 * np.eye(3)):
        difference = fit.log_density(z + step) - fit.log_density(z - step)
        assert float(slopes[k]) == pytest.approx(float(difference) / 2e-6, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("model_error", [True, False])
def test_its_curvature_at_the_fit_is_the_inverse_covariance(fit, model_error):
    freedom, count = 20.0, len(fit.names)
    fit = dataclasses.replace(fit, degrees_of_freedom=np.full(count, freedom))
    density = lambda z: fit.log_density(z, model_error=model_error)
    slopes, curvature = jax.grad(density)(fit.coordinates), jax.hessian(density)(fit.coordinates)
    # Student's t of n degrees of freedom is steeper at its top by (n + p) / n.
    covariance = -np.linalg.inv(curvature) * (freedom + count) / freedom
    wanted = fit.covariance if model_error else fit.noise_covariance
    relative = wanted / np.outer(fit.values, fit.values)
    assert np.sqrt(np.diag(covariance)) == pytest.approx(np.sqrt(np.diag(relative)), rel=0.03)
    assert np.corrcoef(covariance.ravel(), relative.ravel())[0, 1] > 0.999
    # The top is where the fit stopped.
    assert np.abs(covariance @ slopes) == pytest.approx(0, abs=0.01 * np.sqrt(relative.max()))


@pytest.mark.slow
def test_vmap_and_jit_give_the_same_numbers(fit):
    places = fit.coordinates + np.array([0.01, -0.01, 0.02]) * np.arange(4)[:, None]
    singly = [float(fit.log_density(z)) for z in places]
    assert np.asarray(jax.jit(jax.vmap(fit.log_density))(places)) == pytest.approx(singly, rel=1e-9)


PRIORS = [
    (Normal(0.004, mean=0.05), scipy.stats.truncnorm(-4, 4, 0.05, 0.004)),
    (Uniform(0.03, 0.08), scipy.stats.uniform(0.03, 0.05)),
    (LogUniform(0.03, 0.08), scipy.stats.loguniform(0.03, 0.08)),
    (LogNormal(0.1, median=0.05), scipy.stats.lognorm(0.1, scale=0.05)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("prior", "independent"), PRIORS, ids=lambda x: type(x).__name__)
def test_a_prior_is_that_of_scipy_times_the_slope_of_the_value(fit, prior, independent):
    # d value / d z is the value itself, whose logarithm is fitted.
    places = fit.coordinates + np.linspace(-0.1, 0.1, 5)[:, None] * np.array([0.0, 1.0, 0.0])
    values = np.asarray([fit.parameters.values(z)[1] for z in places])
    with_prior = jax.vmap(lambda z: fit.log_density(z, prior={"lag": prior}))(places)
    added = np.asarray(with_prior - jax.vmap(fit.log_density)(places))
    # scipy's LogNormal has the tails beyond 4 standard deviations: 6e-5 of it.
    assert added == pytest.approx(independent.logpdf(values) + np.log(values), abs=1e-4)
    assert float(prior.log_density(jnp.asarray(0.5))) == -np.inf


@pytest.mark.slow
def test_far_from_the_fit_it_is_the_likelihood_of_all_points(pair):
    def likelihood(gain, lag):
        """Of a complex error of 0.02, relative to the model, in either part."""
        model = gain * np.exp(-1j * 0.02 * OMEGA) / (1j * OMEGA * (1 + 1j * lag * OMEGA))
        logarithm = np.log(np.asarray(FRF.response)[:, 0, 0] / model)
        return -0.5 * np.sum(np.abs(logarithm) ** 2) / 0.02**2

    here = pair.log_density(pair.coordinates, model_error=False)
    for factor in ((1.5, 1.0), (1.0, 2.0), (0.8, 0.6)):
        z = pair.coordinates + np.log(factor)
        fall = float(pair.log_density(z, model_error=False) - here)
        wanted = likelihood(*(pair.values * factor)) - likelihood(*pair.values)
        # Weights are relative to the fitted model.
        assert fall == pytest.approx(wanted, rel=0.05)


def quantiles_on_a_grid(fit, name, levels):
    """Of one of two parameters, from the density on a grid of both, by numpy alone."""
    axes = [np.linspace(z - 8 * s, z + 6 * s, 71) for z, s in zip(*box(fit), strict=True)]
    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    density = np.asarray(jax.jit(jax.vmap(jax.vmap(fit.log_density)))(mesh))
    k = fit.names.index(name)
    marginal = np.exp(density - density.max()).sum(axis=1 - k)
    shares = cumulative_trapezoid(marginal, axes[k], initial=0)
    return np.exp(np.interp(levels, shares / shares[-1], axes[k]))


def box(fit):
    """Middle and width of the grid: what is at zero falls off by e in each of its last units."""
    spread = np.where(fit.values == 0, 2.0, fit.standard_errors / np.maximum(fit.values, 1e-9))
    return fit.coordinates, np.minimum(spread, 2.0)


def draws_by_metropolis(fit, count=12000):
    """Values from a random walk in the coordinates, by numpy alone."""
    density, random = jax.jit(fit.log_density), np.random.default_rng(0)
    z, spread = fit.coordinates, 1.2 * box(fit)[1]
    here, kept = float(density(z)), []
    for jump, chance in zip(random.normal(size=(count, z.size)), random.random(count), strict=True):
        tried = z + spread * jump
        there = float(density(tried))
        if np.log(chance) < there - here:
            z, here = tried, there
        kept.append(z)
    return np.exp(np.array(kept[count // 10 :]))


LEVELS = np.array([0.1, 0.5, 0.9])


@pytest.mark.slow
def test_draws_have_the_quantiles_of_an_integration_on_a_grid(at_zero):
    draws = draws_by_metropolis(at_zero)
    for k, name in enumerate(at_zero.names):
        wanted = quantiles_on_a_grid(at_zero, name, LEVELS)
        shares = [np.mean(draws[:, k] < value) for value in wanted]
        assert shares == pytest.approx(LEVELS, abs=0.05)  # some 1000 independent draws


@pytest.mark.slow
def test_a_delay_at_zero_has_the_limit_of_the_fit(at_zero):
    (bound,) = at_zero.verdict.bounds
    assert bound.name == "delay"
    limit = quantiles_on_a_grid(at_zero, "delay", 0.95)
    assert 0.6 * bound.limit < limit < 1.4 * bound.limit


@pytest.mark.slow
@pytest.mark.parametrize("freedom", [np.inf, 8.0])
def test_a_determined_parameter_has_the_interval_of_the_fit(pair, freedom):
    fit = dataclasses.replace(pair, degrees_of_freedom=np.full(2, freedom))
    for name in fit.names:
        ends = quantiles_on_a_grid(fit, name, [0.025, 0.975])
        low, high = fit.interval(name)
        assert ends == pytest.approx([low, high], abs=0.05 * (high - low))


@pytest.mark.slow
def test_priors_bound_what_the_record_does_not_determine():
    rig = jq.models.AttitudeAxis(L=0.197, K_t=0.1188, J_x=0.0552, lag=0.05, delay=0.02)
    open_fit = jq.fit(rig, response_of(rig, seed=4), free=("K_t", "J_x", "lag"))
    z = open_fit.coordinates
    with pytest.raises(jq.identify.UndeterminedError, match="K_t, J_x"):
        open_fit.log_density(z)
    with pytest.raises(jq.identify.UndeterminedError, match="K_t, J_x"):
        open_fit.log_density(z, prior={"lag": LogNormal(0.1, median=0.05)})
    prior = {"K_t": Normal(0.002, mean=float(open_fit.values[0]))}
    curvature = jax.hessian(lambda z: open_fit.log_density(z, prior=prior))(z)
    # Nothing else tells K_t, and J_x is K_t over what the record tells.
    errors = np.sqrt(np.diag(-np.linalg.inv(curvature)))
    assert errors[:2] == pytest.approx(0.002 / open_fit.values[0], rel=0.05)


def test_messages_say_what_to_give(fit):
    z = fit.coordinates
    with pytest.raises(ValueError, match=r"shape \(2,\), but the fit has 3 .*\(gain, lag, delay"):
        fit.log_density(z[:2])
    with pytest.raises(KeyError, match="lagg"):
        fit.log_density(z, prior={"lagg": Uniform(0.0, 1.0)})
    with pytest.raises(ValueError, match="mean="):
        fit.log_density(z, prior={"lag": Normal(0.1)})
    with pytest.raises(ValueError, match="no density"):
        fit.log_density(z, prior={"lag": Choice([0.1, 0.2])})
    with pytest.raises(ValueError, match="keeps the sign"):
        fit.log_density(z, prior={"lag": Uniform(-2.0, -1.0)})
    paper = jq.fit(START, FRF, cost=jq.identify.CoherenceWeighted())
    with pytest.raises(ValueError, match="MaximumLikelihood"):
        paper.log_density(z)


@pytest.mark.slow
@pytest.mark.parametrize(("library", "place"), [("numpyro", 0), ("blackjax", 1)])
def test_nuts_as_the_guide_runs_it_has_the_standard_errors_of_the_fit(fit, library, place):
    pytest.importorskip(library)
    section = (ROOT / "docs" / "how_to.md").read_text().split("## sample the posterior")[1]
    code = re.findall(r"```python\n(.*?)```", section, flags=re.S)[place]
    names = {"jax": jax, "jnp": jnp, "jq": jq, "fit": fit}
    names["prior"] = {"delay": Uniform(0.0, 0.2)}
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        exec(code, names)
    errors = np.std(np.asarray(names["values"]), axis=0)
    assert errors == pytest.approx(fit.standard_errors, rel=0.2)
