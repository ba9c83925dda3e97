import argparse
from pathlib import Path
from typing import Any

from ._options import (
    add_log,
    command,
    read_mix,
    read_segment,
    read_unit,
    require_identifiable,
    SECONDS,
    stdout_for_json,
)


EXAMPLES = """examples:
  jaxquad identify flight.ulg
  jaxquad identify flight.npz --input M --output q --reference x0 --rate 250 --start 50 --stop 76
  jaxquad identify flight.csv --input "roll=-m1-m2+m3+0.5*m4" --output p --band 0.7 12 --no-lag
  jaxquad identify flight.csv --input elevator --output q --integrators 0 --poles 3 --zeros 1
  jaxquad identify flight.csv --input p_cmd --output p --segment 22:30 --segment 41:49.5
  jaxquad identify log15 --input "roll=-motor.m1^2-motor.m2^2+motor.m3^2+motor.m4^2" --output gyro.x
  jaxquad identify a.npz --input "cmd[0]" --output "rate[0]" --verify b.npz --json > fit.json

Without --input and --output the log of a known autopilot says what they are; the line that this
stands for is printed. Weights and powers of an input make a torque of motors with a thrust curve.
exit codes: 0 done, 2 for what cannot be used, 3 where the record does not determine the parameters
"""
TEXT = "fit K e^(-delay s) / (s^n (lag s + 1)) to a record"


def add(commands: Any) -> None:
    declared = command(commands, "identify", run, TEXT, EXAMPLES)
    add_log(declared)
    _add_channels(declared)
    _add_model(declared)
    _add_estimate(declared)
    add = declared.add_argument
    add("--verify", type=Path, metavar="FILE", help="a record with the same channels to simulate")
    add("--verify-start", help="in that file's time", **SECONDS)
    add("--verify-stop", help="in that file's time", **SECONDS)
    add("--out", type=Path, metavar="FOLDER", help="by default results/NAME of the file")
    add("--json", action="store_true", help="result.json to stdout, and the report to stderr")


def run(options: argparse.Namespace) -> int:
    from jaxquad.workflows import report_identification

    with stdout_for_json(options):
        path, verdict = report_identification(options)
    if options.json:
        print(path.read_text(), end="")
    require_identifiable(verdict)
    return 0


def _add_channels(declared: argparse.ArgumentParser) -> None:
    add = declared.add_argument
    add("--input", type=read_mix, help="a channel, or NAME=-a+b+0.5*c, with powers: NAME=0.1*a^2")
    add("--output", type=read_mix, help="likewise")
    add("--reference", type=read_mix, help="an outside signal that no feedback computes")
    add("--axis", choices=("roll", "pitch", "yaw"), help="to propose input and output for")
    add("--unit", type=read_unit, action="append", default=[], metavar="NAME=UNIT",
        help="of a channel, such as q=rad/s; may be repeated")  # fmt: skip
    add("--rate", type=float, metavar="HZ", help="to resample to; by default the file's own")
    add("--start", help="in the file's time", **SECONDS)
    add("--stop", help="in the file's time", **SECONDS)
    add("--segment", type=read_segment, action="append", default=[], metavar="START:STOP",
        help="instead of both of these; repeated, all segments are analysed together")  # fmt: skip
    band = declared.add_mutually_exclusive_group()
    for name, unit in (("--band", "Hz"), ("--band-rad", "rad/s")):
        text = f"{unit}, to fit within; by default what the record resolves"
        band.add_argument(name, type=float, nargs=2, metavar=("LOW", "HIGH"), help=text)


def _add_model(declared: argparse.ArgumentParser) -> None:
    add = declared.add_argument
    add("--integrators", type=int, default=1, help="n: 1 from a moment to a rate, 2 to an angle")
    add("--no-lag", action="store_true", help="a model without a lag")
    add("--no-delay", action="store_true", help="a model without a delay")
    add("--poles", type=int, metavar="N", help="fit a transfer function of so many poles beside "
        "the integrators, instead of a lag")  # fmt: skip
    add("--zeros", type=int, metavar="N", default=0, help="and of so many zeros")


def _add_estimate(declared: argparse.ArgumentParser) -> None:
    add = declared.add_argument
    add("--estimator", choices=("local", "composite", "welch"), default="local",
        help="local polynomials, composite windows, or windows of one length")  # fmt: skip
    add("--window", help="length of a window for welch, a fifth of the record by default",
        **SECONDS)  # fmt: skip
    add("--cost", choices=("ml", "coherence"), default="ml",
        help="maximum likelihood, or CIFER's coherence-weighted cost, Eq. (14)")  # fmt: skip
