"""Time to the first answer: whole processes, without and with compiled programs from disk."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from resource import getrusage, RUSAGE_CHILDREN
from typing import NamedTuple


sys.path.insert(0, str(Path(__file__).parent.parent))
from px4_flights import Vehicle, write_log


ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("JAXQUAD_DATA", ROOT / ".." / "shared" / "data"))
LOG = DATA / "antx_pitch" / "antx_log3_prbs.npz"
COMMAND = (str(Path(sys.executable).with_name("jaxquad")),)
IDENTIFY = (*COMMAND, "identify", str(LOG), "--input", "M", "--output", "q", "--reference", "x0")
IDENTIFY = (*IDENTIFY, "--rate", "250", "--unit", "q=rad/s", "--quiet", "--out", "antx")
FLIGHT = "flight.ulg"
AUTOPILOT = (*COMMAND, "autopilot", FLIGHT, "--axis", "roll", "--quiet")


class Job(NamedTuple):
    """What a user starts; `after` is what has to have run in the same folder before."""

    name: str
    command: Sequence[str]
    after: Sequence[str] = ()


class Times(NamedTuple):
    """Seconds by the clock, and of all processors."""

    wall: float
    processor: float


JOBS = (
    Job("`import jaxquad`", (sys.executable, "-c", "import jaxquad")),
    Job("`jaxquad --help`", (*COMMAND, "--help")),
    Job("`jaxquad identify`, report and figures", IDENTIFY),
    Job(
        "`jaxquad tune` on its result",
        (*COMMAND, "tune", "antx", "--inertia", "0.0552", "--limit", "1", "--quiet"),
        IDENTIFY,
    ),
    Job("`jaxquad autopilot` on a simulated flight of 30 s", AUTOPILOT),
    Job("the README's main job", (sys.executable, str(ROOT / "fits" / "hover_roll.py"))),
)


def measured(rounds: int) -> list[list[str]]:
    """Rows of the table: each job without compiled programs on disk, and with them."""
    jobs = [job for job in JOBS if LOG.is_file() or str(LOG) not in (*job.command, *job.after)]
    vehicle = Vehicle()
    with tempfile.TemporaryDirectory() as folder:
        flight = write_log(Path(folder) / FLIGHT, vehicle.fly(), vehicle.parameters)
        return [_row(job, rounds, flight.read_bytes()) for job in jobs]


def _row(job: Job, rounds: int, flight: bytes) -> list[str]:
    with tempfile.TemporaryDirectory() as cache:
        kept = {"XDG_CACHE_HOME": cache}  # where the command line keeps its programs
        cold = _median([_run(job, flight, {"JAXQUAD_CACHE": "off"}) for _ in range(rounds)])
        _run(job, flight, kept)
        again = _median([_run(job, flight, kept) for _ in range(rounds)])
    numbers = (cold.wall, cold.processor, again.wall, again.processor)
    return [job.name, *(f"{number:.2g}" if number < 10 else f"{number:.0f}" for number in numbers)]


def _run(job: Job, flight: bytes, told: dict[str, str]) -> Times:
    # Modules are kept compiled, as after an installation.
    other = ("JAX_", "PYTHONDONTWRITEBYTECODE")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(other)}
    environment |= told
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / FLIGHT).write_bytes(flight)
        if job.after:
            _process(job.after, folder, environment)
        return _process(job.command, folder, environment)


def _process(command: Sequence[str], folder: str, environment: dict[str, str]) -> Times:
    used, began = getrusage(RUSAGE_CHILDREN), time.perf_counter()
    ran = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    wall, now = time.perf_counter() - began, getrusage(RUSAGE_CHILDREN)
    if ran.returncode not in (0, 4):  # 4: a design that is not to be flown
        raise RuntimeError(f"{' '.join(command)} ended with {ran.returncode}: {ran.stderr[-500:]}")
    return Times(wall, now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime)


def _median(times: Sequence[Times]) -> Times:
    return sorted(times)[len(times) // 2]
