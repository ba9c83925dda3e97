"""A batch on a Dask cluster: two workers on this machine, one of which is killed in the middle."""

import pytest
from batch_work import die_once, started

from jaxquad.cli import main
from jaxquad.workflows import batch, BatchSettings


@pytest.mark.slow
def test_a_killed_worker_of_a_cluster_loses_no_log(tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs pip install jaxquad[cluster]")
    folder, out = tmp_path / "logs", tmp_path / "out"
    folder.mkdir()
    for k in range(12):
        (folder / f"{k:02}.csv").write_text(f"{k}")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs="CRITICAL"
    ) as cluster:
        settings = BatchSettings(scheduler=cluster.scheduler_address)
        rows = batch(folder, settings, out=out, work=die_once)
        again = batch(folder, settings, out=out, work=die_once)
    assert (out / "died").exists()
    assert [row["status"] for row in rows] == ["identified"] * 12
    assert len(list(out.glob("results/*.json"))) == 12
    assert again == rows and len(started(out)) == 12


def test_a_scheduler_that_is_not_there_is_one_line(tmp_path, capsys, monkeypatch):
    pytest.importorskip("distributed", reason="needs pip install jaxquad[cluster]")
    monkeypatch.setattr("jaxquad.workflows._batch_workers.PATIENCE", 0.2)
    (tmp_path / "a.csv").write_text("a")
    words = ["batch", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([*words, "--scheduler", "tcp://127.0.0.1:9"]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("jaxquad: error: no Dask scheduler at tcp://127.0.0.1:9")
