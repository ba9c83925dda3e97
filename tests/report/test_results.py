"""Result files that can be parsed, and fits side by side."""

import dataclasses
import json

import equinox as eqx
import numpy as np
import pytest
from html_pages import read_page
from synthetic import OMEGA, response_of

import jaxquad as jq
from jaxquad.report import compare_fits, write_json, write_report, write_results


TRUTH = jq.LaggedIntegrator(280.0, 0.016, 0.011)


@pytest.fixture(scope="module")
def frf():
    return response_of(TRUTH, error=0.05, seed=0)


@pytest.fixture(scope="module")
def fit(frf):
    return jq.fit(TRUTH, frf)


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


@pytest.mark.slow
def test_what_is_not_determined_keeps_its_number_and_is_marked(tmp_path):
    rig = jq.models.AttitudeAxis(0.197, 0.1188, 0.0552, 0.02)
    fit = jq.fit(rig, response_of(rig, seed=0), free=("J_x", "K_t"))
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
    head, joint, direct, note = compare_fits({"joint": fit, "direct": nothing}, late).splitlines()
    assert head.split() == "gain lag delay lag + delay misfit / error".split()
    total = fit.derived(late["lag + delay"])
    words = joint.split()
    for name, value, error in (
        ("gain", fit.values[0], fit.standard_errors[0]), ("sum", total.value, total.standard_error)
    ):  # fmt: skip
        place = words.index("+-") if name == "gain" else len(words) - 1 - words[::-1].index("+-")
        assert float(words[place - 1]) == pytest.approx(value, abs=0.06 * error)
        assert float(words[place + 1]) == pytest.approx(error, rel=0.06)
    assert direct.split() == ["direct", "not", "identifiable"]
    assert "one standard error" in note


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (284.0213, 14.95, "284 +- 15"), (277.05, 1.996, "277.1 +- 2.0"),
        (0.0164092, 0.00219, "0.0164 +- 0.0022"), (-16.84, 0.0996, "-16.84 +- 0.10"),
        (1032400.0, 2.4e5, "1.03e+06 +- 2.4e+05"), (8.1234e-9, 3.1e-11, "8.123e-09 +- 3.1e-11"),
        (0.0, 0.0032, "0.0000 +- 0.0032"), (1.5, 0.0, "1.5 +- 0"), (1.5, np.inf, "1.5 +- inf"),
    ],
)  # fmt: skip
def test_a_value_has_the_digits_that_its_error_supports(fit, value, error, text):
    values = np.array([value, *fit.values[1:]])
    errors = np.array([error, *fit.standard_errors[1:]])
    other = dataclasses.replace(fit, values=values, standard_errors=errors)
    assert f" {text} " in compare_fits({"fit": other}).splitlines()[1]


@pytest.mark.slow
def test_a_tied_parameter_is_a_row_of_the_page(frf, tmp_path):
    tied = {"delay": lambda model: 0.7 * model.lag}
    fit = jq.fit(TRUTH, frf, free=("gain", "lag"), tied=tied)
    page = read_page(write_report(tmp_path / "report.html", fit=fit, frf=frf))
    cells = [text.strip() for path, text in page.texts if "td" in path or "th" in path]
    cells = [text for text in cells if text]
    row = cells[cells.index("delay, tied to lag") :]
    assert row[1] == f"{fit.tied[0].value:.5g}"
    assert row[2] == f"{0.7 * fit.standard_errors[1]:.2g}" and " .. " in row[3]


def test_where_nothing_was_fitted_there_is_no_number(tmp_path, frf):
    content = json.loads(write_results(tmp_path, fit=silent_fit(), frf=frf).read_text())["fit"]
    assert not content["identifiable"] and "parameters" not in content
    assert "at 0 of" in content["verdict"]["summary"]


def test_json_is_whole_and_holds_null_for_what_is_not_finite(tmp_path):
    path = write_json(tmp_path / "new" / "x.json", {"a": np.array([1.0, np.nan]), "b": (1, 2)})
    assert json.loads(path.read_text()) == {"a": [1.0, None], "b": [1, 2]}
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert [each.name for each in path.parent.iterdir()] == ["x.json"]
    assert json.loads(path.read_text())["b"] == [1, 2]
