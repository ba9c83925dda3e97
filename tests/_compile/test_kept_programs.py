"""Programs are found on the disk by what they would be traced from, and by nothing less."""

import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad import LADRC
from jaxquad._compile import _programs, KeptPrograms


ARGUMENTS = LADRC(10.0, 30.0, 0.85, dt=0.002), jnp.arange(3.0)
PROCESS = """
import jax
import jaxquad as jq
from synthetic import response_of

jq.enable_x64()
jq.enable_compile_cache()
traced = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, _, fun_name="", **__: "trace" in event and traced.append(fun_name)
)
loop = jq.Loop(jq.DecoupledAxes([0.0468], [0.0552]), jq.LADRC(10.0, 30.0, 0.85))
flight = jq.simulation.scenario(duration=0.5, dt=0.002, axes=1, reference=jq.simulation.Step(0.1))
print(jq.simulate(loop, flight).angle.tobytes().hex())
axis = jq.LaggedIntegrator(280.0, 0.016, 0.011)
print(jq.fit(axis, response_of(axis, seed=0)).values.tobytes().hex())
print(*(any(each in name for name in traced) for each in ("_run", "_solve_by_default")))
"""


class Foreign(eqx.Module):
    gain: jax.Array


@pytest.fixture
def traced(monkeypatch, tmp_path):
    """What was traced, by functions whose programs are kept in a folder of this test."""
    monkeypatch.setattr(_programs, "_folder", lambda: tmp_path)
    return []


def kept(traced):
    def scaled(controller, values, power=2):
        traced.append(power)
        return {"values": controller.wc * values.astype(float) ** power, "wc": controller.wc}

    return KeptPrograms(scaled, dict)


def test_a_program_is_found_again_without_tracing(traced):
    first = kept(traced)(*ARGUMENTS)
    again = kept(traced)(*ARGUMENTS)
    assert traced == [2]
    np.testing.assert_array_equal(first["values"], 10 * np.arange(3.0) ** 2)
    assert first["wc"] == again["wc"] and np.array_equal(first["values"], again["values"])


@pytest.mark.parametrize("folder", [True, False])
def test_loaded_programs_are_bounded(folder, traced, monkeypatch):
    if not folder:
        monkeypatch.setattr(_programs, "_folder", lambda: None)
    monkeypatch.setattr(_programs, "_MOST_LOADED", 3)
    functions = [kept(traced), kept(traced)]
    for length in (*range(2, 9), 2):
        for function in functions:
            result = function(ARGUMENTS[0], jnp.arange(float(length)))
            np.testing.assert_array_equal(result["values"], 10 * np.arange(length) ** 2.0)
    leaves, structure = jax.tree.flatten(ARGUMENTS)
    _, others = _programs._arrays_and_others(leaves)
    programs = [function.of(structure, others) for function in functions]
    assert sum(len(x._compiled) + x.plain._cache_size() for x in programs) <= 3


def filled(arrays):
    """ARGUMENTS with other arrays."""
    leaves, structure = jax.tree.flatten(ARGUMENTS)
    given = iter(arrays)
    return jax.tree.unflatten(structure, [next(given) if eqx.is_array(x) else x for x in leaves])


@pytest.mark.parametrize("values", [np.arange(3.0), np.arange(5.0)], ids=["three", "five"])
def test_a_program_of_arrays_alone_is_found_again(traced, values):
    *own, _ = filter(eqx.is_array, jax.tree.leaves(ARGUMENTS))
    first, again = (kept(traced).of_arrays(filled)([*own, values]) for _ in range(2))
    assert traced == [2]
    np.testing.assert_array_equal(first["values"], 10 * values**2)
    assert np.array_equal(first["values"], again["values"])


def test_arrays_out_of_order_are_refused(traced):
    arrays = [*filter(eqx.is_array, jax.tree.leaves(ARGUMENTS))]
    with pytest.raises(ValueError, match="in their order"):
        kept(traced).of_arrays(lambda given: filled(given[::-1]))(arrays)


@pytest.mark.parametrize(
    "other",
    [
        (ARGUMENTS[0], jnp.arange(4.0)),
        (ARGUMENTS[0], jnp.arange(3)),
        (*ARGUMENTS, 3),
        (LADRC(10.0, 30.0, 0.85, dt=0.004), ARGUMENTS[1]),
    ],
    ids=["shape", "type", "number", "setting"],
)
def test_a_program_is_for_what_it_was_traced_from(traced, other):
    kept(traced)(*ARGUMENTS)
    found = kept(traced)(*other)
    assert len(traced) == 2
    np.testing.assert_allclose(found["values"], 10.0 * np.asarray(other[1], float) ** traced[1])


def test_numbers_of_arrays_are_given_to_the_same_program(traced):
    kept(traced)(*ARGUMENTS)
    other = LADRC(5.0, 30.0, 0.85, dt=0.002), jnp.ones(3)
    assert kept(traced)(*other)["wc"] == 5.0
    assert len(traced) == 1


@pytest.mark.parametrize(
    "foreign",
    [(Foreign(jnp.ones(())), jnp.arange(3.0)), (*ARGUMENTS, lambda x: x), (*ARGUMENTS, kept)],
    ids=["class", "function", "function with a name"],
)
def test_what_another_has_made_is_not_kept(traced, foreign, tmp_path):
    programs = KeptPrograms(lambda *args: args[1] + 1, dict)
    np.testing.assert_array_equal(programs(*foreign), np.arange(3.0) + 1)
    assert not any(tmp_path.iterdir())


def test_a_program_that_calls_lapack_is_not_kept(traced, tmp_path):
    """In a process that has not traced it, its functions are not loaded, and it crashes."""

    def eigenvalues(matrix):
        return jnp.linalg.eigvalsh(matrix)

    found = KeptPrograms(eigenvalues, dict)(jnp.eye(2))
    assert not any(tmp_path.iterdir())
    np.testing.assert_array_equal(found, [1.0, 1.0])


def test_a_change_of_the_source_makes_another_name(monkeypatch):
    name = lambda: _programs._name(test_a_program_is_found_again_without_tracing, {}, ())
    before = name()
    monkeypatch.setattr(_programs, "_makers", lambda: b"another source")
    assert name() != before


def test_a_damaged_file_is_compiled_anew(traced, tmp_path):
    kept(traced)(*ARGUMENTS)
    [path] = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:100])
    with pytest.warns(UserWarning, match="compiled again"):
        assert kept(traced)(*ARGUMENTS)["wc"] == 10.0
    assert kept(traced)(*ARGUMENTS)["wc"] == 10.0
    assert len(traced) == 2


def test_without_a_folder_no_program_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(_programs, "_write", lambda *_: pytest.fail("a program is kept"))
    assert KeptPrograms(lambda _, x: x, dict)(*ARGUMENTS)[2] == 2.0


@pytest.mark.slow
def test_a_second_process_traces_neither_flight_nor_fit_and_finds_the_same(tmp_path):
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    environment = inherited | {
        "JAXQUAD_CACHE": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)
    }  # fmt: skip
    compute = lambda: subprocess.run(
        [sys.executable, "-W", "error", "-c", PROCESS],
        env=environment, capture_output=True, text=True, check=True, timeout=100,
    ).stdout.split()  # fmt: skip
    (*found, flown, fitted), (*again, flown_again, fitted_again) = compute(), compute()
    assert found == again
    assert flown == fitted == "True" and flown_again == fitted_again == "False"
