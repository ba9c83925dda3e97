"""Commands around one log: channels, identify, report and verify."""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jaxquad.records import parse_mix, require_file
from jaxquad.workflows import (
    default_folder,
    IdentifySettings,
    in_options,
    open_logs,
)

from ._options import (
    add_config,
    add_force,
    add_json,
    add_log,
    add_log_option,
    add_out,
    add_output,
    add_result,
    add_settings,
    Command,
    folder_to_write,
    given_settings,
    print_json,
    print_table,
    settings_of,
    start_computing,
    stdout_for_json,
)
from ._progress import add_quiet


if TYPE_CHECKING:
    from jaxquad.workflows import Identification


def _add_channels(declared: argparse.ArgumentParser) -> None:
    add_log(declared)
    add_settings(declared, IdentifySettings, only={"time": "", "time_unit": "", "dt": ""})
    add_json(add_output(declared), "the list")


def _channels(options: argparse.Namespace) -> int:
    from jaxquad.records import channels, flights

    given = vars(options)
    time, unit, dt = given.get("time"), given.get("time_unit"), given.get("dt")
    found = channels(options.file, time=time, time_unit=unit, dt=dt)
    if options.json:
        print_json([channel._asdict() for channel in found])
        return 0
    rows = [("channel", "samples", "rate, Hz", "from, s", "to, s", "minimum", "maximum", "unit")]
    for c in found:
        numbers = (f"{c.rate:.5g}", f"{c.start:.6g}", f"{c.stop:.6g}", f"{c.minimum:.4g}")
        rows.append((c.name, f"{c.samples}", *numbers, f"{c.maximum:.4g}", c.unit))
    print_table(rows)
    if any(math.isnan(c.rate) for c in found):
        print(
            "\nnan: no time of that length is known, or its unit is not, or it goes back. Name "
            "it (--time), its unit (--time-unit), or give --dt."
        )
    if any(c.name.startswith("log1.") for c in found):
        print("", *flights(options.file), "--flight N chooses one of them", sep="\n")
    return 0


CHANNELS = Command(
    "channels",
    "list the channels of a file",
    """examples:
  jaxquad channels flight.npz
  jaxquad channels table.npy --time "data[0]"
  jaxquad channels table.csv --dt 0.004

A channel without a known time has no rate: name the channel that holds the time (--time), or give
the distance of its rows (--dt).
exit codes: 0 done, 2 unusable input
""",
    _add_channels,
    _channels,
)


NOT_IDENTIFIABLE = 3
_CODES = "exit codes: 0 done, 2 unusable input, 3 the record does not determine the parameters\n"


def finish_identification(
    options: argparse.Namespace, found: "Identification", folder: Path, note: str = ""
) -> int:
    """Print an identification, write its folder, and tell whether it is identifiable."""
    verified = found.settings.verify
    sources = [*found.paths, *([verified] if verified else [])]
    same = {"settings": found.settings.content()}
    with stdout_for_json(options):
        print(in_options(found.message()), flush=True)
        path = found.write(folder_to_write(options, folder, "result.json", same, sources))
        drawn = [name for name in found.figure_names if path.with_name(name).exists()]
        names = ", ".join(["report.html", *drawn])
        print(f"\n{path}, {names}{note.format(report=path.with_name('report.html'))}")
    if options.json:
        print(path.read_text(), end="")
    if found.fit.identifiable:
        return 0
    print("jaxquad: error:", " ".join(found.fit.verdict.summary.split()), file=sys.stderr)
    return NOT_IDENTIFIABLE


def _add_identify(declared: argparse.ArgumentParser) -> None:
    text = "a log of an autopilot, CSV, NPZ, MAT, HDF5, ...; several logs of one vehicle in one "
    text += "condition are fitted together"
    declared.add_argument("file", type=Path, nargs="+", help=text)
    add_config(declared)
    add_settings(declared, IdentifySettings)
    output = add_output(declared)
    add_out(output, "results/NAME of the first file")
    add_force(output)
    add_json(output, "result.json")
    add_quiet(output)


def _identify(options: argparse.Namespace) -> int:
    given = settings_of(options, IdentifySettings)
    for path in options.file:
        _require_log(path)
    _require_used_units(vars(options).get("units", ()), given)
    if given.verify:
        require_file(given.verify)
    start_computing()
    from jaxquad.workflows import identify_opened

    opened = open_logs(options.file, given)
    if opened.proposal is not None:
        with stdout_for_json(options):
            print(f"{opened.proposal}\n", flush=True)
    folder = options.out or default_folder(options.file[0])
    return finish_identification(options, identify_opened(opened), folder)


def _require_used_units(typed: Sequence[str], settings: IdentifySettings) -> None:
    """Raise ValueError for a unit of another channel than those that were named."""
    if settings.input is None:  # the log proposes them
        return
    texts = (settings.input, settings.output, settings.reference)
    names = [name for text in texts if text for name in parse_mix(text)]
    for name in (each.partition("=")[0].strip() for each in typed):
        if name not in names:
            used = ", ".join(names)
            raise ValueError(f"--unit names {name!r}, but the channels in use are {used}")


def _require_log(path: Path) -> None:
    """A ROS 2 bag is a folder; any other one is a batch."""
    require_file(path)
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise ValueError(
            f"{path} is a folder: jaxquad batch {path} identifies each log in it; for one log, "
            "name the file"
        )


IDENTIFY = Command(
    "identify",
    "fit K e^(-delay s) / (s^n (lag s + 1)), or a transfer function, to a log",
    """examples:
  jaxquad identify flight.ulg
  jaxquad identify flight.npz --input M --output q --reference x0 --rate 250 --start 50 --stop 76
  jaxquad identify flight.csv --input "roll=-m1-m2+m3+0.5*m4" --output p --band 0.7 12 --no-lag
  jaxquad identify flight.csv --input elevator --output q --integrators 0 --poles 3 --zeros 1
  jaxquad identify flight.csv --input p_cmd --output p --segment 22:30 --segment 41:49.5
  jaxquad identify log15 --input "roll=-motor.m1^2-motor.m2^2+motor.m3^2+motor.m4^2" --output gyro.x
  jaxquad identify a.npz --input "cmd[0]" --output "rate[0]" --verify b.npz --json > fit.json
  jaxquad identify flight1.csv flight2.csv --input u --output p

Without --input and --output, the log of a known autopilot proposes them, and the full command line
is printed. Several logs of one vehicle in one condition (mass, battery, speed) give one response;
--start, --stop and --segment hold in each of them. Powers of a channel describe motors with a
thrust curve. The keys of a file for --config are the names of the options, but units, segments,
lag = false and delay = false.
"""
    + _CODES,
    _add_identify,
    _identify,
)


def _add_report(declared: argparse.ArgumentParser) -> None:
    add_result(declared)
    add_log_option(declared)
    output = add_output(declared)
    add_out(output, "the folder of the result")
    add_force(output)
    add_json(output, "result.json")
    add_quiet(output)


def _report(options: argparse.Namespace) -> int:
    from jaxquad.workflows import load_result

    stored = load_result(options.result)
    start_computing()
    from jaxquad.workflows import identify_again

    found = identify_again(stored, log=options.log)
    return finish_identification(options, found, options.out or stored.folder)


REPORT = Command(
    "report",
    "write the report and the figures of a result again",
    """example:
  jaxquad report results/flight

The log is identified again with the settings in result.json. It has to be the same file.
"""
    + _CODES,
    _add_report,
    _report,
)


_OF_A_RECORD = {
    "input": "the input, if it has another name in this file",
    "output": "the output, likewise",
    "time": "",
    "time_unit": "",
    "dt": "",
    "rate": "resample to this rate; by default that of the result",
    "valid": "",
    "max_gap": "",
    "hold": "for how long its input keeps each value; by default as in the result",
    "start": "",
    "stop": "",
    "band": "compare between these frequencies, in Hz; by default the whole band of the result",
    "band_rad": "",
}


def _add_verify(declared: argparse.ArgumentParser) -> None:
    add_result(declared)
    add_log(declared)
    add_settings(declared, IdentifySettings, only=_OF_A_RECORD)
    output = add_output(declared)
    output.add_argument("--out", type=Path, metavar="PNG", help="draw both outputs into a figure")
    add_json(output, "the measures of agreement")
    add_quiet(output)


def _verify(options: argparse.Namespace) -> int:
    from jaxquad.workflows import load_result

    stored = load_result(options.result)
    require_file(options.file)
    start_computing()
    from jaxquad.plot import compare, headless
    from jaxquad.report import verification_content
    from jaxquad.workflows import verify_result

    check = verify_result(stored, options.file, given_settings(options, IdentifySettings))
    with stdout_for_json(options):
        if stored.doubts:
            print(f"THE MODEL IS WEAK: {stored.doubts[0]}")
            print("  a good agreement below does not make up for that")
        for doubt in stored.doubts[1:]:
            print(f"! {doubt}")
        print(check)
        if options.out:
            picture = options.out if options.out.suffix else options.out.with_suffix(".png")
            picture.parent.mkdir(parents=True, exist_ok=True)
            with headless():
                compare(check, title=options.file.name).figure.savefig(picture, dpi=130)
            print(picture)
    if options.json:
        known = {"identifiable": stored.identifiable, "verdict": stored.summary}
        print_json(known | verification_content(check))
    return 0 if stored.identifiable else NOT_IDENTIFIABLE


VERIFY = Command(
    "verify",
    "simulate an identified model on another log, and compare",
    """example:
  jaxquad verify results/flight second_flight.npz --start 20 --stop 45 --out verification.png

Channels, rate and band are those of the result, unless other ones are given.
exit codes: 0 done, 2 unusable input, 3 the record that was identified does not determine the
parameters of the model, or the result holds none
""",
    _add_verify,
    _verify,
)
