"""A known change of the model in one of several records."""

import pickle

import equinox as eqx
import jax
import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq


RIG = jq.models.AttitudeAxis(L=0.197, K_t=0.1188, J_x=0.0552, lag=0.02)
START = jq.models.AttitudeAxis(L=0.197, K_t=0.2, J_x=0.1, lag=0.03)
FREE = ("J_x", "K_t", "lag")
ADDED = 0.0276
CHANGED = jq.identify.Changed("J_x", plus=ADDED)


def loaded(rig):
    return rig.with_added_inertia(ADDED)


@pytest.fixture(scope="module")
def frfs():
    return response_of(RIG, seed=2), response_of(loaded(RIG), seed=3)


def fit(frfs, condition):
    return jq.fit(START, frfs, free=FREE, conditions=(None, condition))


@pytest.mark.slow
def test_a_changed_parameter_is_fitted_as_the_function_that_changes_it(frfs):
    named, function = fit(frfs, CHANGED), fit(frfs, loaded)
    assert named.identifiable
    np.testing.assert_allclose(named.values, function.values, rtol=1e-9)
    np.testing.assert_allclose(named.standard_errors, function.standard_errors, rtol=1e-6)
    assert np.all(np.abs(named.values - [0.0552, 0.1188, 0.02]) < 3 * named.standard_errors)


def test_it_adds_and_multiplies():
    changed = jq.identify.Changed("K_t", plus=0.01, times=2.0)(RIG)
    assert float(changed.K_t) == pytest.approx(2 * 0.1188 + 0.01)
    assert float(changed.J_x) == 0.0552 and float(RIG.K_t) == 0.1188


def test_it_changes_models_of_numpys_arrays_too():
    changed = CHANGED(jax.tree.map(np.asarray, RIG))
    assert isinstance(changed.J_x, np.ndarray) and float(changed.J_x) == 0.0552 + ADDED


@pytest.mark.slow
def test_its_numbers_are_no_part_of_a_program():
    lowered = []

    def listen(event: str, duration_secs: float, **facts: str | int):
        if "jaxpr_to_mlir" in event:
            lowered.append(facts.get("fun_name"))

    omega = np.geomspace(0.5, 20.0, 23)  # as no other test has them
    few = response_of(RIG, seed=2, omega=omega), response_of(loaded(RIG), seed=3, omega=omega)
    fit(few, CHANGED)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        other = fit(few, jq.identify.Changed("J_x", plus=0.03))
    finally:
        jax.monitoring.clear_event_listeners()
    assert not lowered and other.identifiable


@pytest.mark.parametrize("condition", [None, loaded, CHANGED], ids=["none", "function", "changed"])
def test_jax_finds_arrays_alone_in_a_problem(frfs, condition):
    parameters = jq.identify.select_parameters(START, FREE)
    problem = jq.identify.make_problem(START, parameters, frfs, (None, condition))
    assert all(map(eqx.is_array, jax.tree.leaves(problem)))


def test_it_pickles():
    again = pickle.loads(pickle.dumps(CHANGED))
    assert float(again(RIG).J_x) == pytest.approx(0.0552 + ADDED)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "J_x is not changed: give plus= or times="),
        ({"plus": np.nan}, "plus"),
        ({"times": -1.0}, "times"),
    ],
    ids=["nothing", "not finite", "a turned sign"],
)
def test_what_is_no_change_is_refused(given, said):
    with pytest.raises(ValueError, match=said):
        jq.identify.Changed("J_x", **given)


@pytest.mark.parametrize(
    ("condition", "said"),
    [
        (jq.identify.Changed("Jx", plus=0.01), "no parameter 'Jx' for a condition; the model has"),
        (0.0276, "condition 0.0276 is no change of the model: give None, jq.identify.Changed"),
    ],
    ids=["an unknown parameter", "a number"],
)
def test_what_is_no_condition_is_refused(frfs, condition, said, without_type_checks):
    with pytest.raises(ValueError, match=said):
        fit(frfs, condition)
