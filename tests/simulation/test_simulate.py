import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

from jaxquad.control import PD, place_pd
from jaxquad.loops import Loop
from jaxquad.models import Allocation, Attitude, MotorLag, Multirotor, QUANSER_HOVER
from jaxquad.simulation import Encoder, excite, MotorDrive, runge_kutta, Scenario, simulate


DT, SAMPLES = 0.002, 125
SHEET = QUANSER_HOVER
GAIN = np.array([SHEET.arm * SHEET.thrust_coefficient] * 2 + [SHEET.torque_coefficient])
GAIN = GAIN / np.array(SHEET.inertia)  # rad/s^2/V
STEPS = (0.2, 0.3, 0.02)  # rad: the commands stay within the amplifier's limits
PILOT = place_pd(GAIN, natural_frequency=4.0, damping=0.7, dt=DT)


def allocation():
    return Allocation(SHEET.arm, SHEET.thrust_coefficient, SHEET.torque_coefficient)


DRIVE, ENCODER = MotorDrive(allocation()), Encoder(SHEET.encoder_counts)


def rig(inertia=SHEET.inertia, lag=0.05):
    return Multirotor(Attitude(inertia, damping=(0.01,) * 3), allocation(), MotorLag(lag))


def scenario(seed=0, ensemble=(), samples=SAMPLES) -> Scenario:
    """Steps, injected noise, gusts and sensor noise on all axes."""
    draw = np.random.default_rng(seed).standard_normal((4, samples, 3, *ensemble))
    draw[0] = np.sign(draw[0, :1])
    scale = np.array([STEPS, [0.5] * 3, [0.01, 0.01, 0.002], [1e-4] * 3])
    scale = scale.reshape(4, 1, 3, *(1,) * len(ensemble))
    return Scenario(*(jnp.asarray(part) for part in draw * scale))


def quiet(samples=SAMPLES, **parts) -> Scenario:
    nothing = jnp.zeros((samples, 3))
    held = {name: jnp.broadcast_to(jnp.asarray(x), (samples, 3)) for name, x in parts.items()}
    names = ("reference", "injection", "disturbance", "noise")
    return Scenario(**(dict.fromkeys(names, nothing) | held), dt=None)


def independent(plant, inputs, disturbance):
    """Every sample integrated by scipy's DOP853 on its own, under that sample's inputs."""
    flat, unravel = ravel_pytree(plant.init())
    slope = jax.jit(lambda x, u, d: ravel_pytree(plant.derivative(unravel(x), u, d))[0])
    states = []
    for u, d in zip(inputs, disturbance, strict=True):
        states.append(flat)
        run = lambda t, x, u=u, d=d: np.asarray(slope(x, u, d))
        done = solve_ivp(run, (0, DT), flat, "DOP853", first_step=DT, rtol=1e-11, atol=1e-13)
        flat = done.y[:, -1]
    return jax.vmap(lambda x: plant.measure(unravel(x)))(np.stack(states))


@pytest.mark.slow
def test_between_samples_the_loop_agrees_with_scipy_under_the_same_held_inputs():
    plant, case = rig(), scenario()
    found = simulate(Loop(plant, PILOT, dt=DT, drive=DRIVE), case)
    inputs = jax.vmap(DRIVE.inputs)(found.command)
    expected = independent(plant, inputs, case.disturbance)
    # One fourth-order step a sample: (dt / lag)^5 / 120 = 1e-9 of the motor's lag at a step.
    np.testing.assert_allclose(found.angle, expected, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_the_error_falls_as_the_fourth_power_of_the_step():
    def final(steps):
        held = quiet(steps + 1, injection=(3.0, -2.0, 4.0), disturbance=(0.05, 0.02, -0.02))
        idle, dt = PD(np.zeros(3), np.zeros(3), dt=0.8 / steps), 0.8 / steps
        return np.asarray(simulate(Loop(rig(), idle, dt=dt, drive=DRIVE), held).angle[-1])

    exact = final(1600)
    coarse, fine = (np.linalg.norm(final(steps) - exact) for steps in (40, 80))
    # Next-order terms, (dt / lag) of the error.
    assert coarse / fine == pytest.approx(16, rel=0.3)


def test_a_runge_kutta_step_keeps_every_structure_and_is_exact_for_a_cubic():
    moved = runge_kutta(lambda s: {"t": jnp.ones(()), "x": 4 * s["t"] ** 3},
                        {"t": jnp.asarray(1.0), "x": jnp.asarray(1.0)}, 0.5)  # fmt: skip
    assert moved["t"] == 1.5
    assert moved["x"] == pytest.approx(1.5**4, rel=1e-14)


INERTIAS = np.array(SHEET.inertia)[:, None] * np.array([0.7, 1.0, 1.6])


def fleet():
    case = scenario(1, (3,))
    return simulate(Loop(rig(INERTIAS), PILOT, dt=DT, drive=DRIVE, encoder=ENCODER), case)


@pytest.mark.slow
def test_an_ensemble_is_as_many_single_runs():
    together, case = fleet(), scenario(1, (3,))
    assert together.angle.shape == (SAMPLES, 3, 3)
    for k in range(3):
        single = jax.tree.map(lambda x, k=k: x[..., k], case)
        alone = simulate(
            Loop(rig(INERTIAS[:, k]), PILOT, dt=DT, drive=DRIVE, encoder=ENCODER), single
        )
        for name in ("angle", "measurement", "command", "injection"):
            # Sums over axes may be ordered differently, and the loop forgets it.
            np.testing.assert_allclose(
                getattr(together, name)[..., k], getattr(alone, name), rtol=0, atol=1e-12
            )


@pytest.mark.slow
def test_one_scenario_serves_an_ensemble_of_plants():
    one, wide = scenario(2), jax.tree.map(lambda x: jnp.stack([x] * 3, axis=-1), scenario(2))
    found, expected = (
        simulate(Loop(rig(INERTIAS), PILOT, dt=DT, drive=DRIVE), case) for case in (one, wide)
    )
    # Two programs, whose last bits differ on some processors.
    np.testing.assert_allclose(found.angle, expected.angle, rtol=1e-15)
    assert found.injection.shape == (SAMPLES, 3, 3)


def test_the_measurement_is_the_counted_angle_with_its_noise():
    case = scenario()
    found = simulate(Loop(rig(), PILOT, dt=DT, drive=DRIVE, encoder=ENCODER), case)
    step = 2 * np.pi / SHEET.encoder_counts
    noisy = np.asarray(found.angle) + np.asarray(case.noise)
    np.testing.assert_allclose(found.measurement, step * np.round(noisy / step), rtol=1e-12)


def test_the_injected_signal_is_added_to_the_command():
    case = quiet(injection=(1.0, -2.0, 0.5))
    found = simulate(Loop(rig(), PILOT, dt=DT, drive=DRIVE), case)
    np.testing.assert_allclose(found.command[0], [1.0, -2.0, 0.5], rtol=1e-13)
    np.testing.assert_array_equal(found.injection, case.injection)


def cost(inertia):
    found = simulate(Loop(rig(inertia), PILOT, dt=DT, drive=DRIVE), scenario())
    return jnp.sum(found.angle**2) + 1e-3 * jnp.sum(found.command**2)


@pytest.mark.slow
def test_forward_reverse_and_finite_derivatives_agree():
    inertia = jnp.asarray(SHEET.inertia)
    forward, reverse = jax.jacfwd(cost)(inertia), np.asarray(jax.grad(cost)(inertia))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    h = 1e-4  # its square is the error of a central difference
    finite = (cost((1 + h) * inertia) - cost((1 - h) * inertia)) / (2 * h)
    assert reverse @ np.array(SHEET.inertia) == pytest.approx(float(finite), rel=1e-6)


@pytest.mark.slow
def test_single_precision_stays_single():
    with jax.enable_x64(False):
        narrow = Scenario(*(jnp.zeros((5, 3), jnp.float32) for _ in range(4)))
        plant, pilot = rig(), place_pd(GAIN, natural_frequency=4.0, damping=0.7, dt=DT)
        drive = MotorDrive(allocation())
        found = simulate(Loop(plant, pilot, dt=DT, drive=drive, encoder=ENCODER), narrow)
    kinds = {leaf.dtype for leaf in jax.tree.leaves(found)}
    assert kinds == {jnp.dtype("float32"), jnp.dtype(bool)}


def with_injection(found, signal):
    return eqx.tree_at(lambda f: f.scenario.injection, found, signal)


def test_a_record_of_a_flight_names_its_channels_and_units():
    found = simulate(Loop(rig(), PILOT, dt=DT, drive=DRIVE), quiet(injection=(0.0, 1.0, 0.0)))
    wavy = with_injection(found, found.injection * jnp.sin(found.time)[:, None])
    record = wavy.record("pitch")
    assert record.names == ("pitch_command", "pitch_angle", "sweep")
    assert [record.unit(name) for name in record.names] == ["V", "rad", "V"]
    assert record.source == "simulation" and record.dt == pytest.approx(DT, rel=1e-12)
    np.testing.assert_array_equal(record.outputs[:, 0], found.measurement[:, 1])
    np.testing.assert_array_equal(record.inputs[:, 0], found.command[:, 1])


def test_without_an_injection_a_record_has_no_reference():
    found = simulate(Loop(rig(), PILOT, dt=DT, drive=DRIVE), scenario())
    idle = with_injection(found, jnp.zeros_like(found.injection))
    assert idle.record("roll").reference_names == ()


@pytest.mark.slow
def test_a_record_is_of_one_member_and_of_an_axis_that_exists():
    found = fleet()
    np.testing.assert_array_equal(
        found.record("yaw", member=2).outputs[:, 0], found.measurement[:, 2, 2]
    )
    with pytest.raises(ValueError, match=r"ensemble of shape \(3,\) .* pick one, member=0"):
        found.record("yaw")
    with pytest.raises(ValueError, match="axis 'heave': choose one of roll, pitch, yaw"):
        found.record("heave")


def test_a_scenario_of_unequal_shapes_is_refused():
    part = jnp.zeros((5, 3))
    with pytest.raises(Exception, match="samples|different shapes"):
        Scenario(part, part, part, jnp.zeros((4, 3)))


def test_a_controller_made_for_another_sample_interval_is_refused():
    with pytest.raises(ValueError, match="made for samples of 0.002 s, not 0.004 s"):
        simulate(Loop(rig(), PILOT, dt=0.004), scenario())
    with pytest.raises(ValueError, match="dt is 0.0 s"):
        simulate(Loop(rig(), PILOT, dt=0.0), scenario())


@pytest.mark.parametrize(
    "bad",
    [
        {"dt": 0.0},
        {"torque_noise": -1.0},
        {"sensor_noise": float("nan")},
        {"torque_corner": 0.0},
        {"axis": "surge"},
    ],
    ids=lambda bad: next(iter(bad)),
)
def test_an_experiment_that_means_nothing_is_refused(bad):
    options = {"key": jax.random.key(0), "dt": 0.01} | bad
    with pytest.raises(ValueError, match=f"{next(iter(bad))}"):
        excite(np.zeros(50), **options)
    with pytest.raises(ValueError, match="jq.sweep"):
        excite(np.full(50, np.nan), key=jax.random.key(0), dt=0.01)
