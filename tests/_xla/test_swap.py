"""A queue of rows that is exchanged in place is the same in every derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad._xla import swap_row


LONG, STEPS = 3, 8
X = jnp.array([0.3, 0.7])


def queued(x):
    def step(carry, k):
        rows, x0, sent = carry
        rows, oldest = swap_row(rows, sent, k % LONG)
        return (rows, jnp.sin(x0 + 0.1 * x - 0.3 * oldest), x0 * x), oldest

    return jax.lax.scan(step, (jnp.zeros((LONG, 2)), x, x), jnp.arange(STEPS))[0][1]


def listed(x):
    rows, x0, sent = [jnp.zeros(2)] * LONG, x, x
    for _ in range(STEPS):
        rows, oldest = [*rows[1:], sent], rows[0]
        x0, sent = jnp.sin(x0 + 0.1 * x - 0.3 * oldest), x0 * x
    return x0


def test_a_row_takes_the_place_of_another():
    rows, old = swap_row(jnp.arange(6.0).reshape(3, 2), jnp.array([8.0, 9.0]), jnp.asarray(1))
    np.testing.assert_array_equal(rows, [[0, 1], [8, 9], [4, 5]])
    np.testing.assert_array_equal(old, [2, 3])


MODES = {
    "forward": jax.jacfwd,
    "reverse": jax.jacrev,
    "second": jax.hessian,
    "batched": lambda f: lambda x: jax.vmap(jax.jacrev(f))(jnp.stack([x, 2 * x])),
}


@pytest.mark.parametrize("mode", MODES)
def test_a_queue_in_place_has_the_derivatives_of_a_list(mode):
    found, expected = (jax.jit(MODES[mode](f))(X) for f in (queued, listed))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


def test_members_may_exchange_rows_at_places_of_their_own():
    rows, row = jnp.arange(12.0).reshape(2, 3, 2), jnp.zeros((2, 2))
    found, old = jax.vmap(swap_row)(rows, row, jnp.asarray([0, 2]))
    np.testing.assert_array_equal(old, [[0, 1], [10, 11]])
    np.testing.assert_array_equal(found[1], [[6, 7], [8, 9], [0, 0]])
