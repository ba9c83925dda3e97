"""Stand-ins for an identification, quick and willing to fail; and a batch to be killed.

python tests/batch_work.py FOLDER OUT
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from jaxquad.workflows import batch, BatchSettings, Job


def measure(job: Job) -> dict:
    """The length of the log; each start is noted, and takes a while."""
    _note(job)
    time.sleep(0.05)
    size = len(Path(job.log).read_bytes())
    row = {"name": "size", "value": float(size), "standard_error": None}
    return {"status": "identified", "parameters": [row], "remarks": ["counted"]}


def fail(job: Job) -> dict:
    """As the name of the log says."""
    name = Path(job.log).name
    if name.startswith("unusable"):
        raise ValueError(f"{name}: <b>no clock</b>")
    if name.startswith("lost"):
        raise ValueError("lost \ud800")
    if name.startswith("defect"):
        raise ZeroDivisionError("a defect")
    if name.startswith("killed"):
        os.kill(os.getpid(), signal.SIGKILL)
    if name.startswith("hangs"):
        _note(job)
        reader = subprocess.Popen(["sleep", "600"])
        (Path(job.out) / "reader").write_text(str(reader.pid))
        while True:
            time.sleep(600)
    return measure(job)


def die_once(job: Job) -> dict:
    """The first process that is asked is killed; the others take their time."""
    mark = Path(job.out) / "died"
    try:
        mark.touch(exist_ok=False)
    except FileExistsError:
        return measure(job)
    os.kill(os.getpid(), signal.SIGKILL)
    return {}


def started(out: Path) -> list[tuple[str, int]]:
    """The keys of the jobs in the order of their starts, and by which process."""
    notes = out / "started.txt"
    lines = notes.read_text().splitlines() if notes.exists() else []
    return [(key, int(process)) for key, process in map(str.split, lines)]


def _note(job: Job) -> None:
    with (Path(job.out) / "started.txt").open("ab", buffering=0) as notes:
        notes.write(f"{job.key} {os.getpid()}\n".encode())


if __name__ == "__main__":
    batch(sys.argv[1], BatchSettings(workers=2), out=sys.argv[2], work=measure)
