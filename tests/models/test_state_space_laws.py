"""What must hold for every linear model, on models drawn by hypothesis."""

import equinox as eqx
import hypothesis
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from jaxquad.models import StateSpace


OMEGA = jnp.asarray(np.geomspace(0.01, 300.0, 30))


def system(seed):
    """A plant of four states with everything in it: H1, M, and delays of both kinds."""
    rng = np.random.default_rng(seed)
    F, G, H0, H1, M = (
        rng.standard_normal(shape) for shape in ((4, 4), (4, 2), (2, 4), (2, 4), (4, 4))
    )
    return StateSpace(
        F=F,
        G=G,
        H0=H0,
        H1=0.3 * H1,
        M=np.eye(4) + 0.2 * M,
        input_delay=rng.uniform(0, 0.05, 2),
        output_delay=rng.uniform(0, 0.05, 2),
    )


BOUNDED = arrays(float, (2,), elements=st.floats(-3, 3))
CHECK = hypothesis.settings(deadline=None, max_examples=5, derandomize=True)


@pytest.mark.slow
@CHECK
@hypothesis.given(seed=st.integers(0, 1000), logs=arrays(float, (4,), elements=st.floats(-3, 3)))
def test_other_coordinates_and_other_equations_change_nothing(seed, logs):
    model = system(seed)
    rng = np.random.default_rng(seed + 7)
    turn = np.linalg.qr(rng.standard_normal((4, 4)))[0] * 10.0**logs
    mix = np.linalg.qr(rng.standard_normal((4, 4)))[0]
    other = StateSpace(
        F=mix @ model.F @ turn,
        G=mix @ model.G,
        H0=model.H0 @ turn,
        H1=model.H1 @ turn,
        M=mix @ model.M @ turn,
        input_delay=model.input_delay,
        output_delay=model.output_delay,
    )
    expected = np.asarray(model.frequency_response(OMEGA))
    close = np.abs(np.asarray(other.frequency_response(OMEGA)) - expected)
    assert np.all(close < 1e-9 * np.max(np.abs(expected), axis=(1, 2), keepdims=True))


@CHECK
@hypothesis.given(seed=st.integers(0, 1000), logs=BOUNDED)
def test_units_of_inputs_and_outputs_scale_the_response(seed, logs):
    model = system(seed)
    units = 10.0**logs
    scaled = eqx.tree_at(lambda m: m.G, model, jnp.asarray(np.asarray(model.G) * units))
    expected = np.asarray(model.frequency_response(OMEGA)) * units
    np.testing.assert_allclose(scaled.frequency_response(OMEGA), expected, rtol=1e-12)


@CHECK
@hypothesis.given(
    seed=st.integers(0, 1000), rows=st.permutations(range(2)), columns=st.permutations(range(2))
)
def test_channels_in_another_order_permute_the_response(seed, rows, columns):
    model = system(seed)
    found = model.select(rows, columns).frequency_response(OMEGA)
    expected = np.asarray(model.frequency_response(OMEGA))[:, rows][:, :, columns]
    np.testing.assert_allclose(found, expected, rtol=1e-11)
