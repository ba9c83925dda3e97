"""`jaxquad identify`, as a user types it."""

import json
import shlex
import shutil

import numpy as np
import pytest
from sweep_logs import GAIN, TOTAL, write_noise, write_sweep, write_two_sweeps

from jaxquad.cli import main


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return write_sweep(tmp_path_factory.mktemp("flight") / "sweep.csv")


def identify(path, *more, channels=("M=right-left", "q")):
    given = ["--input", channels[0], "--output", channels[1], "--quiet"]
    return main(["identify", str(path), *given, *more])


def result_in(folder):
    return json.loads((folder / "result.json").read_text())


def test_a_csv_gives_its_model_back(flight, tmp_path, capsys):
    out = tmp_path / "out"
    code = identify(flight, "--out", str(out), "--band", "0.5", "6", "--verify", str(flight))
    printed = capsys.readouterr().out
    assert code == 0 and "gain" in printed and "TIC" in printed
    result = result_in(out)
    gain, lag, delay = result["fit"]["parameters"]
    assert abs(gain["value"] - GAIN) < 3 * gain["standard_error"] < 0.03 * GAIN
    assert lag["value"] + delay["value"] == pytest.approx(TOTAL, rel=0.02)
    assert result["verification"]["fit_percent"] > 90
    assert (out / "bode.png").stat().st_size > 10_000
    assert (out / "verification.png").stat().st_size > 10_000


def test_bad_input_is_one_line_on_stderr(flight, capsys):
    assert identify(flight, channels=("M=right-lefty", "q")) == 2
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1 and "'lefty'" in printed.err and "left" in printed.err
    assert identify("missing.csv") == 2
    assert "no such file" in capsys.readouterr().err


@pytest.mark.slow
def test_noise_is_not_identifiable(tmp_path, capsys):
    log, out = write_noise(tmp_path / "hover.npz"), tmp_path / "out"
    assert identify(log, "--out", str(out), channels=("M", "q")) == 3
    printed = capsys.readouterr()
    assert "NOT IDENTIFIABLE from this record" in printed.out
    assert "jaxquad design sweep" in printed.out and "free=" not in printed.out
    assert printed.err.count("\n") == 1 and printed.err.startswith("jaxquad: error: not ident")
    assert not result_in(out)["fit"]["identifiable"]
    assert (out / "bode.png").stat().st_size > 10_000


@pytest.mark.slow
def test_json_is_all_that_stdout_holds_and_knows_no_nan(flight, tmp_path, capsys):
    """Far below 1 / lag the lag and the delay trade off, which is said of both."""
    code = identify(flight, "--out", str(tmp_path), "--band-rad", "1", "1.5", "--json")
    printed = capsys.readouterr()
    result = json.loads(printed.out, parse_constant=pytest.fail)
    by_name = {row["name"]: row for row in result["fit"]["parameters"]}
    assert code == 3 and not all(by_name[name]["determined"] for name in ("lag", "delay"))
    assert by_name["gain"]["value"] == pytest.approx(GAIN, rel=0.03)
    assert "jaxquad: error: not identifiable from this record" in printed.err
    assert "(--no-lag)" in printed.err and "std. error" in printed.err


@pytest.mark.slow
def test_a_model_without_a_lag_has_the_whole_of_it_as_delay(flight, tmp_path, capsys):
    band = ["--band-rad", "3", "12"]
    assert identify(flight, "--out", str(tmp_path), *band, "--no-lag", "--cost", "coherence") == 0
    assert "q / M = K e^(-delay s) / s," in capsys.readouterr().out
    gain, delay = result_in(tmp_path)["fit"]["parameters"]
    assert gain["name"] == "gain" and delay["name"] == "delay"
    assert delay["value"] == pytest.approx(TOTAL, rel=0.05)


@pytest.mark.slow
def test_poles_and_zeros_of_given_orders_are_fitted(flight, tmp_path, capsys):
    orders = ("--poles", "1", "--zeros", "0", "--band", "0.5", "6")
    assert identify(flight, "--out", str(tmp_path), *orders) == 0
    assert "0 zeros over 1 poles and 1 integrators, delayed" in capsys.readouterr().out
    rows = result_in(tmp_path)["fit"]["parameters"]
    assert [row["name"] for row in rows] == ["numerator[0]", "denominator[1]", "delay"]
    assert rows[0]["value"] == pytest.approx(GAIN / 0.02, rel=0.1)


@pytest.mark.slow
def test_options_take_precedence_over_a_file(flight, tmp_path, capsys):
    config = tmp_path / "identify.toml"
    config.write_text('input = "M=right-left"\noutput = "q"\nband_rad = [1, 1.5]\nlag = false\n')
    words = ["--config", str(config), "--band", "0.5", "2", "--out", str(tmp_path)]
    assert main(["identify", str(flight), *words]) == 0
    settings = result_in(tmp_path)["settings"]
    assert (settings["band"], settings["band_rad"], settings["lag"]) == ([0.5, 2.0], None, False)
    config.write_text("bnad = 3")
    assert main(["identify", str(flight), "--config", str(config)]) == 2
    assert "identify.toml: unknown key 'bnad'; did you mean 'band'?" in capsys.readouterr().err


def test_a_warning_of_the_reader_is_one_line_however_many_logs_have_it(tmp_path, capsys):
    time = np.delete(np.arange(2000) / 100, slice(700, 704))
    noise = np.random.default_rng(2).standard_normal((time.size, 2))
    np.savez(tmp_path / "gap.npz", t=time, M=noise[:, 0], q=noise[:, 1])
    shutil.copy(tmp_path / "gap.npz", tmp_path / "again.npz")
    logs = [str(tmp_path / name) for name in ("gap.npz", "again.npz")]
    main(["identify", *logs, "--input", "M", "--output", "q", "--out", str(tmp_path), "--quiet"])
    warning, error = capsys.readouterr().err.splitlines()
    assert warning.startswith("! gaps filled by interpolation") and error.startswith("jaxquad: ")


@pytest.mark.parametrize(
    ("option", "complaint"),
    [
        (["--band", "6", "0.5"], "--band is [6.0, 0.5]: give two numbers above 0"),
        (["--integrators", "7"], "0 to 3"),
        (["--start", "90"], "90"),
        (["--window", "900"], "window"),
        (["--axis", "roll"], "--axis is for a proposal: leave it out, or leave --input"),
        (["--segment", "5"], "--segment is ['5']: '5' is no START:STOP"),
        (["--segment", "0:40", "--start", "5"], "--segment says where to start and stop"),
        (["--band", "1", "2", "--band-rad", "1", "2"], "--band (Hz) and --band-rad (rad/s)"),
        (["--unit", "q"], "'q' is no NAME=UNIT: write q=rad/s"),
    ],
)
def test_an_option_that_cannot_be_is_refused(flight, capsys, option, complaint):
    assert identify(flight, *option) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("jaxquad: error:") and complaint in printed
    assert printed.count("\n") == 1


def test_a_mix_without_a_meaning_is_refused(capsys):
    assert main(["identify", "x.csv", "--input", "roll=a b", "--output", "q"]) == 2
    assert "--input is 'roll=a b': " in capsys.readouterr().err


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0 and capsys.readouterr().out.strip()


@pytest.mark.slow
def test_two_segments_are_analysed_together_and_what_lies_between_is_not(tmp_path, capsys):
    path = tmp_path / "twice.npz"
    end = write_two_sweeps(path)
    spans = [f"0:{end}", f"{2 * (end + 0.01)}:{3 * end + 0.02}"]
    words = [word for span in spans for word in ("--segment", span)]
    words += ["--input", "M=0.5*w+2*w^2", "--output", "q", "--band", "0.5", "6", "--unit", "M=N m"]
    assert main(["identify", str(path), *words, "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert printed.count(f"{end:g} s at 100 Hz") == 2 and "inputs: M [N m]" in printed
    result = result_in(tmp_path)
    gain = result["fit"]["parameters"][0]
    assert abs(gain["value"] - GAIN) < 3 * gain["standard_error"] < 0.02 * GAIN
    assert len(result["record"]["segments_s"]) == 2
    assert (tmp_path / "record_2.png").exists()
    # The command in the report says what was typed.
    again = shlex.split(result["provenance"]["command"])
    assert again[again.index("--segment") + 1] == f"0:{end:g}" and "M=0.5*w+2*w^2" in again
    # Its model serves a record that has the same channels.
    assert main(["verify", str(tmp_path), str(path), "--stop", f"{end}", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["fit_percent"] > 90


@pytest.mark.slow
@pytest.mark.parametrize(
    ("log", "axis", "said"),
    [
        ("E8_log00", 0, "NOT IDENTIFIABLE from this record: coherence reaches 0.6"),
        ("E8_log00", 1, "NO MODEL of this structure holds"),
        ("E8_log00", 2, "NO MODEL of this structure holds"),
        ("E8_log01", 0, "NOT IDENTIFIABLE from this record: coherence reaches 0.6"),
        ("E9_log00", 0, "NOT IDENTIFIABLE from this record: coherence reaches 0.6"),
    ],
)
def test_a_hover_without_excitation_is_not_identifiable(data, tmp_path, capsys, log, axis, said):
    """Roll is not coherent. In pitch and yaw the controller's feedback is, which no plant fits."""
    path = data / f"crazypad_hover/{log}.npz"
    channels = (f"cmd[{axis}]", f"rate[{axis}]")
    assert identify(path, "--out", str(tmp_path), channels=channels) == 3
    assert capsys.readouterr().out.split("\n\n")[2].split("\n")[1].startswith(said)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["composite", "welch"])
def test_windows_can_be_asked_for(flight, tmp_path, name):
    assert identify(flight, "--out", str(tmp_path), "--estimator", name, "--band", "0.5", "6") == 0
    gain = result_in(tmp_path)["fit"]["parameters"][0]
    assert gain["value"] == pytest.approx(GAIN, rel=0.02)
