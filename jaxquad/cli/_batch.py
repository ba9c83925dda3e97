"""`jaxquad batch`: all logs of a folder, with a bar that shows how far it is."""

import argparse
import sys
from collections import Counter
from pathlib import Path

from jaxquad.workflows import BatchSettings

from ._options import (
    add_config,
    add_output,
    add_settings,
    command,
    print_json,
    Run,
    settings_of,
    stdout_for_json,
)


_SOME_FAILED = 4


@command(
    "identify all logs of a folder",
    """examples:
  jaxquad batch logs/ --config fleet.toml
  jaxquad batch logs/ --config fleet.toml --workers 4 --out results/fleet
  jaxquad batch logs/ --config fleet.toml --scheduler tcp://10.0.0.1:8786

fleet.toml, in which every key may be left out:
  logs = "**/*.ulg"             # a file pattern below the folder, or a list of them
  timeout = 600                 # s for one log; workers and scheduler likewise
  input = "roll=-m1-m2+m3+m4"   # without input and output, an autopilot's log proposes them
  output = "p"
  reference = "setpoint"
  units = { p = "rad/s" }
  band = [0.7, 12]              # Hz
  lag = false                   # as --no-lag
  [[override]]
  logs = "flight_07*"           # these logs alone
  segments = [[22, 30], [41, 49.5]]
The other keys are the options of jaxquad identify (--unit and --segment are units and segments).

A batch that was stopped or killed continues where it was: start it again.
exit codes: 0 done, 2 unusable input, 4 some logs failed (see table.csv)
A log that is not identifiable has not failed.
""",
)
def batch(declared: argparse.ArgumentParser) -> Run:
    declared.add_argument("folder", type=Path, help="the folder that contains the logs")
    add_config(declared)
    text = "identify logs again that failed before"
    declared.add_argument("--again", action="store_true", help=text)
    add_settings(declared, BatchSettings)
    add_output(declared, "the rows of the table", folder="results/NAME of the folder", force="")

    def run(options: argparse.Namespace) -> int:
        from tqdm import tqdm

        from jaxquad.workflows import batch, find_logs

        settings = settings_of(options, BatchSettings)
        out = options.out or Path("results") / options.folder.resolve().name
        logs = find_logs(options.folder, settings, out=out)
        # A bar on a terminal, plain lines elsewhere, nothing with --quiet.
        bar = tqdm(total=len(logs), unit="log", leave=False, disable=options.quiet or None)
        shown: list[str] = []

        def show(row: dict) -> None:
            text = f"{row['log']}: {row['status']}"
            shown.append("".join(c if c.isprintable() else "?" for c in text))
            if not bar.disable:
                bar.set_postfix_str(shown[-1], refresh=False)
                bar.update()
            elif not options.quiet:
                print(f"{len(shown)}/{len(logs)} {shown[-1]}", file=sys.stderr, flush=True)

        with stdout_for_json(options), bar:
            rows = batch(options.folder, settings, out=out, again=options.again, listener=show)
        if options.json:
            print_json(rows)
        else:
            counts = Counter(row["status"] for row in rows)
            print(f"{len(rows)} logs:", ", ".join(f"{n} {state}" for state, n in counts.items()))
            print(f"{out / 'summary.html'}, table.csv")
        return _SOME_FAILED if any(row["status"] == "failed" for row in rows) else 0

    return run
