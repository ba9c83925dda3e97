import argparse
from pathlib import Path
from typing import Any

from ._options import (
    add_json,
    command,
    print_json,
    require_identifiable,
    SECONDS,
    stdout_for_json,
)


EXAMPLES = """examples:
  jaxquad tune results/flight --inertia 0.0552 --limit 10
  jaxquad tune results/flight --inertia 0.0552 --limit 10 --spread 0.5 3 --told 0.1 --members 64

A scheduled LADRC for the angle of the axis, on all plants that the record leaves open, times the
spread of inertia; flown over a step, a torque pulse and a step back. Writes the report, the
certificate and a C header.
exit codes: 0 done, 2 for what cannot be used, 3 where the record does not determine the plant,
4 where the certificate fails (the gains are written all the same)
"""
FAILS = 4


def add(commands: Any) -> None:
    text = "tune a LADRC on the plants that an identified model leaves open, and certify it"
    declared = command(commands, "tune", run, text, EXAMPLES)
    add = declared.add_argument
    number = lambda *names, **more: add(*names, type=float, **more)
    add("result", type=Path, help="the folder, or result.json, of jaxquad identify")
    number("--inertia", required=True, metavar="J", help="believed, kg m^2")
    number("--limit", required=True, help="of the command, to both sides, in its unit")
    number("--spread", nargs=2, default=(0.5, 3.0), metavar=("LOW", "HIGH"),
           help="of the inertia, times J; 0.5 3 by default")  # fmt: skip
    number("--told", default=0.1, help="relative error of the inertia told; 0.1 by default")
    number("--step", default=4.0, metavar="DEG", help="of the reference; 4 by default")
    number("--disturbance", metavar="NM", help="a tenth of the limit's torque by default")
    number("--noise", default=0.02, metavar="DEG", help="of the measured angle; 0.02 by default")
    number("--sensitivity", default=3.6, help="limit of the peak of |S|; 3.6 by default")
    add("--duration", default=4.0, help="of a flight; 4 by default", **SECONDS)
    add("--dt", help="of the controller; the record's by default", **SECONDS)
    add("--members", type=int, default=64, help="to tune on; 64 by default")
    add("--fresh", type=int, default=256, help="to certify on; 256 by default")
    add("--seed", type=int, default=0, help="of the draws; 0 by default")
    add("--name", default="attitude", help="of the functions in the C header; attitude by default")
    add("--log", type=Path, metavar="FILE", help="where the log is by now")
    add("--out", type=Path, metavar="FOLDER", help="by default tuned/ in the result's folder")
    add_json(declared, "gains and certificate")


def run(options: argparse.Namespace) -> int:
    from jaxquad.workflows import Case, identified, stored, tuned_case, tuned_content, write_tuning

    from ._again import options_again

    content = stored(options.result)
    again = options_again(content, options.log)
    record, frf, found = identified(again)
    if not found.verdict.fitted:
        require_identifiable(found.verdict)
    low, high = options.spread
    case = Case(
        inertia=options.inertia, limit=options.limit, spread=(low, high), told=options.told,
        step=options.step, disturbance=options.disturbance, noise=options.noise,
        sensitivity=options.sensitivity, duration=options.duration, dt=options.dt or record.dt,
        members=options.members, fresh=options.fresh, seed=options.seed,
    )  # fmt: skip
    tuned = tuned_case(found, record, case)
    folder = options.result if options.result.is_dir() else options.result.parent
    with stdout_for_json(options):
        print(tuned)
        out = options.out or folder / "tuned"
        names = write_tuning(out, record, frf, found, tuned, case, again.file, options.name)
        print(f"{out}: {', '.join(names)}")
    if options.json:
        print_json(tuned_content(tuned, case))
    return 0 if tuned.holds else FAILS
