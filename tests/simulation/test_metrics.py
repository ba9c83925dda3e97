"""Numbers of a loop's answer, against closed forms, python-control and numpy."""

from functools import partial
from typing import Any

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.simulation import metrics, scenario, Simulation, Sine, Step


DT, COUNT = 0.002, 5000
TIME = DT * np.arange(COUNT)
ZETA = np.array([0.2, 0.4, 0.6, 0.8])
OMEGA = 5.0  # rad/s


def second_order(zeta, time):
    """The unit step response of omega^2 / (s^2 + 2 zeta omega s + omega^2)."""
    damped = OMEGA * np.sqrt(1 - zeta**2)
    time = np.maximum(time, 0)
    ripple = np.cos(damped * time) + zeta * OMEGA / damped * np.sin(damped * time)
    return 1 - np.exp(-zeta * OMEGA * time) * ripple


def simulation(angle, happens, **known):
    """A record of one axis [samples, 1, members], made by hand."""
    still = jnp.zeros(angle.shape, jnp.asarray(angle).dtype)
    parts = {"measurement": still, "command": still, "saturated": still > 0, "signals": {}}
    parts |= {"diverged": jnp.zeros(angle.shape[2:], bool), "angle": angle}
    made = {name: jax.tree.map(jnp.asarray, x) for name, x in (parts | known).items()}
    return Simulation(time=jnp.asarray(TIME), scenario=happens, dt=DT, **made)


def step_of(size, at=0.0):
    return scenario(duration=10.0, dt=DT, axes=1, reference={0: Step(size, at=at)})


@pytest.fixture(scope="module")
def steps():
    """0.1 rad, by four damping ratios."""
    angle = 0.1 * second_order(ZETA, TIME[:, None])[:, None]
    return metrics(simulation(angle, step_of(0.1)))


def test_overshoot_is_that_of_the_damping_ratio(steps):
    exact = 100 * np.exp(-np.pi * ZETA / np.sqrt(1 - ZETA**2))
    # The highest sample misses the peak by at most (omega T / 2)^2 / 2 of the step.
    np.testing.assert_allclose(steps.overshoot[0], exact, atol=100 * (OMEGA * DT / 2) ** 2 / 2)


@pytest.mark.slow
def test_settling_and_rise_times_are_those_of_python_control(steps):
    fine = np.arange(0, 10, DT / 20)
    for k, zeta in enumerate(ZETA):
        system = control.tf([OMEGA**2], [1, 2 * zeta * OMEGA, OMEGA**2])
        answer = control.step_response(system, fine).outputs
        info: Any = partial(control.step_info, answer, fine, yfinal=1.0)
        two, five = (info(SettlingTimeThreshold=x) for x in (0.02, 0.05))
        assert steps.settling_time[0, k] == pytest.approx(two["SettlingTime"], abs=DT / 10)
        assert steps.settling_time_5[0, k] == pytest.approx(five["SettlingTime"], abs=DT / 10)
        assert steps.rise_time[0, k] == pytest.approx(two["RiseTime"], abs=DT / 10)


def test_integral_of_the_squared_error_is_the_closed_form(steps):
    exact = 0.1**2 * (ZETA + 1 / (4 * ZETA)) / OMEGA
    np.testing.assert_allclose(steps.ise[0], exact, rtol=1e-4)  # (omega T)^2
    np.testing.assert_allclose(steps.normalised().ise[0], exact / 0.1**2, rtol=1e-4)


def test_integrals_of_an_exponential_are_the_closed_forms():
    rates = np.array([1.0, 3.0, 10.0, 30.0])
    error = np.exp(-rates * TIME[:, None])[:, None]
    found = metrics(simulation(1 - error, step_of(1.0)))
    remaining = np.exp(-rates * 10.0)
    # The trapezoidal rule is right to (rate T)^2 / 12.
    np.testing.assert_allclose(found.iae[0], (1 - remaining) / rates, rtol=1e-3)
    np.testing.assert_allclose(found.itae[0], 1 / rates**2, rtol=1e-3)
    np.testing.assert_allclose(found.ise[0], 1 / (2 * rates), rtol=2e-3)
    assert not np.any(found.overshoot)
    np.testing.assert_allclose(found.settling_time[0], np.log(50) / rates, atol=DT / 10)
    np.testing.assert_allclose(found.rise_time[0], np.log(9) / rates, atol=DT / 10)


def test_a_step_at_any_time_is_judged_from_its_own_start(steps):
    angle = 0.1 * second_order(ZETA, TIME[:, None] - 4.0)[:, None]
    later = metrics(simulation(angle, step_of(0.1, at=4.0)), start=4.0)
    sooner = metrics(
        simulation(0.1 * second_order(ZETA, TIME[:, None])[:, None], step_of(0.1)), stop=6.0
    )
    for name in ("itae", "ise", "overshoot", "settling_time", "settling_time_5", "rise_time"):
        np.testing.assert_allclose(getattr(later, name), getattr(sooner, name), rtol=1e-9)
    assert (later.start, later.stop, later.load_start) == (4.0, 10.0, 4.0)


def test_all_sums_are_those_of_numpy_on_any_record():
    draw = np.random.default_rng(3)
    angle, command, torque, estimate = draw.normal(size=(4, COUNT, 1, 4))
    saturated = draw.uniform(size=angle.shape) < 0.3
    happens = scenario(
        duration=10.0,
        axes=1,
        reference={0: Sine(0.5, period=2.0)},
        disturbance={0: torque[:, 0]},
    )
    found = metrics(
        simulation(
            angle, happens, command=command, saturated=saturated, signals={"disturbance": estimate}
        ),
        start=2.0,
        stop=9.0,
        load_start=5.0,
        torque_gain=[0.5],
    )
    window, load = slice(1000, 4500), slice(2500, 4500)
    error = np.asarray(happens.reference)[..., None] - angle
    since = (TIME[window] - 2.0)[:, None, None]
    missed = 0.5 * estimate - torque
    expected = {
        "iae": np.trapezoid(np.abs(error[window]), dx=DT, axis=0),
        "itae": np.trapezoid(since * np.abs(error[window]), dx=DT, axis=0),
        "ise": np.trapezoid(error[window] ** 2, dx=DT, axis=0),
        "energy": DT * np.sum(command[window] ** 2, axis=0),
        "activity": np.sum(np.diff(command[window], axis=0) ** 2, axis=0),
        "saturation_share": saturated[window].mean(axis=0),
        "peak": np.abs(error[load]).max(axis=0),
        "rms": np.sqrt(np.mean(error[load] ** 2, axis=0)),
        "disturbance_rmse": np.sqrt(np.mean(missed[load] ** 2, axis=0)),
    }
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(found, name), values, rtol=1e-12, err_msg=name)
    assert np.isnan(found.overshoot).all() and not found.stepped.any()


def test_an_angle_that_never_settles_has_no_settling_time_and_the_table_says_so():
    ringing = 0.1 * (1 - np.exp(-5 * TIME)) + 0.01 * np.sin(7 * TIME)
    slow = 0.05 * (1 - np.exp(-TIME))
    angle = np.stack([ringing, ringing, slow, slow], axis=-1)[:, None]
    found = metrics(simulation(angle, step_of(0.1)))
    assert np.isnan(found.settling_time).all() and np.isnan(found.rise_time[0, 2:]).all()
    text = " ".join(found.remarks)
    assert "roll: 100.0% of the members: the angle is outside 2 % of the step at the end" in text
    assert "roll: 50.0% of the members: the angle does not reach 90 % of the step" in text
    assert np.isinf(found.summary().settling_time.mean[0]) and "never" in str(found)


def test_a_reference_that_does_not_stay_makes_no_step():
    there_and_back = Step(0.1) + Step(-0.1, at=5.0)
    for signal, steps in ((there_and_back, False), (Step(0.1, at=3.0), True)):
        happens = scenario(duration=10.0, axes=1, reference={0: signal})
        found = metrics(simulation(np.zeros((COUNT, 1, 4)), happens))
        assert bool(found.stepped.all()) is steps
    assert np.isnan(metrics(simulation(np.zeros((COUNT, 1, 4)), happens)).settling_time).all()


def test_a_recovery_from_an_angle_is_a_step_from_it(steps):
    angle = 0.1 - 0.1 * second_order(ZETA, TIME[:, None])[:, None]
    found = metrics(simulation(angle, step_of(0.0)))
    for name in ("itae", "overshoot", "settling_time", "rise_time"):
        np.testing.assert_allclose(getattr(found, name), getattr(steps, name), rtol=1e-9)


def test_what_a_load_does_is_not_taken_for_the_answer_to_the_step(steps):
    angle = 0.1 * second_order(ZETA, TIME[:, None])
    angle[2500:] += 0.2 * np.sin(TIME[2500:, None])
    found = metrics(simulation(angle[:, None], step_of(0.1)), load_start=5.0)
    for name in ("overshoot", "settling_time", "settling_time_5", "rise_time", "step"):
        np.testing.assert_allclose(getattr(found, name), getattr(steps, name), rtol=1e-9)
    error = 0.1 - angle[2500:]
    np.testing.assert_allclose(found.peak[0], np.abs(error).max(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.rms[0], np.sqrt(np.mean(error**2, axis=0)), rtol=1e-12)


@pytest.mark.slow
def test_a_summary_is_that_of_numpy_and_counts_every_member():
    scale = np.random.default_rng(5).lognormal(size=64)
    error = scale * np.exp(-3.0 * TIME[:, None])[:, None]
    found = metrics(simulation(-error, step_of(0.0), diverged=np.arange(64) < 3))
    spread, values = found.summary().itae, np.asarray(found.itae[0])
    worst = np.sort(values)[::-1]
    assert spread.mean[0] == pytest.approx(values.mean(), rel=1e-12)
    assert spread.p95[0] == pytest.approx(np.percentile(values, 95), rel=1e-12)
    assert spread.worst[0] == worst[0]
    # A fifth of 64 members is 12.8.
    assert spread.cvar20[0] == pytest.approx((worst[:12].sum() + 0.8 * worst[12]) / 12.8, rel=1e-12)
    assert found.summary().diverged_share == pytest.approx(3 / 64)
    assert "3 of 64 members (4.7%) diverged" in str(found)


@pytest.mark.slow
def test_times_and_integrals_have_the_gradients_of_central_differences():
    happens = step_of(0.1)

    def weighed(zeta):
        damped = OMEGA * jnp.sqrt(1 - zeta**2)
        time = jnp.asarray(TIME)
        ripple = jnp.cos(damped * time) + zeta * OMEGA / damped * jnp.sin(damped * time)
        angle = 0.1 * (1 - jnp.exp(-zeta * OMEGA * time) * ripple)
        found = metrics(simulation(jnp.stack([angle] * 4, axis=-1)[:, None], happens))
        names = ("itae", "ise", "rms", "settling_time", "rise_time", "overshoot")
        # Weights of one size and no pattern, so that no error hides behind another.
        weights = (1.3, 7.1, 2.9, 0.31, 0.17, 0.0023)
        return sum(w * getattr(found, n)[0, 0] for w, n in zip(weights, names, strict=True))

    exact, h = jax.grad(weighed)(0.45), 1e-6
    numeric = (weighed(0.45 + h) - weighed(0.45 - h)) / (2 * h)
    assert float(exact) == pytest.approx(float(numeric), rel=1e-6)


def test_float32_records_are_judged_in_float32(steps):
    angle = (0.1 * second_order(ZETA, TIME[:, None])[:, None]).astype(np.float32)
    happens = jax.tree.map(lambda x: x.astype(jnp.float32), step_of(0.1))
    found = metrics(eqx.tree_at(lambda s: s.time, simulation(angle, happens), jnp.zeros(COUNT)))
    assert found.itae.dtype == jnp.float32
    for name in ("itae", "ise", "overshoot", "settling_time"):
        # 5000 roundings of 6e-8.
        np.testing.assert_allclose(getattr(found, name), getattr(steps, name), rtol=2e-4)


@pytest.mark.parametrize(
    "window", [{"start": 10.0}, {"stop": 12.0}, {"start": 5.0, "load_start": 4.0}, {"stop": 0.002}]
)
def test_a_window_outside_the_record_is_refused(window):
    with pytest.raises(ValueError, match="flight of 10 s: give at least two"):
        metrics(simulation(np.zeros((COUNT, 1, 4)), step_of(0.1)), **window)


def test_one_loop_prints_in_degrees_by_axis():
    angle = np.zeros((COUNT, 2))
    angle[:, 0] = np.radians(4.0) * (1 - np.exp(-10 * TIME))
    happens = scenario(duration=10.0, axes=2, reference={"roll": Step(np.radians(4.0))})
    text = str(metrics(simulation(angle, happens)))
    assert text.splitlines()[1].split() == ["roll", "pitch"]
    assert "IAE                deg s            0.4          0" in text
    assert "pitch" not in text.split("!", 1)[1]


def test_labelled_metrics_hold_every_number_with_its_unit(steps):
    pytest.importorskip("xarray", reason="xarray is not installed: pip install 'jaxquad[interop]'")
    table = steps.to_xarray()
    assert dict(table.sizes) == {"axis": 1, "member": ZETA.size} and table.axis.item() == "roll"
    arrays = {k: x for k, x in vars(steps).items() if isinstance(x, jax.Array)}
    assert set(table.data_vars) == set(arrays)
    for name, values in arrays.items():
        np.testing.assert_array_equal(table[name].values, values)
    assert (table.itae.units, table.rise_time.units) == ("rad s^2", "s")
    assert steps.normalised().to_xarray().ise.units == "s"
    assert (table.start, table.stop) == (steps.start, steps.stop)
