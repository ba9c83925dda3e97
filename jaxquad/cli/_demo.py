"""`jaxquad demo`: a log whose true model is known, on its way through identify or autopilot."""

import argparse
from pathlib import Path

from jaxquad.workflows import AutopilotSettings

from ._identify import finish_identification
from ._options import add_output, command, Run, start_computing
from ._tune import run_autopilot


_NEXT = """

The log is simulated: one axis under rate feedback, in gusts, excited by a sweep of its command.
True values: gain {gain:g}, lag {lag:g} s, delay {delay:g} s, so lag + delay = {sum:.4g} s.
Look at {{report}}
Then identify your own log:
  jaxquad channels YOUR.LOG
  jaxquad identify YOUR.LOG"""
_NEXT_FLIGHT = """

The flight is measured: an ANT-X quadrotor on a pitch test stand in closed loop, with a binary
sequence on the set-point x0 of its position.
Look at {report}"""
_NEXT_CHIRP = """

The log is simulated, as Betaflight 2026.6 writes it: a 5-inch quadrotor with default gains rests,
takes off, and flies a chirp on roll from 0.5 to 40 Hz, in gusts and gyro noise.
True plant of roll: gain {gain:g}, lag {lag:g} s, delay {delay:g} s.
Look at {{page}}
Then your own log:
  jaxquad autopilot YOUR.BFL"""


@command(
    "write a simulated log whose true model is known, and identify it",
    """examples:
  jaxquad demo
  jaxquad demo --autopilot
  jaxquad demo --flight

exit codes: 0 done, 2 the folder cannot be written, or the flight is not found; with --autopilot
those of jaxquad autopilot
""",
)
def demo(declared: argparse.ArgumentParser) -> Run:
    text = "identify a measured flight instead: a quadrotor on a pitch test stand (JAXQUAD_DATA)"
    source = declared.add_mutually_exclusive_group()
    source.add_argument("--flight", action="store_true", help=text)
    text = "tune the gains of a simulated Betaflight chirp flight instead, to a parameter file"
    source.add_argument("--autopilot", action="store_true", help=text)
    content = "result.json, or autopilot.json,"
    add_output(declared, content, folder="results/demo, demo_flight or demo_autopilot")

    def run(options: argparse.Namespace) -> int:
        if options.flight:
            from jaxquad.workflows import find_demo_flight

            log, settings = find_demo_flight()  # before JAX: it may have nothing to compute
            start_computing()
            from jaxquad.workflows import identify

            folder = options.out or Path("results/demo_flight")
            return finish_identification(options, identify(log, settings), folder, _NEXT_FLIGHT)
        start_computing()
        if options.autopilot:
            from jaxquad.autopilot import CHIRP_TRUTH, write_chirp_log

            folder = options.out or Path("results/demo_autopilot")
            log, axis = write_chirp_log(folder / "demo.bfl"), AutopilotSettings(axis="roll")
            return run_autopilot(options, log, axis, folder, _NEXT_CHIRP.format(**CHIRP_TRUTH))
        from jaxquad.workflows import DEMO, DEMO_TRUTH, identify, write_demo_log

        folder = options.out or Path("results/demo")
        log = write_demo_log(folder / "demo.csv")
        note = _NEXT.format(**DEMO_TRUTH, sum=DEMO_TRUTH["lag"] + DEMO_TRUTH["delay"])
        return finish_identification(options, identify(log, DEMO), folder, note)

    return run
