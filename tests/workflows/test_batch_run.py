"""A fleet's logs: planned without opening them, resumed after any death, one row each."""

import csv
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import batch_work
import pytest
from batch_work import fail, measure, started

from jaxquad.workflows import planned, read_settings, run_batch, Settings
from jaxquad.workflows._batch._settings import settings_of


def logs(folder: Path, names) -> Path:
    """Each with a content of its own."""
    folder.mkdir()
    for name in names:
        (folder / name).write_text(name)
    return folder


def rows_of(out: Path) -> dict[str, dict[str, str]]:
    with (out / "table.csv").open(newline="") as file:
        return {row["log"]: row for row in csv.DictReader(file)}


def results(out: Path) -> dict[str, dict]:
    return {path.stem: json.loads(path.read_text()) for path in out.glob("results/*.json")}


def test_ten_thousand_logs_are_planned_and_none_is_opened(tmp_path):
    for k in range(10_000):
        os.close(os.open(tmp_path / f"flight_{k:05}.bin", os.O_CREAT))
    opened, watching = [], [True]
    look = lambda event, args: opened.append(args[0]) if watching and event == "open" else None
    sys.addaudithook(look)
    found = planned(tmp_path, Settings(logs=("*.bin",)))
    watching.clear()
    assert len(found) == 10_000 and found == sorted(found)
    assert not [path for path in opened if str(path).endswith(".bin")]


def test_a_batch_that_is_killed_loses_nothing_and_does_nothing_twice(tmp_path):
    folder, out = logs(tmp_path / "logs", [f"{k}.csv" for k in range(60)]), tmp_path / "out"
    moments, before = random.Random(7), set()
    for _ in range(3):
        batch = subprocess.Popen([sys.executable, batch_work.__file__, str(folder), str(out)])
        wanted = len(before) + moments.randint(2, 12)
        while len(list(out.glob("results/*.json"))) < wanted:
            assert batch.poll() is None
            time.sleep(0.01)
        time.sleep(moments.random() * 0.1)
        batch.send_signal(signal.SIGKILL)
        batch.wait()
        wait_for_the_end_of({process for _, process in started(out)})
        assert before <= set(results(out))
        before, so_far = set(results(out)), len(started(out))
    rows = run_batch(folder, Settings(), out=out, work=measure, workers=2)
    assert not before & {key for key, _ in started(out)[so_far:]}
    assert len(rows) == len(results(out)) == 60
    assert {row["status"] for row in rows} == {"identified"}
    # What was under way when the batch was killed: two processes, three times.
    assert 60 <= len(started(out)) <= 60 + 2 * 3
    assert not list(out.rglob("*.part"))


def wait_for_the_end_of(processes):
    deadline = time.monotonic() + 20
    for process in processes:
        while alive(process):
            assert time.monotonic() < deadline, f"process {process} outlives its batch"
            time.sleep(0.01)


def alive(process: int) -> bool:
    """A process that ended, but whose parent has not asked for it, counts as ended."""
    try:
        return ") Z" not in Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False


def test_one_failing_log_is_a_row_and_stops_no_other(tmp_path):
    names = ["a.csv", "b.csv", "defect.csv", "killed.csv", "unusable.csv", "z.csv"]
    folder, out = logs(tmp_path / "logs", names), tmp_path / "out"
    run_batch(folder, Settings(), out=out, work=fail, workers=2)
    found = rows_of(out)
    assert list(found) == names
    good = [name for name, row in found.items() if row["status"] == "identified"]
    assert good == ["a.csv", "b.csv", "z.csv"] and found["z.csv"]["size"] == "5.0"
    assert "no clock" in found["unusable.csv"]["error"]
    assert found["defect.csv"]["error"] == "ZeroDivisionError: a defect"
    assert "killed by signal 9" in found["killed.csv"]["error"]
    # What is wrong with the log stays so; a defect or a death is tried again.
    assert len(results(out)) == 4
    page = (out / "summary.html").read_text()
    assert "3 failed" in page and "&lt;b&gt;no clock" in page and "<b>no clock" not in page


def test_a_log_that_hangs_has_failed_and_stops_no_other(tmp_path):
    names = ["a.csv", "b.csv", "c.csv", "hangs.csv", "killed.csv"]
    folder, out = logs(tmp_path / "logs", names), tmp_path / "out"
    run = lambda limit: run_batch(folder, Settings(timeout=limit), out=out, work=fail, workers=2)
    run(12.0)  # s: a process starts within a few
    found = rows_of(out)
    assert [found[name]["status"] for name in names] == 3 * ["identified"] + 2 * ["failed"]
    assert found["hangs.csv"]["error"] == "it took longer than 12 s: see --timeout"
    assert "killed by signal 9" in found["killed.csv"]["error"]
    # With all that it had started.
    wait_for_the_end_of({int((out / "reader").read_text())})
    before = len(started(out))
    run(12.0)
    assert len(started(out)) == before  # What hung is known to have hung.
    run(13.0)
    assert len(started(out)) == before + 1  # It had less time.


@pytest.mark.parametrize("limit", [0, -1, float("inf"), float("nan")])
def test_a_limit_that_is_none_is_refused(tmp_path, limit):
    folder = logs(tmp_path / "logs", ["a.csv"])
    with pytest.raises(ValueError, match="timeout is .*: give a number of s above 0"):
        run_batch(folder, Settings(), out=tmp_path / "out", work=measure, timeout=limit)


def test_a_limit_on_a_cluster_is_refused(tmp_path):
    folder, limited = logs(tmp_path / "logs", ["a.csv"]), Settings(timeout=9)
    with pytest.raises(ValueError, match="leave it out with a scheduler"):
        run_batch(folder, limited, out=tmp_path / "out", work=measure, scheduler="tcp://none:1")


def test_equal_logs_share_a_result_and_settings_make_it_another(tmp_path):
    folder, out = logs(tmp_path / "logs", ["a.csv"]), tmp_path / "out"
    (folder / "copy.csv").write_text("a.csv")
    run = lambda s: run_batch(folder, s, out=out, work=measure, workers=1)
    assert [row["log"] for row in run(Settings())] == ["a.csv", "copy.csv"]
    assert len(results(out)) == len(started(out)) == 1
    run(Settings(common={"rate": 100}))
    assert len(results(out)) == len(started(out)) == 2
    run(Settings(overrides=((("copy*",), {"rate": 100}),)))
    assert len(started(out)) == 2  # Both are known by now.


def test_a_folder_has_one_batch_at_a_time(tmp_path):
    from jaxquad.workflows._batch._store import locked

    folder = logs(tmp_path / "logs", ["a.csv"])
    with locked(tmp_path / "out"), pytest.raises(ValueError, match="another batch"):
        run_batch(folder, Settings(), out=tmp_path / "out", work=measure, workers=1)


def test_a_table_is_parquet_too(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    from jaxquad.workflows._batch._tables import write_tables

    rows = [
        {"log": "=cmd()", "status": "failed", "key": "k", "error": "lost \ud800"},
        {"log": "b", "status": "identified", "key": "l", "parameters": [
            {"name": "gain", "value": 2.5, "standard_error": None}]},
    ]  # fmt: skip
    write_tables(tmp_path, rows)
    table = parquet.read_table(tmp_path / "table.parquet").to_pydict()
    assert table["gain"] == [None, 2.5] and table["log"][1] == "b"
    # A spreadsheet must not run what a file's name says.
    assert list(rows_of(tmp_path))[0] == "'=cmd()"


def test_settings_are_read_with_overrides_by_glob(tmp_path):
    path = tmp_path / "fleet.toml"
    path.write_text("""
logs = ["*.npz", "old/*.csv"]
input = "M=right-left"
output = "q"
band = [0.5, 6]
lag = false
[units]
q = "rad/s"
[[override]]
logs = "old/*"
output = "gyro"
[[override]]
logs = "old/7*"
rate = 50
""")
    settings = read_settings(path)
    assert settings.logs == ("*.npz", "old/*.csv")
    assert settings.of("new.npz")["output"] == "q" and "rate" not in settings.of("old/6.csv")
    assert settings.of("old/7.csv") == settings.of("old/6.csv") | {"rate": 50}
    assert settings.of("old/7.csv")["output"] == "gyro"


def test_an_override_replaces_what_says_the_same_in_another_way():
    settings = settings_of(
        {
            "start": 5, "stop": 9, "band": [1, 2],
            "override": [
                {"logs": "a*", "segments": [[1, 2], [3, 4]], "band_rad": [2, 9]},
                {"logs": "ab", "stop": 7},
            ],
        }
    )  # fmt: skip
    assert settings.of("a") == {"segments": [[1, 2], [3, 4]], "band_rad": [2, 9]}
    assert settings.of("ab") == {"stop": 7, "band_rad": [2, 9]}
    assert settings.of("b") == {"start": 5, "stop": 9, "band": [1, 2]}


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ({"estimater": "welch"}, "unknown key 'estimater'; did you mean 'estimator'"),
        ({"override": [{"logs": "a", "ouput": "q"}]}, "override 1: .*did you mean 'output'"),
        ({"override": [{"output": "q"}]}, "says of no logs"),
        ({"rate": "fast"}, "rate = 'fast' has to be of kind int or float"),
        ({"poles": True}, "poles = True has to be of kind int"),
        ({"estimator": "best"}, "'best' is none of local, composite, welch"),
        ({"band": [3, 1]}, "rising from above 0"),
        ({"input": "roll=a b"}, "input: 'roll=a b': cannot read"),
        ({"logs": "/etc/*"}, "below the folder"),
        ({"timeout": "long"}, "timeout = 'long' has to be a number of s above 0"),
        ({"segments": [[3, 1]]}, r"one of segments = \[3, 1\] has to be"),
        ({"segments": [5, 9]}, "one of segments = 5 has to be"),
        ({"segments": [[1, 2]], "start": 0}, "leave start, stop out"),
        ({"band": [1, 2], "band_rad": [1, 2]}, "keep one"),
    ],
)
def test_settings_that_cannot_be_say_what_to_mend(content, complaint):
    with pytest.raises(ValueError, match=complaint):
        settings_of(content)
