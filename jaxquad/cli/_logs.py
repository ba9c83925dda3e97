"""Commands on logs and results: channels, identify, report, verify, batch, tune, autopilot."""

import argparse
import io
import math
import shlex
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import jaxquad.workflows as workflows
from jaxquad._core import write_file
from jaxquad.records import parse_mix, require_file
from jaxquad.workflows import (
    AutopilotSettings,
    BatchSettings,
    default_folder,
    IdentifySettings,
    in_options,
    open_logs,
    TuneSettings,
)

from . import _options as shell
from ._options import command, print_text, Run


if TYPE_CHECKING:
    from jaxquad.workflows import Identification

NOT_IDENTIFIABLE = 3
_CODES = "exit codes: 0 done, 2 unusable input, 3 the record does not determine the parameters\n"


@command(
    "list the channels of a file",
    """examples:
  jaxquad channels flight.npz
  jaxquad channels table.npy --time "data[0]"
  jaxquad channels table.csv --dt 0.004

A channel without a known time has no rate: name the channel that holds the time (--time), or give
the distance of its rows (--dt).
exit codes: 0 done, 2 unusable input
""",
)
def channels(declared: argparse.ArgumentParser) -> Run:
    shell.add_paths(declared, "file")
    shell.add_settings(declared, IdentifySettings, only={"time": "", "time_unit": "", "dt": ""})
    shell.add_output(declared, "the list", quiet=False, force="")

    def run(options: argparse.Namespace) -> int:
        from jaxquad.records import channels, flights

        typed = vars(options).get
        listed = channels(
            options.file, time=typed("time"), time_unit=typed("time_unit"), dt=typed("dt")
        )
        if options.json:
            shell.print_json([channel._asdict() for channel in listed])
            return 0
        heads = ("channel", "samples", "rate, Hz", "from, s", "to, s", "minimum", "maximum", "unit")
        rows: list[tuple[str, ...]] = [heads]
        for c in listed:
            numbers = (f"{c.rate:.5g}", f"{c.start:.6g}", f"{c.stop:.6g}", f"{c.minimum:.4g}")
            rows.append((c.name, f"{c.samples}", *numbers, f"{c.maximum:.4g}", c.unit))
        first, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
        lines = []
        for name, *cells in rows:
            padded = (f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True))
            lines.append("  ".join((f"{name:<{first}}", *padded)).rstrip())
        print_text("\n".join(lines))
        if any(math.isnan(c.rate) for c in listed):
            print(
                "\nnan: no time of that length is known, or its unit is not, or it goes back. Name "
                "it (--time), its unit (--time-unit), or give --dt."
            )
        if any(c.name.startswith("log1.") for c in listed):
            print("", *flights(options.file), "--flight N chooses one of them", sep="\n")
        return 0

    return run


def finish_identification(
    options: argparse.Namespace, result: "Identification", folder: Path, note: str = ""
) -> int:
    """Print an identification, write its folder, and tell whether it is identifiable."""
    verified = result.settings.verify
    sources = [*result.paths, *([verified] if verified else [])]
    same = {"settings": result.settings.content()}
    with shell.stdout_for_json(options):
        print_text(in_options(result.message()))
        with shell.folder_to_write(options, folder, "result.json", same, sources) as free:
            path = result.write(free)
        drawn = [name for name in result.figure_names if path.with_name(name).exists()]
        names = ", ".join(["report.html", *drawn])
        print(f"\n{path}, {names}{note.format(report=path.with_name('report.html'))}")
    if options.json:
        print(path.read_text(), end="")
    if result.fit.identifiable:
        return 0
    print("jaxquad: error:", " ".join(result.fit.verdict.summary.split()), file=sys.stderr)
    return NOT_IDENTIFIABLE


@command(
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
)
def identify(declared: argparse.ArgumentParser) -> Run:
    text = "a log of an autopilot, CSV, NPZ, MAT, HDF5, ...; several logs of one vehicle in one "
    text += "condition are fitted together"
    declared.add_argument("file", type=Path, nargs="+", help=text)
    shell.add_paths(declared, "--config")
    shell.add_settings(declared, IdentifySettings)
    shell.add_output(declared, "result.json", folder="results/NAME of the first file")

    def run(options: argparse.Namespace) -> int:
        settings = shell.settings_of(options, IdentifySettings)
        for path in options.file:
            require_file(path)
            if path.is_dir() and not (path / "metadata.yaml").is_file():  # no ROS 2 bag
                raise ValueError(
                    f"{path} is a folder: jaxquad batch {shlex.quote(str(path))} identifies each "
                    "log in it; for one log, name the file"
                )
        texts = (settings.input, settings.output, settings.reference)
        used = [name for text in texts if text for name in parse_mix(text)]
        for name in (unit.partition("=")[0].strip() for unit in vars(options).get("units", ())):
            if used and name not in used:  # without names, the log proposes them
                raise ValueError(
                    f"--unit names {name!r}, but the channels in use are {', '.join(used)}"
                )
        if settings.verify:
            require_file(settings.verify)
        shell.start_computing()
        opened = open_logs(options.file, settings)
        if opened.proposal is not None:
            with shell.stdout_for_json(options):
                print(f"{opened.proposal}\n", flush=True)
        folder = options.out or default_folder(options.file[0])
        return finish_identification(options, workflows.identify_opened(opened), folder)

    return run


@command(
    "write the report and the figures of a result again",
    """example:
  jaxquad report results/flight

The log is identified again with the settings in result.json. It has to be the same file.
"""
    + _CODES,
)
def report(declared: argparse.ArgumentParser) -> Run:
    shell.add_paths(declared, "result", "--log")
    shell.add_output(declared, "result.json", folder="the folder of the result")

    def run(options: argparse.Namespace) -> int:
        stored = workflows.load_result(options.result)
        shell.start_computing()
        result = workflows.identify_again(stored, log=options.log)
        return finish_identification(options, result, options.out or stored.folder)

    return run


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


@command(
    "simulate an identified model on another log, and compare",
    """example:
  jaxquad verify results/flight second_flight.npz --start 20 --stop 45 --out verification.png

Channels, rate and band are those of the result, unless other ones are given.
exit codes: 0 done, 2 unusable input, 3 the log contradicts the model, or the record that was
identified does not determine its parameters, or the result holds none
""",
)
def verify(declared: argparse.ArgumentParser) -> Run:
    shell.add_paths(declared, "result", "file")
    shell.add_settings(declared, IdentifySettings, only=_OF_A_RECORD)
    file = ("PNG", "draw both outputs into a figure")
    shell.add_output(declared, "the measures of agreement", file=file, force="")

    def run(options: argparse.Namespace) -> int:
        stored = workflows.load_result(options.result)
        require_file(options.file)
        shell.start_computing()
        from jaxquad.identify import CONTRADICTS
        from jaxquad.plot import compare, headless
        from jaxquad.report import verification_content

        check = workflows.verify_result(
            stored, options.file, shell.typed_settings(options, IdentifySettings)
        )
        with shell.stdout_for_json(options):
            if stored.doubts:
                print(f"THE MODEL IS WEAK: {stored.doubts[0]}")
                print("  a good agreement below does not make up for that")
            for doubt in stored.doubts[1:]:
                print(f"! {doubt}")
            print_text(f"{check}\n{check.verdict}")
            if options.out:
                picture = options.out if options.out.suffix else options.out.with_suffix(".png")
                image = io.BytesIO()
                with headless():
                    compare(check, title=options.file.name).figure.savefig(
                        image, dpi=130, format=picture.suffix[1:]
                    )
                write_file(picture, image.getvalue())
                print(picture)
        if options.json:
            model = {"identifiable": stored.identifiable, "verdict": stored.summary}
            shell.print_json(model | verification_content(check))
        sound = stored.identifiable and check.verdict.kind != CONTRADICTS
        return 0 if sound else NOT_IDENTIFIABLE

    return run


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
    shell.add_paths(declared, "--config")
    text = "identify logs again that failed before"
    declared.add_argument("--again", action="store_true", help=text)
    shell.add_settings(declared, BatchSettings)
    shell.add_output(
        declared, "the rows of the table", folder="results/NAME of the folder", force=""
    )

    def run(options: argparse.Namespace) -> int:
        from tqdm import tqdm

        settings = shell.settings_of(options, BatchSettings)
        out = options.out or Path("results") / options.folder.resolve().name
        logs = workflows.find_logs(options.folder, settings, out=out)
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

        with shell.stdout_for_json(options), bar:
            rows = workflows.batch(
                options.folder, settings, out=out, again=options.again, listener=show
            )
        if options.json:
            shell.print_json(rows)
        else:
            counts = Counter(row["status"] for row in rows)
            print(f"{len(rows)} logs:", ", ".join(f"{n} {state}" for state, n in counts.items()))
            print(f"{out / 'summary.html'}, table.csv")
        return _SOME_FAILED if any(row["status"] == "failed" for row in rows) else 0

    return run


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
        stored = workflows.load_result(options.result)
        stored.require_radians()  # before options are asked for that would be of no use
        settings = shell.settings_of(options, TuneSettings)
        shell.start_computing()
        tuning = workflows.tune(
            stored, settings, log=options.log, progress=False if options.quiet else None
        )
        content, logs = tuning.content(), tuning.identification.paths
        with shell.stdout_for_json(options):
            print_text(tuning)
            print(_WORDS)
            same = {key: content[key] for key in ("settings", "identified_with")}
            wanted = options.out or stored.folder / "tuned"
            with shell.folder_to_write(options, wanted, "tuned.json", same, logs) as folder:
                names = ", ".join(path.name for path in tuning.write(folder))
            print(f"\n{folder}: {names}")
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


@command(
    "compare two flights of one vehicle with other gains: better, worse, or cannot tell",
    """examples:
  jaxquad compare before.bbl after.bbl
  jaxquad compare before.bbl after.bbl --axis roll
  jaxquad compare day.bbl day.bbl --flight-before 1 --flight-after 3

Logs of Betaflight, PX4 or ArduPilot. Each is identified, and its plant flown in the law that flew.
Compared are the step from set-point to rate, the peak of |S|, the effect of a step of torque, and
the noise of the command in steady hover, each with its errors.
exit codes: 0 done, 2 unusable input, 3 these logs cannot tell
""",
)
def compare(declared: argparse.ArgumentParser) -> Run:
    for name, text in (("before", "the first log"), ("after", "the second log, of other gains")):
        declared.add_argument(name, type=Path, help=f"{text}, of the same vehicle")
    shell.add_paths(declared, "--config")
    shell.add_settings(declared, workflows.CompareSettings)
    folder = "compare_NAME/ of the second log in results/NAME of the first"
    shell.add_output(declared, "compare.json", folder=folder)

    def run(options: argparse.Namespace) -> int:
        settings = shell.settings_of(options, workflows.CompareSettings)
        before, after = logs = options.before, options.after
        for path in logs:
            require_file(path)
        wanted = options.out or default_folder(logs[0]) / f"compare_{logs[1].stem}"
        shell.start_computing()
        comparison = workflows.compare(before, after, settings)
        with shell.stdout_for_json(options):
            print(in_options(str(comparison)))
            same = {"settings": settings.content()}
            with shell.folder_to_write(options, wanted, "compare.json", same, logs) as folder:
                names = ", ".join(path.name for path in comparison.write(folder))
            print(f"\n{folder}: {names}")
        if options.json:
            shell.print_json(comparison.content())
        return NOT_IDENTIFIABLE if comparison.kind == "cannot tell" else 0

    return run


def run_autopilot(
    options: argparse.Namespace, log: Path, settings: AutopilotSettings, wanted: Path,
    note: str = "",
) -> int:  # fmt: skip
    """Tune the gains of the loop that flew the log, print and write what comes out; `{page}` in
    `note` is the page's path."""
    proposal = workflows.autopilot(log, settings)
    with shell.stdout_for_json(options):
        print_text(in_options(str(proposal)))
        same = {"settings": settings.content()}
        with shell.folder_to_write(options, wanted, "autopilot.json", same, [log]) as folder:
            names = ", ".join(path.name for path in proposal.write(folder))
        print(f"\n{folder}: {names}{note.format(page=folder / 'autopilot.html')}")
    if options.json:
        shell.print_json(proposal.content())
    return _EXIT.get(proposal.kind, 0)
