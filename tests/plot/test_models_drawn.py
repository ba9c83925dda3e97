"""Models, fits, loops and records are drawn by the same few functions."""

from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
from synthetic import response_of
from tuning_case import B, flight as case_flight, ladrc, loop as case_loop

import jaxquad as jq


pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("compiled_quickly")]
TRUTH = jq.LaggedIntegrator(280.0, 0.016, 0.011)
TWO = jq.StateSpace(F=[[-1.0, 1.0], [-10.0, -1.0]], G=[[1.0, 0.0], [0.0, 2.0]], H0=np.eye(2))


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def fit():
    start, frf = jq.LaggedIntegrator(250.0, 0.01, 0.011), response_of(TRUTH, error=0.05, seed=0)
    return jq.fit(start, frf, free=("gain", "lag"), band=(1.0, 15.0))


@pytest.fixture(scope="module")
def record():
    time = np.arange(600) * 0.01
    u = np.sign(np.sin(3 * time))
    y = np.asarray(jq.models.simulate_linear(TRUTH.transfer_function(), u, 0.01))
    y = y + np.random.default_rng(0).normal(0.0, 0.3, y.size)
    return jq.Record(
        time, u, y, hold="dt", input_names="M", output_names="q", input_units="V",
        output_units="rad/s",
    )  # fmt: skip


def lines(panel) -> dict[str, Any]:
    return {line.get_label(): line for line in panel.get_lines()}


def test_a_fit_shows_its_points_its_model_and_what_it_did_not_use(fit):
    magnitude = jq.plot.bode(fit)[0]
    drawn = lines(magnitude)
    unused = drawn["joint estimate, not used"].get_xdata()
    assert unused.size and np.all((unused < 1.0) | (unused > 15.0))
    band = next(c for c in magnitude.collections if c.get_label() == "fit, 95 %")
    top, model = np.asarray(band.get_paths()[0].vertices), drawn["fit"]
    at = np.argmin(np.abs(np.asarray(model.get_xdata()) - 10.0))
    omega, level = model.get_xdata()[at], model.get_ydata()[at]
    reach = np.max(top[np.isclose(top[:, 0], omega), 1]) - level
    np.testing.assert_allclose(reach, fit.response_band(np.array([omega])).decibels[0, 0, 0])


def test_two_inputs_and_two_outputs_are_a_grid_of_all_pairs():
    panels = jq.plot.bode(TWO)
    names = [panel.get_ylabel() for panel in panels]
    assert names[:2] == ["|y1 / u1|, dB", "|y1 / u2|, dB"] and names[2:4] == ["phase, deg"] * 2
    assert names[4:6] == ["|y2 / u1|, dB", "|y2 / u2|, dB"] and len(panels) == 8
    assert len(jq.plot.bode(TWO, pair=("y2", "u1"))) == 2
    assert [p.get_ylabel() for p in jq.plot.step(TWO)] == [
        "y1 / u1", "y1 / u2", "y2 / u1", "y2 / u2"
    ]  # fmt: skip
    with pytest.raises(ValueError, match="models of different channels"):
        jq.plot.bode(TWO, TRUTH)


def test_units_stand_at_the_axes(record):
    frf = jq.frequency_response(record, np.geomspace(4.0, 30.0, 12))
    panels = jq.plot.bode(frf)
    assert "(rad/s per V)" in panels[0].get_ylabel()
    panels.figure.draw_without_rendering()
    hertz = panels[0].child_axes[0]
    np.testing.assert_allclose(hertz.get_xlim(), np.array(panels[0].get_xlim()) / (2 * np.pi))
    assert hertz.get_xlabel() == "frequency, Hz"


def test_several_models_differ_in_dash_and_colour_and_too_many_are_refused():
    models = {f"gain {k}": jq.LaggedIntegrator(k, 0.02) for k in (1.0, 2.0, 3.0, 4.0, 5.0)}
    drawn = lines(jq.plot.bode(models)[0]).values()
    assert len({line.get_color() for line in drawn}) == 5
    assert len({repr(line._unscaled_dash_pattern) for line in drawn}) == 5
    with pytest.raises(ValueError, match="gain 6.0 is curve 6, too many to be distinguished"):
        jq.plot.bode(models, {"gain 6.0": TRUTH})


def test_the_step_response_of_a_first_order_lag_is_exponential():
    [panel] = jq.plot.step(jq.TransferFunction([2.0], [0.5, 1.0]), duration=2.0)
    line = lines(panel)["model"]
    exact = 2 * (1 - np.exp(-np.asarray(line.get_xdata()) / 0.5))
    np.testing.assert_allclose(line.get_ydata(), exact, atol=1e-9)
    assert panel.get_xlabel().endswith(", s")


def test_a_loop_is_drawn_open_closed_and_by_its_poles():
    loop = case_loop(ladrc(8.0, 25.0))
    [panel] = jq.plot.step(loop, duration=2.0)
    assert lines(panel)["loop"].get_ydata()[-1] == pytest.approx(1.0, abs=0.01)
    [plane] = jq.plot.nyquist(loop)
    near = lines(plane)["loop"]
    distance = np.hypot(1 + np.asarray(near.get_xdata()), near.get_ydata())
    peak = float(jq.analyse(loop, 0).sensitivity_peak)
    assert 1 / np.min(distance) == pytest.approx(peak, rel=0.01)  # Ms, on 300 frequencies
    [poles] = jq.plot.pzmap(loop)
    real = np.sort(lines(poles)["loop, poles"].get_xdata())
    np.testing.assert_allclose(real, [-25.0] * 3 + [-8.0] * 2, rtol=2e-3)


def test_poles_of_a_fit_have_the_interval_of_its_lag(fit):
    low, high = fit.interval("lag")
    reach = np.max(np.real(fit.pole_reach))
    assert reach == pytest.approx((high - low) / 2 / fit["lag"] ** 2, rel=1e-6)  # of -1 / lag
    [panel] = jq.plot.pzmap(fit, {"truth": TRUTH})
    assert {"fit, poles", "truth, poles"} <= set(lines(panel))


def test_white_residuals_stay_within_the_bound_of_their_autocorrelation(fit, record):
    left, correlation = jq.plot.resid(TRUTH, record)
    found = np.asarray(correlation.get_lines()[1].get_ydata())
    assert found[0] == pytest.approx(1.0)
    assert np.mean(np.abs(found[1:]) > 1.96 / np.sqrt(600)) < 0.12
    assert left.get_ylabel().endswith("deg/s")
    assert len(jq.plot.resid(fit)) == 2
    with pytest.raises(ValueError, match="resid needs what was measured"):
        jq.plot.resid(TRUTH)


def test_a_comparison_says_the_fit_of_each_model(record):
    half = jq.LaggedIntegrator(140.0, 0.016, 0.011)
    panels: Any = jq.plot.compare({"truth": TRUTH, "half": half}, record)
    top, bottom = panels
    texts = [text.get_text() for text in top.get_legend().get_texts()]
    found = jq.compare({"truth": TRUTH, "half": half}, record).fit_percent
    assert texts == ["measured", *(f"{name}: {value:.1f} %" for name, value in found.items())]
    assert len(bottom.get_lines()) == 2
    with pytest.raises(ValueError, match="compare needs a record"):
        jq.plot.compare(TRUTH)


def test_a_spectrogram_finds_the_line_and_the_power_of_a_sine():
    """Over time and over the throttle: a sine of amplitude a has the power a^2 / 2."""
    time = np.arange(8000) / 1000.0
    throttle = 0.3 + 0.05 * time
    sine = np.radians(20.0) * np.sin(2 * np.pi * 125.0 * time)
    names: Any = {"input_names": "throttle", "output_names": "gyro", "output_units": "rad/s"}
    flown = jq.Record(time, throttle, sine, **names)
    for over, label in (("time", "time, s"), ("throttle", "throttle")):
        panels = jq.plot.spectrogram(flown, over=over)
        assert panels[0].get_xlabel() == label and panels[0].get_ylabel() == "frequency, rad/s"
        mesh: Any = panels[0].collections[0]
        corners, level = mesh.get_coordinates(), np.asarray(mesh.get_array())
        omega = 0.5 * (corners[1:, 0, 1] + corners[:-1, 0, 1])
        column = level[:, np.flatnonzero(np.isfinite(level[0]))[0]]
        assert omega[np.argmax(column)] / (2 * np.pi) == pytest.approx(125.0, abs=2.0)
        width = np.diff(omega[:2])[0] / (2 * np.pi)
        assert np.sum(10 ** (column / 10)) * width == pytest.approx(200.0, rel=0.02)  # (deg/s)^2
    with pytest.raises(ValueError, match="window is 20.0 s, 20000 samples: give 16 to 8000"):
        jq.plot.spectrogram(flown, window=20.0)


def test_flights_by_name_share_their_set_point():
    loop, scene = case_loop(ladrc(8.0, 25.0)), case_flight()
    flown = jq.simulate(loop, scene)
    angle, command, torque = jq.plot.flight({"slow": flown, "same": flown}, command_unit="V")
    assert angle.get_ylabel() == "roll, deg" and command.get_ylabel() == "command, V"
    np.testing.assert_allclose(lines(angle)["set-point"].get_ydata()[0], 4.0, rtol=1e-6)
    assert set(lines(torque)) == {"slow"} and set(lines(command)) == {"slow", "same"}
    with pytest.raises(ValueError, match="axis is 'pitch': choose one of roll"):
        jq.plot.flight(flown, axis="pitch")
    with pytest.raises(ValueError, match="flight cannot draw a LADRC"):
        jq.plot.flight(ladrc(8.0, 25.0, B))


def test_what_cannot_be_drawn_is_refused_with_what_to_give(record):
    frf = response_of(TRUTH)
    for draw, thing, message in (
        (jq.plot.bode, 3.0, "bode cannot draw a float: give a model with frequency_response"),
        (jq.plot.nyquist, "log.csv", "nyquist cannot draw a str"),
        (jq.plot.step, frf, "joint estimate was measured, but step needs a model"),
        (jq.plot.pzmap, record, "flown was measured, but pzmap needs a model"),
        (jq.plot.coherence, TRUTH, "model: a model has no coherence"),
        (jq.plot.bode, [], "bode has nothing to draw"),
    ):
        with pytest.raises(ValueError, match=message):
            draw(thing)


def test_the_worst_members_of_a_certificate_fly_again_as_they_flew():
    from tuning_case import ensemble, equivalent

    loop, scene = case_loop(equivalent(8.0, 25.0)), case_flight()
    certificate = jq.certify(loop, ensemble(), scene, members=12, linear_members=12)
    angle, command, _ = jq.plot.flight(certificate, loop, ensemble(), scene)
    worst = certificate.design.worst_member("itae")
    assert worst is not None
    members = ensemble().fresh(loop, 12, jax.random.key(0)).take([worst])
    exact = jq.simulate(members.loop(loop.controller), members.flight(scene))
    name = next(text for text in lines(angle) if f"member {worst}" in text)
    drawn = np.asarray(lines(angle)[name].get_ydata())
    np.testing.assert_allclose(drawn, np.degrees(np.asarray(exact.angle)[:, 0, 0]), atol=1e-9)


def test_a_flown_loop_is_drawn_by_its_record_as_what_flew():
    """A closed loop of first order under a square wave, without noise."""
    time = np.arange(6000) * 0.01
    wave = np.sign(np.sin(0.9 * time))
    closed_loop = jq.TransferFunction([1.0], [0.2, 1.0])
    answer = np.asarray(jq.models.simulate_linear(closed_loop, wave, 0.01))
    flown = jq.Record(
        time, wave - answer, answer, wave, output_names="roll", reference_names="stick",
        output_units="rad/s",
    )  # fmt: skip
    [panel] = jq.plot.step(flown, {"designed": closed_loop})
    assert panel.get_ylabel().endswith("deg/s") and {"flown", "designed"} <= set(lines(panel))
    measured, model = lines(panel)["flown"], lines(panel)["designed"]
    at = np.asarray(measured.get_xdata())
    exact = np.interp(at[at > 0.4], model.get_xdata(), model.get_ydata())
    np.testing.assert_allclose(np.asarray(measured.get_ydata())[at > 0.4], exact, rtol=0.02)
