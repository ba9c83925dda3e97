"""What identify and tune have stored comes back as objects."""

import jax
import numpy as np
import pytest
from sweep_logs import write_noise, write_sweep

import jaxquad as jq
from jaxquad.control import certainty_equivalence, LADRC, ScheduledLADRC
from jaxquad.report import write_json
from jaxquad.tuning import describe_controller
from jaxquad.workflows import identify, IdentifySettings, TuneSettings


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    log = write_sweep(tmp_path_factory.mktemp("flight") / "sweep.csv")
    settings = IdentifySettings(
        input="M=right-left", output="q", band=(0.5, 6), units={"q": "rad/s"}
    )
    return identify(log, settings)


@pytest.fixture
def folder(found, tmp_path):
    jq.report.write_results(
        tmp_path, fit=found.fit, frf=found.frf,
        extra={
            "settings": found.settings.content(), "record": {"file": str(found.paths[0])},
            "provenance": {"files": []}, "band_rad_per_s": found.band,
            "model": {"kind": "LaggedIntegrator"} | {
                name: np.asarray(x).tolist() for name, x in vars(found.fit.model).items()
            },
        },
    )  # fmt: skip
    return tmp_path


CONTROLLER = ScheduledLADRC(
    LADRC(8.0, 25.0, 0.9, limit=5.0, dt=0.005), certainty_equivalence(0.05, 0.06, knots=4)
)
SETTINGS = TuneSettings(inertia=0.06, limit=5.0)


def store_gains(folder):
    verdict = {"name": "STABILITY", "holds": False, "text": "1 of 12 is unstable", "remedy": ""}
    return write_json(folder / "tuned.json", {
        "holds": False, "verdicts": [verdict], "values": {"ladrc.wc": 8.0},
        "controller": describe_controller(CONTROLLER) | {"dt": 0.005},
        "settings": SETTINGS.content(),
    })  # fmt: skip


@pytest.mark.slow
def test_a_result_has_the_model_the_numbers_and_the_settings(found, folder):
    stored = jq.load_result(folder)
    assert stored.model == found.fit.model and stored.settings == found.settings
    assert stored.values == dict(zip(found.fit.names, found.fit.values, strict=True))
    assert stored.intervals["gain"] == pytest.approx(found.fit.interval("gain"))
    assert stored.standard_errors["lag"] == pytest.approx(found.fit.standard_errors[1])
    assert stored.tuned is None and "gain = " in str(stored) and len(str(stored)) < 500


@pytest.mark.slow
def test_the_stored_response_is_that_which_was_fitted(found, folder):
    frf = jq.load_result(folder / "result.json").frf
    np.testing.assert_allclose(frf.response, found.frf.response, rtol=1e-9)
    np.testing.assert_allclose(frf.random_error, found.frf.random_error, rtol=1e-12)
    assert frf.output_units == ("rad/s",) and frf.method == found.frf.method
    variance = np.diagonal(np.asarray(frf.relative_covariance()))
    np.testing.assert_allclose(variance, 2 * np.asarray(frf.random_error)[:, 0, 0] ** 2, rtol=1e-9)


def test_gains_come_back_as_the_controller_that_was_certified(folder):
    (folder / "tuned").mkdir()
    store_gains(folder / "tuned")
    for stored in (jq.load_result(folder).tuned, jq.load_result(folder / "tuned").tuned):
        assert stored is not None
        pairs = zip(jax.tree.leaves(stored.controller), jax.tree.leaves(CONTROLLER), strict=True)
        assert all(np.array_equal(one, other) for one, other in pairs)
        assert stored.controller.ladrc.dt == 0.005 and stored.settings == SETTINGS
        assert not stored.holds and stored.values == {"ladrc.wc": 8.0}
        assert str(stored).startswith("FAIL STABILITY: 1 of 12 is unstable")


@pytest.mark.slow
def test_a_result_without_a_fit_has_no_numbers(tmp_path):
    settings = IdentifySettings(input="M", output="q")
    found = identify(write_noise(tmp_path / "noise.npz"), settings)
    found.write(tmp_path / "result")
    stored = jq.load_result(tmp_path / "result")
    assert not stored.identifiable and set(stored.values) == set(stored.standard_errors)


def test_what_neither_has_written_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no such result: run jaxquad identify first"):
        jq.load_result(tmp_path)
    with pytest.raises(ValueError, match="no such result: run jaxquad tune first"):
        jq.workflows.load_tuning(tmp_path)
    (tmp_path / "tuned.json").write_text("{}")
    with pytest.raises(ValueError, match="no result of this version of jaxquad tune"):
        jq.workflows.load_tuning(tmp_path)
