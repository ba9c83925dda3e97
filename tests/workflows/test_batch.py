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

from jaxquad.workflows import batch, BatchSettings, find_logs, Override, SettingsError


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


@pytest.mark.slow
def test_ten_thousand_logs_are_planned_and_none_is_opened(tmp_path):
    for k in range(10_000):
        os.close(os.open(tmp_path / f"flight_{k:05}.bin", os.O_CREAT))
    opened, watching = [], [True]
    look = lambda event, args: opened.append(args[0]) if watching and event == "open" else None
    sys.addaudithook(look)
    found = find_logs(tmp_path, BatchSettings(logs="*.bin"))
    watching.clear()
    assert len(found) == 10_000 and found == sorted(found)
    assert not [path for path in opened if str(path).endswith(".bin")]


@pytest.mark.slow
def test_a_batch_that_is_killed_loses_nothing_and_does_nothing_twice(tmp_path):
    folder, out = logs(tmp_path / "logs", [f"{k}.csv" for k in range(60)]), tmp_path / "out"
    moments, before = random.Random(7), set()
    for _ in range(3):
        running = subprocess.Popen([sys.executable, batch_work.__file__, str(folder), str(out)])
        wanted = len(before) + moments.randint(2, 12)
        while len(list(out.glob("results/*.json"))) < wanted:
            assert running.poll() is None
            time.sleep(0.01)
        time.sleep(moments.random() * 0.1)
        running.send_signal(signal.SIGKILL)
        running.wait()
        wait_for_the_end_of({process for _, process in started(out)})
        assert before <= set(results(out))
        before, so_far = set(results(out)), len(started(out))
    rows = batch(folder, BatchSettings(workers=2), out=out, work=measure)
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


@pytest.mark.slow
def test_one_failing_log_is_a_row_and_stops_no_other(tmp_path):
    names = ["a.csv", "b.csv", "defect.csv", "killed.csv", "unusable.csv", "z.csv"]
    folder, out = logs(tmp_path / "logs", names), tmp_path / "out"
    batch(folder, BatchSettings(workers=2), out=out, work=fail)
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


@pytest.mark.slow
def test_a_log_that_hangs_has_failed_and_stops_no_other(tmp_path):
    names = ["a.csv", "b.csv", "c.csv", "hangs.csv", "killed.csv"]
    folder, out = logs(tmp_path / "logs", names), tmp_path / "out"
    run = lambda limit: batch(folder, BatchSettings(timeout=limit, workers=2), out=out, work=fail)
    run(12.0)  # s: a process starts within a few
    found = rows_of(out)
    assert [found[name]["status"] for name in names] == 3 * ["identified"] + 2 * ["failed"]
    assert found["hangs.csv"]["error"] == "it took longer than 12 s: raise the timeout (--timeout)"
    assert "killed by signal 9" in found["killed.csv"]["error"]
    # With all that it had started.
    wait_for_the_end_of({int((out / "reader").read_text())})
    before = len(started(out))
    run(12.0)
    assert len(started(out)) == before  # What hung is known to have hung.
    run(13.0)
    assert len(started(out)) == before + 1  # It had less time.


def test_equal_logs_share_a_result_and_settings_make_it_another(tmp_path):
    folder, out = logs(tmp_path / "logs", ["a.csv"]), tmp_path / "out"
    (folder / "copy.csv").write_text("a.csv")
    run = lambda **how: batch(folder, BatchSettings(workers=1, **how), out=out, work=measure)
    assert [row["log"] for row in run()] == ["a.csv", "copy.csv"]
    assert len(results(out)) == len(started(out)) == 1
    run(identify={"rate": 100})
    assert len(results(out)) == len(started(out)) == 2
    run(overrides=[Override(("copy*",), {"rate": 100})])
    assert len(started(out)) == 2  # Both are known by now.


def test_a_folder_has_one_batch_at_a_time(tmp_path):
    fcntl = pytest.importorskip("fcntl")
    folder, out = logs(tmp_path / "logs", ["a.csv"]), tmp_path / "out"
    out.mkdir()
    with (out / ".lock").open("w") as other, pytest.raises(ValueError, match="another batch"):
        fcntl.flock(other, fcntl.LOCK_EX)
        batch(folder, BatchSettings(workers=1), out=out, work=measure)


def test_settings_that_exclude_each_other_stop_a_batch_before_the_first_log(tmp_path):
    folder, out = logs(tmp_path / "logs", ["a.csv", "b.csv"]), tmp_path / "out"
    settings = BatchSettings(overrides=[Override(("b*",), {"input": "M"})])
    with pytest.raises(SettingsError, match="settings of b.csv: input and output belong together"):
        batch(folder, settings, out=out, work=measure)
    assert not started(out)


def test_a_table_is_parquet_too_and_holds_no_formula(tmp_path):
    """A spreadsheet must not run what a file's name says."""
    parquet = pytest.importorskip("pyarrow.parquet")
    folder, out = logs(tmp_path / "logs", ["=cmd()", "lost", "b"]), tmp_path / "out"
    batch(folder, BatchSettings(workers=1), out=out, work=fail)
    table = parquet.read_table(out / "table.parquet").to_pydict()
    assert table["log"] == ["=cmd()", "b", "lost"] and table["size"] == [6.0, 1.0, None]
    assert table["error"][2] == "lost ?" and list(rows_of(out))[0] == "'=cmd()"
