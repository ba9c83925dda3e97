"""`jq.workflows.identify` gives in Python what the command line gives, and can be made again."""

import dataclasses
import json
import pickle
import re

import numpy as np
import pytest
from sweep_logs import GAIN, swept, write_noise, write_sweep
from synthetic import response_of

import jaxquad as jq
from jaxquad.cli import main
from jaxquad.workflows import (
    _identification,
    _identify,
    identify,
    identify_again,
    IdentifySettings,
    load_result,
    open_logs,
    verify_result,
)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_sweep(tmp_path_factory.mktemp("flight") / "sweep.csv")


@pytest.fixture(scope="module")
def found(log):
    settings = IdentifySettings(
        input="M=right-left", output="q", band=(0.5, 6), units={"q": "rad/s"}
    )
    return identify(log, settings)


@pytest.fixture(scope="module")
def folder(found, tmp_path_factory):
    folder = tmp_path_factory.mktemp("result")
    assert found.write(folder) == folder / "result.json"
    return folder


@pytest.mark.slow
def test_python_gives_what_the_command_line_gives(log, found, folder, tmp_path, capsys):
    words = ["identify", str(log), *found.settings.words(), "--out", str(tmp_path)]
    assert main(words) == 0
    assert str(found) in capsys.readouterr().out
    typed, written = (json.loads((each / "result.json").read_text()) for each in (tmp_path, folder))
    for content in (typed, written):
        del content["provenance"]["date"]
    assert typed == written
    assert {each.name for each in tmp_path.iterdir()} == {each.name for each in folder.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("poles", [None, 1])
def test_a_reference_that_moves_nothing_leaves_no_response_and_is_named(poles, tmp_path):
    time, random = 0.2 * np.arange(200), np.random.default_rng(0)
    reference, command, noise = random.standard_normal((3, time.size))
    rate = 0.2 * np.cumsum(command) + 0.1 * noise
    np.savez(tmp_path / "idle.npz", t=time, r=reference, u=command, q=rate)
    settings = IdentifySettings(input="u", output="q", reference="r", hold="dt", poles=poles)
    found = identify(tmp_path / "idle.npz", settings)
    assert found.fit.verdict.kind == "too few points"
    [remark] = found.frf.remarks
    assert "the references move the inputs too little" in remark
    assert remark in str(found)


@pytest.mark.slow
def test_an_identification_can_be_pickled(log, found):
    sent = lambda x: pickle.loads(pickle.dumps(x))
    opened = sent(open_logs(log, found.settings))
    assert opened.settings == found.settings and opened.paths == found.paths
    np.testing.assert_array_equal(opened.records[0].inputs, found.records[0].inputs)
    assert str(sent(found)) == str(found)


@pytest.mark.slow
def test_numbers_and_figures_are_at_hand_without_a_folder(found):
    assert found.fit.verdict.identifiable
    assert found.fit.values[0] == pytest.approx(GAIN, rel=0.03)
    assert found.fit.model.gain == found.fit.values[0]
    [total] = found.combinations
    assert total.value == pytest.approx(found.fit.values[1] + found.fit.values[2])
    assert total.unit == "s" and "s (std. error" in str(total) and str(total) in str(found)
    assert list(found.figures()) == [*found.figure_names] == ["record.png", "bode.png"]
    assert found.formula == "q / M = K e^(-delay s) / (s (lag s + 1))"


@pytest.mark.slow
def test_where_the_quick_response_finds_a_wrong_delay_the_right_one_is_taken_out(
    log, found, monkeypatch
):
    known, taken_out = _identify._delay_of, []

    def wrong_at_first(*given):
        taken_out.append(known(*given) + (0.0 if taken_out else 0.1))
        return taken_out[-1]

    monkeypatch.setattr(_identify, "_delay_of", wrong_at_first)
    again = identify(log, found.settings)
    assert taken_out[0] > 0.1 > 2 * taken_out[1]
    assert np.all(np.abs(again.fit.values - found.fit.values) < 0.1 * found.fit.standard_errors)


@pytest.mark.slow
def test_a_result_is_made_again_from_its_settings(found, folder, log, tmp_path):
    again = identify_again(folder)
    assert again.settings == found.settings == load_result(folder).settings
    np.testing.assert_array_equal(again.fit.values, found.fit.values)
    moved = tmp_path / "moved.csv"
    moved.write_bytes(log.read_bytes())
    assert identify_again(folder, log=moved).paths == (moved,)
    moved.write_bytes(log.read_bytes() + b"\n")
    with pytest.raises(ValueError, match="not the log that was identified"):
        identify_again(folder, log=moved)


@pytest.mark.slow
def test_the_sum_of_lag_and_delay_has_its_unit_in_the_report(folder):
    page = (folder / "report.html").read_text()
    row = re.search(r"<bdi>lag \+ delay</bdi></th>(.*?)</tr>", page, re.S)
    assert row and re.sub(r"<[^>]+>", " ", row[1]).split()[0] == "s"


@pytest.mark.slow
def test_a_stored_model_is_that_of_the_fit(found, folder):
    stored = load_result(folder / "result.json")
    assert stored.band == pytest.approx(found.band) and stored.doubts == ()
    assert stored.model == found.fit.model


@pytest.mark.slow
def test_a_second_record_is_read_with_the_settings_of_the_first(found, folder, log):
    check = verify_result(folder, log, {"start": 5, "stop": 30})
    record = jq.read(log, inputs={"M": {"right": 1, "left": -1}}, outputs="q", start=5, stop=30)
    same = jq.verify(found.fit.model, record, band=found.band)
    assert check.fit_percent == pytest.approx(same.fit_percent) and check.fit_percent > 90
    assert check.output_unit == "rad/s"
    assert verify_result(folder, log, {"band": (1, 2)}).band == pytest.approx(
        (2 * np.pi, 4 * np.pi)
    )


def test_a_narrow_band_is_named_in_options():
    truth = jq.LaggedIntegrator(8.0, 0.05, 0.03)
    omega = np.geomspace(5.0, 8.0, 4)
    few = jq.fit(truth, response_of(truth, omega=omega))
    record = jq.Record(np.arange(16.0) / 10, np.arange(16.0), np.arange(16.0))
    remedies = _identify.finish_fit(few, IdentifySettings(), record).verdict.remedies
    advice = "excite the axis (jaxquad design sweep) over more than 5 to 8 rad/s"
    assert remedies[0].startswith(advice)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("terms", "unit"),
    [(("lag", "delay"), "s"), (("gain", "lag"), ""), (("lag",), ""), ((), ""), (("x", "lag"), "")],
)
def test_a_sum_has_the_unit_of_all_its_terms(terms, unit):
    truth = jq.LaggedIntegrator(8.0, 0.05, 0.03)
    fit = jq.fit(truth, response_of(truth, omega=np.geomspace(1.0, 30.0, 40)))
    combination = jq.identify.Combination("a sum", 1.0, 0.1, sum_of=terms)
    verdict = dataclasses.replace(fit.verdict, combinations=(combination,))
    record = jq.Record(np.arange(16.0) / 10, np.arange(16.0), np.arange(16.0))
    fit = dataclasses.replace(fit, verdict=verdict)
    [found] = _identify.finish_fit(fit, IdentifySettings(), record).combinations
    assert found.unit == unit and f"0.1{unit and ' '}{unit} (std. error" in str(found)


@pytest.mark.slow
def test_what_is_not_identifiable_is_a_value_with_advice(tmp_path):
    noise = write_noise(tmp_path / "noise.npz")
    found = identify(noise, IdentifySettings(input="M", output="q"))
    assert not found.fit.verdict.identifiable and found.combinations == ()
    assert any("jaxquad design sweep" in remedy for remedy in found.fit.verdict.remedies)
    found.write(tmp_path)
    stored = load_result(tmp_path)
    assert "not identifiable from this record" in stored.doubts[0]
    with pytest.raises(ValueError, match="the result holds no model: not identifiable"):
        verify_result(stored, noise)


@pytest.mark.slow
def test_what_stands_beside_the_fit_may_fail(log, tmp_path, monkeypatch, capsys):
    """Halves of the band and a figure: the code stays 0, page and text say what is missing."""
    monkeypatch.setattr(jq.identify.Fit, "bands", lambda _: 1 / 0)
    monkeypatch.setattr(jq.plot, "record_figure", lambda _: 1 / 0)
    (tmp_path / "record.png").write_text("of an earlier run")
    words = ["identify", str(log), "--input", "M=right-left", "--output", "q", "--band", "0.5", "6"]
    assert main([*words, "--quiet", "--force", "--out", str(tmp_path)]) == 0
    printed, warned = capsys.readouterr()
    assert "half of the band:\ncould not be computed: ZeroDivisionError" in printed
    assert "could not be computed: ZeroDivisionError" in (tmp_path / "report.html").read_text()
    assert warned.startswith("! record.png could not be drawn: ZeroDivisionError")
    assert not (tmp_path / "record.png").exists() and "record.png" not in printed
    assert (tmp_path / "bode.png").exists() and "bode.png" in printed


def write_hover(path):
    """Gusts on q' = 20 u behind a lag of 30 ms, and u = -0.25 q - 0.5 integral of q."""
    rng, q, slow, turned, gust, rows = np.random.default_rng(0), 0.0, 0.0, 0.0, 0.0, []
    for step in range(4000):
        seen = q + 0.01 * rng.standard_normal()
        turned += 0.01 * seen
        u = -0.25 * seen - 0.5 * turned
        rows.append((0.01 * step, u, seen))
        gust = 0.98 * gust + 0.2 * rng.standard_normal()
        slow += 0.28 * (u - slow)
        q += 0.01 * 20 * (slow + gust)
    np.savetxt(path, rows, fmt="%.6f", delimiter=",", header="t,u,q", comments="")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], ["--poles", "2", "--zeros", "1"]], ids=["lag", "poles"])
def test_a_hover_without_a_reference_is_no_plant(more, tmp_path, capsys):
    log = write_hover(tmp_path / "hover.csv")
    words = ["identify", str(log), "--input", "u", "--output", "q", "--out", str(tmp_path)]
    assert main([*words, *more]) == 3
    printed = " ".join(capsys.readouterr().out.split())
    assert "! feedback-dominated: " in printed and "feedback dominates" in printed
    assert "to resolve it: name the external reference (--reference)" in printed
    assert "higher order" not in printed and "another band" not in printed
    assert "Nothing about this vehicle." in (tmp_path / "report.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gain", "said"), [(-8.0, ["the gain is negative: when u0 rises, y0 falls."]), (8.0, [])]
)
def test_a_negative_gain_is_told_with_what_to_check(gain, said):
    """As many conventions have it: the elevator's trailing edge down, the nose down."""
    frf = response_of(jq.LaggedIntegrator(gain, 0.05, 0.03), omega=np.geomspace(1.0, 30.0, 40))
    fit = jq.fit(jq.LaggedIntegrator(gain / 2, 0.05, 0.03), frf)
    assert [text[:46] for text in _identification._on_negative_gain(fit, frf)] == said
    turns = dataclasses.replace(fit, names=("numerator[0]", "numerator[1]", "delay"))
    assert _identification._on_negative_gain(turns, frf) == []  # of a zero in the right half plane


@pytest.mark.slow
def test_swapped_channels_are_asked_about(log, tmp_path, capsys, recwarn):
    swapped = {"input": "q", "output": "M=right-left", "band": (0.5, 6), "integrators": 1}
    found = identify(log, IdentifySettings(**swapped))
    assert not found.fit.identifiable
    assert any("are swapped" in each for each in found.fit.remarks)
    assert not any("overflow" in str(each.message) for each in recwarn)


@pytest.mark.parametrize("text", ["[1]", "{}", "no json", '{"fit": {}, "settings": {}}'])
def test_a_file_that_is_no_result_is_refused(tmp_path, text):
    (tmp_path / "result.json").write_text(text)
    with pytest.raises(ValueError, match="no result of"):
        load_result(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("closed", [False, True])
def test_another_axis_that_moves_the_output_is_remarked_and_taken_out(closed, tmp_path):
    time, sweep, _ = swept(0)
    random = np.random.default_rng(3)
    wave = np.convolve(random.standard_normal(sweep.size + 5), np.ones(6), "valid")
    other = 0.6 * sweep / np.std(sweep) + 0.8 * wave / np.std(wave)
    other *= np.std(sweep)
    noise, command, rate = random.normal(0, 0.05, time.size), *np.zeros((2, time.size))
    for k in range(1, time.size):  # one sample late, and held: delay .01 s
        rate[k] = rate[k - 1] + 0.01 * GAIN * (command[k - 2] + 0.05 * other[k - 2]) * (k > 1)
        command[k] = sweep[k] - 0.05 * closed * (rate[k] + noise[k])
    columns = {"t": time, "roll_cmd": command, "pitch_cmd": other, "p": rate + noise}
    np.savez(
        tmp_path / "axes.npz", **columns, sweep=sweep, yaw_cmd=random.standard_normal(wave.size)
    )
    settings = IdentifySettings(
        input="roll_cmd", output="p", reference="sweep" if closed else None, hold="dt", lag=False,
    )  # fmt: skip
    found = identify(tmp_path / "axes.npz", settings)
    [remark] = [remark for remark in found.fit.remarks if remark.kind == "other input"]
    assert "--other-input pitch_cmd)" in remark
    assert abs(found.fit["gain"] - GAIN) > 3 * found.fit.noise_standard_errors[0]
    if closed:  # windows cannot take it out
        by_windows = identify(tmp_path / "axes.npz", settings.changed({"estimator": "welch"}))
        [remark] = [remark for remark in by_windows.fit.remarks if remark.kind == "other input"]
        assert "not known" in remark
    settings = settings.changed({"other_inputs": ["pitch_cmd"]})
    again = identify(tmp_path / "axes.npz", settings)
    assert not any(remark.kind == "other input" for remark in again.fit.remarks)
    for name, truth in (("gain", GAIN), ("delay", 0.01)):
        error = again.fit.standard_errors[again.fit.names.index(name)]
        assert again.fit[name] == pytest.approx(truth, abs=3 * error)
    assert "--other-input pitch_cmd" in " ".join(again.settings.words())
