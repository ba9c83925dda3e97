"""What is no model, or has a response that cannot be compared, is refused in one sentence."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq


pytestmark = pytest.mark.usefixtures("without_type_checks")


TRUTH = jq.LaggedIntegrator(80.0, 0.06, 0.03)


@pytest.fixture(scope="module")
def response():
    return response_of(TRUTH, error=0.01, seed=0)


class Own(eqx.Module):
    gain: float

    def frequency_response(self, omega):
        return jq.TransferFunction([self.gain], [1.0, 0.0]).frequency_response(omega)


class Short(Own):
    def frequency_response(self, omega):
        return super().frequency_response(omega)[:3]


class Real(Own):
    def frequency_response(self, omega):
        return jnp.abs(super().frequency_response(omega))


class ByNumPy(Own):
    def frequency_response(self, omega):
        return 1j * np.asarray(omega)


class Silent(eqx.Module):
    gain: float


@pytest.mark.parametrize(
    "model, words",
    [
        ([1.0, 2.0], r"not a list; it comes first: jq.fit\(model, data\)"),
        (jq.LaggedIntegrator, r"not the class LaggedIntegrator: give LaggedIntegrator\(...\)"),
        (Silent(1.0), r"Silent has no frequency_response\(omega\)"),
        (Short(1.0), r"shape \(3, 1, 1\) for 5 frequencies, .* return \(5, 1, 1\) or \(5,\)"),
        (Real(1.0), "is real: return complex numbers"),
        (ByNumPy(1.0), "computes with NumPy, which has no derivatives: use jax.numpy"),
    ],
)
def test_what_cannot_be_fitted_is_refused(response, model, words):
    with pytest.raises(ValueError, match=words):
        jq.fit(model, response)


def test_an_own_model_is_fitted(response):
    assert jq.fit(Own(50.0), response).verdict.fitted


def test_swapped_arguments_are_told():
    record = jq.Record(np.arange(100) * 0.01, np.arange(100) % 7.0, np.arange(100) % 5.0)
    with pytest.raises(ValueError, match=r"not a Record; it comes first: jq.refine\(model, data\)"):
        jq.refine(record, TRUTH)  # pyright: ignore[reportArgumentType]


def test_questions_that_a_fit_cannot_answer_are_refused(response):
    fit = jq.fit(jq.LaggedIntegrator(70.0, 0.05, 0.04), response)
    with pytest.raises(ValueError, match="key is 0: give a jax.random.key"):
        fit.ensemble(3, 0)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="quantity is 'lag': give a function of the model"):
        fit.derived("lag")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="the quantity is an array: ask for each"):
        fit.derived(lambda model: jnp.stack([model.lag, model.delay]))
    with pytest.raises(ValueError, match="give a list of frequencies in rad/s"):
        fit.response_band(3.0)
    with pytest.raises(ValueError, match="give times in s, equally spaced from 0"):
        fit.step_response(1.0)
    with pytest.raises(KeyError, match="what is tied to them"):
        fit["tied"]


def test_a_start_without_a_finite_response_is_told(response):
    class Nan(Own):
        def frequency_response(self, omega):
            gain = jnp.log(self.gain - 50.0)
            return jq.TransferFunction([gain], [1.0, 0.0]).frequency_response(omega)

    held = dataclasses.replace(response, hold=0.01, dt=0.01)
    with pytest.raises(
        ValueError, match=r"not finite at its starting values, first at [0-9.]+ rad/s"
    ):
        jq.fit(Nan(40.0), held)
