"""A time loop compiled as one kernel computes what the plain one does, or is left plain."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad._compile import engine
from jaxquad._xla import _stablehlo, as_one_kernel


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


def test_both_passes_are_kernels_where_each_is_in_a_function_of_its_own():
    """Nothing asks for the forward pass's result there, nor does its reverse see where it is."""
    last = jax.jit(lambda x, p: as_one_kernel(lambda x, p: march(turn, x, p), x, p)[-1])
    slope = jax.jit(jax.grad(lambda x, p: jnp.sum(last(x, p)), argnums=(0, 1)))
    assert slope.lower(START, GAIN).as_text().count(TAG) == 2
    expected = jax.grad(lambda x, p: jnp.sum(march(turn, x, p)[-1]), argnums=(0, 1))(START, GAIN)
    for one, other in zip(slope(START, GAIN), expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


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
    def has_a_window_whose_reverse_scatters(x, p):
        pool = lambda x: jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (2,), (1,), "SAME")
        return p * jax.grad(lambda x: jnp.sum(pool(x) ** 2))(x)

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
    assert any(line.startswith("a kernel does not hold") for line in engine().left_plain)


def test_more_operations_than_compile_in_time_are_left_to_the_plain_compiler(monkeypatch):
    run = jax.jit(lambda x, p: kernel(x, p))
    monkeypatch.setattr(_stablehlo, "_MOST_OPERATIONS", 10)
    assert TAG not in run.lower(START, GAIN).as_text()
    assert any(" operations, " in line for line in engine().left_plain)


@pytest.mark.parametrize("numbers", [20_000, 90_000])
@pytest.mark.parametrize("kind", ["carried", "stored", "branched"])
def test_arrays_that_xla_would_divide_among_threads_do_not_end_the_compiler(numbers, kind):
    """A kernel has one thread; XLA divides a function's only result from 256 KiB on."""
    x = jnp.linspace(0.0, 1.0, numbers)

    def step(x, p):
        if kind == "branched":
            return jax.lax.cond(x[0] > 0.5, lambda: jnp.sin(p * x), lambda: x + p)
        return jnp.sin(p * x) if kind == "carried" else jnp.broadcast_to(p * x[:3].sum(), x.shape)

    fast = jax.jit(lambda x, p: as_one_kernel(lambda x, p: march(step, x, p), x, p))
    found, expected = fast(x, GAIN)[-1], march(step, x, GAIN)[-1]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


ABORTING = """
import jax, jax.numpy as jnp
from jaxquad._xla import as_one_kernel

def march(step, x):
    return jax.lax.scan(lambda x, _: (step(x),) * 2, x, None, length=40)[1]

def check(function, *args, constants=()):
    run = jax.jit(lambda *args: as_one_kernel(function, *args, *constants))
    assert "xla_cpu_small_call" in run.lower(*args).as_text()
    assert jnp.allclose(run(*args), function(*args, *constants), rtol=1e-5)

x, k = jnp.asarray([1.0, 0.3, -0.2]), jnp.asarray([3, 1, 2])
turned = lambda x: jnp.sin(x) + 0.1
check(lambda x, y: march(turned, x), x, x + 1)
check(lambda x, k: march(lambda x: turned(x) + jnp.where(k == k, 0.1, 0.2), x), x, k)
check(lambda x, y: march(lambda x: turned(x) + jnp.where(jnp.zeros(3, bool), y, 0.2), x), x, x + 1)
check(lambda x, b: march(lambda x: turned(x) + (b & False), x), x, x > 0)
check(lambda x, k: march(lambda x: turned(x) + k % 1, x), x, k)
check(lambda x, y: march(lambda x: turned(x) * y, x), x, constants=(jnp.asarray(0.3),))
check(lambda x, y: march(lambda x: turned(x) * y[2], x), x, constants=(jnp.ones((999, 3)),))
check(lambda x, y: y, x, x + 1)
print("survived")
"""


def in_a_process(program):
    """What it prints last; XLA's failures end a process, so that none is seen in this one."""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr[-2000:]
    return ran.stdout.split()[-1]


@pytest.mark.slow
def test_constants_and_arguments_whose_use_is_simplified_away_do_not_end_the_process():
    """They do, in XLA as of jaxlib 0.10, unless a barrier hides those and a sum uses these."""
    assert in_a_process(ABORTING) == "survived"


SHARDED = """
import jax, jax.numpy as jnp
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
from jaxquad._xla import as_one_kernel

jax.config.update("jax_num_cpu_devices", 2)
mesh = jax.make_mesh((2,), ("members",), axis_types=(AxisType.Auto,))

def mean(x):
    return jax.lax.scan(lambda x, _: (jnp.sin(x) + 0.1 * jnp.mean(x),) * 2, x, None, length=40)[1]

own = jax.jit(lambda x: as_one_kernel(mean, x))
apart = jax.jit(jax.shard_map(own, mesh=mesh, in_specs=P("members"), out_specs=P(None, "members")))
x = jnp.linspace(0.0, 1.0, 8)
split = jax.device_put(x, NamedSharding(mesh, P("members")))
kernels = ["xla_cpu_small_call" in run.lower(split).as_text() for run in (own, apart)]
assert kernels == [False, True]
assert jnp.allclose(own(split), mean(x), rtol=1e-5)
assert jnp.allclose(apart(split), jnp.concatenate([mean(x[:4]), mean(x[4:])], 1), rtol=1e-5)
print("split")
"""


@pytest.mark.slow
def test_what_xla_splits_among_devices_is_left_plain():
    """A kernel cannot be split; within `jax.shard_map` each device has its own."""
    assert in_a_process(SHARDED) == "split"


MISSING = """
import sys
import equinox, jax  # equinox needs some of them itself
{how}
from jaxquad._compile import engine, no_fuse
import warnings
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter('always')
    told = engine()
assert not told.one_kernel and 'lacks what kernels are made with' in told.why_not
assert told.why_not in str(said[-1].message)
x = jax.numpy.ones(3)
assert jax.numpy.allclose(no_fuse(jax.numpy.sin, x), jax.numpy.sin(1.0))
print("plain")
"""
WITHOUT = {
    "the extension": "sys.modules['jax.extend.mlir'] = None",
    "the rules": "import jax.interpreters.mlir as m; del m.register_lowering",
    "the dialect": "sys.modules['jax.extend.mlir.dialects'] = None",
}


@pytest.mark.slow
@pytest.mark.parametrize("what", WITHOUT)
def test_without_the_compilers_interfaces_a_loop_is_plain(what):
    assert in_a_process(MISSING.format(how=WITHOUT[what])) == "plain"


def test_an_interface_that_fails_leaves_a_program_that_runs_and_is_warned_of(monkeypatch):
    monkeypatch.setattr(_stablehlo, "_sum_of_firsts", None)
    run = jax.jit(lambda x, p: 2 * kernel(x, p))
    with pytest.warns(UserWarning, match="cannot mark a kernel"):
        assert TAG not in run.lower(START, GAIN).as_text()
    np.testing.assert_allclose(run(START, GAIN), 2 * plain(START, GAIN), rtol=1e-12)
    assert any("cannot mark a kernel" in line for line in engine().left_plain)


@pytest.mark.parametrize("odd", [jnp.zeros(0), jnp.ones(3, complex)], ids=["empty", "complex"])
def test_empty_and_complex_arguments_are_left_to_the_plain_compiler(odd):
    run = jax.jit(lambda x, y: as_one_kernel(lambda x, y: march(turn, x, 0.7) + y.sum().real, x, y))
    assert TAG not in run.lower(START, odd).as_text()
    expected = march(turn, START, 0.7) + np.sum(np.asarray(odd)).real
    np.testing.assert_allclose(run(START, odd), expected, rtol=1e-12)
