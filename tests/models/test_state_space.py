import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.models import StateSpace


OMEGA = jnp.asarray(np.geomspace(0.01, 300.0, 30))
S = 1j * np.asarray(OMEGA)


def system(seed=0, states=4, inputs=2, outputs=2):
    """A plant with everything in it: unstable, with H1, an M, and delays of both kinds."""
    rng = np.random.default_rng(seed)
    F, G, H0, H1, M = (
        rng.standard_normal(shape)
        for shape in (
            (states, states),
            (states, inputs),
            (outputs, states),
            (outputs, states),
            (states, states),
        )
    )
    return StateSpace(
        F=F,
        G=G,
        H0=H0,
        H1=0.3 * H1,
        M=np.eye(states) + 0.2 * M,
        input_delay=rng.uniform(0, 0.05, inputs),
        output_delay=rng.uniform(0, 0.05, outputs),
    )


def by_numpy(model, dtype=complex):
    F, G, H0, H1, M = (np.asarray(x) for x in (model.F, model.G, model.H0, model.H1, model.M))
    s = S.astype(dtype)[:, None, None]
    late = np.asarray(model.output_delay)[:, None] + np.asarray(model.input_delay)
    return (H0 + s * H1) @ np.linalg.solve(s * M - F, G[None].astype(dtype)) * np.exp(-s * late)


def plain(F, G, H0):
    return StateSpace(F=F, G=G, H0=H0).frequency_response(OMEGA)


HARD = {
    "repeated poles": -np.eye(4) + np.eye(4, k=1),
    "zeros on the diagonal": np.array(
        [[0, 1, 0, 0], [-4.0, 0, 1, 0], [0, 0, 0, 1.0], [1, 0, -9.0, 0]]
    ),
    "a singular F": np.array([[0, 1, 0, 0], [0, -2.0, 0, 0], [0, 0, 0, 1.0], [0, 0, 0, 0]]),
    "unstable": np.array([[2, 1, 0, 0], [-1, 3.0, 0, 1], [0, 5, -9, 0], [1, 0, 0, -60.0]]),
}


@pytest.mark.parametrize("name", HARD)
def test_the_response_is_that_of_python_control(name):
    rng = np.random.default_rng(1)
    F, G, H0 = HARD[name], rng.standard_normal((4, 2)), rng.standard_normal((3, 4))
    expected = np.moveaxis(control.ss(F, G, H0, 0)(S), -1, 0)
    np.testing.assert_allclose(plain(F, G, H0), expected, rtol=1e-10)


def test_accelerations_a_mass_matrix_and_delays_answer_as_the_textbook_says():
    np.testing.assert_allclose(system().frequency_response(OMEGA), by_numpy(system()), rtol=1e-11)


@pytest.mark.slow
def test_twenty_states_with_poles_over_six_decades_keep_ten_digits():
    # Companion blocks with known factors: the product of the factors is the independent answer.
    poles = -np.geomspace(1e-3, 1e3, 20)
    F = np.diag(poles) + np.diag(-poles[1:], -1)
    G, H0 = np.zeros((20, 1)), np.zeros((1, 20))
    G[0, 0], H0[0, -1] = -poles[0], 1
    expected = np.prod(-poles / (S[:, None] - poles), axis=1)
    assert np.ptp(np.log10(np.abs(expected))) > 6
    np.testing.assert_allclose(plain(F, G, H0)[:, 0, 0], expected, rtol=1e-10)


@pytest.mark.parametrize("name", HARD)
def test_the_units_of_the_states_do_not_matter(name):
    rng = np.random.default_rng(2)
    F, G, H0 = HARD[name], rng.standard_normal((4, 2)), rng.standard_normal((3, 4))
    unit = np.array([1e-6, 1e6, 1e3, 1e-4])
    found = plain(F * unit / unit[:, None], G / unit[:, None], H0 * unit)
    np.testing.assert_allclose(found, plain(F, G, H0), rtol=1e-9)


def test_a_response_on_an_undamped_pole_is_infinite_and_the_other_pairs_are_right():
    F = np.array([[0, 1, 0], [-9.0, 0, 0], [0, 0, -2.0]])
    model = StateSpace(F=F, G=np.array([[0, 0], [1, 0], [0, 1.0]]), H0=np.eye(3)[[0, 2]])
    found = np.asarray(model.frequency_response(jnp.asarray([3.0, 4.0])))
    assert np.isinf(np.abs(found[0, 0, 0]))
    assert np.isnan(np.angle(found[0, 0, 0]))
    np.testing.assert_allclose(found[0, 1], [0, 1 / (3j + 2)], rtol=1e-14)
    np.testing.assert_allclose(found[1, 0], [1 / (9 - 16), 0], rtol=1e-14)


def test_at_frequency_zero_an_integrator_is_infinite_and_its_rate_is_not():
    model = StateSpace(F=[[-2.0, 0], [1, 0]], G=[[3.0], [0]], H0=np.eye(2), input_delay=[0.1])
    found = np.asarray(model.frequency_response(jnp.asarray([0.0])))[0, :, 0]
    assert found[0] == pytest.approx(1.5)
    assert np.isinf(np.abs(found[1]))


def test_an_output_that_an_input_cannot_move_is_zero_and_not_infinite():
    # The second output is a difference of two equal states: a cancellation, not a pole.
    model = StateSpace(F=-np.eye(2) / 3, G=[[0.7], [0.7]], H0=[[1, 0], [1, -1]])
    np.testing.assert_allclose(model.frequency_response(OMEGA)[:, 1, 0], 0, atol=1e-15)


@eqx.filter_jit
def loss(model, omega):
    found = model.frequency_response(omega)
    return jnp.sum(jnp.log(jnp.real(found * jnp.conj(found))) + jnp.imag(found))


@eqx.filter_jit
def loss_by_solve(model, omega):
    s = jax.lax.complex(jnp.zeros_like(omega), omega)[:, None, None]
    F, G, H0, H1, M = (
        x.astype(s.dtype)[None] for x in (model.F, model.G, model.H0, model.H1, model.M)
    )
    G = jnp.broadcast_to(G, (len(omega), *G.shape[1:]))
    late = (model.output_delay[:, None] + model.input_delay[None]).astype(s.dtype)[None]
    found = (H0 + s * H1) @ jnp.linalg.solve(s * M - F, G) * jnp.exp(-s * late)
    return jnp.sum(jnp.log(jnp.real(found * jnp.conj(found))) + jnp.imag(found))


@pytest.mark.slow
def test_the_reverse_gradient_by_everything_is_that_of_a_library_solver():
    found, expected = (
        jax.grad(f, argnums=(0, 1))(system(), OMEGA[10:20]) for f in (loss, loss_by_solve)
    )
    for mine, theirs in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-8, atol=1e-9)


@pytest.mark.slow
def test_the_hessian_forward_over_reverse_is_that_of_a_library_solver():
    def along(f):
        def value(z):
            at = system()
            moved = eqx.tree_at(
                lambda m: (m.F, m.G, m.H1, m.M, m.input_delay),
                at,
                (
                    at.F.at[0].add(z[0]),
                    at.G * (1 + z[1]),
                    at.H1 * (1 + z[2]),
                    jnp.asarray(at.M).at[:, 1].add(z[3]),
                    at.input_delay + z[4],
                ),
            )
            return f(moved, OMEGA[10:20] * (1 + z[5]))

        return jax.jit(jax.hessian(value))(jnp.zeros(6))

    np.testing.assert_allclose(along(loss), along(loss_by_solve), rtol=1e-7, atol=1e-7)


def test_neither_the_response_nor_its_derivatives_call_lapack():
    # Its threads can wait for each other where a solver is mapped over a batch on two cores.
    lowered = jax.jit(jax.jacfwd(jax.grad(loss, argnums=1), argnums=1)).lower(system(), OMEGA)
    assert "lapack" not in lowered.as_text()


def test_models_map_over_a_batch():
    models = [system(seed) for seed in (3, 4)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)
    found = eqx.filter_vmap(lambda model: model.frequency_response(OMEGA))(batch)
    for one, model in zip(found, models, strict=True):
        np.testing.assert_allclose(one, model.frequency_response(OMEGA), rtol=1e-12)


def test_what_is_left_out_is_no_parameter():
    leaves = jax.tree.leaves(StateSpace(F=-np.eye(2), G=np.ones((2, 1)), H0=np.ones((1, 2))))
    assert [leaf.shape for leaf in leaves] == [(2, 2), (2, 1), (1, 2)]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"F": np.ones((2, 3))}, r"F has shape \(2, 3\).*square"),
        ({"G": np.ones((3, 1))}, r"G has shape \(3, 1\).*need \(2, 1\)"),
        ({"H1": np.ones((2, 2))}, r"H1 has shape \(2, 2\).*need \(1, 2\)"),
        ({"input_delay": [0.1, 0.2]}, r"input_delay has shape \(2,\)"),
        ({"output_delay": [-0.1]}, "output_delay is .*0 or above"),
        ({"F": np.array([[1, 0], [0, np.nan]])}, "(?s)F is .*finite"),
        ({"M": np.ones((2, 2))}, "(?s)M is .*singular"),
    ],
)
def test_matrices_that_make_no_model_are_refused(change, complaint):
    given = {"F": -np.eye(2), "G": np.ones((2, 1)), "H0": np.ones((1, 2))}
    with pytest.raises(ValueError, match=complaint):
        StateSpace(**{**given, **change})
