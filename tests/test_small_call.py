"""A time loop compiled as one kernel computes what the plain one does, or is left plain."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.simulate._small_call import as_one_kernel


STEPS = 40
START, GAIN = jnp.asarray([1.0, 0.3, -0.2]), jnp.asarray(0.7)
TAG = "xla_cpu_small_call"


def march(step, x, p):
    return jax.lax.scan(lambda x, _: (step(x, p),) * 2, x, None, length=STEPS)[1]


def turn(x, p):
    return jnp.roll(jnp.sin(p * x), 1) + 0.1 * x


def plain(x, p, step=turn):
    return jnp.sum(march(step, x, p)[-1] ** 2)


def kernel(x, p, step=turn):
    return jnp.sum(as_one_kernel(lambda x, p: march(step, x, p), x, p)[-1] ** 2)


def batched(function):
    return jax.vmap(function, in_axes=(0, None))


MODES = {
    "forward": (lambda f: f, START, GAIN),
    "reverse": (lambda f: jax.grad(f, argnums=(0, 1)), START, GAIN),
    "forward derivative": (lambda f: jax.jacfwd(f, argnums=(0, 1)), START, GAIN),
    "Hessian": (jax.hessian, START, GAIN),
    "vmap": (batched, jnp.stack([START, 2 * START]), GAIN),
    "gradient of vmap": (
        lambda f: jax.grad(lambda x, p: jnp.sum(batched(f)(x, p)), argnums=(0, 1)),
        jnp.stack([START, 2 * START]),
        GAIN,
    ),
    "vmap of a gradient": (
        lambda f: batched(jax.grad(f, argnums=(0, 1))),
        jnp.stack([START, 2 * START]),
        GAIN,
    ),
    "single precision": (lambda f: f, START.astype(jnp.float32), GAIN.astype(jnp.float32)),
}


@pytest.mark.parametrize("mode", MODES)
def test_a_kernel_computes_the_same_in_every_mode(mode):
    transform, *given = MODES[mode]
    fast, slow = (jax.jit(transform(f)) for f in (kernel, plain))
    # XLA may add in another order.
    tolerance = 1e-5 if mode == "single precision" else 1e-12
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=tolerance), fast(*given), slow(*given)
    )
    assert TAG in fast.lower(*given).as_text()


def test_both_passes_of_a_gradient_are_kernels():
    text = jax.jit(jax.grad(kernel)).lower(START, GAIN).as_text()
    assert text.count(TAG) == 2


class Foreign:
    """Steps that a kernel cannot hold."""

    @staticmethod
    def sorts(x, p):
        return p * jnp.sort(x)

    @staticmethod
    def scatters(x, p):
        return (p * x).at[jnp.argmax(x)].add(0.1)

    @staticmethod
    def solves(x, p):
        return jnp.linalg.solve(jnp.eye(3) + p * jnp.outer(x, x), x)

    @staticmethod
    def multiplies(x, p):
        return (p * jnp.outer(x, x) @ jnp.outer(x, x))[0]

    @staticmethod
    def calls_back(x, p):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct(x.shape, x.dtype), p * x)

    @staticmethod
    def is_wide(x, p):
        return turn(x, p) + 1e-6 * jnp.sum(jnp.broadcast_to(x, (2000, 3)) * jnp.ones((2000, 1)))


@pytest.mark.parametrize("name", [name for name in vars(Foreign) if name[0] != "_"])
def test_what_a_kernel_cannot_hold_is_left_to_the_plain_compiler(name):
    step = getattr(Foreign, name)
    fast, slow = (jax.jit(lambda x, p, f=f: f(x, p, step)) for f in (kernel, plain))
    assert TAG not in fast.lower(START, GAIN).as_text()
    np.testing.assert_allclose(fast(START, GAIN), slow(START, GAIN), rtol=1e-12)


def test_constants_and_arguments_without_use_do_not_end_the_process():
    """They do, in XLA as of jaxlib 0.10, unless a barrier hides the one and a check the other."""

    @jax.custom_jvp
    def opaque(x, unused):
        return 0.5 * jnp.cos(x)

    opaque.defjvp(lambda at, t: (opaque(*at), -0.5 * jnp.sin(at[0]) * t[0]))
    run = lambda x, p, y: march(lambda x, p: opaque(p * x, y), x, p)
    whole = jax.jit(lambda x: as_one_kernel(run, x, jnp.asarray(0.3), x + 1))
    partly = jax.jit(lambda x: as_one_kernel(lambda x, p: march(turn, x, p), x, jnp.asarray(0.3)))
    assert TAG not in whole.lower(START).as_text() and TAG in partly.lower(START).as_text()
    np.testing.assert_allclose(whole(START), run(START, 0.3, START + 1), rtol=1e-12)
    np.testing.assert_allclose(partly(START), march(turn, START, 0.3), rtol=1e-12)
