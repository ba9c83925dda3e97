import argparse

from jaxquad.workflows import IdentifySettings

from ._options import add_json, add_log, add_settings, Command, print_json, print_table


def _add(declared: argparse.ArgumentParser) -> None:
    add_log(declared)
    add_settings(declared, IdentifySettings, only={"time": "", "time_unit": ""})
    add_json(declared, "the list")


def _run(options: argparse.Namespace) -> int:
    from jaxquad.records import channels

    given = vars(options)
    time, unit = given.get("time"), given.get("time_unit")
    found = channels(options.file, time=time, time_unit=unit)
    if options.json:
        print_json([channel._asdict() for channel in found])
        return 0
    rows = [("channel", "samples", "rate, Hz", "from, s", "to, s", "minimum", "maximum", "unit")]
    for c in found:
        numbers = (f"{c.rate:.5g}", f"{c.start:.6g}", f"{c.stop:.6g}", f"{c.minimum:.4g}")
        rows.append((c.name, f"{c.samples}", *numbers, f"{c.maximum:.4g}", c.unit))
    print_table(rows)
    return 0


CHANNELS = Command(
    "channels",
    "list the channels of a file",
    """examples:
  jaxquad channels flight.npz
  jaxquad channels table.npy --time "data[0]"

A channel without a known time has no rate: name the channel that holds the time (--time).
exit codes: 0 done, 2 unusable input
""",
    _add,
    _run,
)
