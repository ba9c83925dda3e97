import argparse
import contextlib
from collections import Counter
from pathlib import Path
from typing import Any

from ._options import add_json, command, print_json, SECONDS, stdout_for_json


SOME_FAILED = 4
TIMEOUT = 1800.0  # s
EXAMPLES = """examples:
  jaxquad batch logs/ --config fleet.toml
  jaxquad batch logs/ --config fleet.toml --workers 4 --out results/fleet
  jaxquad batch logs/ --config fleet.toml --scheduler tcp://10.0.0.1:8786

fleet.toml, in which every key may be left out:
  logs = "**/*.ulg"             # a glob below the folder, or a list of them
  input = "roll=-m1-m2+m3+m4"   # without input and output an autopilot's log says what they are
  output = "p"
  reference = "setpoint"
  rate = 250                    # Hz
  start = 10                    # s; stop likewise; or segments = [[22, 30], [41, 49.5]]
  band = [0.7, 12]              # Hz; or band_rad in rad/s
  integrators = 1               # lag = false, delay = false, or poles = 2 and zeros = 0
  estimator = "local"           # composite, welch with window = 10
  cost = "ml"                   # or coherence
  axis = "roll"                 # for the proposal; time and time_unit as for identify
  units = { p = "rad/s" }
  timeout = 600                 # s for one log, which then has failed
  [[override]]
  logs = "flight_07*"           # those logs alone
  stop = 80

A batch that was stopped or killed goes on where it was: start it again.
exit codes: 0 done, 2 for what cannot be used, 4 where some logs failed (see table.csv)
A log that is not identifiable has not failed.
"""


def add(commands: Any) -> None:
    declared = command(commands, "batch", run, "identify all logs of a folder", EXAMPLES)
    add = declared.add_argument
    add("folder", type=Path, help="where the logs are")
    add("--config", type=Path, metavar="TOML", help="how to identify them")
    add("--out", type=Path, metavar="FOLDER", help="by default results/NAME of the folder")
    add("--workers", type=int, metavar="N", help="processes; by default one for each core")
    add("--scheduler", metavar="ADDRESS", help="of a Dask cluster that sees the same files")
    add("--timeout", help="of one log, which then has failed; by default that of the TOML file, "
        "else 1800 s; none with --scheduler", **SECONDS)  # fmt: skip
    add("--again", action="store_true", help="try the logs that failed before again")
    add_json(declared, "the rows of the table")


def _timeout(options: argparse.Namespace, of_settings: float | int | None) -> float | int | None:
    if options.timeout is not None:
        return options.timeout
    return of_settings if of_settings is not None or options.scheduler else TIMEOUT


def run(options: argparse.Namespace) -> int:
    from jaxquad.workflows import planned, read_settings, run_batch, Settings

    from ._options import Bar

    settings = read_settings(options.config) if options.config else Settings()
    out = options.out or Path("results") / options.folder.resolve().name
    bar = Bar(len(planned(options.folder, settings, out=out)))
    with stdout_for_json(options), contextlib.closing(bar):
        rows = run_batch(
            options.folder, settings, out=out, workers=options.workers,
            scheduler=options.scheduler, again=options.again,
            timeout=_timeout(options, settings.timeout),
            listener=lambda row: bar.advance(f"{row['log']}: {row['status']}"),
        )  # fmt: skip
    if options.json:
        print_json(rows)
    else:
        counts = Counter(row["status"] for row in rows)
        print(f"{len(rows)} logs:", ", ".join(f"{n} {word}" for word, n in counts.items()))
        print(f"{out / 'summary.html'}, table.csv")
    return SOME_FAILED if any(row["status"] == "failed" for row in rows) else 0
