"""The command line `jaxquad`: options in, messages out.

Here are `main` and the commands that need no flight: a demonstration, what to fly, and a signal to
excite the vehicle with.
"""

import argparse
import contextlib
import difflib
import gc
import io
import os
import re
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import chain, count
from pathlib import Path
from types import FrameType

import jaxquad.workflows as workflows
from jaxquad._core import __version__, is_ours, readable
from jaxquad.records import AXES, RecordWarning, require_file
from jaxquad.report import PageWarning
from jaxquad.workflows import AutopilotSettings, in_options

from . import _options as shell
from ._logs import (
    autopilot,
    batch,
    channels,
    compare,
    finish_identification,
    identify,
    NOT_IDENTIFIABLE,
    report,
    run_autopilot,
    tune,
    verify,
)
from ._options import Run


__all__ = ["main", "make_parser"]
_NEXT = """

The log is simulated: one axis under rate feedback, in gusts, excited by a sweep of its command.
True values: gain {gain:g}, lag {lag:g} s, delay {delay:g} s, so lag + delay = {sum:.4g} s.
Look at {{report}}
Then identify your own log:
  jaxquad channels YOUR.LOG
  jaxquad identify YOUR.LOG"""
_NEXT_FLIGHT = """

The flight is measured: an ANT-X quadrotor on a pitch test stand in closed loop, with a binary
sequence on the set-point x0 of its position.
Look at {report}"""
_NEXT_CHIRP = """

The log is simulated, as Betaflight 2026.6 writes it: a 5-inch quadrotor with default gains rests,
takes off, and flies a chirp on roll from 0.5 to 40 Hz, in gusts and gyro noise.
True plant of roll: gain {gain:g}, lag {lag:g} s, delay {delay:g} s.
Look at {{page}}
Then your own log:
  jaxquad autopilot YOUR.BFL"""


@shell.command(
    "write a simulated log whose true model is known, and identify it",
    """examples:
  jaxquad demo
  jaxquad demo --autopilot
  jaxquad demo --flight

exit codes: 0 done, 2 the folder cannot be written, or the flight is not found; with --autopilot
those of jaxquad autopilot
""",
)
def demo(declared: argparse.ArgumentParser) -> Run:
    text = "identify a measured flight instead: a quadrotor on a pitch test stand (JAXQUAD_DATA)"
    source = declared.add_mutually_exclusive_group()
    source.add_argument("--flight", action="store_true", help=text)
    text = "tune the gains of a simulated Betaflight chirp flight instead, to a parameter file"
    source.add_argument("--autopilot", action="store_true", help=text)
    content = "result.json, or autopilot.json,"
    shell.add_output(declared, content, folder="results/demo, demo_flight or demo_autopilot")

    def run(options: argparse.Namespace) -> int:
        if options.autopilot:
            shell.start_computing()
            from jaxquad.autopilot import CHIRP_TRUTH, write_chirp_log

            folder = options.out or Path("results/demo_autopilot")
            log, axis = write_chirp_log(folder / "demo.bfl"), AutopilotSettings(axis="roll")
            return run_autopilot(options, log, axis, folder, _NEXT_CHIRP.format(**CHIRP_TRUTH))
        if options.flight:
            log, settings = workflows.find_demo_flight()  # before JAX: it may not be there
            folder, note = Path("results/demo_flight"), _NEXT_FLIGHT
            shell.start_computing()
        else:
            shell.start_computing()
            settings, truth, folder = workflows.DEMO, workflows.DEMO_TRUTH, Path("results/demo")
            log = workflows.write_demo_log((options.out or folder) / "demo.csv")
            note = _NEXT.format(**truth, sum=truth["lag"] + truth["delay"])
        result = workflows.identify(log, settings)
        return finish_identification(options, result, options.out or folder, note)

    return run


@shell.command(
    "say what to set and to fly, so that jaxquad autopilot can tune from the log",
    """examples:
  jaxquad recipe betaflight
  jaxquad recipe ardupilot --axis pitch --amplitude 0.08 --out pitch.param

exit codes: 0 done, 2 no recipe for this firmware, or a value that is not flyable
""",
)
def recipe(declared: argparse.ArgumentParser) -> Run:
    declared.add_argument("firmware", metavar="FIRMWARE", help="betaflight, ardupilot or px4")
    axes, text = (*AXES, "all"), "the axis to excite; all by default"
    declared.add_argument("--axis", type=str.lower, choices=axes, default="all", help=text)
    text = "of the chirp, in the firmware's unit; by default one to begin with"
    declared.add_argument("--amplitude", type=float, metavar="NUMBER", help=text)
    text = "number of the channel, or of the position, of the switch that starts it"
    declared.add_argument("--switch", type=int, metavar="N", help=text)
    text = "write what to set, and to FILE_back what goes back: with the ending .param (ArduPilot) "
    file = ("FILE", text + "or .params (PX4) files to load, else the text to paste")
    shell.add_output(declared, "the recipe", file=file, force="", quiet=False)

    def run(options: argparse.Namespace) -> int:
        from jaxquad._core import write_file

        answer = workflows.recipe(
            options.firmware.lower(), options.axis, amplitude=options.amplitude,
            switch=options.switch,
        )  # fmt: skip
        files = answer.files(options.out) if options.out else {}
        with shell.stdout_for_json(options):
            print(answer)
            if files:
                print("", *(write_file(path, text) for path, text in files.items()), sep="\n")
        if options.json:
            shell.print_json(answer.content())
        return 0

    return run


@shell.command(
    "open a page in the browser: drop a log, see it, tune it, take the parameters away",
    """examples:
  jaxquad app
  jaxquad app flight.bbl

The page is of this machine alone (127.0.0.1, behind a token); the log stays on it. It needs the
extra: pip install "jaxquad[app]". It ends a minute after its last tab is closed, or with Ctrl-C.
exit codes: 0 done, 2 the port is taken, or the extra is missing
""",
)
def app(declared: argparse.ArgumentParser) -> Run:
    declared.add_argument("file", type=Path, nargs="?", help="a log to open at once")
    text = "of 127.0.0.1; by default a free one"
    declared.add_argument("--port", type=int, default=0, metavar="N", help=text)
    text = "print the address alone"
    declared.add_argument("--no-browser", action="store_true", help=text)
    text = "end so long after the last tab was closed; 60 by default"
    declared.add_argument("--linger", type=float, default=60.0, metavar="S", help=text)

    def run(options: argparse.Namespace) -> int:
        if options.file is not None:
            require_file(options.file)
        try:
            from jaxquad.app import serve
        except ModuleNotFoundError as error:
            raise ValueError(
                f'jaxquad app needs {error.name}: pip install "jaxquad[app]", or run it as '
                'uvx "jaxquad[app]" app'
            ) from error
        serve(
            options.file, port=options.port, browser=not options.no_browser,
            linger=options.linger,
        )  # fmt: skip
        return 0

    return run


_BELOW_GUIDELINE = 4


@shell.command(
    "make a signal to excite the vehicle with, and check it against published guidelines",
    """examples:
  jaxquad design sweep --band 0.3 12 --rate 500 --amplitude 0.2 --out sweep.csv
  jaxquad design multisine --band 0.3 12 --rate 500 --amplitude 0.2 --lines 25 --json

exit codes: 0 done, 2 unusable input, 4 a guideline is not met (the signal is written all the same)
""",
)
def design(declared: argparse.ArgumentParser) -> Run:
    declared.add_argument("kind", choices=("sweep", "multisine"))
    add = declared.add_argument_group("the signal").add_argument
    text = "in Hz; 1 Hz is 6.28 rad/s"
    add("--band", type=float, nargs=2, required=True, metavar=("LOW", "HIGH"), help=text)
    add("--rate", type=float, required=True, metavar="HZ", help="samples per second")
    add("--amplitude", type=float, required=True, help="peak, in the unit of the command")
    text = "of the excitation, without the 3 s of rest around a sweep; by default five of a "
    text += "sweep's longest periods, ten of a multisine's"
    add("--duration", type=float, metavar="S", help=text)
    add("--lines", type=int, metavar="N", help="frequencies of a multisine; by default all")
    text = "expected bandwidth of the response, for the guideline on the lower end of the band"
    add("--bandwidth", type=float, metavar="HZ", help=text)
    text = "where the phase is expected to be -180 degrees, for the guideline on the upper end"
    add("--phase-crossover", type=float, metavar="HZ", help=text)
    force = "overwrite another signal; without it, that is kept, and CSV-2 written"
    file = ("CSV", "by default sweep.csv or multisine.csv")
    shell.add_output(declared, "the guidelines", file=file, force=force, quiet=False)

    def run(options: argparse.Namespace) -> int:
        import numpy as np

        from jaxquad._core import write_file
        from jaxquad.excitation import check_guidelines, harmonics, multisine, sweep

        (low, high), rate, duration = options.band, options.rate, options.duration
        is_sweep = options.kind == "sweep"
        if is_sweep and options.lines is not None:
            raise ValueError("--lines is for a multisine: leave it out, or design a multisine")
        if not 0 < low < high:
            raise ValueError(f"--band is {low:g} {high:g}: give two frequencies above 0, rising")
        if not rate > 0:
            raise ValueError(f"--rate is {rate:g}: give a rate above 0 Hz")
        band = 2 * np.pi * low, 2 * np.pi * high
        if is_sweep:
            duration = 5 / low if duration is None else duration
            signal = sweep(*band, duration=duration, sample_rate=rate, amplitude=options.amplitude)
        else:
            period = np.ceil(rate / low - 1e-9) / rate
            duration = 10 * period if duration is None else duration
            if not duration > 0:
                raise ValueError(f"--duration is {duration:g}: give a time above 0 s")
            signal = multisine(
                harmonics(*band, period=period, lines=options.lines), period=period,
                periods=max(1, round(duration / period)), sample_rate=rate,
                amplitude=options.amplitude,
            )  # fmt: skip
        radian = lambda hertz: None if hertz is None else 2 * np.pi * hertz
        check = check_guidelines(
            signal,
            omega_bandwidth=radian(options.bandwidth),
            omega_180=radian(options.phase_crossover),
        )
        rows = (f"{t:.9g},{u:.9g}\n" for t, u in zip(signal.time, signal.signal, strict=True))
        content = f"time,signal\n{''.join(rows)}"
        wanted = options.out or Path(f"{options.kind}.csv")
        numbered = (wanted.with_stem(f"{wanted.stem}-{number}") for number in count(2))
        out = next(  # another signal is kept
            path
            for path in chain([wanted], numbered)
            if options.force or not path.exists() or path.read_bytes() == content.encode()
        )
        write_file(out, content)
        if options.json:
            rules = [rule._asdict() for rule in check]
            shell.print_json(
                {"file": str(out), "samples": signal.time.size, "ok": check.ok, "rules": rules}
            )
        else:
            hertz = f"{low:g} to {high:g} Hz ({band[0]:.3g} to {band[1]:.3g} rad/s)"
            print(f"{signal.time.size} samples, {signal.time[-1]:.4g} s, {hertz}\n{check}\n{out}")
        return 0 if check.ok else _BELOW_GUIDELINE

    return run


# In order of use.
_COMMANDS = (
    demo, app, recipe, design, channels, identify, verify, tune, autopilot, compare, report, batch,
)  # fmt: skip
_WAY = """jaxquad demo                   a simulated flight, identified: results/demo/report.html
jaxquad identify YOUR.LOG      a model of your own flight, with error bars
jaxquad tune results/YOUR ...  gains from it, with a certificate; jaxquad --help lists all commands
"""
_PLACES = {  # what a command takes beside its options
    "demo": "",
    "app": "[FILE] ",
    "recipe": "FIRMWARE ",
    "design": "{sweep,multisine} --band LOW HIGH --rate HZ --amplitude AMPLITUDE ",
    "channels": "FILE ",
    "identify": "FILE [FILE ...] ",
    "verify": "RESULT FILE ",
    "tune": "RESULT --inertia J --limit NUMBER ",
    "autopilot": "FILE ",
    "compare": "BEFORE AFTER ",
    "report": "RESULT ",
    "batch": "FOLDER ",
}
_CODES = """exit codes:
  0  done
  2  the input or the options cannot be used
  3  the record does not determine the parameters
  4  some logs of a batch failed, a design is not to be flown, or an excitation misses a guideline
  130  interrupted
"""
_UNUSABLE, _INTERRUPTED, _CLOSED = 2, 130, 141
_LATER = 0.05  # s


def _collects_garbage(frame: FrameType | None) -> bool:
    """Whether a callback of the collection runs there, as JAX has one: it loses what is raised."""
    callbacks = {getattr(callback, "__code__", None) for callback in gc.callbacks}
    while frame is not None and frame.f_code not in callbacks:
        frame = frame.f_back
    return frame is not None


@contextlib.contextmanager
def _interrupts_are_errors() -> Iterator[None]:
    """Within it each interrupt ends the run, also one that comes while garbage is collected."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        if not _collects_garbage(frame):
            raise KeyboardInterrupt
        threading.Timer(_LATER, signal.raise_signal, (number,)).start()

    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not usual or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    **Arguments:**

    - `argv`: its words; those of the process by default.

    **Returns:** the exit code, see `jaxquad --help`.
    """
    words = sys.argv[1:] if argv is None else list(argv)
    if isinstance(sys.stdout, io.TextIOWrapper):  # which may know fewer letters than names of files
        sys.stdout.reconfigure(errors="replace")
    try:
        with _interrupts_are_errors():
            try:
                return _run(words)
            finally:
                sys.stdout.flush()  # a full disk shows here, or never
    except OSError as error:  # what the system could not do: `out/a.png: no space left on device`
        place, why = error.filename or "what is printed", error.strerror
        if error.filename is None:  # else the end of the process tries once more
            with contextlib.suppress(io.UnsupportedOperation):  # of a test
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):  # `jaxquad ... | head` has read enough
            return _CLOSED
        return _fail(f"{place}: {why.lower()}" if why else str(error), _UNUSABLE)
    except ValueError as error:
        code = _UNUSABLE
        if "jaxquad.identify" in sys.modules:  # else nothing was fitted, and JAX is not needed
            from jaxquad.identify import UndeterminedError

            code = NOT_IDENTIFIABLE if isinstance(error, UndeterminedError) else _UNUSABLE
        return _fail(in_options(error), code)
    except KeyboardInterrupt:
        print("jaxquad: interrupted", file=sys.stderr)
        return _INTERRUPTED


def _run(words: Sequence[str]) -> int:
    if not words:
        print(_WAY, end="")
        return 0
    parser, first = make_parser(), words[0]
    if first == "help":
        parser.print_help()
        return 0
    if not first.startswith("-") and first not in _PLACES:
        file = shlex.quote(first)
        if Path(first).is_dir():
            text = f"{first} is a folder, not a command: jaxquad batch {file} identifies its logs."
            return _fail(text, _UNUSABLE)
        if Path(first).exists():
            return _fail(
                f"{first} is a file, not a command: jaxquad identify {file} gives a model, "
                f"jaxquad autopilot {file} the gains of an autopilot.", _UNUSABLE
            )  # fmt: skip
        near = difflib.get_close_matches(first, _PLACES, n=1)
        meant = f" Did you mean {near[0]}?" if near else ""
        return _fail(f"there is no command {first!r}.{meant} See jaxquad --help.", _UNUSABLE)
    options, unknown = parser.parse_known_args(words)
    if unknown:  # words that no command declares: what is wrong, and the option that was meant
        command = f"jaxquad {options.command}"
        first = next((word for word in unknown if word.startswith("-")), unknown[0])
        text = f"{command} takes no further argument {first!r}."
        if first.startswith("-"):
            name = first.partition("=")[0]
            flags = re.findall(r"--[a-z][a-z0-9-]*", options.usage)
            near = difflib.get_close_matches(name, flags, n=1)
            text = f"{command} has no option {name}."
            text += f" Did you mean {near[0]}?" if near else ""
        return _fail(f"{text} See {command} --help.", _UNUSABLE)
    with warnings.catch_warnings(), shell.shown_stages(options):
        for kind in (RecordWarning, PageWarning):
            warnings.simplefilter("always", kind)
        warnings.showwarning = printer_of_warnings()
        shell.check_out(options)
        return options.run(options)


def _fail(message: str, code: int) -> int:
    print("jaxquad: error:", *readable(message).split(), file=sys.stderr)
    return code


def printer_of_warnings() -> Callable[..., None]:
    """Prints each text of the package, and of no other, once: a log is read several times."""
    printed: set[str] = set()

    def show(message: Warning | str, kind: type[Warning], *_: object) -> None:
        text = " ".join(in_options(message).split())
        if is_ours(kind) and text not in printed:
            printed.add(text)
            print("!", readable(text), file=sys.stderr)

    return show


class _Parser(argparse.ArgumentParser):
    """argparse says nothing where its help cannot be printed."""

    def _print_message(self, message, file=None):
        (file or sys.stderr).write(message)


def make_parser() -> argparse.ArgumentParser:
    """The parser of the whole command line."""
    pad, first = f"\n  {'':<9} ", lambda command: command.examples.splitlines()[1].strip()
    listed = (f"  {x.name:<9} {x.help}{pad}{first(x)}" for x in _COMMANDS)
    parser = _Parser(
        prog="jaxquad",
        usage="jaxquad COMMAND ...",
        description="From a flight record to an identified model with honest error bars.",
        epilog="\n".join(("commands, in order of use:", *listed, "", _CODES)),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(
        required=True, metavar="COMMAND", dest="command", help=argparse.SUPPRESS
    )
    for name, text, examples, declare in _COMMANDS:
        declared = commands.add_parser(
            name, prog=f"jaxquad {name}", description=text, epilog=examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )  # fmt: skip
        declared.set_defaults(run=declare(declared))
        declared.set_defaults(usage=declared.format_usage())
        declared.usage = f"jaxquad {name} {_PLACES[name]}[options]"
    return parser
