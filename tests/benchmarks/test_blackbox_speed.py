"""A million rows of a blackbox log, 25 fields each; the target is 3 s.

    python -m pytest tests/benchmarks/test_blackbox_speed.py -o addopts=

The frames between key frames repeat every 64 intervals; every key frame has its own time.
"""

import sys
from pathlib import Path


sys.path.insert(0, str(Path(__file__).parent.parent))

import blackbox_writer as writer
import pytest
from blackbox_rows import rows
from log_writers import decode


ROWS = 1_000_000
INTERVAL = 32


@pytest.fixture(scope="module")
def data():
    written = rows(64 * INTERVAL)
    frames = writer.frames(written)
    between = [b"".join(frames[i + 1 : i + INTERVAL]) for i in range(0, len(frames), INTERVAL)]
    keys = [dict(row) for row in written[::INTERVAL]]
    parts = []
    for i in range(ROWS // INTERVAL):
        shift = i // 64 * 64 * INTERVAL
        now = {"loopIteration": i * INTERVAL, "time": keys[i % 64]["time"] + 125 * shift}
        [frame] = writer.frames([keys[i % 64] | now])
        parts += [frame, between[i % 64]]
    return writer.header() + b"".join(parts) + writer.END


def test_decode(benchmark, data):
    log = benchmark.pedantic(decode, ("betaflight", data), rounds=3)
    assert log.tables[""].time.size == ROWS and log.remarks == ()
