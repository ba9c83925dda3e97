import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad._compile import evaluate_once, FEW, no_fuse


def lag_with_delay(values, omega):
    gain, lag, delay = values.astype(complex)
    s = jax.lax.complex(jnp.zeros_like(omega), omega)
    found = gain * jnp.exp(-delay * s) / (lag * s + 1)
    return jnp.real(found), jnp.imag(found)


def with_slopes(values, omega):
    along = lambda change: jax.jvp(lambda v: lag_with_delay(v, omega), (values,), (change,))
    return jax.vmap(along, out_axes=(None, 0))(jnp.eye(3))


VALUES, OMEGA = jnp.array([2.0, 0.05, 0.02]), jnp.linspace(0.5, 40.0, 60)


def compiled(function, *args):
    return jax.jit(function).lower(*args).compile()


def count(operation, program):
    return (program.as_text() or "").count(f" {operation}(")


@pytest.mark.slow
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="other devices fuse well enough")
def test_slopes_of_few_frequencies_compute_an_exponential_once():
    once = lambda values: evaluate_once(lambda v: with_slopes(v, OMEGA), least=FEW)(values)
    plain = lambda values: with_slopes(values, OMEGA)
    for got, expected in zip(*map(jax.tree.leaves, (once(VALUES), plain(VALUES))), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-13, atol=1e-15)
    cosines = [count("cosine", compiled(each, VALUES)) for each in (once, plain)]
    assert cosines[0] == 1 < cosines[1]


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="other devices fuse well enough")
@pytest.mark.parametrize(("size", "calls"), [(60, 0), (1024, 1)])
def test_what_is_not_to_be_fused_stays_a_call_where_it_is_large(size, calls):
    def function(x):
        return no_fuse(lambda x: x * x + 1, x) + 2 * x

    x = jnp.linspace(0.0, 1.0, size)
    program = compiled(evaluate_once(function, least=FEW), x)
    assert count("call", program) == calls
    np.testing.assert_allclose(program(x), x * x + 1 + 2 * x, rtol=1e-15)
