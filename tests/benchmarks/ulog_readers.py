"""PX4 logs, sound and damaged, read by jaxquad and by pyulog: time, and rows that are lost.

    python tests/benchmarks/ulog_readers.py --megabytes 50

The rows that a reader gives are compared with those that were written. The log has four topics at
1 kHz and a synchronisation message every 0.5 s, as PX4 writes it.
"""

import argparse
import contextlib
import io
import sys
import tempfile
import time
import warnings
from pathlib import Path


sys.path.insert(0, str(Path(__file__).parent.parent))

import numpy as np
import pyulog
from log_writers import structured, ULog

from jaxquad.records.formats import load_log


TOPICS = {
    "vehicle_angular_velocity": "float[3] xyz;float[3] xyz_derivative;",
    "vehicle_torque_setpoint": "float[3] xyz;",
    "actuator_motors": "float[12] control;",
    "sensor_combined": "float[3] gyro_rad;float[3] accelerometer_m_s2;",
}
NUMBERS = (6, 3, 12, 6)  # of each topic
PART = 500  # samples between synchronisation messages
DAMAGE = ("flipped bit", "noise", "removed", "inserted")


def main() -> None:
    parser = argparse.ArgumentParser(description="Read ULog files by two readers.")
    parser.add_argument("--megabytes", type=float, default=50.0, help="of the log that is timed")
    parser.add_argument("--cases", type=int, default=120, help="damaged copies of a 1 MB log")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.ulg"
        path.write_bytes(written(options.megabytes))
        for name, read in (("jaxquad", by_jaxquad), ("pyulog", by_pyulog)):
            begin = time.process_time()
            rows = sum(len(each) for each in read(path).values())
            print(f"{name}: {time.process_time() - begin:.2f} s of CPU for {rows} rows")
        sound = written(1.0)
        path.write_bytes(sound)
        truth = {name: set(map(bytes, rows)) for name, rows in by_jaxquad(path).items()}
        total = sum(map(len, truth.values()))
        for i, kind in enumerate(DAMAGE):
            lost = {"jaxquad": [], "pyulog": []}
            for number in range(options.cases // len(DAMAGE)):
                path.write_bytes(damaged(sound, kind, np.random.default_rng([i, number])))
                for name, read in (("jaxquad", by_jaxquad), ("pyulog", by_pyulog)):
                    lost[name].append(total - true_rows(read(path), truth))
            said = (f"{n} {np.mean(each):.0f} (most {max(each)})" for n, each in lost.items())
            print(f"{kind}: of {total} rows lost: {', '.join(said)}")


def written(megabytes: float) -> bytes:
    random = np.random.default_rng(0)
    log = ULog()
    for name, fields in TOPICS.items():
        log.define(f"{name}:uint64_t timestamp;{fields}")
    for number, name in enumerate(TOPICS):  # Only after the definitions, by the specification.
        log.subscribe(number, name)
    begin = 1_000_000
    while len(log.content) < 1e6 * megabytes:
        stamps = (begin + 1000 * np.arange(PART)).astype("<u8")
        tables = []
        for count in NUMBERS:
            values = random.standard_normal((PART, count)).astype("<f4")
            tables.append(structured({"t": ("<u8", stamps), "x": (f"({count},)<f4", values)}))
        for k in range(PART):
            for number, table in enumerate(tables):
                log.write_rows(number, table[k : k + 1])
        log.sync()
        begin += 1000 * PART
    return bytes(log.content)


def damaged(content: bytes, kind: str, random: np.random.Generator) -> bytes:
    """The log with one to four places of up to 300 bytes damaged behind its definitions."""
    data = bytearray(content)
    for _ in range(random.integers(1, 5)):
        at, size = int(random.integers(2000, len(data) - 2000)), int(random.integers(1, 300))
        if kind == "flipped bit":
            data[at] ^= 1 << int(random.integers(8))
        elif kind == "noise":
            data[at : at + size] = random.bytes(size)
        elif kind == "removed":
            del data[at : at + size]
        else:
            data[at:at] = random.bytes(size)
    return bytes(data)


def by_jaxquad(path: Path) -> dict[str, np.ndarray]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        tables = load_log(path).tables
    return {name: rows(each.time, each.columns.values()) for name, each in tables.items()}


def by_pyulog(path: Path) -> dict[str, np.ndarray]:
    with contextlib.redirect_stdout(io.StringIO()):
        topics = pyulog.ULog(str(path)).data_list
    return {
        each.name: rows(
            1e-6 * each.data["timestamp"], [v for k, v in each.data.items() if k != "timestamp"]
        )
        for each in topics
    }


def rows(stamps, columns) -> np.ndarray:
    """Time and values, one row after the other, in numbers that compare by their bytes."""
    blocks = [each.reshape(len(stamps), -1) for each in (stamps, *columns)]
    with np.errstate(invalid="ignore"):  # Damaged numbers may be signalling NaNs.
        return np.ascontiguousarray(np.concatenate(blocks, axis=1, dtype=np.float64))


def true_rows(found: dict[str, np.ndarray], truth: dict[str, set[bytes]]) -> int:
    return sum(bytes(row) in truth.get(name, ()) for name, each in found.items() for row in each)


if __name__ == "__main__":
    main()
