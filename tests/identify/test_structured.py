"""Residuals of state spaces, and their slopes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxquad as jq
from jaxquad.identify import make_problem, residuals, select_parameters


OMEGA = jnp.asarray(np.geomspace(0.2, 30.0, 12))
MODEL = jq.StateSpace(
    F=[[-0.4, 1.1, -9.8], [0.3, -2.0, 0.0], [0.0, 1.0, 0.0]],
    G=[[0.1, 0.7], [4.0, -1.0], [0.0, 0.0]],
    H0=[[1.0, 0.0, 0.0], [0.2, 1.5, 0.0]],
    H1=[[0.0, 0.3, 0.0], [1.0, 0.0, 0.0]],
    M=[[1.2, 0.1, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 1.0]],
    input_delay=[0.02, 0.05],
    output_delay=[0.01, 0.03],
)


def measured(seed):
    rng = np.random.default_rng(seed)
    true = np.asarray(MODEL.frequency_response(OMEGA))
    noise = rng.standard_normal((2, *true.shape))
    response = jnp.asarray(true * np.exp(0.1 * (noise[0] + 1j * noise[1])))
    shape = response.shape
    return jq.spectra.FrequencyResponse(
        omega=OMEGA,
        response=response,
        coherence=jnp.full(shape, 0.9),
        random_error=jnp.full(shape, 0.1),
        errors=jq.spectra.independent_errors(OMEGA, 0.02 * jnp.abs(response) ** 2),
        direct_coherence=jnp.full(shape, 0.9),
        multiple_coherence=jnp.full(shape[:2], 0.9),
        method="direct",
        input_names=("a", "b"),
        output_names=("x", "y"),
    )


def problem(model, entries):
    frfs = [measured(0), measured(1)]
    parameters = select_parameters(model, entries)
    weights = np.random.default_rng(2).random((2, *frfs[0].response.shape, 2))
    return make_problem(model, parameters, frfs).weighted(list(jnp.asarray(weights)))


@pytest.mark.slow
def test_equations_may_stand_in_any_order():
    # In the second one no diagonal element is large enough for a pivot.
    order = np.array([1, 2, 0])
    turned = eqx.tree_at(
        lambda m: (m.F, m.G, m.M),
        MODEL,
        tuple(jnp.asarray(x)[order] for x in (MODEL.F, MODEL.G, MODEL.M)),
    )
    found = []
    for model, row in ((MODEL, 1), (turned, 0)):
        entries = [f"F[{row}][0]", f"F[{row}][1]", f"G[{row}][0]", f"M[{row}][1]", "H1[0][1]"]
        made = problem(model, entries)
        both = jax.jit(lambda z, made: (residuals(z, made), jax.jacfwd(residuals)(z, made)))
        found.append(both(made.parameters.start[: len(entries)], made))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11 * np.max(np.abs(other)))
