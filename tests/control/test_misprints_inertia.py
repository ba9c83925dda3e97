"""Eq. (15)-(25), the inertia from a disturbance observer: printed against derived."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ladrc_loop import loop
from scipy.integrate import solve_ivp

import jaxquad as jq
from jaxquad.control import paper_inertia


J, DRAG, LOAD = 0.0552, 0.004, 0.03  # kg m^2, N m s/rad, N m
NOMINAL, POLE = 0.04, 20.0  # J_n and lambda
CHANGE = J - NOMINAL
LOADS = {"dJ": CHANGE, "K_afx": DRAG, "M_g": LOAD, "lam": POLE}


# J_x and J_n are the true and the nominal inertia in kg m^2, phi the roll angle in rad, u = tau_x
# the torque in N m, lam the observer's pole in rad/s, M_c the estimate of the disturbance in N m.


def disturbed_axis(J_x):
    """Eq. (15), (16): A, B and C of J_x phi'' = u + tau_M, with x = [phi', tau_M] and y = phi'."""
    A = jnp.array([[0.0, 1.0], [0.0, 0.0]]) / J_x
    B = jnp.array([1.0, 0.0]) / J_x
    C = jnp.array([1.0, 0.0])
    return A, B, C


def observe_disturbance(z, phi_dot, u, *, J_n, lam):
    """Eq. (17): z' and M_c of the observer of least order."""
    z_dot = -lam * z + lam * J_n * phi_dot + u
    M_c = -lam * z + lam * J_n * phi_dot
    return z_dot, M_c


def estimate_disturbance(q0_dot, q1, *, J_n):
    """Eq. (18) with (19) in it: M_c = J_n q0' - q1; the printed (18) lacks a filter."""
    return J_n * q0_dot - q1


def filter_signals(q0, q1, phi_dot, u, *, lam):
    """Eq. (19): q0' and q1' of the filters of rate and torque."""
    return -lam * q0 + lam * phi_dot, -lam * q1 + lam * u


def disturbance_slope(M_c, phi_dot, phi_ddot, *, dJ, K_afx, M_g, lam):
    """Eq. (20): M_c' under dJ = J_x - J_n, drag and a constant load; printed with phi' and J_x."""
    return -lam * M_c - lam * (dJ * phi_ddot + K_afx * phi_dot + M_g)


def expected_disturbance(q0, q0_dot, t, *, dJ, K_afx, M_g, lam):
    """Eq. (21): M_c from rest at t = 0; printed with q0 for its derivative and q1 for the rise."""
    return -dJ * q0_dot - K_afx * q0 - M_g * (1 - jnp.exp(-lam * t))


def torque(time):
    return 0.05 * np.sin(6 * time) + 0.02 * np.cos(2.3 * time) + 0.01


def observer(time, state):
    """Derivatives of the rate under drag and load, of z in Eq. (17), of q0 and q1 in (19)."""
    return np.asarray(slopes(jnp.asarray(state), jnp.asarray(torque(time))))


@jax.jit
def slopes(state, u):
    rate, z, q0, q1 = state
    A, B, _ = disturbed_axis(J)
    acceleration = A[0, 1] * (-DRAG * rate - LOAD) + B[0] * u
    z_dot, _ = observe_disturbance(z, rate, u, J_n=NOMINAL, lam=POLE)
    return jnp.stack([acceleration, z_dot, *filter_signals(q0, q1, rate, u, lam=POLE)])


@pytest.fixture(scope="module")
def run():
    time = np.linspace(0, 3, 1501)
    found = solve_ivp(observer, (0, 3), np.zeros(4), "DOP853", time, rtol=1e-11, atol=1e-13)
    return time, found.y, observer(time, found.y)


def estimate(state):
    """M_c, the second line of Eq. (17)."""
    rate, z = jnp.asarray(state[:2])
    return np.asarray(observe_disturbance(z, rate, 0 * z, J_n=NOMINAL, lam=POLE)[1])


def same(found, expected):
    return np.allclose(found, expected, rtol=0, atol=1e-9)


def test_the_disturbance_of_eq_15_holds_the_drag_and_not_the_lift():
    inertia, damping = np.array([0.05, 0.07, 0.11]), np.array([0.01, 0.02, 0.03])
    rate, lift = np.array([1.0, 2.0, -1.5]), np.array([0.05, -0.02, 0.01])
    attitude = jq.models.Attitude(inertia, damping=damping, rotor_inertia=1e-4)
    needed = inertia * np.asarray(attitude.acceleration(jnp.array(rate), jnp.array(lift), 200.0))
    rotors = np.cross(rate, [0, 0, 1e-4 * 200.0])
    rest = rotors - np.cross(rate, inertia * rate)
    assert same(needed - lift, rest - damping * rate)
    assert not same(needed - lift, rest - lift)  # as printed


def test_the_observer_of_eq_17_finds_a_constant_load_with_its_pole(run):
    """The forced part that is left, (J - J_n) q0' + K q0, vanishes for a right J_n without drag."""
    time, state, slope = run
    rest = estimate(state) + CHANGE * slope[2] + DRAG * state[2]
    assert same(rest, -LOAD * (1 - np.exp(-POLE * time)))


def test_the_transform_of_eq_18_lacks_a_filter_on_its_first_term(run):
    _, state, slope = run
    right = estimate_disturbance(jnp.asarray(slope[2]), jnp.asarray(state[3]), J_n=NOMINAL)
    assert same(
        estimate(state), right
    )  # lambda s / (s + lambda) J_n rate - lambda / (s + lambda) u
    assert not same(estimate(state), POLE * NOMINAL * state[0] - state[3])
    assert not same(estimate(state), NOMINAL * slope[3] - state[2])  # text after (19)


def test_eq_20_drives_the_estimate_by_the_acceleration_and_the_rate(run):
    _, state, slope = run
    left = POLE * (NOMINAL * slope[0] - slope[1])
    signals = map(jnp.asarray, (estimate(state), state[0], slope[0]))
    assert same(left, disturbance_slope(*signals, **LOADS))
    assert not same(left, -POLE * (estimate(state) + CHANGE * state[0] + DRAG * J + LOAD))


def test_eq_21_holds_the_derivative_of_q0_and_a_rising_load(run):
    time, state, slope = run
    _, _, q0, q1 = state
    signals = map(jnp.asarray, (q0, slope[2], time))
    assert same(estimate(state), expected_disturbance(*signals, **LOADS))
    assert not same(estimate(state), -CHANGE * q0 - DRAG * q0 + LOAD * q1)


def steady(window, start=0.0):
    """Time, q0, q0' and q1 in the steady state under a 1 Hz test torque and a constant load."""
    time, omega = np.linspace(start, start + window, 20001), 2 * np.pi
    wave = np.exp(1j * omega * time) * POLE / (POLE + 1j * omega)
    rate = 0.03 * wave / (J * 1j * omega + DRAG)
    return time, rate.real, (1j * omega * rate).real, (0.03 * wave).real + 0.1


def regression(window, start=0.0):
    """Eq. (24) as corrected: the integral of q1 q0' over that of q0'^2."""
    time, _, slope, q1 = steady(window, start)
    return np.trapezoid(q1 * slope, time) / np.trapezoid(slope**2, time)


STARTS = np.linspace(0, 1, 8, endpoint=False)


@pytest.mark.parametrize("window", [1.0, 2.0, 7.0])
def test_the_quadrature_after_eq_22_holds_over_whole_periods(window):
    found = [regression(window, start) for start in STARTS]
    np.testing.assert_allclose(found, J, rtol=1e-9)


@pytest.mark.parametrize("window", [0.5, 0.7, 1.3, 2.5, 3.3])
def test_over_other_windows_a_constant_load_is_taken_for_inertia(window):
    found = [regression(window, start) for start in STARTS]
    assert np.ptp(found) > 0.5 * J
    for start in STARTS:  # two more regressors make every window exact
        _, q0, slope, q1 = steady(window, start)
        columns = np.stack([slope, q0, np.ones_like(q0)], axis=1)
        np.testing.assert_allclose(np.linalg.lstsq(columns, q1)[0], [J, DRAG, 0.1], rtol=1e-9)


def change(nominal, denominator, sign):
    """The change of inertia of Eq. (23) over one period, with `denominator` under the bar."""
    time, _, slope, q1 = steady(1.0)
    seen = nominal * slope - q1
    return sign * np.trapezoid(seen * slope, time) / np.trapezoid(denominator(slope), time)


@pytest.mark.parametrize("nominal", [0.03, 0.05, 0.1])
def test_eq_23_needs_a_square_below_and_a_minus(nominal):
    with np.errstate(divide="ignore"):
        assert abs(change(nominal, lambda slope: slope, 1)) > 1e6  # over the integral of q0': 0
    right = change(nominal, np.square, -1)
    assert nominal + right == pytest.approx(J, rel=1e-9)
    # Eq. (24) is a regression: the nominal inertia has left it.
    assert nominal + right == pytest.approx(regression(1.0), rel=1e-12)
    time, q0, _, q1 = (jnp.asarray(x) for x in steady(1.0))
    middle = jnp.concatenate([q1[:1], (q1[1:] + q1[:-1]) / 2])  # where the differences of q0 are
    found = paper_inertia(q0, middle, J_n=nominal, dt=float(time[1]))
    assert float(found) == pytest.approx(J, rel=1e-7)


def test_with_the_printed_plus_the_error_doubles_every_period():
    nominal, errors = 0.05, []
    for _ in range(5):
        errors.append(nominal - J)
        nominal = nominal + change(nominal, np.square, 1)
    np.testing.assert_allclose(np.divide(errors[1:], errors[:-1]), 2.0, rtol=1e-6)


def printed_map(ratio):
    """b0 of Eq. (25) from 3: eight equal triangles on both sides, mean of the sets' centres."""
    sets, raised = np.linspace(1, 22, 8), np.linspace(0, 24, 8)
    membership = np.maximum(0, 1 - np.abs(ratio - sets) / (sets[1] - sets[0]))
    return 3 + membership @ raised / membership.sum()


def test_the_map_of_eq_25_is_a_straight_line_that_can_only_raise_b0():
    ratios = np.linspace(1, 22, 400)
    found = np.array([printed_map(ratio) for ratio in ratios])
    np.testing.assert_allclose(found, 3 + 24 / 21 * (ratios - 1), rtol=1e-13)
    assert found.min() == 3.0  # the paper ends at 1.6
    assert printed_map(3 / 1.6) == pytest.approx(4.0) and printed_map(22.0) == pytest.approx(27.0)
    assert printed_map(0.0552 / 0.0517) == pytest.approx(3.08, abs=0.005)  # the paper's inertias


@pytest.mark.parametrize(("b0", "stable"), [(3.0, True), (1.6, True), (4.0, False), (27.0, False)])
def test_raising_b0_as_eq_25_does_leaves_the_stable_window(b0, stable):
    poles = np.linalg.eigvals(loop(2 * 0.197 * 0.1188 / J, b0)[0])
    assert bool(np.max(np.abs(poles)) < 1) == stable
