import argparse
from collections.abc import Callable
from pathlib import Path

from jaxquad.records import require_file
from jaxquad.workflows import AutopilotSettings, default_folder, in_options

from ._identify import NOT_IDENTIFIABLE
from ._options import (
    add_config,
    add_force,
    add_json,
    add_log,
    add_out,
    add_output,
    add_settings,
    Command,
    folder_to_write,
    print_json,
    settings_of,
    start_computing,
    stdout_for_json,
)
from ._progress import add_quiet
from ._tune import NOT_TO_BE_FLOWN


_EXIT = {"cannot tell": NOT_IDENTIFIABLE, "not to be flown": NOT_TO_BE_FLOWN}


def _add(declared: argparse.ArgumentParser) -> None:
    add_log(declared)
    add_config(declared)
    add_settings(declared, AutopilotSettings)
    output = add_output(declared)
    add_out(output, "autopilot/ in results/NAME of the file, autopilot_AXIS/ of one axis")
    add_force(output)
    add_json(output, "autopilot.json")
    add_quiet(output)


def _run(options: argparse.Namespace) -> int:
    settings = settings_of(options, AutopilotSettings)
    require_file(options.file)
    name = "autopilot" if settings.axis == "all" else f"autopilot_{settings.axis}"
    folder = options.out or default_folder(options.file) / name
    return run_autopilot(options, lambda: options.file, settings, folder)


def run_autopilot(
    options: argparse.Namespace,
    log: Callable[[], Path],
    settings: AutopilotSettings,
    wanted: Path,
    note: str = "",
) -> int:
    """Tune the gains of the loop that flew the log, print and write what comes out.

    `log` returns the file; `{page}` in `note` is the page's path.
    """
    start_computing()
    from jaxquad.workflows import autopilot

    file = log()
    found = autopilot(file, settings)
    with stdout_for_json(options):
        print(in_options(str(found)))
        same = {"settings": settings.content()}
        folder = folder_to_write(options, wanted, "autopilot.json", same, [file])
        names = ", ".join(path.name for path in found.write(folder))
        print(f"\n{folder}: {names}{note.format(page=folder / 'autopilot.html')}")
    if options.json:
        print_json(found.content())
    return _EXIT.get(found.kind, 0)


AUTOPILOT = Command(
    "autopilot",
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
    _add,
    _run,
)
