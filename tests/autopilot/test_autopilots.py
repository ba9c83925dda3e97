"""The firmwares' loops against a second writing of each law, their linear form, and differences."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from jaxquad.autopilot import (
    adrc_b0,
    ArduPilotAttitude,
    ArduPilotRate,
    BandwidthNotch,
    BetaflightADRC,
    BetaflightAngle,
    BetaflightPID,
    Butterworth,
    CrazyflieAttitude,
    CrazyflieRate,
    DMax,
    dynamic_cutoff,
    FilterChain,
    ItermRelax,
    Notch,
    PT1,
    PT2,
    PX4Attitude,
    PX4Rate,
    tpa_factor,
)
from jaxquad.control import Setpoint


pytestmark = pytest.mark.usefixtures("compiled_quickly")
DEGREES = 180 / np.pi
SAMPLES = 300
CLEAN = 1e-9


@eqx.filter_jit
def fly(law, reference, measured):
    """Commands and terms of one axis."""

    def sample(state, now):
        state, command = law.step(state, now[:1], now[1:])
        return state, (command[0], {k: x[0] for k, x in law.signals(state).items()})

    return jax.lax.scan(sample, law.init(jnp.zeros(1)), jnp.stack([reference, measured], axis=1))[1]


def broken_lines(size):
    """Random signals that move slowly enough for gains of a firmware: rad or rad/s."""
    noise = np.random.default_rng(3).standard_normal((2, SAMPLES))
    return size * signal.lfilter([0.05], [1, -0.95], noise)


def gyro(y, chain, dt):
    """The rate at the gyro's own samples, straight between those of the loop, and filtered."""
    count = round(chain.rate_hz * dt)
    at = np.arange(1, count * len(y) + 1) / count - 1
    fine = np.interp(at, np.arange(-1, len(y)), np.append(0.0, y))
    for section in chain.sections():
        b0, b1, a1, b2, a2 = (0.0 if x is None else float(x) for x in section)
        fine = signal.lfilter([b0, b1, b2], [1, a1, a2], fine)
    return fine, count


def low_pass(x, cutoff, dt):
    alpha = dt / (dt + 1 / (2 * np.pi * cutoff))
    return np.asarray(signal.lfilter([alpha], [1, alpha - 1], x))


CHAIN8 = FilterChain((PT1(500.0),), 8000.0)
BETAFLIGHT = BetaflightPID(
    p=[45.0], i=[80.0], d=[30.0], f=[120.0], gyro=CHAIN8, filters=(Notch(180.0, 5.0), PT1(350.0)),
    dterm=(PT1(105.0), PT1(150.0)), integral_factor=[2.5], p_lowpass_hz=[100.0], limit=[300.0],
    relax=ItermRelax(15.0), d_max=DMax([40.0], 8e-5, 8e-5), tpa=[0.8], dt=1 / 4000,
)  # fmt: skip


def betaflight(r, y):
    dt = BETAFLIGHT.dt
    fine, count = gyro(DEGREES * y, CHAIN8, dt)
    y = gyro(fine[count - 1 :: count], FilterChain(BETAFLIGHT.filters, 1 / dt), dt)[0]
    yd = low_pass(low_pass(y, 105.0, dt), 150.0, dt)
    r, error = DEGREES * r, DEGREES * r - y
    p = low_pass(0.032029 * 45 * error, 100.0, dt)
    fast = np.abs(r - low_pass(r, 15.0, dt))
    relaxed = error * np.maximum(0, 1 - fast / 40)
    i, total = np.zeros(len(r)), 0.0
    for n, e in enumerate(relaxed):
        total = i[n] = np.clip(total + 0.244381 * 2.5 * 80 * dt * e, -400, 400)
    delta = -np.diff(yd, prepend=0) / dt
    speed = np.diff(r, prepend=0) / dt
    twice = lambda x, f: low_pass(low_pass(x, 1.553773974 * f, dt), 1.553773974 * f, dt)
    share = twice(8e-5 * np.maximum(np.abs(twice(delta, 85.0)), np.abs(speed)), 35.0)
    d = 0.000529 * 30 * 0.8 * np.minimum(1 + share / 3, 4 / 3) * delta
    f = 0.013754 * 120 / 100 * speed
    return np.clip(p + i + d + f, -300, 300), p, i, d, f


ADRC = BetaflightADRC(
    wc=[60.0], wo=[100.0], b0=[2000.0], f=[50.0], gyro=CHAIN8, setpoint_lowpass_hz=[80.0],
    b0_scale=[1.3], limit=[150.0], dt=1 / 4000,
)  # fmt: skip


def adrc(r, y):
    dt = ADRC.dt
    fine, count = gyro(DEGREES * y, CHAIN8, dt)
    factor = 1.553773974 * 150
    y = low_pass(low_pass(fine[count - 1 :: count], factor, dt), factor, dt)
    slow, speed = low_pass(DEGREES * r, 80.0, dt), np.diff(DEGREES * r, prepend=0) / dt
    b, wc, wo, u = 2000 * 1.3, 60.0, 100.0, 0.0
    z1 = z2 = z3 = 0.0
    rows = []
    for n in range(len(r)):
        e = z1 - y[n]
        z1, z2, z3 = (
            z1 + dt * (z2 - 3 * wo * e),
            z2 + dt * (z3 + b * u - 3 * wo**2 * e),
            z3 + dt * (-0.3 * z3 - wo**3 * e),
        )
        z1, z2, z3 = np.clip(z1, -8e3, 8e3), np.clip(z2, -1e5, 1e5), np.clip(z3, -150 * b, 150 * b)
        p, d, i = wc**2 * (slow[n] - z1) / b, -2 * wc * z2 / b, -z3 / b
        f = 0.013754 * 50 / 100 * speed[n]
        u = np.clip(p + i + d + f, -150, 150)
        rows.append((u, p, i, d, f))
    return np.array(rows).T


CHAIN_PX4 = FilterChain((BandwidthNotch(120.0, 20.0), Butterworth(40.0)), 2000.0)
PX4 = PX4Rate(
    p=[0.15], i=[0.2], d=[0.003], k=[1.2], ff=[0.01], gyro=CHAIN_PX4, derivative_hz=[20.0],
    torque_hz=[30.0], integral_limit=[0.01],
)  # fmt: skip


def px4(r, y):
    dt = PX4.dt
    fine, count = gyro(y, CHAIN_PX4, dt)
    slope = low_pass(np.diff(fine, prepend=0) * 2000, 20.0, 1 / 2000)[count - 1 :: count]
    error = r - fine[count - 1 :: count]
    i, total = np.zeros(len(r)), 0.0
    for n, e in enumerate(error):
        i[n] = total
        fade = max(0.0, 1 - (e / np.deg2rad(400)) ** 2)
        total = np.clip(total + fade * 1.2 * 0.2 * e * dt, -0.01, 0.01)
    p, d, f = 1.2 * 0.15 * error, -1.2 * 0.003 * slope, 0.01 * r
    return low_pass(p + i + d + f, 30.0, dt), p, i, d, f


CHAIN_AP = FilterChain((Butterworth(40.0),), 2000.0)
ARDUPILOT = ArduPilotRate(
    p=[0.135], i=[0.135], d=[0.0036], ff=[0.02], d_ff=[0.001], gyro=CHAIN_AP, error_hz=[30.0],
    integral_limit=[0.005], pd_limit=[0.06],
)  # fmt: skip


def ardupilot(r, y):
    dt = ARDUPILOT.dt
    fine, count = gyro(y, CHAIN_AP, dt)
    target = low_pass(r, 20.0, dt)
    error = low_pass(target - fine[count - 1 :: count], 30.0, dt)
    slope = low_pass(np.diff(error, prepend=0) / dt, 20.0, dt)
    i, total = np.zeros(len(r)), 0.0
    for n, e in enumerate(error):
        total = i[n] = np.clip(total + 0.135 * e * dt, -0.005, 0.005)
    p, d = 0.135 * error, 0.0036 * slope
    scale = np.minimum(1, 0.06 / np.abs(p + d))
    f = 0.02 * target + 0.001 * np.diff(target, prepend=0) / dt
    return (p + d) * scale + i + f, p * scale, i, d * scale, f


CHAIN_CF = FilterChain((Butterworth(80.0),), 1000.0)
CRAZYFLIE = CrazyflieRate(
    kp=[250.0], ki=[500.0], kd=[2.5], kff=[3.0], gyro=CHAIN_CF, derivative_hz=[30.0],
    integral_limit=[2.0], limit=[9000.0],
)  # fmt: skip


def crazyflie(r, y):
    dt = CRAZYFLIE.dt
    fine, count = gyro(DEGREES * y, CHAIN_CF, dt)
    y, r = fine[count - 1 :: count], DEGREES * r
    butterworth: Any = signal.butter(2, 30.0, fs=500.0)
    above, below = butterworth
    slope = np.asarray(signal.lfilter(above, below, -np.diff(y, prepend=0) / dt))
    i, total = np.zeros(len(r)), 0.0
    for n, e in enumerate(r - y):
        total = i[n] = np.clip(total + e * dt, -2, 2)
    p, i, d, f = 250 * (r - y), 500 * i, 2.5 * slope, 3 * r
    return np.clip(p + i + d + f, -9000, 9000), p, i, d, f


RATES = {
    "Betaflight": (BETAFLIGHT, betaflight, 300.0),
    "ADRC": (ADRC, adrc, 300.0),
    "PX4": (PX4, px4, 8.0),
    "ArduPilot": (ARDUPILOT, ardupilot, 8.0),
    "Crazyflie": (CRAZYFLIE, crazyflie, 8.0),
}


@pytest.mark.parametrize("firmware", RATES)
def test_every_law_is_its_second_writing_within_its_limits_and_at_them(firmware):
    law, second, size = RATES[firmware]
    r, y = broken_lines(size)
    expected = second(r, y)
    command, terms = fly(law, jnp.asarray(r), jnp.asarray(y))
    for name, value in zip("PIDF", expected[1:], strict=True):
        np.testing.assert_allclose(terms[name], value, rtol=0, atol=1e-9 * np.abs(value).max())
    np.testing.assert_allclose(command, expected[0], rtol=0, atol=1e-9 * np.abs(expected[0]).max())
    whole = np.sum(expected[1:], axis=0)
    assert (
        np.ptp(expected[0]) > 0
        and not np.allclose(whole, expected[0], rtol=1e-3)
        or (
            firmware == "ArduPilot"  # it bounds the terms
        )
    )


ANGLES = {
    "Betaflight, angle": BetaflightAngle(BETAFLIGHT),
    "PX4, angle": PX4Attitude(PX4, [4.0]),
    "ArduPilot, angle": ArduPilotAttitude(ARDUPILOT, [4.5]),
    "Crazyflie, angle": CrazyflieAttitude(CRAZYFLIE, [6.0], [3.0], [0.1]),
}
SLOW = pytest.mark.slow
LAWS = {name: law for name, (law, *_) in RATES.items()} | ANGLES


@pytest.mark.parametrize("name", [pytest.param(x, marks=() if x == "ADRC" else SLOW) for x in LAWS])
def test_small_signals_pass_as_the_linear_form_says(name):
    law, (r, y) = LAWS[name], broken_lines(1e-7)
    if name == "Betaflight, angle":
        law = BetaflightAngle(dataclasses.replace(BETAFLIGHT, relax=None, d_max=None))
    linear = jax.tree.map(np.asarray, law.linear(0))
    assert linear.dt == law.dt
    x, expected = np.zeros(len(linear.A)), []
    for now in zip(r, y, strict=True):
        through = linear.reference_through * now[0] + linear.measurement_through * now[1]
        expected.append(linear.C @ x + through)
        x = linear.A @ x + linear.reference_in * now[0] + linear.measurement_in * now[1]
    found, _ = fly(law, jnp.asarray(r), jnp.asarray(y))
    # Relaxation and D_MAX leave terms of second order, by the signals over their thresholds.
    smallest = 1e-6 if name == "Betaflight" else CLEAN
    np.testing.assert_allclose(found, expected, rtol=0, atol=smallest * np.abs(expected).max())


def test_the_linear_form_without_relaxation_and_d_max_is_exact():
    law = dataclasses.replace(BETAFLIGHT, relax=None, d_max=None)
    r, y = broken_lines(0.1)
    linear = jax.tree.map(np.asarray, law.linear(0))
    through = np.stack([linear.reference_through, linear.measurement_through])
    system = (
        linear.A,
        np.stack([linear.reference_in, linear.measurement_in], 1),
        linear.C[None],
        through[None],
    )
    expected = signal.dlsim((*system, law.dt), np.stack([r, y], 1))[1][:, 0]
    found, _ = fly(law, jnp.asarray(r), jnp.asarray(y))
    np.testing.assert_allclose(found, expected, rtol=0, atol=CLEAN * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_gradients_by_every_number_agree_with_differences(name):
    law, size = LAWS[name], 0.3 if "angle" in name else 1.0
    r, y = map(jnp.asarray, broken_lines(size))
    numbers, rest = eqx.partition(law, eqx.is_inexact_array)
    flat, tree = jax.tree.flatten(numbers)
    start = jnp.concatenate([x.ravel() for x in flat])

    @jax.jit
    def cost(x):
        parts = jnp.split(x, np.cumsum([leaf.size for leaf in flat])[:-1])
        leaves = [part.reshape(leaf.shape) for part, leaf in zip(parts, flat, strict=True)]
        return jnp.mean(fly(eqx.combine(jax.tree.unflatten(tree, leaves), rest), r, y)[0] ** 2)

    forward, reverse = jax.jit(jax.jacfwd(cost))(start), jax.jit(jax.grad(cost))(start)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12 * np.abs(forward).max())
    at = np.asarray(start)
    steps = 1e-6 * np.where(at == 0, 1.0, np.abs(at))
    inside = np.isfinite(at) & (at > 0)  # a limit of inf has none; a cutoff of 0 is off
    for k in np.flatnonzero(inside):
        h = np.zeros(len(at))
        h[k] = steps[k]
        difference = (cost(jnp.asarray(at + h)) - cost(jnp.asarray(at - h))) / (2 * steps[k])
        scale = float(cost(start)) / at[k]
        assert forward[k] == pytest.approx(float(difference), rel=1e-6, abs=2e-6 * scale)


@eqx.filter_jit
def step(law, state, r, y):
    return law.step(state, r, y)


@pytest.mark.parametrize("law", [PX4, ARDUPILOT], ids=["PX4", "ArduPilot"])
def test_the_integral_stops_where_the_mixer_gave_less(law):
    r, y = jnp.full(1, 0.5), jnp.zeros(1)
    state, command = step(law, law.init(y), r, y)
    integrals = [
        step(law, law.applied(state, share * command), r, y)[0].memory["integral"]
        for share in (0.5, 1.0)
    ]
    assert integrals[0] == state.memory["integral"] and integrals[1] > integrals[0]


@pytest.mark.slow
def test_a_setpoint_feeds_its_own_rate_forward():
    law = PX4Attitude(PX4, [4.0])
    zero = jnp.zeros(1)
    ahead = step(law, law.init(zero), Setpoint(zero, zero + 0.1, zero), zero)[1]
    as_angle = step(law, law.init(zero), Setpoint(zero + 0.1 / 4, zero, zero), zero)[1]
    np.testing.assert_allclose(ahead, as_angle, rtol=1e-12)


@pytest.mark.slow
def test_axes_and_members_have_their_own_gains():
    law = dataclasses.replace(
        CRAZYFLIE, kp=[[250.0, 200.0], [250.0, 200.0]], ki=[500.0, 400.0], kd=[2.5, 2.0],
        integral_limit=33.3, limit=32767.0, kff=0.0, derivative_hz=None,
    )  # fmt: skip
    assert law.ensemble == (2,)
    r, y = jnp.full((2, 2), 0.1), jnp.zeros((2, 2))
    command = step(law, law.init(y), r, y)[1]
    assert command.shape == (2, 2)
    for axis in (0, 1):
        for member in (0, 1):
            through = law.linear(axis, member).reference_through
            assert float(command[axis, member]) == pytest.approx(0.1 * float(through))


def test_the_kind_of_relaxation_and_its_growth_alone_are_the_laws_of_betaflight():
    relax = ItermRelax(15.0, 40.0, kind="gyro")
    slow, r, y = jnp.array([10.0, 10.0]), jnp.array([12.0, 12.0]), jnp.array([-5.0, 9.0])
    np.testing.assert_allclose(relax.error(slow, r, y, slow), [13.0, 0.0])  # deadband of 2
    growing = dataclasses.replace(relax, growth_only=True)
    np.testing.assert_allclose(growing.error(slow, r, y, -slow), [17.0, 3.0])  # it shrinks


def test_throttle_moves_gain_and_cutoff_as_documented():
    np.testing.assert_allclose(tpa_factor(np.array([0.2, 0.35, 1.0])), [1.0, 1.0, 0.35])
    assert round(float(dynamic_cutoff(0.3, 250.0, 500.0)), -1) == 350  # at hover
    assert float(dynamic_cutoff(0.3, 75.0, 150.0)) == pytest.approx(105.4, abs=0.1)


def test_b0_of_an_identified_plant_and_its_slopes():
    assert round(float(adrc_b0(1000.0, 0.03))) == 1910
    slopes = jax.grad(lambda x: adrc_b0(x[0], x[1]))(jnp.array([1000.0, 0.03]))
    np.testing.assert_allclose(slopes, [1.90986, -1.90986e3 / 0.03], rtol=1e-5)


def test_a_gyro_rate_that_is_no_multiple_of_the_loops_is_refused():
    with pytest.raises(ValueError, match="2.25 samples"):
        PX4Rate(0.15, 0.2, 0.003, gyro=FilterChain((PT2(40.0),), 900.0))
