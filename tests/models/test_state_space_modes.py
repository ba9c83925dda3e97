import control
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.models import modes, state_space, StateSpace, TransferFunction


OMEGA = jnp.asarray(np.geomspace(0.01, 300.0, 30))


@pytest.mark.parametrize(
    ("numerator", "denominator"),
    [([2.0, 3.0], [1.0, 0.4, 25.0, 0.0]), ([2.0, 1.0, 5.0], [4.0, 1.0, 9.0])],
)
def test_a_transfer_function_in_states_has_its_response_poles_and_zeros(numerator, denominator):
    model = TransferFunction(numerator, denominator, 0.03)
    found = state_space(model)
    expected = np.asarray(model.frequency_response(OMEGA))
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found.frequency_response(OMEGA), expected, atol=1e-13 * scale)
    np.testing.assert_allclose(np.sort(found.poles), np.sort(model.poles), atol=1e-12)
    np.testing.assert_allclose(np.sort(found.zeros), np.sort(model.zeros), rtol=1e-9)


def by_size(x):
    """Conjugates, equal but for rounding, in one order."""
    return x[np.lexsort((np.imag(x) > 0, np.round(np.abs(x), 6)))]


def test_transmission_zeros_have_none_at_infinity_and_do_not_depend_on_units():
    rng = np.random.default_rng(5)
    F, G, H0 = (rng.standard_normal(shape) for shape in ((6, 6), (6, 2), (2, 6)))
    expected = by_size(control.zeros(control.ss(F, G, H0, 0)))
    unit = 10.0 ** rng.uniform(-5, 5, 6)
    scaled = StateSpace(F=F * unit / unit[:, None], G=G / unit[:, None], H0=H0 * unit)
    np.testing.assert_allclose(by_size(scaled.zeros), expected, rtol=1e-8)
    chain = StateSpace(F=np.eye(6, k=1), G=np.eye(6)[:, 5:], H0=np.eye(6)[:1])
    assert len(chain.zeros) == 0


def test_modes_are_listed_with_frequency_damping_and_time_constant():
    F = np.zeros((4, 4))
    F[:2, :2], F[2, 2] = [[0, 1], [-25, -2]], -0.5
    slow, fast = modes(StateSpace(F=F, G=np.ones((4, 1)), H0=np.ones((1, 4))))[1:]
    assert slow[1:] == pytest.approx((0.5, 1.0, 2.0))
    assert fast[1:] == pytest.approx((5.0, 0.2, 1.0))
    assert all(part in str(fast) for part in ("0.2", "5 rad/s", "1 s"))
    integrator = modes(TransferFunction([1.0], [1.0, 0.0]))[0]
    assert np.isnan(integrator.damping)
    assert integrator.time_constant == np.inf
