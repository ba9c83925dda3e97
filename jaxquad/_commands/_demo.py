import argparse
from pathlib import Path
from typing import Any

from ._options import add_json, command, stdout_for_json


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
    from jaxquad._identification import report_identification

    from ._again import options_of
    from ._demo_log import BAND, DELAY, GAIN, LAG, RATE_HZ, write_demo_log

    log = write_demo_log(options.out / "demo.csv")
    words = ["--input", "M", "--output", "q", "--reference", "x0", "--unit", "q=rad/s"]
    words += ["--band", *(f"{f:g}" for f in BAND), "--out", str(options.out)]
    with stdout_for_json(options):
        path, failure = report_identification(options_of(["identify", str(log), *words]))
        delay = DELAY + 0.5 / RATE_HZ  # An input that is held is half a sample late.
        report = path.with_name("report.html")
        truth = {"gain": GAIN, "lag": LAG, "delay": delay, "sum": LAG + delay}
        print(_NEXT.format(report=report, **truth))
    if options.json:
        print(path.read_text(), end="")
    if failure is not None:
        raise failure
    return 0
