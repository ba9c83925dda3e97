"""Damping of the rate is fitted where a response shows one, and the gain is right either way."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal
from scipy.linalg import expm
from synthetic import response_of

import jaxquad as jq
from jaxquad.identify import fit_damped
from jaxquad.workflows import AutopilotSettings


GAIN, LAG, DELAY = 25000.0, 0.03, 0.001  # deg/s^2 per unit, as ArduCopter's roll
START = jq.LaggedIntegrator(20000.0, 0.05, 0.005)
OMEGA = np.geomspace(3.0, 180.0, 60)


def axis(damping):
    return jq.LaggedIntegrator(GAIN, LAG, DELAY, damping=damping)


def flown(damping, seed):
    """Errors as gusts leave them in a loop: 2 %, and more at low frequencies."""
    exact = response_of(axis(damping), omega=OMEGA)
    error = 0.02 * np.sqrt(1 + (10 / OMEGA) ** 2)[:, None, None]
    white = np.random.default_rng(seed).standard_normal((*error.shape, 2)) @ [1.0, 1.0j]
    response = np.asarray(exact.response)
    variance = jnp.asarray(2 * error**2 * np.abs(response) ** 2)
    return dataclasses.replace(
        exact,
        response=jnp.asarray(response * (1 + error * white)),
        random_error=jnp.asarray(error),
        errors=jq.spectra.independent_errors(exact.omega, variance),
    )


def closed_loop(damping, seed, rate=400.0, duration=40.0, inner=5):
    """A chirp of the set-point of a PID at 400 Hz, in gusts, with gyro noise."""
    dt, count, random = 1 / (rate * inner), int(rate * duration), np.random.default_rng(seed)
    system = np.array([[-damping, GAIN], [0.0, -1 / LAG]]), np.array([[0.0], [1 / LAG]])
    powers = expm(dt * np.block([[*system], [np.zeros((1, 3))]]))
    A, B = powers[:2, :2], powers[:2, 2]
    time = np.arange(count) / rate
    reference = 100 * signal.chirp(time, 0.3, duration, 30.0, method="log")
    noise, gusts = random.normal(size=(2, count))
    gust = signal.lfilter([60 * np.sqrt(2 / (0.3 * rate))], [1, -np.exp(-1 / (0.3 * rate))], gusts)
    P, I, D = 0.07 * np.pi / 180, 0.07 * np.pi / 180, 0.0018 * np.pi / 180
    late, state = [0.0] * round(DELAY / dt), np.zeros(2)
    integral = slope = before = 0.0
    record = np.zeros((count, 2))
    for k in range(count):
        measured = state[0] + noise[k]
        error = reference[k] - measured
        integral += I * error / rate
        slope += 0.27 * ((before - measured) * rate - slope)
        before = measured
        record[k] = P * error + integral + D * slope, measured
        for _ in range(inner):
            late.append(record[k, 0])
            state = A @ state + B * late.pop(0) + np.array([gust[k] * dt, 0.0])
    return jq.Record(
        time, record[:, :1], record[:, 1:], references=reference[:, None], input_names=("u",),
        output_names=("q",), reference_names=("r",), hold=1 / rate,
    )  # fmt: skip


def holds(fit, name, value):
    low, high = fit.interval(name)
    return low <= value <= high


@pytest.mark.slow
@pytest.mark.parametrize("damping", [0.0, 0.1, 0.5, 2.1, 5.0])
def test_the_intervals_hold_with_and_without_damping(damping):
    """95 % of 20, less two standard deviations."""
    plain = [jq.fit(START, flown(damping, seed)) for seed in range(20)]
    fits = [fit_damped(one) for one in plain]
    shown = [fit is not one for fit, one in zip(fits, plain, strict=True)]
    assert all(shown) if damping >= 0.5 else sum(shown) <= (14 if damping else 3)
    assert all(("damping" in fit.names) == mine for fit, mine in zip(fits, shown, strict=True))
    for name, value in {"gain": GAIN, "lag": LAG, "delay": DELAY}.items():
        assert sum(holds(fit, name, value) for fit in fits) >= 17
    if damping >= 0.5:
        assert sum(holds(fit, "damping", damping) for fit in fits) >= 17


@pytest.mark.slow
@pytest.mark.parametrize("damping", [0.0, 2.1])
def test_a_flown_chirp_shows_a_damping_where_there_is_one(damping):
    frf = jq.frequency_response(closed_loop(damping, seed=0))
    plain = jq.fit(START, frf)
    fit = fit_damped(plain)
    assert (fit is plain) == (damping == 0)
    assert fit.identifiable
    truth = {"gain": GAIN, "lag": LAG, "delay": DELAY, "damping": damping}
    for name in fit.names:
        assert abs(fit[name] - truth[name]) < 3 * fit.standard_errors[fit.names.index(name)]


@pytest.mark.slow
def test_one_more_fit_which_starts_from_the_phase_at_the_lowest_frequencies_is_enough(monkeypatch):
    plain, starts = jq.fit(START, flown(1.0, seed=0)), []
    assert plain.origin is not None
    kind = type(plain.origin)
    run = kind.fit_again

    def watched(origin, model, *options):
        starts.append(float(model.damping))
        return run(origin, model, *options)

    monkeypatch.setattr(kind, "fit_again", watched)
    fit_damped(plain)
    [start] = starts
    assert 0.4 < start < 1.5


@pytest.mark.slow
def test_the_errors_count_what_a_damping_of_three_degrees_moves():
    """It moves the parameters as leaving out the one that was found does, to first order."""
    plain = jq.fit(START, flown(2.1, seed=3))
    sharp, fit = fit_damped(plain, unmodelled=0.0), fit_damped(plain)
    np.testing.assert_array_equal(fit.values, sharp.values)
    assert plain.used_band is not None
    share = 0.05 * plain.used_band[0] / fit["damping"]
    moved = share * (sharp.values[:3] - plain.values) / 1.96
    wanted = np.sqrt(sharp.standard_errors[:3] ** 2 + moved**2)
    np.testing.assert_allclose(fit.standard_errors[:3], wanted)
    spread = fit.derived(lambda model: model.gain * model.lag).standard_error
    assert spread > sharp.derived(lambda model: model.gain * model.lag).standard_error
    assert "width prior" in str(fit_damped(plain, unmodelled=0.5)) and "width" in str(fit)
    with pytest.raises(ValueError, match="unmodelled is -1"):
        fit_damped(plain, unmodelled=-1.0)


@pytest.mark.slow
def test_the_fit_keeps_what_was_free_and_in_which_band():
    frf = flown(2.1, seed=0)
    plain = jq.fit(START, frf, free=["gain", "lag"], band=(4.0, 100.0))
    fit = fit_damped(dataclasses.replace(plain, parameter_units=("deg/s^2", "s")))
    assert fit.parameter_units == ("deg/s^2", "s", "1/s")
    assert fit.names == ("gain", "lag", "damping") and float(fit.model.delay) == 0.005
    assert fit.used_band == plain.used_band
    assert fit_damped(fit) is fit


@pytest.mark.slow
def test_other_models_are_refused_and_nothing_fitted_stays_so():
    frf = response_of(jq.LaggedIntegrator(8.0, 0.05, 0.03, integrators=0))
    flat = jq.fit(jq.LaggedIntegrator(8.0, 0.05, 0.03, integrators=0), frf)
    with pytest.raises(ValueError, match="LaggedIntegrator without integrators"):
        fit_damped(flat)
    ratio = jq.fit(jq.TransferFunction([8.0], [0.05, 1.0]), frf, free=["numerator[0]"])
    with pytest.raises(ValueError, match="one of a TransferFunction"):
        fit_damped(ratio)
    empty = jq.fit(START, flown(0.0, seed=0), band=(3.0, 3.3))
    assert not empty.verdict.fitted and fit_damped(empty) is empty


@pytest.mark.slow
@pytest.mark.parametrize("log", ["mixer_chirp_roll", "rate_chirp_pitch"])
def test_a_firmware_s_gain_is_right_beside_a_small_damping(data, log, without_type_checks):
    """437.5 rad/s^2 and 30 ms, and a damping of 0.12 and 0.11 1/s."""
    axis = log.split("_")[-1]
    path, settings = data / "ardupilot_firmware" / f"{log}.BIN", AutopilotSettings(axis=axis)
    proposal = jq.workflows.autopilot(path, settings)
    assert isinstance(proposal, jq.autopilot.AutopilotProposal)
    plain = proposal.identification.fit
    if plain.values[0] < 0:
        pytest.skip("the chirp is counted twice in the command of this log")
    fit = fit_damped(plain)
    low, high = fit.interval("gain")
    assert low < np.degrees(437.5) < high < 1.03 * low and holds(fit, "lag", LAG)
