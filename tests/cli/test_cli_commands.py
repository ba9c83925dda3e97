"""The commands around `jaxquad identify`: demo, report, verify, tune, design, and proposals."""

import json
import logging
import time

import numpy as np
import pytest
from log_writers import DataFlash

import jaxquad as jq
from jaxquad.cli import main
from jaxquad.workflows import DEMO, DEMO_TRUTH, identify, write_demo_log


pytestmark = pytest.mark.usefixtures("compiled_quickly")


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The folder of `jaxquad demo`; tests only read it."""
    folder = tmp_path_factory.mktemp("demo")
    assert main(["demo", "--out", str(folder)]) == 0
    return folder


def test_the_demo_finds_the_truth_of_its_log_within_its_error_bars(demo):
    """The lag's mean over a sample and the hold of the command are exact: no bias is allowed."""
    rows = {row["name"]: row for row in result(demo)["fit"]["parameters"]}
    for name, truth in {"gain": 280.0, "lag": 0.02, "delay": 0.008}.items():
        assert abs(rows[name]["value"] - truth) < 3 * rows[name]["standard_error"]
        assert 3 * rows[name]["noise_standard_error"] < 0.06 * truth  # 2 % by the noise
    assert [rows[name]["unit"] for name in rows] == ["rad/s^2 per M", "s", "s"]
    assert "identif" in (demo / "report.html").read_text().lower()


@pytest.mark.slow
def test_a_right_model_of_logs_like_the_demos_pays_little_for_possible_model_error(tmp_path):
    """One log's residuals may look like a model error; over five logs few do."""
    truths, errors, widths = np.array([*DEMO_TRUTH.values()]), [], []
    for seed in range(5):
        fit = identify(write_demo_log(tmp_path / f"{seed}.csv", seed), DEMO).fit
        errors.append((fit.values - truths) / fit.standard_errors)
        widths.append(3 * fit.standard_errors / truths)
    assert np.max(np.abs(errors)) < 3
    assert np.all(np.mean(widths, axis=0) < 0.07)


def result(folder):
    return json.loads((folder / "result.json").read_text())


@pytest.mark.slow
def test_a_report_is_written_again_from_the_same_log_only(demo, tmp_path, capsys):
    assert main(["report", str(demo), "--out", str(tmp_path), "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["fit"]["parameters"] == result(demo)["fit"]["parameters"]
    assert (tmp_path / "report.html").exists() and (tmp_path / "bode.png").exists()
    changed = tmp_path / "changed.csv"
    changed.write_bytes((demo / "demo.csv").read_bytes() + b"\n")
    assert main(["report", str(demo), "--log", str(changed)]) == 2
    assert "not the log that was identified" in capsys.readouterr().err
    assert main(["report", str(demo), "--log", str(tmp_path / "gone.csv")]) == 2
    assert "the log is gone" in capsys.readouterr().err


def test_a_stored_model_is_verified_on_another_record(demo, tmp_path, capsys):
    """Held against `jq.verify` of the model that was printed."""
    log, picture = str(demo / "demo.csv"), tmp_path / "verification.png"
    words = ["verify", str(demo), log, "--start", "5", "--stop", "40", "--out", str(picture)]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    values = [row["value"] for row in result(demo)["fit"]["parameters"]]
    record = jq.read(log, inputs="M", outputs="q", start=5, stop=40, hold="dt")
    check = jq.verify(jq.LaggedIntegrator(*values), record, band=tuple(found["band_rad_per_s"]))
    assert found["fit_percent"] == pytest.approx(check.fit_percent) and check.fit_percent > 70
    assert found["band_rad_per_s"] == pytest.approx([np.pi, 24 * np.pi], rel=0.01)
    assert found["unit"] == "rad/s" and picture.stat().st_size > 10_000


def test_a_weak_model_is_called_so_before_its_agreement(demo, tmp_path, capsys):
    content = result(demo)
    content["fit"]["identifiable"] = False
    content["fit"]["verdict"]["summary"] = "not identifiable from this record: lag"
    (tmp_path / "result.json").write_text(json.dumps(content))
    words = ["verify", str(tmp_path), str(demo / "demo.csv"), "--start", "5", "--stop", "40"]
    assert main([*words, "--band-rad", "4", "60"]) == 3
    first, second, *_, last, verdict = capsys.readouterr().out.splitlines()
    assert verdict.startswith("AGREES: ")
    assert first == "THE MODEL IS WEAK: not identifiable from this record: lag"
    assert "does not make up for that" in second
    assert last.startswith("verification on q, 4..60 rad/s (0.637..9.55 Hz): fit")


def test_what_holds_no_model_is_said(demo, tmp_path, capsys):
    assert main(["verify", str(tmp_path), "x.csv"]) == 2
    assert "run jaxquad identify first" in capsys.readouterr().err
    content = result(demo)
    del content["model"]
    (tmp_path / "result.json").write_text(json.dumps(content))
    assert main(["verify", str(tmp_path), str(demo / "demo.csv")]) == 3
    assert "holds no model" in capsys.readouterr().err
    (tmp_path / "result.json").write_text("[1]")
    assert main(["verify", str(tmp_path), "x.csv"]) == 2
    assert "no result of" in capsys.readouterr().err
    (tmp_path / "log.bbl").write_bytes(b"\xa0\xff")
    assert main(["report", str(tmp_path / "log.bbl")]) == 2
    said = capsys.readouterr().err
    assert f"jaxquad identify {tmp_path / 'log.bbl'}" in said and "codec" not in said


@pytest.mark.parametrize("kind", ["sweep", "multisine"])
def test_an_excitation_is_designed_within_its_band(kind, tmp_path, capsys):
    """Held against the transform of the file."""
    out = tmp_path / "signal.csv"
    words = ["design", kind, "--band", "0.5", "10", "--rate", "500", "--amplitude", "0.2"]
    assert main([*words, "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    time, signal = np.loadtxt(out, delimiter=",", skiprows=1, unpack=True)
    assert told["ok"] and told["samples"] == time.size
    np.testing.assert_allclose(np.diff(time), 0.002, atol=1e-9)
    assert 0.15 < np.abs(signal).max() <= 0.2 + 1e-9
    power = np.abs(np.fft.rfft(signal)) ** 2
    hertz = np.fft.rfftfreq(time.size, 0.002)
    inside = (hertz > 0.4) & (hertz < 10.5)
    # The fades at its two ends take a few per cent of a sweep elsewhere.
    assert power[inside].sum() > 0.95 * power.sum()


def test_another_signal_keeps_its_file(tmp_path, capsys):
    def written(*more):
        words = ["design", "sweep", "--band", "0.5", "10", "--rate", "500", "--json", *more]
        assert main([*words, "--out", str(tmp_path / "s.csv")]) == 0
        return json.loads(capsys.readouterr().out)["file"]

    one, two = str(tmp_path / "s.csv"), str(tmp_path / "s-2.csv")
    amplitudes = ["0.2", "0.2", "0.3", "0.3"]
    assert [written("--amplitude", each) for each in amplitudes] == [one, one, two, two]
    assert written("--amplitude", "0.3", "--force") == one


@pytest.mark.parametrize(
    ("words", "code", "complaint"),
    [
        (["--band", "0.5", "10", "--rate", "100"], 4, "sample rate"),
        (["--band", "10", "0.5", "--rate", "100"], 2, "--band is 10 0.5: give two frequencies"),
        (["--band", "0.5", "10", "--rate", "0"], 2, "above 0"),
        (["--band", "0.5", "10", "--rate", "500", "--duration", "0"], 2, "duration"),
        (["--band", "0.5", "10", "--rate", "500", "--lines", "5"], 2, "--lines is for a multisine"),
    ],
)
def test_a_design_that_breaks_a_rule_says_so(words, code, complaint, tmp_path, capsys):
    out = ["--amplitude", "1", "--out", str(tmp_path / "s.csv")]
    assert main(["design", "sweep", *words, *out]) == code
    printed = capsys.readouterr()
    assert complaint in printed.out + printed.err


@pytest.mark.slow
def test_an_autopilots_log_needs_no_channels(tmp_path, capsys):
    path, out = chirped(tmp_path), tmp_path / "out"
    assert main(["identify", str(path), "--out", str(out), "--no-lag"]) == 0
    assert "Proposal for the roll axis" in capsys.readouterr().out
    gain = result(out)["fit"]["parameters"][0]
    assert gain["value"] == pytest.approx(100.0, rel=0.02)
    command = result(out)["provenance"]["command"]
    assert "RATE.ROut" in command and "--axis" not in command
    assert main(["identify", str(path), "--input", "RATE.ROut"]) == 2
    assert "belong together" in capsys.readouterr().err


@pytest.mark.slow
def test_all_chirps_of_a_log_are_used_together(tmp_path, capsys):
    path, out = chirped(tmp_path, starts=(22, 45)), tmp_path / "out"
    assert main(["identify", str(path), "--out", str(out), "--no-lag"]) == 0
    assert "2 times: 0.5 .. 6.5 Hz" in capsys.readouterr().out
    assert np.allclose(result(out)["record"]["segments_s"], [(22, 42), (45, 65)], atol=0.02)
    assert result(out)["fit"]["parameters"][0]["value"] == pytest.approx(100.0, rel=0.02)
    # Of those, what lies where the user says to look.
    words = ["identify", str(path), "--out", str(out), "--no-lag", "--start", "43", "--force"]
    assert main(words) == 0
    assert np.allclose(result(out)["record"]["segments_s"], [(45, 65)], atol=0.02)


def test_what_several_steps_read_of_one_log_is_said_once(tmp_path, capsys):
    path = chirped(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[:-3000] + b"noise" + content[-3000:])
    assert main(["identify", str(path), "--band", "200", "300"]) == 2
    printed = capsys.readouterr().err
    assert printed.count("damaged block") == 1 and "Nyquist" in printed


def chirped(folder, starts=(22,)):
    """ArduPilot's chirps of 20 s into the mixer of a roll axis 100 / s under feedback of the rate.

    Between them the rate is disturbed, by what no channel shows.
    """
    log, time = DataFlash(), 20.0 + np.arange((starts[-1] + 2) * 100) / 100
    log.define("SIDS", "QBfff", "TimeUS,Ax,Mag,FSt,FSp", units="s----", mults="F----")
    log.define("SIDD", "Qff", "TimeUS,Targ,F", units="s--", mults="F--")
    log.define("RATE", "Qfff", "TimeUS,RDes,R,ROut", units="skk-", mults="F---")
    log.write("PARM", 0, b"SID_AXIS", 10.0)
    since = np.min([np.where(time < start, np.inf, time - start) for start in starts], axis=0)
    run = since < 20
    since = np.where(run, since, 0.0)
    chirp = 0.2 * np.sin(2 * np.pi * (0.5 * since + 0.15 * since**2)) * run
    idle = (time >= starts[0] + 20) & (time < starts[-1])
    rate = np.random.default_rng(0).normal(0, 0.02, time.size)
    output, moved = np.zeros(time.size), 0.0
    for k in range(time.size):
        rate[k] += moved
        output[k] = -0.02 * rate[k] + (chirp[k - 1] if k else 0.0)  # acts one loop later
        moved += output[k] + idle[k] * np.sin(9 * time[k])  # 100 / s for 10 ms
    for k, t in enumerate(np.round(time * 1e6).astype(int).tolist()):
        if run[k]:
            if not run[k - 1]:
                log.write("SIDS", t - 10, 10, 0.2, 0.5, 6.5)
            log.write("SIDD", t, chirp[k], 1.0)
        log.write("RATE", t, 0.0, rate[k], output[k])
    path = folder / "log.bin"
    path.write_bytes(log.content)
    return path


@pytest.mark.parametrize(
    "name",
    [
        "demo",
        "channels",
        "identify",
        "verify",
        "report",
        "tune",
        "autopilot",
        "compare",
        "design",
        "batch",
    ],
)
def test_every_command_has_help_with_an_example(name, capsys):
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    printed = capsys.readouterr().out
    assert stop.value.code == 0 and f"  jaxquad {name}" in printed and "--json" in printed


@pytest.mark.parametrize(
    "words, said",
    [
        (
            ["identify", "x", "--lagg"],
            "jaxquad identify has no option --lagg. Did you mean --no-lag?",
        ),
        (["identify", "x", "--referense=r"], "no option --referense. Did you mean --reference?"),
        (["channels", "x", "--zzz", "1"], "has no option --zzz. See jaxquad channels --help."),
        (["channels", "x", "y"], "jaxquad channels takes no further argument 'y'."),
        (["identfy", "x"], "no command 'identfy'. Did you mean identify? See jaxquad --help."),
        (["zzz"], "there is no command 'zzz'. See jaxquad --help."),
    ],
)
def test_an_option_that_does_not_exist_is_answered_with_the_nearest(words, said, capsys):
    assert main(words) == 2
    printed = capsys.readouterr()
    assert said in printed.err and not printed.out and printed.err.count("\n") == 1


def test_a_log_without_a_command_is_answered_with_what_to_do_with_it(tmp_path, capsys):
    log = tmp_path / "my log.bfl"
    log.touch()
    assert main([str(log)]) == 2
    said = capsys.readouterr().err
    assert f"jaxquad identify '{log}' gives a model" in said
    assert f"jaxquad autopilot '{log}' the gains" in said
    assert main([str(tmp_path)]) == 2
    assert f"jaxquad batch {tmp_path} identifies its logs" in capsys.readouterr().err
    assert main(["help"]) == 0
    assert "commands, in order of use:" in capsys.readouterr().out


def test_channels_are_listed_as_json(demo, capsys):
    assert main(["channels", str(demo / "demo.csv"), "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert rows["q"]["rate"] == pytest.approx(250)


@pytest.mark.parametrize(("more", "said"), [([], "long ...\n"), (["--quiet"], "")])
def test_a_stage_that_takes_longer_than_a_second_is_a_line(more, said, demo, capsys, monkeypatch):
    def identify_slowly(*_, **__):
        for stage, seconds in (("short", 0.0), ("long", 1.5), ("last", 0.0)):
            logging.getLogger("jaxquad.stages").info(stage)
            time.sleep(seconds)
        raise ValueError("enough")

    monkeypatch.setattr("jaxquad.workflows.identify_opened", identify_slowly)
    words = ["identify", str(demo / "demo.csv"), "--input", "M", "--output", "q", "--json", *more]
    assert main(words) == 2
    printed = capsys.readouterr()
    assert printed.err == f"{said}jaxquad: error: enough\n" and not printed.out


PLANT = ["--inertia", "0.01", "--limit", "0.2"]
SMALL = ["--noise", "0.05", "--members", "8", "--fresh", "32", "--duration", "1.6"]


@pytest.mark.slow
def test_a_report_is_drawn_again_to_the_byte(demo, capsys, tmp_path):
    assert main(["report", str(demo), "--out", str(tmp_path), "--quiet"]) == 0
    assert "report.html" in capsys.readouterr().out
    assert (tmp_path / "bode.png").read_bytes() == (demo / "bode.png").read_bytes()


@pytest.mark.slow
def test_a_result_becomes_gains_with_a_certificate(demo, tmp_path, capsys):
    code = main(["tune", str(demo), *PLANT, *SMALL, "--out", str(tmp_path), "--json"])
    printed = json.loads(capsys.readouterr().out)
    # Whichever way it falls, the code says what the certificate says.
    assert code == (0 if printed["holds"] else 4)
    assert printed["holds"] == printed["certificate"]["holds"] and printed["stabilised"]
    assert {"ladrc.wc", "ladrc.wo"} <= {name.partition("[")[0] for name in printed["values"]}
    assert printed["settings"]["inertia"] == 0.01
    assert json.loads((tmp_path / "tuned.json").read_text())["values"] == printed["values"]
    stored = jq.workflows.load_tuning(tmp_path)
    assert stored.values == printed["values"]
    assert float(stored.controller.ladrc.wc) == pytest.approx(printed["values"]["ladrc.wc"])
    assert "attitude" in (tmp_path / "attitude.h").read_text()
    page = (tmp_path / "report.html").read_text()
    assert "Tuned gains" in page and "SHA-256" in page
    assert (tmp_path / "certificate.png").stat().st_size > 10_000
    assert (tmp_path / "flight.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("more", "complaint"),
    [
        (["--spread", "3", "0.5"], "--spread is [3.0, 0.5]: give two numbers above 0"),
        (["--step", "0"], "--step is 0.0: give a number above 0"),
    ],
)
def test_what_cannot_be_tuned_is_one_line(demo, capsys, more, complaint):
    assert main(["tune", str(demo), *PLANT, *more]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1 and complaint in printed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("units", "said"),
    [
        ({}, "the unit of q is not known, but gains are for an angle in rad: identify with the"),
        ({"q": "deg/s"}, "(--output angle=0.017453293*q --unit angle=rad/s)"),
    ],
)
def test_an_output_that_is_not_in_radians_is_refused(demo, tmp_path, capsys, units, said):
    """Gains in the wrong unit would be 57 times too large or too small."""
    content = json.loads((demo / "result.json").read_text())
    content["settings"]["units"] = units
    (tmp_path / "result.json").write_text(json.dumps(content))
    assert main(["tune", str(tmp_path), *PLANT]) == 2
    assert said in capsys.readouterr().err
