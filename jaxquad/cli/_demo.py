import argparse
from pathlib import Path
from typing import Any

import numpy as np

from ._options import add_json, command, require_identifiable, stdout_for_json


RATE_HZ, GAIN, LAG, DELAY = 250.0, 280.0, 0.02, 0.008  # Hz, rad/s^2 per unit of M, s, s
BAND = (0.5, 12.0)  # Hz
_FEEDBACK = 0.02  # of M per rad/s
_GUST, _CORNER, _NOISE = 2.0, 3.0, 0.01  # rad/s^2, rad/s, rad/s


def write_demo_log(path: Path) -> Path:
    """Write time, reference x0, command M and rate q as CSV; the same at every call."""
    from jaxquad.excitation import sweep
    from jaxquad.workflows import write_whole

    signal = sweep(
        2 * np.pi * 0.4, 2 * np.pi * 15, duration=40, sample_rate=RATE_HZ, amplitude=0.06
    )
    command, rate = _flown(signal.signal)
    columns = (signal.time, signal.signal, command, rate)
    rows = ("{:.6f},{:.8g},{:.8g},{:.8g}\n".format(*row) for row in zip(*columns, strict=True))
    write_whole(path, f"time,x0,M,q\n{''.join(rows)}".encode())
    return path


def _flown(swept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """M = x0 - feedback q, held for a sample; q' = GAIN M(t - delay) behind a lag, and gusts."""
    random = np.random.default_rng(0)
    noise, shocks = random.standard_normal((2, swept.size))
    dt, late = 1 / RATE_HZ, round(DELAY * RATE_HZ)
    stay, hold = np.exp(-dt / LAG), np.exp(-_CORNER * dt)
    command, measured = np.zeros((2, swept.size))
    rate = moment = gust = 0.0
    for k in range(swept.size):
        measured[k] = rate + _NOISE * noise[k]
        command[k] = swept[k] - _FEEDBACK * measured[k]
        held = command[k - late] if k >= late else 0.0
        # The lag's exact mean over the sample, in which its input is constant.
        mean = held + (moment - held) * (1 - stay) * LAG / dt
        rate += dt * (GAIN * mean + gust)
        moment = held + (moment - held) * stay
        gust = hold * gust + _GUST * np.sqrt(1 - hold**2) * shocks[k]
    return command, measured


EXAMPLES = """example:
  jaxquad demo

The log is simulated, so that the answer can be held against the truth, which is printed.
exit codes: 0 done, 2 for a folder that cannot be written
"""
_NEXT = """
The log is simulated: an axis under rate feedback, in gusts, excited by a sweep of the command.
The truth: gain {gain:g}, lag {lag:g} s, delay {delay:g} s, so lag + delay = {sum:.4g} s.
Look at {report}
Then at your own log:
  jaxquad channels YOUR.LOG
  jaxquad identify YOUR.LOG
"""


def add(commands: Any) -> None:
    declared = command(commands, "demo", run, "write a sample log, and identify it", EXAMPLES)
    declared.add_argument("--out", type=Path, default=Path("results/demo"), metavar="FOLDER",
        help="by default results/demo")  # fmt: skip
    add_json(declared, "result.json")


def run(options: argparse.Namespace) -> int:
    from jaxquad.workflows import report_identification

    from ._again import options_of

    log = write_demo_log(options.out / "demo.csv")
    words = ["--input", "M", "--output", "q", "--reference", "x0", "--unit", "q=rad/s"]
    words += ["--band", *(f"{f:g}" for f in BAND), "--out", str(options.out)]
    with stdout_for_json(options):
        path, verdict = report_identification(options_of(["identify", str(log), *words]))
        delay = DELAY + 0.5 / RATE_HZ  # An input that is held is half a sample late.
        report = path.with_name("report.html")
        truth = {"gain": GAIN, "lag": LAG, "delay": delay, "sum": LAG + delay}
        print(_NEXT.format(report=report, **truth))
    if options.json:
        print(path.read_text(), end="")
    require_identifiable(verdict)
    return 0
