import argparse
from pathlib import Path
from typing import Any

from ._options import add_json, command, require_identifiable, stdout_for_json


EXAMPLES = """example:
  jaxquad report results/flight

The log is identified again as result.json says, and has to be the same file.
exit codes: 0 done, 2 for what cannot be used, 3 where the record does not determine the parameters
"""


def add(commands: Any) -> None:
    text = "write the report and the figures of a result again"
    declared = command(commands, "report", run, text, EXAMPLES)
    declared.add_argument("result", type=Path, help="the folder of jaxquad identify")
    declared.add_argument("--log", type=Path, metavar="FILE", help="where the log is by now")
    declared.add_argument("--out", type=Path, metavar="FOLDER", help="by default the same")
    add_json(declared, "result.json")


def run(options: argparse.Namespace) -> int:
    from jaxquad.workflows import report_identification, stored

    from ._again import options_again

    again = options_again(stored(options.result), options.log)
    folder = options.result if options.result.is_dir() else options.result.parent
    again.out = options.out or folder
    with stdout_for_json(options):
        path, verdict = report_identification(again)
    if options.json:
        print(path.read_text(), end="")
    require_identifiable(verdict)
    return 0
