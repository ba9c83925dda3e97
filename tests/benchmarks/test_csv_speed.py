"""A text table of a million rows and 43 columns; the target is 3 s and 1 GB, with pyarrow.

    python -m pytest tests/benchmarks/test_csv_speed.py -o addopts=

NumPy's own parser of the same cells, without any check, is the peer.
"""

import resource

import numpy as np
import pytest

from jaxquad.records.formats import load_log


ROWS, COLUMNS = 1_000_000, 43
ALIKE = 1000  # rows, repeated


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    cells = np.random.default_rng(0).integers(-99_999, 99_999, (ALIKE, COLUMNS)) / 1000
    rows = "".join(",".join(map(str, row)) + "\n" for row in cells.tolist())
    path = tmp_path_factory.mktemp("long") / "long.csv"
    with path.open("w") as file:
        file.write(",".join(f"c{k}" for k in range(COLUMNS)) + "\n")
        for _ in range(ROWS // ALIKE):
            file.write(rows)
    yield path
    path.unlink()


def test_read(benchmark, table):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    log = benchmark.pedantic(load_log, (table,), rounds=1)
    assert all(column.size == ROWS for column in log.tables[""].columns.values())
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert after - before < 800_000  # kB; the package itself takes less than 200,000


def test_numpy_alone(benchmark, table):
    content = table.read_bytes()
    text = content[content.index(b"\n") :].replace(b",", b" ").decode()
    benchmark.pedantic(np.fromstring, (text,), {"sep": " "}, rounds=1)
