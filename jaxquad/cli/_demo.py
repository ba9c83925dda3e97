"""`jaxquad demo`: a log whose true model is known, on its way through identify or autopilot."""

import argparse
from pathlib import Path

from jaxquad.workflows import AutopilotSettings

from ._autopilot import run_autopilot
from ._identify import finish_identification
from ._options import (
    add_force,
    add_json,
    add_out,
    add_output,
    Command,
    start_computing,
)
from ._progress import add_quiet


_NEXT = """

The log is simulated: one axis under rate feedback, in gusts, excited by a sweep of its command.
True values: gain {gain:g}, lag {lag:g} s, delay {delay:g} s, so lag + delay = {sum:.4g} s.
Look at {{report}}
Then identify your own log:
  jaxquad channels YOUR.LOG
  jaxquad identify YOUR.LOG"""


def _add(declared: argparse.ArgumentParser) -> None:
    text = "identify a measured flight instead: a quadrotor on a pitch test stand (JAXQUAD_DATA)"
    source = declared.add_mutually_exclusive_group()
    source.add_argument("--flight", action="store_true", help=text)
    text = "tune the gains of a simulated Betaflight chirp flight instead, to a parameter file"
    source.add_argument("--autopilot", action="store_true", help=text)
    output = add_output(declared)
    add_out(output, "results/demo, demo_flight or demo_autopilot")
    add_force(output)
    add_json(output, "result.json, or autopilot.json,")
    add_quiet(output)


def _run(options: argparse.Namespace) -> int:
    if options.flight:
        return _measured(options)
    return _chirp(options) if options.autopilot else _stand(options)


def _stand(options: argparse.Namespace) -> int:
    start_computing()
    from jaxquad.workflows import DEMO, DEMO_TRUTH, identify, write_demo_log

    folder = options.out or Path("results/demo")
    log = write_demo_log(folder / "demo.csv")
    note = _NEXT.format(**DEMO_TRUTH, sum=DEMO_TRUTH["lag"] + DEMO_TRUTH["delay"])
    return finish_identification(options, identify(log, DEMO), folder, note)


_NEXT_FLIGHT = """

The flight is measured: an ANT-X quadrotor on a pitch test stand in closed loop, with a binary
sequence on the set-point x0 of its position.
Look at {report}"""


def _measured(options: argparse.Namespace) -> int:
    from jaxquad.workflows import find_demo_flight

    log, settings = find_demo_flight()  # before JAX: it may have nothing to compute
    start_computing()
    from jaxquad.workflows import identify

    folder = options.out or Path("results/demo_flight")
    return finish_identification(options, identify(log, settings), folder, _NEXT_FLIGHT)


_NEXT_CHIRP = """

The log is simulated, as Betaflight 2026.6 writes it: a 5-inch quadrotor with default gains rests,
takes off, and flies a chirp on roll from 0.5 to 40 Hz, in gusts and gyro noise.
True plant of roll: gain {gain:g}, lag {lag:g} s, delay {delay:g} s.
Look at {{page}}
Then your own log:
  jaxquad autopilot YOUR.BFL"""


def _chirp(options: argparse.Namespace) -> int:
    from jaxquad.autopilot import CHIRP_TRUTH, write_chirp_log

    folder = options.out or Path("results/demo_autopilot")
    write = lambda: write_chirp_log(folder / "demo.bfl")
    settings = AutopilotSettings(axis="roll")
    return run_autopilot(options, write, settings, folder, _NEXT_CHIRP.format(**CHIRP_TRUTH))


DEMO = Command(
    "demo",
    "write a simulated log whose true model is known, and identify it",
    """examples:
  jaxquad demo
  jaxquad demo --autopilot
  jaxquad demo --flight

exit codes: 0 done, 2 the folder cannot be written, or the flight is not found; with --autopilot
those of jaxquad autopilot
""",
    _add,
    _run,
)
