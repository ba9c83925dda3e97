"""All logs of a fleet in one go: by default the measured ones beside the repository.

Prints a table and writes it, a summary and a report for each log under results/fleet. Stop or
kill it, and start it again: it goes on where it was. `jaxquad batch` is the same on the command
line; `--scheduler` names a Dask cluster that sees the same files.
"""

import argparse
import sys
from pathlib import Path

from jaxquad.workflows import batch, BatchSettings


HERE = Path(__file__).parent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=HERE / "../../shared/data")
    parser.add_argument("--config", type=Path, default=HERE / "fleet.toml")
    parser.add_argument("--out", type=Path, default=HERE / "../results/fleet")
    parser.add_argument("--workers", type=int)
    parser.add_argument("--timeout", type=float, help="s for one log, which then has failed")
    parser.add_argument("--scheduler")
    given = parser.parse_args()
    options = {"workers": given.workers, "scheduler": given.scheduler, "timeout": given.timeout}
    changes = {name: value for name, value in options.items() if value is not None}
    rows = batch(
        given.folder,
        BatchSettings.from_toml(given.config).changed(changes),
        out=given.out,
        listener=lambda row: print(f"{row['log']}: {row['status']}", file=sys.stderr),
    )
    for row in rows:
        values = {each["name"]: each["value"] for each in row.get("parameters", ())}
        known = ", ".join(f"{n} {v:.4g}" for n, v in values.items() if v is not None)
        print(f"{row['log']:34}  {row['status']:17} {known or row['error']}")


if __name__ == "__main__":
    main()
