"""How loops are compiled: the switch, the trial of an unknown jaxlib, and what a failure does."""

import json
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib.version
import numpy as np
import pytest

import jaxquad as jq
from jaxquad._compile import brief_options, compiler_options, engine, hasty_options, Jit
from jaxquad._xla import _stablehlo, _switch, as_one_kernel


TAG = "xla_cpu_small_call"
ONE = jnp.asarray(1.0)


def loop(x):
    return jax.lax.scan(lambda x, _: (jnp.sin(x) + 0.1, None), x, None, length=40)[0]


def is_kernel():
    return TAG in jax.jit(lambda x: as_one_kernel(loop, x)).lower(ONE).as_text()


@pytest.fixture
def silence(monkeypatch):
    """Nothing was said yet."""
    monkeypatch.setattr(_switch, "_said", {})
    yield
    _switch.set_kernel("auto")


def test_a_switch_compiles_loops_plain_and_back(silence):
    assert is_kernel() and jq.engine().one_kernel
    off = jq.engine(kernel="off")
    assert (off.one_kernel, off.why_not) == (False, "switched off")
    assert not is_kernel()
    assert jq.engine(kernel="auto").why_not is None and is_kernel()


def test_a_change_of_the_switch_reaches_programs_that_are_compiled_already(silence):
    seen = []
    run = jax.jit(lambda x: (seen.append(engine().one_kernel), as_one_kernel(loop, x))[1])
    first = run(ONE)
    engine(kernel="off")
    np.testing.assert_allclose(run(ONE), first, rtol=1e-12)
    assert seen == [True, False]


def test_the_environment_switches_kernels_off(silence, monkeypatch):
    monkeypatch.setenv("JAXQUAD_KERNEL", "off")
    assert engine().why_not == "switched off" and not is_kernel()
    monkeypatch.setenv("JAXQUAD_KERNEL", "yes")
    with pytest.raises(ValueError, match='JAXQUAD_KERNEL is "yes", but it must be "auto" or "off"'):
        engine()


def test_another_word_for_the_switch_is_refused():
    with pytest.raises(ValueError, match='kernel is "on", but it must be "auto" or "off"'):
        _switch.set_kernel("on")


def test_an_outermost_loop_has_the_compilers_options_and_others_have_none():
    doubled = Jit(lambda x: 2 * x)
    assert doubled(ONE) == 2
    assert jax.jit(doubled)(ONE) == jax.jit(lambda: doubled(ONE))() == jax.grad(doubled)(ONE) == 2
    np.testing.assert_array_equal(jax.vmap(doubled)(jnp.ones(3)), 2)


def test_an_option_that_xla_does_not_know_is_said_once_and_left_out(monkeypatch):
    here = compiler_options()
    assert engine().vector_bits == here["xla_cpu_prefer_vector_width"]
    monkeypatch.setattr(_switch, "TESTED", ())
    monkeypatch.setattr(_switch, "_WIDEST", {"xla_of_another_age": 1})
    _switch._vector_options.cache_clear()
    with pytest.warns(UserWarning, match="up to a tenth slower.*xla_of_another_age"):
        assert compiler_options() == {}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert engine().vector_bits is None
    monkeypatch.undo()
    _switch._vector_options.cache_clear()
    assert compiler_options() == here


def test_tested_versions_are_not_asked_about_options_and_get_those_that_they_know(monkeypatch):
    options, unknown = _switch._WIDEST | _switch._BRIEF, {"xla_of_another_age": 1}
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    with monkeypatch.context() as patch:
        patch.setattr(_switch, "TESTED", (jaxlib.version.__version__,))
        assert _switch._refusal(unknown) is None  # nobody asks
    given = brief_options() | hasty_options()
    monkeypatch.setattr(_switch, "TESTED", ())
    assert "xla_of_another_age" in str(_switch._refusal(unknown))
    known = {k for k, v in options.items() if _switch._refusal({k: v}) is None}
    assert set(given) == known >= {"xla_backend_optimization_level", *_switch._WIDEST}


def test_what_does_not_compile_as_a_kernel_is_compiled_plain_and_said_once(silence, monkeypatch):
    monkeypatch.setattr(_stablehlo, "WIDEST", 10**9)  # lets in what XLA cannot compile
    traced = []

    def totals(x):
        traced.append(engine().one_kernel)
        step = lambda x, _: (jnp.sin(x) + 1e-4 * jnp.sum(x), None)
        return as_one_kernel(lambda x: jax.lax.scan(step, x, None, length=9)[0], x)

    run, x = Jit(totals), jnp.linspace(0.0, 1.0, 9_000)
    with pytest.warns(UserWarning, match="totals did not compile as one kernel"):
        found = run(x)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(run(x), found)
    with _switch.plain_loops(True):
        np.testing.assert_allclose(jax.jit(totals)(x), found, rtol=1e-12)
    assert traced[:2] == [True, False]
    assert "totals did not compile" in engine().left_plain[0]


@pytest.fixture
def untested(silence, monkeypatch, tmp_path):
    """A jaxlib that no test ran on, and an empty cache folder."""
    monkeypatch.setattr(_switch, "TESTED", ())
    monkeypatch.setattr(_switch.platformdirs, "user_cache_dir", lambda name: str(tmp_path / name))
    monkeypatch.delenv("JAXQUAD_CACHE", raising=False)
    _switch.why_not_trusted.cache_clear()
    yield tmp_path
    _switch.why_not_trusted.cache_clear()


@pytest.mark.slow
def test_kernels_pass_their_trial_with_this_jaxlib(untested):
    assert engine().one_kernel
    (answer,) = untested.glob("jaxquad/kernel-*.json")
    assert json.loads(answer.read_text()) == {"why_not": ""}


def test_an_answer_is_kept_and_a_failed_trial_is_warned_of(untested, monkeypatch):
    asked = []
    monkeypatch.setattr(_switch, "_ask_child", lambda: asked.append(1) or "status -6: aborted")
    for _ in range(2):
        _switch._said.clear()
        _switch.why_not_trusted.cache_clear()
        with pytest.warns(UserWarning, match="did not pass the trial.*status -6: aborted"):
            assert not engine().one_kernel
        assert not is_kernel()
    assert asked == [1]


def test_without_a_cache_every_process_asks_anew(untested, monkeypatch):
    monkeypatch.setenv("JAXQUAD_CACHE", "off")
    monkeypatch.setattr(_switch, "_ask_child", lambda: "")
    assert engine().one_kernel and not list(untested.iterdir())


def test_an_answer_that_cannot_be_read_is_asked_for_again(untested, monkeypatch):
    path = _switch._answer_path()
    assert path is not None
    path.parent.mkdir(parents=True)
    path.write_text("{")
    monkeypatch.setattr(_switch, "_ask_child", lambda: "")
    with pytest.warns(UserWarning, match="cannot be read"):
        assert engine().one_kernel
    assert json.loads(path.read_text()) == {"why_not": ""}


def test_a_child_that_dies_tells_its_last_words(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    assert "/no/such/python" in _switch._ask_child()


def run_program(name, first, last):
    script = Path(__file__).parents[1] / name
    program = [sys.executable, "-W", "error", script, str(first), str(last)]
    ran = subprocess.run(program, capture_output=True, text=True)
    assert ran.stdout.endswith("same\n"), ran.stdout + ran.stderr[-2000:]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 304, 309])
def test_random_loops_are_the_same_as_kernels_and_no_process_ends(seed):
    run_program("random_loops.py", seed, seed + 1)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_loops_with_random_delays_are_the_same_as_kernels_and_compile_in_time():
    run_program("random_delays.py", 0, 6)
