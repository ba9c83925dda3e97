"""Rows for blackbox_writer: a flight that no one flew, with steps of every size."""

import blackbox_writer as writer
import numpy as np


LEVEL = {"motor[0]": 400, "motor[1]": 410, "motor[2]": 420, "motor[3]": 390, "servo[5]": 1500}
LEVEL |= {"vbatLatest": 1640, "rssi": 900, "rcCommand[3]": 1300}


def rows(count, *, seed=0, start=5_000_000, iterations=None, largest=40):
    """`count` rows of a random walk whose steps reach about `largest`; time in us."""
    random = np.random.default_rng(seed)
    state = {name: LEVEL.get(name, 0) for name in writer.NAMES}
    iterations = range(count) if iterations is None else iterations
    result = []
    for iteration in iterations:
        for name in writer.NAMES[2:]:
            step = int(random.normal() * random.choice([0, 1, 5, largest]))
            state[name] = _allowed(name, state[name], step)
        time = start + 125 * iteration + int(random.integers(-5, 6))
        result.append({**state, "loopIteration": iteration, "time": time % 2**32})
    return result


def _allowed(name, value, step):
    if name.startswith("rcCommand"):  # TAG8_4S16 has 16 bits for a step.
        step = max(-32768, min(32767, step))
    if name == "vbatLatest":  # 14 bits
        return 1500 + abs(value + step) % 300
    return abs(value + step) % 60_000 if name in writer.UNSIGNED else value + step


def log(written, *, interval=32, logged="1/1", changed=None):
    """The bytes of a whole log."""
    frames = writer.frames(written, interval=interval)
    header = writer.header(interval=interval, logged=logged, changed=changed or {})
    return header + b"".join(frames) + writer.END


def table(rows_):
    """The rows as an integer array, a column for each of the writer's names."""
    return np.array([[row[name] for name in writer.NAMES] for row in rows_])


def decoded(main):
    """The same of a decoded table, its time in us modulo 2^32."""
    micros = np.round(main.time * 1e6).astype(np.int64) % 2**32
    columns = [micros if name == "time" else main.columns[name] for name in writer.NAMES]
    return np.stack([np.asarray(column, np.int64) for column in columns], axis=1)


def clock(table_):
    """The time stamps of a table (s), which it has to have."""
    assert table_.time is not None
    return table_.time
