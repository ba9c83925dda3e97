"""Result files that can be parsed, and fits side by side."""

import json
from typing import cast

import equinox as eqx
import numpy as np
import pytest
from synthetic import OMEGA, response_of

import jaxquad as jq
from jaxquad.report import compare_fits, write_json, write_results
from jaxquad.report._fit import _plus_minus, parameter_section
from jaxquad.report._page import Cell, Table


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
    assert _plus_minus(fit.values[0], fit.standard_errors[0]) in joint
    assert _plus_minus(total.value, total.standard_error) in joint
    assert direct.split() == ["direct", "not", "identifiable"]
    assert note == "(+- one standard error)"


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (284.0213, 14.95, "284 +- 15"), (277.05, 1.996, "277.1 +- 2.0"),
        (0.0164092, 0.00219, "0.0164 +- 0.0022"), (-16.84, 0.0996, "-16.84 +- 0.10"),
        (1032400.0, 2.4e5, "1.03e+06 +- 2.4e+05"), (8.1234e-9, 3.1e-11, "8.123e-09 +- 3.1e-11"),
        (0.0, 0.0032, "0.0000 +- 0.0032"), (1.5, 0.0, "1.5 +- 0"), (1.5, np.inf, "1.5 +- inf"),
    ],
)  # fmt: skip
def test_a_value_has_the_digits_that_its_error_supports(value, error, text):
    assert _plus_minus(value, error) == text


def test_a_tied_parameter_is_a_row_of_the_page(frf):
    tied = {"delay": lambda model: 0.7 * model.lag}
    fit = jq.fit(TRUTH, frf, free=("gain", "lag"), tied=tied)
    table = cast(Table, parameter_section(fit, [], {})["table"])
    assert len(table.rows) == 3 and {len(row) for row in table.rows} == {len(table.heads)}
    name, value, error, interval, *_ = table.rows[2]
    assert cast(Cell, name).text == "delay, tied to lag"
    assert value == f"{fit.tied[0].value:.5g}"
    assert error == f"{0.7 * fit.standard_errors[1]:.2g}" and " .. " in str(interval)


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
