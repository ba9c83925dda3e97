"""Commands that find gains: tune, and autopilot."""

import argparse
from pathlib import Path

import jaxquad.workflows as workflows
from jaxquad.records import require_file
from jaxquad.workflows import AutopilotSettings, default_folder, in_options, TuneSettings

from . import _options as shell
from ._logs import NOT_IDENTIFIABLE
from ._options import command, Run


_NOT_TO_BE_FLOWN = 4
_EXIT = {"cannot tell": NOT_IDENTIFIABLE, "not to be flown": _NOT_TO_BE_FLOWN}
_WORDS = """(A member is one plant that the record leaves possible; fresh ones were not tuned on.
Linear loops are members without the limit of the command: more of them are analysed than flown.
ladrc.wc and ladrc.wo are the bandwidths of controller and observer in rad/s; map.values are ln b0
from the least inertia of the schedule to the greatest, b0 in rad/s^2 per unit of command.)"""


@command(
    "tune a LADRC on the plants that a record leaves possible, and certify it",
    """examples:
  jaxquad tune results/flight --inertia 0.0552 --limit 10
  jaxquad tune results/flight --inertia 0.0552 --limit 10 --spread 0.5 3 --members 128

A LADRC for the angle of the axis, scheduled with the inertia, is tuned on plants that are drawn
from everything the record leaves uncertain. Each flies a step, a torque pulse and a step back. The
folder gets the report, the certificate and a C header.
exit codes: 0 done, 2 unusable input, 3 the record does not determine the plant, 4 the design is not
to be flown, since STABILITY, PERFORMANCE or CONVERGENCE fails or too few plants decide it (it is
written all the same)
""",
)
def tune(declared: argparse.ArgumentParser) -> Run:
    shell.add_paths(declared, "result", "--log", "--config")
    shell.add_settings(declared, TuneSettings)
    shell.add_output(declared, "gains and certificate", folder="tuned/ in the folder of the result")

    def run(options: argparse.Namespace) -> int:
        settings = shell.settings_of(options, TuneSettings)
        stored = workflows.load_result(options.result)
        stored.require_radians()  # before anything is imported that takes long
        shell.start_computing()
        tuning = workflows.tune(
            stored, settings, log=options.log, progress=False if options.quiet else None
        )
        content, logs = tuning.content(), tuning.identification.paths
        with shell.stdout_for_json(options):
            print(tuning)
            print(_WORDS)
            same = {key: content[key] for key in ("settings", "identified_with")}
            wanted = options.out or stored.folder / "tuned"
            folder = shell.folder_to_write(options, wanted, "tuned.json", same, logs)
            print(f"\n{folder}: {', '.join(path.name for path in tuning.write(folder))}")
        if options.json:
            shell.print_json(content)
        return 0 if tuning.tuned.holds else _NOT_TO_BE_FLOWN

    return run


@command(
    "tune the gains of the autopilot that flew a log, and write its parameter file",
    """examples:
  jaxquad autopilot flight.bbl
  jaxquad autopilot flight.ulg --axis pitch --sensitivity 1.6 --noise 1
  jaxquad autopilot flight.bbl --axis roll --law adrc

A log of Betaflight, PX4 or ArduPilot. The gains and filters that flew are read from it, the plant
is identified in the firmware's own units, and the loop of both is compared with the flight. P, I
and D of the rate loop, and cutoffs where the log shows the gyro's noise, are tuned on the plants
that the log leaves possible, rounded to what the firmware stores, and certified on new plants. The
folder gets a parameter file for a third of the way, one for all of it, one that reverts them, and a
table of what changes.
For Betaflight, --law adrc gives wc, wo and b0 of the ADRC of its pull request 15400, which only a
build of that understands, from the gain at each level of throttle in the log. A log that was flown
with that ADRC is tuned so without the option.
exit codes: 0 done, or what flew is kept, 2 unusable input, 3 this log cannot tell, 4 the design is
not to be flown (with 3 and 4 only the file with what flew is written)
""",
)
def autopilot(declared: argparse.ArgumentParser) -> Run:
    shell.add_paths(declared, "file", "--config")
    shell.add_settings(declared, AutopilotSettings)
    folder = "autopilot/ in results/NAME of the file, autopilot_AXIS/ of one axis"
    shell.add_output(declared, "autopilot.json", folder=folder)

    def run(options: argparse.Namespace) -> int:
        settings = shell.settings_of(options, AutopilotSettings)
        require_file(options.file)
        name = "autopilot" if settings.axis == "all" else f"autopilot_{settings.axis}"
        folder = options.out or default_folder(options.file) / name
        shell.start_computing()
        return run_autopilot(options, options.file, settings, folder)

    return run


def run_autopilot(
    options: argparse.Namespace, log: Path, settings: AutopilotSettings, wanted: Path,
    note: str = "",
) -> int:  # fmt: skip
    """Tune the gains of the loop that flew the log, print and write what comes out; `{page}` in
    `note` is the page's path."""
    proposal = workflows.autopilot(log, settings)
    with shell.stdout_for_json(options):
        print(in_options(str(proposal)))
        same = {"settings": settings.content()}
        folder = shell.folder_to_write(options, wanted, "autopilot.json", same, [log])
        names = ", ".join(path.name for path in proposal.write(folder))
        print(f"\n{folder}: {names}{note.format(page=folder / 'autopilot.html')}")
    if options.json:
        shell.print_json(proposal.content())
    return _EXIT.get(proposal.kind, 0)
