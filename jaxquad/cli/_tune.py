import argparse

from jaxquad.workflows import in_options, TuneSettings

from ._options import (
    add_config,
    add_force,
    add_json,
    add_log_option,
    add_out,
    add_output,
    add_result,
    add_settings,
    Command,
    folder_to_write,
    print_json,
    settings_of,
    start_computing,
    stdout_for_json,
)
from ._progress import add_quiet


NOT_TO_BE_FLOWN = 4
_WORDS = """(A member is one plant that the record leaves possible; fresh ones were not tuned on.
Linear loops are members without the limit of the command: more of them are analysed than flown.
ladrc.wc and ladrc.wo are the bandwidths of controller and observer in rad/s; map.values are ln b0
from the least inertia of the schedule to the greatest, b0 in rad/s^2 per unit of command.)"""


def _add(declared: argparse.ArgumentParser) -> None:
    add_result(declared)
    add_log_option(declared)
    add_config(declared)
    add_settings(declared, TuneSettings)
    output = add_output(declared)
    add_out(output, "tuned/ in the folder of the result")
    add_force(output)
    add_json(output, "gains and certificate")
    add_quiet(output)


def _run(options: argparse.Namespace) -> int:
    from jaxquad.workflows import load_result

    settings = settings_of(options, TuneSettings)
    stored = load_result(options.result)
    stored.require_radians()  # before anything is imported that takes long
    start_computing()
    from jaxquad.workflows import tune

    found = tune(stored, settings, log=options.log, progress=False if options.quiet else None)
    with stdout_for_json(options):
        print(in_options(str(found)))
        print(_WORDS)
        content, logs = found.content(), found.identification.paths
        same = {key: content[key] for key in ("settings", "identified_with")}
        wanted = options.out or stored.folder / "tuned"
        folder = folder_to_write(options, wanted, "tuned.json", same, logs)
        print(f"\n{folder}: {', '.join(path.name for path in found.write(folder))}")
    if options.json:
        print_json(found.content())
    return 0 if found.tuned.holds else NOT_TO_BE_FLOWN


TUNE = Command(
    "tune",
    "tune a LADRC on the plants that a record leaves possible, and certify it",
    """examples:
  jaxquad tune results/flight --inertia 0.0552 --limit 10
  jaxquad tune results/flight --inertia 0.0552 --limit 10 --spread 0.5 3 --members 128

A LADRC for the angle of the axis, scheduled with the inertia, is tuned on plants that are drawn
from everything the record leaves uncertain. Each flies a step, a torque pulse and a step back. The
folder gets the report, the certificate and a C header.
exit codes: 0 done, 2 unusable input, 3 the record does not determine the plant, 4 the design is not
to be flown, since STABILITY, PERFORMANCE or CONVERGENCE fails (it is written all the same)
""",
    _add,
    _run,
)
