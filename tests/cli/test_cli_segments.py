"""Several segments of a log at once, and powers of channels, on the command line."""

import json
import shlex

import numpy as np
import pytest

import jaxquad as jq
from jaxquad.cli._main import main
from jaxquad.records import RecordError
from jaxquad.records._segments import read_segments


GAIN, LAG, DELAY = 100.0, 0.02, 0.01
MIX = {"M": {"w": 0.5, "w^2": 2.0}}


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Two sweeps with a pause, and what nobody may use between them; M = 0.5 w + 2 w^2."""
    sweep = jq.sweep(1.0, 40.0, duration=40.0, sample_rate=100.0, amplitude=0.2)
    model = jq.LaggedIntegrator(GAIN, LAG, DELAY).transfer_function()
    noise = np.random.default_rng(0).normal(0, 0.05, (3, sweep.signal.size))
    rate = np.asarray(jq.models.simulate_linear(model, sweep.signal, 0.01))
    moment = np.concatenate([sweep.signal, noise[0], sweep.signal])
    rates = np.concatenate([rate + noise[1], 300 * noise[0], rate + noise[2]])
    speed = (np.sqrt(0.25 + 8 * (moment + 1)) - 0.5) / 4  # 2 w^2 + 0.5 w = M + 1
    path = tmp_path_factory.mktemp("flight") / "twice.npz"
    np.savez(path, t=np.arange(moment.size) / 100, w=speed, q=rates, M=moment)
    return path, sweep.time[-1]


def test_two_segments_are_analysed_together_and_what_lies_between_is_not(flight, tmp_path, capsys):
    path, end = flight
    spans = [f"0:{end}", f"{2 * (end + 0.01)}:{3 * end + 0.02}"]
    words = [word for span in spans for word in ("--segment", span)]
    words += ["--input", "M=0.5*w+2*w^2", "--output", "q", "--band", "0.5", "6", "--unit", "M=N m"]
    assert main(["identify", str(path), *words, "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert printed.count(f"{end:g} s at 100 Hz") == 2 and "inputs: M [N m]" in printed
    result = json.loads((tmp_path / "result.json").read_text())
    gain = result["fit"]["parameters"][0]
    assert abs(gain["value"] - GAIN) < 3 * gain["standard_error"] < 0.02 * GAIN
    assert len(result["record"]["segments_s"]) == 2
    assert (tmp_path / "record_2.png").exists()
    # The command in the report is the one that was typed.
    again = shlex.split(result["provenance"]["command"])
    assert f"--segment=0.0:{end}" in again and "M=+0.5*w+2.0*w^2" in again
    # Its model serves a record that has the same channels.
    check = ["verify", str(tmp_path), str(path), "--stop", f"{end}", "--json"]
    assert main(check) == 0
    assert json.loads(capsys.readouterr().out)["fit_percent"] > 90


def test_a_power_is_that_of_the_channel(flight):
    path, end = flight
    [record] = read_segments(path, [(0, end)], inputs=MIX, outputs={"q": {"q": 1.0}})
    with np.load(path) as log:
        np.testing.assert_allclose(record.inputs[:, 0], log["M"][: record.samples] + 1, atol=1e-12)
        np.testing.assert_array_equal(record.outputs[:, 0], log["q"][: record.samples])


def test_a_channel_by_itself_may_have_the_name_of_a_power(tmp_path):
    time = np.arange(50) / 100
    np.savez(tmp_path / "odd.npz", **{"t": time, "w^2": np.sin(time), "q": np.cos(time)})
    names = ("w^2", "q")
    inputs, outputs = ({name: {name: 1.0}} for name in names)
    [record] = read_segments(tmp_path / "odd.npz", [(None, None)], inputs=inputs, outputs=outputs)
    np.testing.assert_array_equal(record.inputs[:, 0], np.sin(time))


@pytest.mark.parametrize(
    ("segments", "complaint"),
    [
        ([(0, 10), (8, 20)], "0 .. 10 s and 8 .. 20 s overlap"),
        ([(30, 40), (5, 35)], "overlap"),
        ([(0, 10), (20, 900)], "20 .. 900 s is out of range"),
        ([(0, 10), (20, 20.05)], "makes 6 samples, not 16"),
    ],
)
def test_segments_that_cannot_be_say_why(flight, segments, complaint):
    one = {"q": {"q": 1.0}}
    with pytest.raises(RecordError, match=complaint):
        read_segments(flight[0], segments, inputs=MIX, outputs=one, sample_rate=100)


@pytest.mark.parametrize("text", ["5", "5:", "9:3", "a:b", "3:3", "nan:5", "0:inf"])
def test_a_segment_is_a_start_and_a_stop(text, capsys):
    with pytest.raises(SystemExit):
        main(["identify", "x.csv", "--input", "u", "--output", "y", "--segment", text])
    assert "START:STOP" in capsys.readouterr().err


def test_a_segment_beside_a_start_is_refused(flight, capsys):
    words = ["--input", "M", "--output", "q", "--segment", "0:40", "--start", "5"]
    assert main(["identify", str(flight[0]), *words]) == 2
    assert "--segment says where to start and stop" in capsys.readouterr().err


def test_segments_of_different_jitter_come_to_one_rate(tmp_path):
    """Two clocks that differ by 0.1 % between the parts of a log."""
    slow, fast = np.arange(100) / 100, 10 + np.arange(100) / 100.1
    time = np.concatenate([slow, fast])
    np.savez(tmp_path / "drift.npz", t=time, u=np.sin(time), y=np.cos(time))
    one = lambda name: {name: {name: 1.0}}
    first, second = read_segments(
        tmp_path / "drift.npz", [(0, 0.98), (10, 10.98)], inputs=one("u"), outputs=one("y")
    )
    assert first.dt == pytest.approx(second.dt, rel=1e-12) == pytest.approx(0.01)
