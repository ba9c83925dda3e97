"""Models to and from python-control and scipy.signal: the same responses, and no silent delay."""

import dataclasses

import numpy as np
import pytest
from scipy import signal

import jaxquad as jq
from jaxquad.models import from_control


control = pytest.importorskip(
    "control", reason="python-control is not installed: pip install 'jaxquad[interop]'"
)

OMEGA = np.geomspace(0.05, 200.0, 40)
SINGLE = {
    "double integrator": jq.TransferFunction([0.424], [1.0, 0.0, 0.0]),
    "lag": jq.LaggedIntegrator(282.0, 0.02),
    "light mode": jq.TransferFunction([1.0, 3.0, 200.0], [1.0, 0.2, 100.0]),
    "gain": jq.TransferFunction([3.0], [2.0]),
    "attitude": jq.models.AttitudeAxis(0.2, 0.12, 0.05, lag=0.05, K_af=0.01),
}
RANDOM = np.random.default_rng(0)
A = np.array([[-1.0, 2.0, 0.1], [-3.0, -0.4, 0.0], [0.2, 0.3, -8.0]])
B, C = RANDOM.normal(size=(3, 2)), RANDOM.normal(size=(2, 3))
SYSTEMS = {
    "strictly proper": control.ss(A, B, C, np.zeros((2, 2))),
    "passage": control.ss(A, B, C, RANDOM.normal(size=(2, 2))),
    "passage of an idle input": control.ss(A, B * [1, 0], C, [[1.0, 2.0], [0.0, 3.0]]),
    "static": control.ss([], [], [], [[1.0, 2.0]]),
    "bank": control.tf(
        [[[2.0], [1.0, 2.0]], [[0.0], [3.0]]], [[[1.0, 3.0], [4.0, 1.0]], [[1.0], [2.0]]]
    ),
}


def response(system):
    """python-control's or scipy's, with the axes of ours."""
    if isinstance(system, signal.lti):
        return signal.freqresp(system, OMEGA)[1][:, None, None]
    return np.moveaxis(system(1j * OMEGA, squeeze=False), -1, 0)


def assert_equal_responses(found, wanted, rtol):
    np.testing.assert_allclose(found, wanted, rtol=rtol, atol=rtol * np.max(np.abs(wanted)) * 1e-3)


@pytest.mark.parametrize("name", SINGLE)
@pytest.mark.parametrize("to", ["to_control", "to_scipy"])
def test_a_round_trip_returns_the_same_response(name, to):
    model = SINGLE[name]
    system = model.to_control() if to == "to_control" else model.to_scipy()
    wanted = np.asarray(model.frequency_response(OMEGA))
    assert_equal_responses(response(system), wanted, 1e-12)
    for back in (from_control(system), jq.TransferFunction(system)):
        assert isinstance(back, jq.TransferFunction)
        assert_equal_responses(back.frequency_response(OMEGA), wanted, 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_system_of_python_control_keeps_its_response_there_and_back(name):
    system = SYSTEMS[name]
    model = from_control(system)
    assert isinstance(model, jq.StateSpace)
    assert_equal_responses(model.frequency_response(OMEGA), response(system), 1e-12)
    assert_equal_responses(response(model.to_control()), response(system), 1e-12)


@pytest.mark.slow
def test_a_model_with_mass_accelerations_and_scipy_in_between():
    model = jq.StateSpace(
        A, B[:, :1], C[:1], H1=C[1:], M=np.eye(3) + 0.1 * RANDOM.normal(size=(3, 3))
    )
    system = model.to_scipy()
    assert_equal_responses(response(system), model.frequency_response(OMEGA), 1e-12)
    back = from_control(system)  # pyright: ignore[reportArgumentType]
    assert_equal_responses(back.frequency_response(OMEGA), response(system), 1e-12)


@pytest.mark.parametrize("order", [1, 3, 6])
def test_a_delay_becomes_the_approximation_of_python_control(order):
    model = jq.TransferFunction([10.0], [1.0, 4.0, 0.0], delay=0.02)
    wanted = control.tf([10.0], [1.0, 4.0, 0.0]) * control.tf(*control.pade(0.02, order))
    assert_equal_responses(response(model.to_control(pade=order)), response(wanted), 1e-12)


def test_each_delay_of_a_state_space_is_approximated_on_its_channel():
    model = jq.StateSpace(A, B, C, input_delay=[0.02, 0.0], output_delay=[0.0, 0.05])
    late = np.add.outer([0.0, 0.05], [0.02, 0.0])
    slow = OMEGA < 2.9 / 0.07
    wanted = np.asarray(model.frequency_response(OMEGA))
    found = response(model.to_control(pade=3))
    assert np.max(np.abs(np.angle(found / wanted))[slow]) < np.radians(2.0)  # two in series
    pade = np.array([[control.tf(*control.pade(t, 3))(1j * OMEGA) for t in row] for row in late])
    plain = jq.StateSpace(A, B, C).frequency_response(OMEGA)
    single = ~(late == 0.07)  # of those with one delay the approximation is python-control's
    assert_equal_responses(found[:, single], (plain * np.moveaxis(pade, -1, 0))[:, single], 1e-11)


def test_the_refusal_of_a_delay_says_up_to_where_an_approximation_holds():
    model = jq.TransferFunction([1.0], [1.0], delay=0.1)
    with pytest.raises(ValueError, match=r"delay of 0.1 s.*pade=3 is within 1 deg.*29.1 rad/s"):
        model.to_control()
    with pytest.raises(ValueError, match="order of 1 to 10"):
        model.to_scipy(pade=11)
    error = np.angle(model.to_control(pade=3)(29.1j) / np.exp(-2.91j))
    assert 0.5 < abs(np.degrees(error)) < 1.0  # higher terms make it smaller


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (control.tf([1.0], [1.0, 2.0], 0.01), r"sampled \(dt = 0.01\)"),
        (SYSTEMS["bank"], "2 outputs and 2 inputs"),
        ([1.0, 2.0], "no denominator"),
    ],
)
def test_what_is_no_transfer_function_of_one_pair_is_refused(system, message):
    with pytest.raises(ValueError, match=message):
        jq.TransferFunction(system)


def test_a_system_and_a_denominator_at_once_are_refused():
    with pytest.raises(ValueError, match="leave one out"):
        jq.TransferFunction(control.tf([1.0], [1.0, 2.0]), [1.0, 2.0])


def test_a_sampled_state_space_is_refused():
    with pytest.raises(ValueError, match="sampled"):
        from_control(control.ss(A, B, C, np.zeros((2, 2)), 0.01))


def test_a_delay_is_put_in_afterwards():
    model = jq.TransferFunction(control.tf([10.0], [1.0, 4.0]), delay=0.02)
    assert dataclasses.replace(model, delay=0.03).delay == 0.03
