import argparse
from pathlib import Path
from typing import Any

from ._options import add_json, add_log, command, print_json, read_mix, SECONDS, stdout_for_json


EXAMPLES = """example:
  jaxquad verify results/flight second_flight.npz --start 20 --stop 45 --out verification.png

The channels, the rate and the band are those of the result, where nothing else is said.
exit codes: 0 done, 2 for what cannot be used, 3 for a result that holds no model
"""


def add(commands: Any) -> None:
    text = "simulate an identified model on another record, and compare"
    declared = command(commands, "verify", run, text, EXAMPLES)
    add = declared.add_argument
    add("result", type=Path, help="the folder, or result.json, of jaxquad identify")
    add_log(declared)
    add("--input", type=read_mix, help="where the channel has another name in this file")
    add("--output", type=read_mix, help="likewise")
    add("--rate", type=float, metavar="HZ", help="to resample to")
    add("--start", help="in the file's time", **SECONDS)
    add("--stop", help="in the file's time", **SECONDS)
    add("--band", type=float, nargs=2, metavar=("LOW", "HIGH"), help="Hz, to compare within")
    add("--out", type=Path, metavar="PNG", help="the two drawn over each other")
    add_json(declared, "the measures")


def run(options: argparse.Namespace) -> int:
    import numpy as np

    from jaxquad.identify import verify
    from jaxquad.plot import overlay
    from jaxquad.report import verification_content
    from jaxquad.workflows import stored, stored_model

    content = stored(options.result)
    model, band = stored_model(content), content["setup"]["band_rad"]
    if options.band:
        band = [2 * np.pi * f for f in options.band]
    check = verify(model, _record(options, content["setup"]), band=(band[0], band[1]))
    with stdout_for_json(options):
        print(check)
        for remark in () if content["fit"]["identifiable"] else _doubts(content["fit"]):
            print(f"! {remark}")
        if options.out:
            options.out.parent.mkdir(parents=True, exist_ok=True)
            overlay(check, title=options.file.name).savefig(options.out, dpi=130)
            print(options.out)
    if options.json:
        print_json(verification_content(check))
    return 0


def _doubts(fit: dict[str, Any]) -> list[str]:
    return [fit["verdict"]["summary"], *fit["remarks"]]


def _record(options: argparse.Namespace, setup: dict[str, Any]):
    from jaxquad.records import read_segments

    given = lambda name: getattr(options, name) or setup[name]
    [record] = read_segments(
        options.file,
        [(options.start, options.stop)],
        inputs=given("input"),
        outputs=given("output"),
        sample_rate=given("rate"),
        time=given("time"),
        time_unit=given("time_unit"),
        units={name: unit for name, unit in setup["unit"] if name in
               {*given("input"), *given("output")}},
    )  # fmt: skip
    return record
