"""The command line, as a user types it."""

import json

import numpy as np
import pytest

import jaxquad as jq
from jaxquad.cli._main import main
from jaxquad.records import parse_mix


GAIN, LAG, DELAY = 100.0, 0.02, 0.01


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A noisy open-loop sweep of K e^(-delay s) / (s (lag s + 1)), as CSV, driven by two motors."""
    sweep = jq.sweep(1.0, 40.0, duration=40.0, sample_rate=100.0, amplitude=0.2)
    model = jq.LaggedIntegrator(GAIN, LAG, DELAY).transfer_function()
    rate = np.asarray(jq.models.simulate_linear(model, sweep.signal, 0.01))
    rate = rate + np.random.default_rng(0).normal(0, 0.05, rate.size)
    path = tmp_path_factory.mktemp("flight") / "sweep.csv"
    left, right = -0.5 * sweep.signal, 0.5 * sweep.signal
    table = np.column_stack([sweep.time, left, right, rate])
    np.savetxt(path, table, delimiter=",", header="t,left,right,q", comments="")
    return path


def identify(path, *more, channels=("M=right-left", "q")):
    return main(["identify", str(path), "--input", channels[0], "--output", channels[1], *more])


def test_a_csv_gives_its_model_back(flight, tmp_path, capsys):
    out = tmp_path / "out"
    code = identify(flight, "--out", str(out), "--band", "0.5", "6", "--verify", str(flight))
    printed = capsys.readouterr().out
    assert code == 0 and "gain" in printed and "TIC" in printed
    result = json.loads((out / "result.json").read_text())
    gain, lag, delay = result["fit"]["parameters"]
    assert abs(gain["value"] - GAIN) < 3 * gain["standard_error"] < 0.03 * GAIN
    # The input is held for 10 ms: half of it is delay.
    assert lag["value"] + delay["value"] == pytest.approx(LAG + DELAY + 0.005, rel=0.02)
    assert result["verification"]["fit_percent"] > 90
    assert (out / "bode.png").stat().st_size > 10_000
    assert (out / "verification.png").stat().st_size > 10_000


def test_channels_are_listed(flight, capsys):
    assert main(["channels", str(flight)]) == 0
    assert "right" in capsys.readouterr().out


def test_bad_input_is_one_line_on_stderr(flight, capsys):
    assert identify(flight, channels=("M=right-lefty", "q")) == 2
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1 and "'lefty'" in printed.err and "left" in printed.err
    assert identify("missing.csv") == 2
    assert "no such file" in capsys.readouterr().err


def test_noise_is_not_identifiable(tmp_path, capsys):
    noise = np.random.default_rng(1).standard_normal((4096, 2))
    np.savez(tmp_path / "hover.npz", t=np.arange(4096) / 100, M=noise[:, 0], q=noise[:, 1])
    out = tmp_path / "out"
    assert identify(tmp_path / "hover.npz", "--out", str(out), channels=("M", "q")) == 3
    printed = capsys.readouterr()
    assert "NOT IDENTIFIABLE from this record" in printed.out
    assert printed.err.count("\n") == 1 and printed.err.startswith("jaxquad: error: not ident")
    assert not json.loads((out / "result.json").read_text())["fit"]["identifiable"]
    assert (out / "bode.png").stat().st_size > 10_000


def test_json_is_all_that_stdout_holds_and_knows_no_nan(flight, tmp_path, capsys):
    """Far below 1 / lag the lag and the delay trade off, which is said of both."""
    code = identify(flight, "--out", str(tmp_path), "--band-rad", "1", "1.5", "--json")
    printed = capsys.readouterr()
    result = json.loads(printed.out, parse_constant=pytest.fail)
    by_name = {row["name"]: row for row in result["fit"]["parameters"]}
    assert code == 3 and not all(by_name[name]["determined"] for name in ("lag", "delay"))
    assert by_name["gain"]["value"] == pytest.approx(GAIN, rel=0.03)
    assert "jaxquad: error: not identifiable from this record" in printed.err
    assert "standard_error" not in printed.err and "std. error" in printed.err


def test_a_model_without_a_lag_has_the_whole_of_it_as_delay(flight, tmp_path, capsys):
    band = ["--band-rad", "3", "12"]
    assert identify(flight, "--out", str(tmp_path), *band, "--no-lag", "--cost", "coherence") == 0
    assert "q / M = K e^(-delay s) / s," in capsys.readouterr().out
    result = json.loads((tmp_path / "result.json").read_text())
    gain, delay = result["fit"]["parameters"]
    assert gain["name"] == "gain" and delay["name"] == "delay"
    assert delay["value"] == pytest.approx(LAG + DELAY + 0.005, rel=0.05)


def test_a_warning_of_the_reader_is_one_line(tmp_path, capsys):
    time = np.delete(np.arange(2000) / 100, slice(700, 704))
    noise = np.random.default_rng(2).standard_normal((time.size, 2))
    np.savez(tmp_path / "gap.npz", t=time, M=noise[:, 0], q=noise[:, 1])
    identify(tmp_path / "gap.npz", "--out", str(tmp_path), channels=("M", "q"))
    warning, error = capsys.readouterr().err.splitlines()
    assert warning.startswith("! gaps bridged by interpolation") and error.startswith("jaxquad: ")


@pytest.mark.parametrize(
    ("option", "complaint"),
    [
        (["--band", "6", "0.5"], "has to rise"),
        (["--integrators", "7"], "0 to 3"),
        (["--start", "90"], "90"),
        (["--window", "900"], "window"),
    ],
)
def test_an_option_that_cannot_be_is_refused(flight, capsys, option, complaint):
    assert identify(flight, *option) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("jaxquad: error:") and complaint in printed
    assert printed.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "mix"),
    [
        ("M", {"M": {"M": 1.0}}),
        ("roll=-m1+0.5*m2", {"roll": {"m1": -1.0, "m2": 0.5}}),
        ("p = m[0] - 2 * m[1]", {"p": {"m[0]": 1.0, "m[1]": -2.0}}),
        ("r=u[deg/s]-.5*u[1]+u[1]", {"r": {"u[deg/s]": 1.0, "u[1]": 0.5}}),
        ("axis-rate", {"axis-rate": {"axis-rate": 1.0}}),
        ("d=a-a.b+1e-3*c", {"d": {"a": 1.0, "a.b": -1.0, "c": 0.001}}),
        ("f=.1*m[0]^2-m[0] ^ 2+m[0]", {"f": {"m[0]^2": -0.9, "m[0]": 1.0}}),
    ],
)
def test_a_mix_is_read(text, mix):
    assert parse_mix(text) == mix


@pytest.mark.parametrize(
    "text",
    ["", "roll=", "roll=a b", "roll=a+*b", "roll=2", "=a", "f=a^1", "f=a^22", "f=a^2^2", "f=a^"],
)
def test_a_mix_that_means_nothing_is_refused(text, capsys):
    with pytest.raises(SystemExit):
        main(["identify", "x.csv", "--input", text, "--output", "q"])
    assert "--input" in capsys.readouterr().err


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0 and capsys.readouterr().out.strip()


@pytest.mark.parametrize(
    ("log", "axis"),
    [("E8_log00", 0), ("E8_log00", 1), ("E8_log00", 2), ("E8_log01", 0), ("E9_log00", 0)],
)
def test_a_hover_without_excitation_is_not_identifiable(data, tmp_path, capsys, log, axis):
    path = data / f"crazypad_hover/{log}.npz"
    channels = (f"cmd[{axis}]", f"rate[{axis}]")
    assert identify(path, "--out", str(tmp_path), channels=channels) == 3
    assert "not identifiable from this record" in capsys.readouterr().out.lower()


def test_poles_and_zeros_of_given_orders_are_fitted(flight, tmp_path, capsys):
    orders = ("--poles", "1", "--zeros", "0", "--band", "0.5", "6")
    assert identify(flight, "--out", str(tmp_path), *orders) == 0
    printed = capsys.readouterr().out
    assert "0 zeros over 1 poles and 1 integrators, delayed" in printed
    result = json.loads((tmp_path / "result.json").read_text())
    names = [row["name"] for row in result["fit"]["parameters"]]
    assert names == ["numerator[0]", "denominator[1]", "delay"]
    values = [row["value"] for row in result["fit"]["parameters"]]
    assert values[0] == pytest.approx(GAIN / LAG, rel=0.1)


@pytest.mark.parametrize("name", ["composite", "welch"])
def test_windows_can_be_asked_for(flight, tmp_path, name, capsys):
    assert identify(flight, "--out", str(tmp_path), "--estimator", name, "--band", "0.5", "6") == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["fit"]["parameters"][0]["value"] == pytest.approx(GAIN, rel=0.02)
