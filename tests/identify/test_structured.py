"""Normal equations from the structure of a state space against its derivative."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxquad as jq
from jaxquad._core import normal_equations
from jaxquad.identify import make_problem, problem_normal, residuals, select_parameters
from jaxquad.models import Entry, factor_slopes, matrices_of, Split


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
ENTRIES = [
    "F[0][1]", "F[1][1]", "G[1][0]", "G[0][1]", "H0[1][0]", "H0[0][0]", "H1[0][1]", "H1[1][0]",
    "M[0][0]", "M[0][1]", "input_delay[1]", "output_delay[0]",
]  # fmt: skip


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


def problem(model=MODEL, entries=ENTRIES, **options):
    frfs = [measured(0), measured(1)]
    parameters = select_parameters(model, entries, options.pop("tied", None))
    weights = np.random.default_rng(2).random((2, *frfs[0].response.shape, 2))
    return make_problem(model, parameters, frfs, **options).weighted(list(jnp.asarray(weights)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"priors": [jq.identify.Prior("G[1][0]", 3.5, 0.2)]},
        {"tied": {"F[2][1]": lambda m: -m.F[1, 1] / 2}},
    ],
    ids=["every kind of entry", "a prior", "a tie"],
)
def test_normal_equations_are_those_of_the_differentiated_residuals(options):
    made = problem(**options)
    z = made.parameters.start[: len(ENTRIES)] + 0.01
    found = jax.jit(problem_normal)(z, made)
    wanted = jax.jit(normal_equations, static_argnums=0)(residuals, z, made)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11 * np.max(np.abs(other)))


@pytest.mark.slow
def test_equations_may_stand_in_any_order():
    # In the second one no diagonal element is large enough for a pivot.
    order = np.array([1, 2, 0])
    turned = eqx.tree_at(
        lambda m: (m.F, m.G, m.M),
        MODEL,
        tuple(jnp.asarray(x)[order] for x in (MODEL.F, MODEL.G, MODEL.M)),
    )
    normals = []
    for model, row in ((MODEL, 1), (turned, 0)):
        entries = [f"F[{row}][0]", f"F[{row}][1]", f"G[{row}][0]", f"M[{row}][1]", "H1[0][1]"]
        made = problem(model, entries)
        normals.append(jax.jit(problem_normal)(made.parameters.start[: len(entries)], made))
    for one, other in zip(*normals, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11 * np.max(np.abs(other)))


def entry(name):
    field, *index = name.replace("]", "").split("[")
    return Entry(field, *(int(i) for i in (*index, "0")[:2]))


@jax.jit
def both_products(model, scale, weight, misfit):
    """Gradient and Hessian without the slopes, and from the slopes."""
    entries = [entry(name) for name in ENTRIES]
    slopes = factor_slopes(matrices_of(model), OMEGA, entries, scale)[1]
    rows = [part.reshape(len(scale), -1) for part in slopes.multiply_out(Split(weight, weight))]
    parts = [(weight * part).reshape(-1) for part in misfit]
    gradient = sum(row @ part for row, part in zip(rows, parts, strict=True))
    return slopes.normal_products(weight, misfit), (gradient, sum(row @ row.T for row in rows))


@pytest.mark.slow
def test_products_of_slopes_need_no_slopes():
    rng = np.random.default_rng(4)
    scale, shape = jnp.asarray(rng.uniform(0.5, 2.0, len(ENTRIES))), (2, 2, OMEGA.size)
    weight, *misfit = jnp.asarray(rng.standard_normal((3, *shape)))
    for one, other in zip(*both_products(MODEL, scale, weight, Split(*misfit)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12 * np.max(np.abs(other)))


@pytest.mark.slow
def test_weights_may_be_one_for_magnitude_and_phase():
    # Many entries in few columns and rows: their products are taken without the slopes.
    entries = ["F[0][0]", "F[0][1]", "F[0][2]", "F[1][0]", "F[1][1]"]
    entries += ["G[0][0]", "G[0][1]", "G[1][0]", "G[1][1]"]
    made = problem(entries=entries)
    one = [np.asarray(each)[..., :1] for each in made.weights]
    z = made.parameters.start[: len(entries)]
    pairs = [made.weighted(one), made.weighted([np.repeat(each, 2, axis=3) for each in one])]
    normals = [jax.jit(problem_normal)(z, each) for each in pairs]
    for one, other in zip(*normals, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11 * np.max(np.abs(other)))
