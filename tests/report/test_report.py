"""Figures that can be read, and result files that can be parsed."""

import json

import equinox as eqx
import numpy as np
import pytest
from synthetic import OMEGA, response_of

import jaxquad as jq
from jaxquad.plot import bode, overlay, record_figure
from jaxquad.report import comparison, write_results


TRUTH = jq.LaggedIntegrator(280.0, 0.016, 0.011)


@pytest.fixture(scope="module")
def frf():
    return response_of(TRUTH, error=0.05, seed=0)


@pytest.fixture(scope="module")
def fit(frf):
    return jq.fit(TRUTH, frf, cost=jq.identify.MaximumLikelihood())


@pytest.fixture(scope="module")
def check():
    time = np.arange(400) * 0.01
    u = np.sign(np.sin(3 * time))
    y = np.asarray(jq.models.simulate_linear(TRUTH.transfer_function(), u, 0.01))
    record = jq.Record(time, u, y, output_names="q", output_units="rad/s")
    return jq.verify(jq.LaggedIntegrator(250.0, 0.016, 0.011), record)


def silent_fit():
    """Of a response that is coherent nowhere."""
    frf = response_of(TRUTH, error=0.05, seed=0)
    return jq.fit(TRUTH, eqx.tree_at(lambda f: f.coherence, frf, 0.1 * frf.coherence))


def lines(axis):
    return {line.get_label(): line for line in axis.get_lines()}


def test_a_bode_figure_names_its_axes_with_units(frf):
    magnitude, phase, coherence = bode(frf, {"truth": TRUTH}).axes[:3]
    assert magnitude.get_ylabel() == "|y0 / u0|, dB"
    assert phase.get_ylabel() == "phase, deg"
    assert coherence.get_xlabel() == "frequency, rad/s" and coherence.get_xscale() == "log"


def test_the_band_is_the_95_per_cent_band_of_the_random_error(frf):
    magnitude = bode(frf).axes[0]
    (band,) = magnitude.collections
    corners = band.get_paths()[0].vertices
    at_first = corners[np.isclose(corners[:, 0], OMEGA[0]), 1]
    width = 2 * 1.96 * 0.05 * 20 / np.log(10)
    assert np.ptp(at_first) == pytest.approx(width, rel=1e-9)


def test_the_model_is_drawn_on_the_branch_of_the_measured_phase():
    """A delay of many turns, and a response that starts beyond -180 deg."""
    slow = jq.LaggedIntegrator(280.0, 0.016, 1.0)
    figure = bode(response_of(slow), {"model": slow})
    measured, model = (lines(figure.axes[1])[name] for name in ("joint estimate", "model"))
    drawn = np.interp(measured.get_xdata(), model.get_xdata(), model.get_ydata())
    assert np.max(np.abs(drawn - measured.get_ydata())) < 2  # deg, of linear interpolation


def test_points_without_coherence_are_shown_apart(frf):
    weak = eqx.tree_at(lambda f: f.coherence, frf, frf.coherence.at[:5].set(0.3))
    drawn = lines(bode(weak, others={"direct": frf}).axes[0])
    assert len(drawn["joint estimate"].get_xdata()) == OMEGA.size - 5
    assert len(drawn["joint estimate, coherence below 0.6"].get_xdata()) == 5
    assert drawn["direct"].get_marker() != drawn["joint estimate"].get_marker()
    with pytest.raises(ValueError, match=r"no response \('p', 'u0'\)"):
        bode(frf, pair=("p", "u0"))


def test_an_overlay_shows_degrees_and_the_measures(check):
    figure = overlay(check)
    top, bottom = figure.axes
    assert top.get_ylabel() == "q, deg/s" and bottom.get_xlabel() == "time, s"
    np.testing.assert_allclose(
        lines(top)["measured"].get_ydata(), np.degrees(check.measured), rtol=1e-12
    )
    assert f"{check.fit_percent:.1f} %" in figure.get_suptitle()


def test_every_channel_of_a_record_is_drawn():
    time = np.arange(100) * 0.01
    record = jq.Record(time, np.sin(time), np.cos(time), np.sin(2 * time), output_units="rad")
    labels = [axis.get_ylabel() for axis in record_figure(record).axes]
    assert labels == ["r", "u", "y, deg"]


def test_a_result_file_holds_the_numbers_of_the_fit(tmp_path, fit, frf, check):
    path = write_results(tmp_path / "new", fit=fit, frf=frf, check=check, extra={"note": "x"})
    content = json.loads(path.read_text())
    gain = content["fit"]["parameters"][0]
    assert gain["name"] == "gain" and gain["value"] == pytest.approx(float(fit.values[0]))
    assert gain["standard_error"] == pytest.approx(float(fit.standard_errors[0]))
    assert content["verification"]["tic"] == pytest.approx(check.tic)
    assert len(content["response"]["omega_rad_per_s"]) == OMEGA.size
    assert content["note"] == "x" and content["jaxquad_version"]
    assert [file.name for file in path.parent.iterdir()] == ["result.json"]


def test_what_is_not_determined_keeps_its_number_and_is_marked(tmp_path):
    rig = jq.models.AttitudeAxis(0.197, 0.1188, 0.0552, 0.02)
    fit = jq.fit(
        rig, response_of(rig, seed=0), free=("J_x", "K_t"), cost=jq.identify.MaximumLikelihood()
    )
    content = json.loads(write_results(tmp_path, fit=fit).read_text())["fit"]
    row = content["parameters"][0]
    assert row["value"] == float(fit.values[0]) and row["standard_error"] is None
    assert row["determined"] is False and content["verdict"]["kind"] == "not identifiable"
    assert content["combinations"][0]["name"] == "L K_t / J_x"


def test_a_failed_write_leaves_the_old_result(tmp_path, fit):
    path = write_results(tmp_path, fit=fit)
    before = path.read_text()
    with pytest.raises(TypeError):
        write_results(tmp_path, fit=fit, extra={"bad": object()})
    assert path.read_text() == before and len(list(tmp_path.iterdir())) == 1


def test_fits_stand_side_by_side_and_what_is_missing_says_so(fit):
    nothing = silent_fit()
    late = {"lag + delay": lambda model: model.lag + model.delay}
    head, joint, direct = comparison({"joint": fit, "direct": nothing}, late).splitlines()
    assert head.split() == "gain lag delay lag + delay misfit / error".split()
    assert f"{fit.values[0]:.5g} +- {fit.standard_errors[0]:.2g}" in joint
    assert str(f"{fit.derived(late['lag + delay']).value:.5g}") in joint
    assert direct.split() == ["direct", "not", "identifiable"]


def test_where_nothing_was_fitted_there_is_no_number(tmp_path, frf):
    content = json.loads(write_results(tmp_path, fit=silent_fit(), frf=frf).read_text())["fit"]
    assert not content["identifiable"] and "parameters" not in content
    assert "coherence reaches 0.6 at 0 of" in content["verdict"]["summary"]
