"""Names that are no text, full disks, interrupts, nested files, two processes in one folder."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq
from jaxquad._core import plain_content, readable, staged_files, write_file
from jaxquad.cli import main
from jaxquad.workflows import load_result, write_demo_log


WORDS = ("identify", "--input", "M", "--output", "q", "--unit", "q=rad/s", "--quiet")
BAD = os.fsdecode(b"\xff\xfebad")
NESTED = '{"a":' * 50_000 + "1" + "}" * 50_000
ATTACKS = Path(__file__).parents[1] / "benchmarks"


def started(*words, cwd, more=(), **environment):
    return subprocess.Popen(
        [sys.executable, *more, "-m", "jaxquad", *words], cwd=cwd, env=os.environ | environment,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace",
        start_new_session=True,
    )  # fmt: skip


def test_names_that_are_no_text_are_written_with_replacement(tmp_path):
    assert readable("plain") == "plain" and readable("gr\u00fcn") == "gr\u00fcn"
    assert readable(BAD) == "\ufffd\ufffdbad" and readable("\ud800x") == "\ufffdx"
    assert readable("gr\udcc3\udcbcn") == "gr\u00fcn"  # as a system of ASCII alone reads it
    assert plain_content({BAD: [BAD]}) == {readable(BAD): [readable(BAD)]}
    assert write_file(tmp_path / "text", BAD).read_text() == readable(BAD)
    response = response_of(jq.LaggedIntegrator(280.0, 0.016, 0.011), seed=0)
    with jq.plot.headless():
        figure = jq.plot.bode(response, title=BAD).figure
    figure.savefig(tmp_path / "figure.png")  # which a title with half a pair would refuse


def test_a_full_disk_names_the_folder_and_leaves_nothing(tmp_path):
    folder = tmp_path / "new" / "out"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, before[1]))
    try:
        with pytest.raises(OSError) as caught, staged_files(folder) as draft:  # noqa: PT011
            write_file(draft / "small", "x")
            write_file(draft / "large", "x" * 9000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.filename == str(folder)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full disk")
@pytest.mark.parametrize("words", [["--help"], ["--version"], [], ["channels", "demo.csv"]])
def test_what_cannot_be_printed_is_an_error(words, tmp_path):
    write_demo_log(tmp_path / "demo.csv")
    with open("/dev/full", "w") as full:
        for unbuffered in ("", "1"):
            ran = subprocess.run(
                [sys.executable, "-m", "jaxquad", *words], cwd=tmp_path, stdout=full, text=True,
                stderr=subprocess.PIPE, env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
                check=False,
            )  # fmt: skip
            assert ran.returncode == 2
            assert ran.stderr == "jaxquad: error: what is printed: no space left on device\n"


@pytest.mark.parametrize("words", [
    ["report", "."], ["verify", ".", "demo.csv"], ["tune", ".", "--inertia", "1", "--limit", "1"],
    ["identify", "demo.csv", "--config", "nested.toml"],
])  # fmt: skip
def test_a_file_that_is_nested_deeply_is_refused(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_demo_log("demo.csv")
    Path("result.json").write_text(NESTED)
    Path("nested.toml").write_text(f"input = {'[' * 5000}{']' * 5000}")
    assert main(words) == 2
    assert "jaxquad: error: " in capsys.readouterr().err


def test_a_folder_named_like_a_table_is_a_folder(tmp_path, capsys):
    (tmp_path / "log.csv").mkdir()
    assert main(["channels", str(tmp_path / "log.csv")]) == 2
    assert "is a folder, and no bag of ROS 2" in capsys.readouterr().err


def test_a_verification_agrees_is_weak_or_contradicts():
    time = np.arange(0, 20, 0.01)
    u = jq.sweep(1.0, 20.0, duration=14, sample_rate=100.0, amplitude=1.0).signal[: time.size]
    u = np.pad(u, (0, time.size - u.size))
    model = jq.TransferFunction([1.0], [1.0, 3.0, 9.0])
    random = np.random.default_rng(0)
    y = jq.verify(model, jq.Record(time, u, u), band=None).simulated
    of = lambda measured: jq.verify(model, jq.Record(time, u, measured)).verdict
    noise = random.standard_normal(time.size) * np.std(y)
    assert of(y + 0.1 * noise).kind == "agrees"
    assert of(y + 2.0 * noise).kind == "weak"
    assert of(noise).kind == "contradicts" and of(-y).kind == "contradicts"
    small = of(0.2 * y + 0.01 * noise), of(8 * y + 0.1 * noise)
    assert [verdict.kind for verdict in small] == ["contradicts"] * 2
    assert "the output is 8 times what the model predicts" in small[1]
    # Where the input moves the output by a tenth of the noise, a true model is no contradiction.
    for seed in range(20):
        noise = np.random.default_rng(seed).standard_normal(time.size)
        assert of(y + 10 * noise * np.std(y)).kind != "contradicts"


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_demo_log(tmp_path_factory.mktemp("attacks") / "demo.csv")


@pytest.mark.slow
def test_a_log_that_contradicts_the_model_ends_with_3(log, tmp_path, capsys):
    sound = ("--reference", "x0", "--band", "0.5", "12", "--hold", "dt")
    assert main([*WORDS, *sound, "--out", str(tmp_path / "out"), "--", str(log)]) == 0
    rows = np.loadtxt(log, delimiter=",", skiprows=1)
    rows[:, 3] *= -1
    np.savetxt(tmp_path / "wrong.csv", rows, delimiter=",", header="time,x0,M,q", comments="")
    capsys.readouterr()
    assert main(["verify", str(tmp_path / "out"), str(log)]) == 0
    assert "\nAGREES: " in capsys.readouterr().out
    words = ["verify", str(tmp_path / "out"), str(tmp_path / "wrong.csv")]
    assert main(words) == 3
    assert "\nCONTRADICTS: " in capsys.readouterr().out
    assert main([*words, "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["agreement"] == "contradicts"


@pytest.mark.slow
def test_two_processes_in_one_folder_keep_both_results(log, tmp_path):
    words = (*WORDS, "--out", "out", str(log))
    both = [started(*words, "--band", "0.5", high, cwd=tmp_path) for high in ("10", "12")]
    for process in both:
        process.communicate()
    bands = {load_result(tmp_path / name).settings.band for name in ("out", "out-2")}
    assert bands == {(0.5, 10.0), (0.5, 12.0)}


@pytest.mark.slow
def test_an_interrupt_of_a_batch_shows_no_traceback(log, tmp_path):
    for wait in (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2):
        process = started("batch", str(log.parent), "--out", "batch", cwd=tmp_path)
        time.sleep(wait)
        os.killpg(process.pid, signal.SIGINT)
        _, printed = process.communicate()
        assert "jaxquad" not in printed or "Traceback" not in printed


@pytest.mark.slow
@pytest.mark.parametrize("words", [
    ("fuzz_runs.py", "--seconds", "60"), ("fuzz_readers.py", "--cases", "6000", "--workers", "1"),
])  # fmt: skip
def test_a_minute_of_attacks_finds_nothing_bad(words):
    name, *options = words
    ran = subprocess.run(
        [sys.executable, str(ATTACKS / name), *options], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout[-3000:] + ran.stderr[-3000:]
