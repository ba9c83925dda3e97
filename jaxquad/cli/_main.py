"""`jaxquad`: from a flight record to an identified model, on the command line."""

import argparse
import contextlib
import difflib
import io
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib.metadata import version

from jaxquad._core import is_ours, readable
from jaxquad.records import RecordWarning
from jaxquad.report import PageWarning
from jaxquad.workflows import in_options

from ._first import demo, design
from ._logs import autopilot, batch, channels, identify, NOT_IDENTIFIABLE, report, tune, verify
from ._options import check_out, shown_stages


# In order of use.
_COMMANDS = (demo, design, channels, identify, verify, tune, autopilot, report, batch)
_WAY = """jaxquad demo                   a simulated flight, identified: results/demo/report.html
jaxquad identify YOUR.LOG      a model of your own flight, with error bars
jaxquad tune results/YOUR ...  gains from it, with a certificate; jaxquad --help lists all commands
"""
_PLACES = {  # what a command takes beside its options
    "demo": "",
    "design": "{sweep,multisine} --band LOW HIGH --rate HZ --amplitude AMPLITUDE ",
    "channels": "FILE ",
    "identify": "FILE [FILE ...] ",
    "verify": "RESULT FILE ",
    "tune": "RESULT --inertia J --limit NUMBER ",
    "autopilot": "FILE ",
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
    options, unknown = make_parser().parse_known_args(words)
    if unknown:
        return _fail(_describe_unknown(options, unknown), _UNUSABLE)
    with warnings.catch_warnings(), shown_stages(options):
        for kind in (RecordWarning, PageWarning):
            warnings.simplefilter("always", kind)
        warnings.showwarning = printer_of_warnings()
        check_out(options)
        return options.run(options)


def _describe_unknown(options: argparse.Namespace, words: Sequence[str]) -> str:
    """What is wrong with words that no command declares, and the option that was meant."""
    command = f"jaxquad {options.command}"
    first = next((word for word in words if word.startswith("-")), words[0])
    if not first.startswith("-"):
        return f"{command} takes no further argument {first!r}. See {command} --help."
    name = first.partition("=")[0]
    near = difflib.get_close_matches(name, re.findall(r"--[a-z][a-z0-9-]*", options.usage), n=1)
    guess = f" Did you mean {near[0]}?" if near else ""
    return f"{command} has no option {name}.{guess} See {command} --help."


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
    listed = (f"  {x.name:<9} {x.help}\n  {'':<9} {x.example}" for x in _COMMANDS)
    parser = _Parser(
        prog="jaxquad",
        usage="jaxquad COMMAND ...",
        description="From a flight record to an identified model with honest error bars.",
        epilog="\n".join(("commands, in order of use:", *listed, "", _CODES)),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {version('jaxquad')}")
    commands = parser.add_subparsers(
        required=True, metavar="COMMAND", dest="command", help=argparse.SUPPRESS
    )
    for command in _COMMANDS:
        command.add_to(commands)
    for name, declared in commands.choices.items():
        declared.set_defaults(usage=declared.format_usage())
        declared.usage = f"jaxquad {name} {_PLACES[name]}[options]"
    return parser


if __name__ == "__main__":
    sys.exit(main())
