"""The command line, as a user types it."""

import json

import numpy as np
import pytest

import jaxquad as jq
from jaxquad.cli import main, parse_mix


GAIN, LAG, DELAY = 100.0, 0.02, 0.01


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A noisy open-loop sweep of K e^(-delay s) / (s (lag s + 1)), as CSV, driven by two motors."""
    sweep = jq.sweep(1.0, 40.0, duration=40.0, sample_rate=100.0, amplitude=0.2)
    model = jq.LaggedIntegrator(GAIN, LAG, DELAY).transfer_function()
    rate = np.asarray(jq.simulate_linear(model, sweep.signal, 0.01))
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
    assert identify(tmp_path / "hover.npz", channels=("M", "q")) == 3
    assert "not identifiable from this record" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "mix"),
    [
        ("M", {"M": {"M": 1.0}}),
        ("roll=-m1+0.5*m2", {"roll": {"m1": -1.0, "m2": 0.5}}),
        ("p = m[0] - 2 * m[1]", {"p": {"m[0]": 1.0, "m[1]": -2.0}}),
        ("d=a-a.b+1e-3*c", {"d": {"a": 1.0, "a.b": -1.0, "c": 0.001}}),
    ],
)
def test_a_mix_is_read(text, mix):
    assert parse_mix(text) == mix


@pytest.mark.parametrize("text", ["", "roll=", "roll=a b", "roll=a+*b", "roll=2", "=a"])
def test_a_mix_that_means_nothing_is_refused(text, capsys):
    with pytest.raises(SystemExit):
        main(["identify", "x.csv", "--input", text, "--output", "q"])
    assert "--input" in capsys.readouterr().err


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0 and capsys.readouterr().out.strip()


@pytest.mark.parametrize("log", ["E8_log00", "E8_log01", "E9_log00"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_hover_without_excitation_is_not_identifiable(data, tmp_path, capsys, log, axis):
    path = data / f"crazypad_hover/{log}.npz"
    channels = (f"cmd[{axis}]", f"rate[{axis}]")
    assert identify(path, "--out", str(tmp_path), channels=channels) == 3
    assert "not identifiable from this record" in capsys.readouterr().out.lower()
