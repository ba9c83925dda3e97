"""A time loop as one kernel of a GPU is the plain scan, in values and derivatives.

The kernels, in CUDA C, are compiled for the processor here.
"""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cuda_on_host import for_cuda, run_on_host

from jaxquad._xla import (
    _cuda,
    _loop,
    _passes,
    _switch,
    scan_on_device,
)
from jaxquad.models import sincos


MEMBERS, SAMPLES = 150, 7  # a block and a part of one; segments of 3, 3 and 1
QUICK = {"xla_backend_optimization_level": 0}


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    monkeypatch.setattr(_switch, "_said", {})
    run_on_host(monkeypatch)


def plain(step, carry, signals):
    return jax.lax.scan(step, carry, signals)


def kernel(step, carry, signals):
    found = scan_on_device(step, carry, signals, MEMBERS, plain)
    assert found is not None, _switch.left_plain()
    return found


def compiled(function, *args):
    with _switch.device_kernels("forced"):
        return jax.jit(function, compiler_options=QUICK)(*args)


def spread(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).uniform(0.2, 0.8, shape))


def coupled(matrix, gain, carry, now):
    """Small products, stacks, slices, masks, a short loop: all that is no arithmetic."""
    (x, level, stopped), (index, reference, noise) = carry, now
    error = reference[:, None] - x + 0.1 * noise
    torque = jnp.clip(jnp.tensordot(matrix, error, 1) * gain[None], -0.4, 0.4)

    @jax.checkpoint
    def substep(x, _):
        turned = jnp.stack([x[1] * x[2], x[2] * x[0], x[0] * x[1]])
        return x + 0.05 * (torque - turned), None

    x = jax.lax.scan(substep, x, None, length=2)[0]
    x = jnp.where(stopped[None], x, jnp.concatenate([x[:1], jnp.flip(x[1:], 0)]))
    level = jax.lax.cond(index > 3, lambda a: a * 0.9, lambda a: a + jnp.max(x, axis=0), level)
    level = jax.lax.switch(index % 3, [jnp.sin, jnp.cos, lambda a: a * a], level)
    stopped = stopped | (jnp.sum(x**2, axis=0) > 1.2)
    return (x, level, stopped), (jnp.linalg.norm(x, axis=0), jnp.max(reference))


def total(scan, matrix, gain, start, reference, noise):
    carry = (start, jnp.zeros_like(gain), jnp.zeros(MEMBERS, bool))
    signals = (jnp.arange(SAMPLES), reference, noise)
    carry, (size, seen) = scan(ft.partial(coupled, matrix, gain), carry, signals)
    weight = jnp.arange(1.0, MEMBERS + 1).astype(gain.dtype)
    cost = jnp.sum(carry[0] * weight[None]) + jnp.sum(carry[1] * jnp.sum(size, axis=0) * weight)
    return cost, (carry, size, seen)


def given():
    sizes = (3, 3), (MEMBERS,), (3, MEMBERS), (SAMPLES, 3), (SAMPLES, 3, MEMBERS)
    return [spread(*size, seed=k) for k, size in enumerate(sizes)]


def have_memory(monkeypatch):
    """That of a GPU which keeps every second carry, and shares its memory among threads."""
    monkeypatch.setattr(_loop, "_memory", lambda: (10**9, 228 * 1024))


@pytest.mark.slow
@pytest.mark.parametrize("memory", ["little", "much", "much, few registers", "few registers"])
def test_values_and_gradients_are_those_of_the_plain_scan(memory, monkeypatch):
    """With respect to what members share and what they do not, at the start and in every sample."""
    if "much" in memory:
        have_memory(monkeypatch)
    if memory == "few registers":
        monkeypatch.setattr(_loop, "_memory", lambda: (1, 228 * 1024))
    if "registers" in memory:
        monkeypatch.setattr(_loop, "_HELD", 0)
        reverse = written(jax.grad(lambda *args: total(kernel, *args)[0], range(5)), *given())[1]
        assert all(f"held[{k * _passes.BLOCK}]" in reverse for k in range(20))
        assert ("again_float64 = " in reverse) == ("much" in memory)
    both = [jax.value_and_grad(ft.partial(total, scan), argnums=range(5), has_aux=True)
            for scan in (kernel, plain)]  # fmt: skip
    found, expected = (jax.tree.leaves(compiled(f, *given())) for f in both)
    assert not _switch.left_plain()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13)


def test_carries_are_kept_as_often_as_a_part_of_the_memory_allows(monkeypatch):
    count, carry, members, block = 5000, 140, 100_000, 128
    segments = _loop.segments_of
    assert segments(count, carry, members, block) == _loop.Segments(count, 71, False)  # no GPU
    for room, expected in (
        (400e9, _loop.Segments(count, 2, True)),
        (160e9, _loop.Segments(count, 3, True)),
        (80e9, _loop.Segments(count, 6, True)),
        (70e9, _loop.Segments(count, 71, False)),  # 7 carries of a block take more than 113 kB
    ):
        monkeypatch.setattr(_loop, "_memory", lambda room=room: (int(room), 228 * 1024))
        assert segments(count, carry, members, block) == expected
    monkeypatch.setattr(_loop, "_memory", lambda: (10**12, 64 * 1024))
    assert not segments(count, carry, members, block).are_shared  # not even two of them fit
    assert _loop.segments_of(count, 40, members, block) == _loop.Segments(count, 2, True)


def test_what_registers_have_no_room_for_is_held_in_shared_memory(monkeypatch):
    assert _loop.held_bytes(944, 664, 128) == 0  # no GPU
    monkeypatch.setattr(_loop, "_memory", lambda: (10**12, 228 * 1024))
    assert _loop.held_bytes(944, 664, 128) == 664 and _loop.held_bytes(472, 0, 128) == 0
    assert _loop.held_bytes(680, 500, 128) == 0 and _loop.held_bytes(684, 500, 128) == 500
    assert _loop.held_bytes(4000, 2000, 128) == 0  # more than a block has
    assert _loop.segments_of(5000, 40, 1000, 128, 664) == _loop.Segments(5000, 2, True, 664)
    assert _loop.segments_of(5000, 280, 1000, 128, 664) == _loop.Segments(5000, 71, False, 664)


def written(function, *args):
    """The texts of its kernels, in CUDA C."""
    texts = []
    with pytest.MonkeyPatch.context() as patch, _switch.device_kernels("forced"):
        patch.setattr(_passes, "launch", ft.partial(_launched, texts))
        jax.jit(function).lower(*args)
    return texts


def _launched(texts, text, name, args, outs, *_):
    texts.append(text)
    return [jnp.zeros(x.shape, x.dtype) for x in outs]


def steady(scan, tuning, x):
    """Two controllers of the same gains: sums, products and a square root that never change."""
    low, high = tuning[:1], tuning[1:]

    def step(x, now):
        push = [jnp.clip(jnp.sqrt(low * high) * x + now * (high - low), 0.1, 0.3) for _ in "ab"]
        return x + 0.1 * (push[0] + push[1]), None

    return jnp.sum(scan(step, x, jnp.linspace(0.0, 1.0, SAMPLES))[0] ** 2)


@pytest.mark.slow
def test_what_is_the_same_in_every_sample_is_computed_before_the_loop():
    args = spread(2, MEMBERS), spread(1, MEMBERS, seed=1)
    forward, reverse = written(jax.grad(ft.partial(steady, kernel)), *args)
    for text in forward, reverse:
        assert "sqrt(" not in text.split("kernel(")[1]
    found, expected = (compiled(jax.grad(ft.partial(steady, s)), *args) for s in (kernel, plain))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.slow
def test_what_would_take_many_arrays_before_the_loop_stays_in_it():
    """The differences of a map's values, as many as they are."""
    knots, x = spread(40, MEMBERS), spread(1, MEMBERS, seed=1)

    def cost(scan, knots, x):
        slopes = lambda: (knots[k + 1 : k + 2] - knots[k : k + 1] for k in range(39))
        step = lambda x, now: (x + now * sum(jnp.sin(slope * x) for slope in slopes()), None)
        return jnp.sum(scan(step, x, jnp.linspace(0.0, 0.1, SAMPLES))[0])

    [text] = written(ft.partial(cost, kernel), knots, x)
    assert "fixed0" in text and "fixed1" not in text
    found, expected = (compiled(jax.grad(ft.partial(cost, s)), knots, x) for s in (kernel, plain))
    np.testing.assert_allclose(found, expected, rtol=1e-11)


def limited(scan, low, high, x):
    """By either way to write it, at and beyond the limits and between them."""

    def step(x, now):
        held = jax.lax.clamp(low, x + now, high) + jnp.clip(x - now, low, high)
        return 0.5 * jnp.maximum(held, x), None

    return jnp.sum(scan(step, x, jnp.array([0.0, 0.2, 0.0]))[0] ** 2)


@pytest.mark.slow
def test_slopes_of_limits_are_one_choice_and_no_quotient():
    x = jnp.array([[0.1, 0.3, 0.2, 0.4, 0.05] * (MEMBERS // 5)])
    args = jnp.full((1, MEMBERS), 0.1), jnp.full((1, MEMBERS), 0.3), x
    slope = jax.grad(ft.partial(limited, kernel), range(3))
    reverse = written(slope, *args)[1].split("kernel(")[1]
    assert "within(" in reverse
    assert not [line for line in reverse.splitlines() if "/ v" in line]
    found, expected = (compiled(jax.grad(ft.partial(limited, s), range(3)), *args)
                       for s in (kernel, plain))  # fmt: skip
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.parametrize("kind, far", [(np.float32, 1e6), (np.float64, 1e9)])
def test_sines_and_cosines_of_a_kernel_are_right_to_the_last_bit(kind, far):
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(-4, 4, 3000), rng.uniform(-far, far, 3000), [2 * far, np.nan]])
    x = x.astype(kind)
    step = lambda c, now: (jnp.stack(sincos(c[0] + 0 * now)), None)
    run = lambda x: scan_on_device(step, jnp.stack([x, x]), jnp.ones(1, kind), x.size, plain)
    found = np.asarray(compiled(run, jnp.asarray(x))[0])
    with np.errstate(invalid="ignore"):
        expected = np.stack([np.sin(x.astype(np.longdouble)), np.cos(x.astype(np.longdouble))])
    error = np.abs(found - expected)[:, :-2] / np.finfo(kind).eps
    assert error.max() < 0.7
    assert np.isnan(found[:, -2:]).all()


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_gradient_is_two_kernels_of_a_gpu_and_no_loop_around_them(kind):
    args = [x.astype(kind) for x in given()]
    text = for_cuda(jax.grad(lambda *args: total(kernel, *args)[0], range(5)), *args)
    assert not _switch.left_plain()
    assert text.count("gpu.ptx") == 2
    assert "stablehlo.while" not in text


def squared(scan, x):
    step = lambda c, now: (c * jnp.sin(c * now), None)
    return jnp.sum(scan(step, x * jnp.ones((2, MEMBERS)), jnp.arange(1.0, 6.0))[0])


MODES = {
    "forward": jax.jacfwd,
    "second": lambda f: jax.jacfwd(jax.grad(f)),
    "twice reverse": lambda f: jax.grad(jax.grad(f)),
    "batched": lambda f: lambda x: jax.vmap(jax.grad(f))(jnp.stack([x, 2 * x])),
}


@pytest.mark.parametrize("mode", MODES)
def test_other_derivatives_run_as_plain_scans(mode):
    x = jnp.asarray(0.7)
    found, expected = (compiled(MODES[mode](ft.partial(squared, s)), x) for s in (kernel, plain))
    np.testing.assert_allclose(found, expected, rtol=1e-11)


def between(k):
    return (k > 3) & (k < 6)


OPERATIONS = {
    name: getattr(jnp, name)
    for name in """
        abs negative ceil floor exp exp2 expm1 log log1p sqrt square cbrt sin cos tan arcsin arccos
        arctan sinh cosh tanh arcsinh arctanh isfinite sign
    """.split()
} | {
    "arccosh": lambda x: jnp.arccosh(1 + x),
    "round": lambda x: jnp.round(10 * x),
    "away": lambda x: jax.lax.round(10 * x, jax.lax.RoundingMethod.AWAY_FROM_ZERO),
    "rsqrt": jax.lax.rsqrt,
    "power": lambda x: x**2.5,
    "integer power": lambda x: x**-3,
    "logistic": jax.nn.sigmoid,
    "arctan2": lambda x: jnp.arctan2(x, 0.3 - x),
    "remainder": lambda x: jax.lax.rem(x, jnp.full_like(x, 0.3)),
    "clamp": lambda x: jax.lax.clamp(jnp.asarray(0.3, x.dtype), x, jnp.asarray(0.6, x.dtype)),
    "extremes": lambda x: jnp.maximum(x, 0.5) / jnp.minimum(x, 0.4),
    "product": lambda x: jnp.prod(x, axis=0, keepdims=True) + x,
    "running sum": lambda x: jnp.cumsum(x, axis=0),
    "any and all": lambda x: x + (jnp.any(x > 0.5, 0) ^ jnp.all(x > 0.3, 0))[None].astype(x.dtype),
    "padded": lambda x: jnp.pad(x, ((1, 2), (0, 0)))[1:3] + jnp.roll(x, 1, axis=0),
    "placed": lambda x: jax.lax.dynamic_update_slice(x, 2 * x[:1], (1, 0)),
    "taken": lambda x: x * jax.lax.dynamic_slice(x, (1, 0), (1, MEMBERS)),
    "two products": lambda x: jnp.einsum("in,jn,ij->jn", x, x, jnp.asarray(ROWS, x.dtype)),
    "constants": lambda x: x + jnp.sqrt(jnp.full_like(x, 2.0)) ** 3,
    "not finite": lambda x: jnp.where(x > 0.6, jnp.inf, jnp.where(x > 0.4, -jnp.inf, jnp.nan)),
    "error function": jax.scipy.special.erf,
    "counted": lambda x: jnp.where((x > 0.3) & (x < 0.6), jnp.int32(3), 0),
    "chosen by a number": lambda x: jnp.where(between(jnp.floor(9 * x).astype(int)), x, 0.0),
    "switch": lambda x: jax.lax.switch(2, [jnp.sin, jnp.cos, jnp.tan], x),
}  # fmt: skip
ROWS = np.array([[1.0, 2.0], [0.0, 3.0]])


def every_operation(scan, x):
    def step(x, now):
        out = [f(x).astype(x.dtype) for f in OPERATIONS.values()]
        return jnp.sin(x) + now, tuple(out)

    return scan(step, x, jnp.full(3, 0.1, x.dtype))


def test_each_operation_is_that_of_the_plain_scan():
    x = spread(2, MEMBERS)
    found, expected = (compiled(ft.partial(every_operation, s), x) for s in (kernel, plain))
    for name, one, other in zip(OPERATIONS, found[1], expected[1], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14, err_msg=name)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_each_operation_becomes_code_for_a_gpu(kind):
    text = for_cuda(ft.partial(every_operation, kernel), spread(2, MEMBERS).astype(kind))
    assert text.count("gpu.ptx") == 1


def test_a_member_that_is_nan_stays_nan():
    """The maximum and the minimum of CUDA would drop it."""
    x = jnp.full((1, MEMBERS), jnp.nan)
    step = lambda x, now: (jnp.minimum(jnp.maximum(jnp.clip(x, 0, 1), now), now), None)
    out, _ = compiled(lambda x: kernel(step, x, jnp.ones(3)), x)
    assert np.isnan(out).all()


REFUSED = {
    "sort": lambda x: jnp.sort(x, axis=0),
    "reduce_sum over the members": lambda x: x - jnp.sum(x, axis=1, keepdims=True),
    "a slice of the members": lambda x: x + x[:, :1],
    "a loop of 100 iterations": lambda x: jax.lax.fori_loop(0, 100, lambda _, x: 0.9 * x, x),
    "float16": lambda x: x.astype(jnp.float16).astype(x.dtype),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_a_kernel_cannot_hold_is_left_to_the_plain_scan_and_said(what):
    run = lambda x: scan_on_device(lambda x, _: (REFUSED[what](x), None), x, ONES, MEMBERS, plain)
    with _switch.device_kernels("forced"):
        assert jax.eval_shape(run, spread(2, MEMBERS)) is None
    (said,) = _switch.left_plain()
    assert what in said


ONES = np.ones(2)


def test_a_step_of_too_many_arrays_is_left_to_the_plain_scan_and_said():
    many = tuple(spread(MEMBERS) for _ in range(101))
    run = lambda x: scan_on_device(lambda x, _: (x, None), x, ONES, MEMBERS, plain)
    with _switch.device_kernels("forced"):
        assert jax.eval_shape(run, many) is None
    assert "more than 200 arrays" in _switch.left_plain()[0]


def test_what_nvrtc_does_not_compile_runs_as_a_plain_scan_with_a_warning(monkeypatch):
    def fails(*_):
        raise _cuda.CannotCompile("line 7: error")

    monkeypatch.setattr(_passes, "launch", fails)
    x = jnp.asarray(0.7)
    with pytest.warns(UserWarning, match="line 7"):
        found = compiled(jax.grad(ft.partial(squared, kernel)), x)
    np.testing.assert_allclose(found, jax.grad(ft.partial(squared, plain))(x), rtol=1e-12)


def test_without_nvrtc_it_is_said_what_brings_it(monkeypatch):
    monkeypatch.setattr(_cuda, "_places", lambda: iter(["no such library"]))
    with pytest.raises(_cuda.CannotCompile, match="pip install"):
        _cuda._library.__wrapped__()


def test_without_a_gpu_no_loop_is_given_to_one():
    run = lambda x: scan_on_device(lambda x, _: (x, None), x, ONES, 1000, plain)
    assert jax.default_backend() == "gpu" or jax.eval_shape(run, spread(2, 1000)) is None


def trial():
    with _switch.device_kernels("forced"):
        return _switch.why_no_trust_in_gpu.__wrapped__()


@pytest.mark.slow
def test_kernels_are_compared_with_a_plain_loop_before_they_are_trusted(monkeypatch):
    said = []
    jax.jit(lambda x: said.append(trial()))(1.0)  # while another program is traced
    assert said == [None]
    monkeypatch.setattr(_switch, "_by_kernel", lambda *args: plain(args[0], *args[1:]))
    assert trial() is None
    wrong = lambda step, carry, signals: plain(step, carry, signals[::-1])
    monkeypatch.setattr(_switch, "_by_kernel", wrong)
    assert "differs from a plain loop" in str(trial())


def test_a_trial_that_fails_tells_why(monkeypatch):
    def fails(*_):
        raise RuntimeError("no such instruction")

    monkeypatch.setattr(_switch, "_by_kernel", fails)
    assert "no such instruction" in str(trial())
