import argparse
from typing import Any

from ._options import add_json, add_log, command, print_json, print_table


EXAMPLES = """examples:
  jaxquad channels flight.npz
  jaxquad channels table.npy --time "data[0]"

A channel whose time is not known has no rate: --time names it.
exit codes: 0 done, 2 for what cannot be used
"""


def add(commands: Any) -> None:
    declared = command(commands, "channels", run, "list what a file holds", EXAMPLES)
    add_log(declared)
    add_json(declared, "the list")


def run(options: argparse.Namespace) -> int:
    from jaxquad.records import channels

    found = channels(options.file, time=options.time, time_unit=options.time_unit)
    if options.json:
        print_json([channel._asdict() for channel in found])
        return 0
    rows = [("channel", "samples", "rate, Hz", "from, s", "to, s", "minimum", "maximum", "unit")]
    for c in found:
        numbers = (f"{c.rate:.5g}", f"{c.start:.6g}", f"{c.stop:.6g}", f"{c.minimum:.4g}")
        rows.append((c.name, f"{c.samples}", *numbers, f"{c.maximum:.4g}", c.unit))
    print_table(rows)
    return 0
