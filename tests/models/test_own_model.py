"""A model of a user's own needs `frequency_response(omega)` and nothing else."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq
from jaxquad.models import evaluate_response, with_arrays


@pytest.fixture(autouse=True)
def usual_promotion():
    """JAX as a user has it, where a float times a complex number is complex."""
    with jax.numpy_dtype_promotion("standard"):
        yield


OMEGA = jnp.asarray(np.geomspace(1.0, 60.0, 25))


class Rate(eqx.Module):
    """A rate with lag, whose response has one axis and whose numbers are Python's."""

    gain: float
    lag: float
    shape: int = eqx.field(static=True, default=1)

    def frequency_response(self, omega):
        s = 1j * omega
        return (self.gain / (s * (self.lag * s + 1))).reshape((-1,) * self.shape)


class Transposed(Rate):
    def frequency_response(self, omega):
        return super().frequency_response(omega)[None, :]


def test_a_response_of_one_axis_is_that_of_one_input_and_one_output():
    mine, same = Rate(280, 0.05), jq.LaggedIntegrator(280.0, 0.05)
    found = evaluate_response(mine, OMEGA)
    np.testing.assert_allclose(found, same.frequency_response(OMEGA), rtol=1e-12)


@pytest.mark.slow
def test_a_model_of_ones_own_is_fitted():
    fit = jq.fit(Rate(200, 0.1), response_of(jq.LaggedIntegrator(280.0, 0.05)))
    assert fit.values == pytest.approx([280.0, 0.05], rel=1e-6)


def test_a_response_of_two_axes_is_refused():
    with pytest.raises(ValueError, match=r"Transposed.frequency_response returned .*\(1, 25\)"):
        evaluate_response(Transposed(1.0, 0.1), OMEGA)


def test_whole_numbers_become_parameters_and_static_ones_do_not():
    found = with_arrays(Rate(280, 0.05))
    assert found.gain.dtype == found.lag.dtype == jnp.asarray(1.0).dtype
    assert found.shape == 1


@pytest.mark.parametrize(
    "model",
    [
        jq.TransferFunction([1.0], [1.0, 2.0]),
        jq.LaggedIntegrator(2.0, 0.1),
        jq.StateSpace([[-1.0]], [[1.0]], [[1.0]]),
        jq.models.AttitudeAxis(0.2, 0.1, 0.05),
    ],
    ids=lambda model: type(model).__name__,
)
def test_frequencies_may_be_whole_numbers_in_a_list(model):
    found = model.frequency_response([1, 2, 5])
    np.testing.assert_array_equal(found, model.frequency_response(jnp.array([1.0, 2.0, 5.0])))


@pytest.mark.parametrize("number", [280, np.int64(280), np.array(280), jnp.asarray(280)])
def test_no_kind_of_whole_number_is_left_out_of_the_parameters(number):
    found = with_arrays(Rate(number, 0.05))  # pyright: ignore
    assert found.gain.dtype == np.float64 and found.gain == 280.0
    places = jq.identify.name_places(found)
    assert [place.name for place in places] == ["gain", "lag"]
