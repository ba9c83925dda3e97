"""Loops against independent codes: python-control, scipy, NumPy propagation, simulation."""

import functools as ft

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from loop_members import analysed, DAMPING, DELAY, DT, GAIN, LAG, MEMBERS, STIFFNESS, WO

import jaxquad as jq
from jaxquad.control import LADRC, LinearController
from jaxquad.models import DecoupledAxes


# python-control's own types are those of the widest class.
ss, feedback, stability_margins = (
    getattr(control, name) for name in ("ss", "feedback", "stability_margins")
)
STABLE = [0, 1, 2, 5]


@pytest.fixture(scope="module")
def loops():
    return analysed(*MEMBERS)


def law(k):
    return LADRC([10.0], [WO[k]], [1.0], dt=DT).linear()


def continuous(k):
    """State space of member k: angle, rate, motor; command and disturbance torque in."""
    A = [[0, 1, 0], [-STIFFNESS, -DAMPING, GAIN[k]], [0, 0, -1 / LAG[k]]]
    return np.array(A), np.array([[0, 0], [0, 1], [1 / LAG[k], 0]])


@ft.cache
def system(k):
    """Member k without its delay, by python-control: plant, controller and loop."""
    A, B = continuous(k)
    axis = ss(A, B, [[1, 0, 0]], [[0, 0]]).sample(DT, "zoh")
    found = law(k)
    inward = np.stack([found.reference_in, found.measurement_in], axis=1)
    through = np.array([[found.reference_through, found.measurement_through]])
    mind = ss(found.A, inward, [found.C], through, DT)
    return axis, mind, -axis[0, 0] * mind[0, 1]


def propagated(k, substeps=20):
    """Poles of member k, found by marching its states and the commands on their way."""
    A, B = continuous(k)
    block = np.zeros((4, 4))
    block[:3] = np.column_stack([A, B[:, 0]])
    step = scipy.linalg.expm(block * DT / substeps)
    found, late = law(k), round(DELAY[k] / DT * substeps)

    def sample(x):
        angle, older, newer, mind = x[0], x[3], x[4], x[5:]
        command = found.C @ mind + found.measurement_through * angle
        held = [older] * substeps + [newer] * substeps + [command] * substeps
        state = x[:3]
        for i in range(substeps):
            state = (step @ [*state, held[2 * substeps + i - late]])[:3]
        mind = found.A @ mind + np.asarray(found.measurement_in) * angle
        return np.concatenate([state, [newer, command], mind])

    return np.linalg.eigvals(np.column_stack([sample(x) for x in np.eye(8)]))


def discrete(loop):
    return np.exp(loop.poles.real * DT) * np.exp(1j * loop.poles.imag * DT)


def nonzero(poles):
    return np.sort_complex(poles[np.abs(poles) > 1e-4])


@pytest.mark.slow
def test_the_closed_loop_poles_are_those_of_python_control(loops):
    found, (axis, mind, _) = loops.member(2), system(2)
    closed = feedback(axis[0, 0] * mind[0, 1], 1, sign=1)
    z = discrete(found)
    np.testing.assert_allclose(nonzero(z), nonzero(closed.poles()), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("k", range(len(MEMBERS)))
def test_a_delay_of_any_part_of_a_sample_is_exact(loops, k):
    poles = discrete(loops.member(k))
    np.testing.assert_allclose(nonzero(poles), nonzero(propagated(k)), rtol=1e-8)


@pytest.mark.slow
def test_the_abscissa_is_that_of_the_slowest_pole(loops):
    exact = np.max(loops.poles.real, axis=-1)
    np.testing.assert_allclose(loops.abscissa, exact, atol=1e-8)
    np.testing.assert_array_equal(loops.stable, exact < 0)
    assert sorted(np.flatnonzero(loops.stable[:6])) == STABLE


@pytest.mark.slow
def test_an_unstable_loop_is_flagged_and_has_no_margins(loops):
    wild = loops.member(4)
    assert np.isinf(wild.sensitivity_peak) and np.isinf(wild.noise_gain)
    assert np.isnan(wild.gain_margin) and np.isnan(wild.phase_margin)
    assert "unstable" in str(wild) and "ensemble of 20 loops, 90 % stable" in str(loops)
    assert "phase margin" in str(loops.member(0))


def test_responses_are_those_of_python_control(loops):
    omega = np.array([0.1, 1.0, 10.0, 100.0, 1500.0])
    found, (axis, mind, loop) = loops.member(2), system(2)
    at = lambda system: np.squeeze(system(np.exp(1j * omega * DT)))
    L, P, D, K, F = map(at, (loop, axis[0, 0], axis[0, 1], mind[0, 1], mind[0, 0]))
    expected = {"loop": L, "reference": P * F / (1 + L), "disturbance": D / (1 + L)}
    expected |= {"sensitivity": 1 / (1 + L), "noise": K / (1 + L)}
    for name, values in expected.items():
        response = getattr(found, name).frequency_response(jnp.array(omega))[:, 0, 0]
        np.testing.assert_allclose(response, values, rtol=1e-9, err_msg=name)


def test_a_whole_sample_of_delay_is_a_factor_of_one_over_z(loops):
    omega = np.array([1.0, 10.0, 100.0, 1500.0])
    found = loops.member(1).loop.frequency_response(jnp.array(omega))[:, 0, 0]
    z = np.exp(1j * omega * DT)
    np.testing.assert_allclose(found, np.squeeze(system(1)[2](z)) / z**2, rtol=1e-9)


@pytest.mark.filterwarnings("ignore:stability_margins")  # it falls back to another method
def test_margins_and_noise_are_those_of_python_control_and_scipy(loops):
    found, (axis, mind, loop) = loops.member(2), system(2)
    gains, phases, _, _, crossovers, _ = stability_margins(loop, returnall=True)
    assert found.gain_margin == pytest.approx(np.min(gains[gains > 1]), rel=1e-6)
    assert found.gain_reduction == pytest.approx(np.max(gains[gains < 1]), rel=1e-6)
    least = np.argmin(phases)
    assert np.degrees(found.phase_margin) == pytest.approx(phases[least], rel=1e-6)
    assert found.delay_margin == pytest.approx(np.radians(phases[least]) / crossovers[least])
    distance = lambda omega: abs(1 + loop(np.exp(1j * omega * DT)))
    least = scipy.optimize.minimize_scalar(distance, bounds=(5, 50), options={"xatol": 1e-9})
    assert found.sensitivity_peak == pytest.approx(1 / least.fun, rel=1e-9)
    assert found.sensitivity_frequency == pytest.approx(least.x, rel=1e-6)
    noisy = feedback(mind[0, 1], axis[0, 0], sign=1)
    covariance = scipy.linalg.solve_discrete_lyapunov(noisy.A, noisy.B @ noisy.B.T)
    power = noisy.C @ covariance @ noisy.C.T + noisy.D**2
    assert found.noise_gain == pytest.approx(np.sqrt(power.item()), rel=1e-8)


def test_a_delay_of_the_delay_margin_brings_the_loop_to_its_edge(loops):
    margin = np.asarray(loops.delay_margin)
    late = [MEMBERS[k] | {"delay": DELAY[k] + margin[k]} for k in STABLE]
    edge = np.asarray(analysed(*late).abscissa)
    # A held command that is late by part of a sample is not quite exp(-s delay) times itself.
    np.testing.assert_allclose(edge, 0, atol=2e-3)


def test_the_simulated_loop_is_the_analysed_one(loops):
    k, samples = 1, 400
    noise = 1e-3 * jax.random.normal(jax.random.key(1), (samples, 1))
    still = jnp.zeros_like(noise)
    axis = DecoupledAxes(GAIN[k], 1.0, lag=LAG[k], damping=DAMPING, stiffness=STIFFNESS)
    run = jq.simulate(
        jq.Loop(axis, LADRC([10.0], [WO[k]], [1.0], dt=DT), dt=DT, delay=DELAY[k], substeps=4),
        jq.simulation.Scenario(still, still, still, noise),
    )
    closed, command = jax.tree.map(np.asarray, loops.member(k).closed), []
    x = np.zeros(len(closed.noise))
    for w in np.asarray(noise)[:, 0]:
        command.append(closed.command @ x + closed.through * w)
        x = closed.matrix @ x + closed.noise * w
    size = np.max(np.abs(command))
    np.testing.assert_allclose(run.command[:, 0], command, rtol=0, atol=1e-7 * size)


@pytest.mark.slow
def test_the_gain_below_which_an_unstable_plant_falls_is_found_at_frequency_zero():
    axis = DecoupledAxes(0.5, 1.0, stiffness=-2.0)
    hold = LinearController(
        A=jnp.zeros((1, 1)), reference_in=jnp.zeros(1), measurement_in=jnp.ones(1),
        C=jnp.full(1, 500.0), reference_through=jnp.array(10.0),
        measurement_through=jnp.array(-510.0), dt=DT,
    )  # fmt: skip
    reduction = jq.analyse(jq.Loop(axis, hold, dt=DT)).gain_reduction
    assert float(reduction) == pytest.approx(2.0 / (0.5 * 10.0), rel=1e-9)
