"""What several commands share: how a command is declared, and how options are read and shown."""

import argparse
import contextlib
import json
import math
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TYPE_CHECKING

from jaxquad.records import Mix, parse_mix


if TYPE_CHECKING:
    from jaxquad.identify import Verdict


class Bar:
    """How many of `total` are done, and how long the rest takes at this pace."""

    def __init__(self, total: int, *, shown: bool | None = None):
        self.total, self.done, self.start = total, 0, time.monotonic()
        self.shown = sys.stderr.isatty() if shown is None else shown

    def advance(self, text: str = "") -> None:
        """One more is done; `text` says which."""
        self.done += 1
        if self.shown:
            print(f"\r\x1b[K{self._line(text)}", end="", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Clear the line."""
        if self.shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    def _line(self, text: str) -> str:
        spent = time.monotonic() - self.start
        left = spent / self.done * max(self.total - self.done, 0)
        full = 20 * self.done // max(self.total, 1)
        bar = f"[{'#' * full}{'.' * (20 - full)}]"
        line = f"{bar} {self.done}/{self.total}, {left:.0f} s left  {text}"
        plain = "".join(c if c.isprintable() else "?" for c in line)
        return plain[: shutil.get_terminal_size().columns - 1]


Run = Callable[[argparse.Namespace], int]
SECONDS: dict[str, Any] = {"type": float, "metavar": "S"}


def command(commands: Any, name: str, run: Run, text: str, epilog: str) -> argparse.ArgumentParser:
    """Declare a command with its examples."""
    declared = commands.add_parser(
        name,
        help=text,
        description=text,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    declared.set_defaults(run=run)
    return declared


def add_log(declared: argparse.ArgumentParser) -> None:
    """The file and its clock."""
    declared.add_argument("file", type=Path, help="a log of an autopilot, CSV, NPZ, MAT, HDF5 ...")
    declared.add_argument("--time", help="the channel that holds the time")
    declared.add_argument("--time-unit", choices=("s", "ms", "us", "ns"), help="its unit")


def add_json(declared: argparse.ArgumentParser, what: str) -> None:
    declared.add_argument("--json", action="store_true", help=f"{what} to stdout as JSON")


def read_mix(text: str) -> Mix:
    """`parse_mix` for an option."""
    try:
        return parse_mix(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def read_unit(text: str) -> tuple[str, str]:
    """`q=rad/s` as a name and its unit."""
    name, sign, unit = (part.strip() for part in text.partition("="))
    if not (name and sign and unit):
        raise argparse.ArgumentTypeError(f"{text!r}: write NAME=UNIT, for instance q=rad/s")
    return name, unit


def read_segment(text: str) -> tuple[float, float]:
    """`22:30.5` as start and stop in s."""
    start, _, stop = text.partition(":")
    try:
        span = float(start), float(stop)
    except ValueError:
        span = 0.0, 0.0
    if not -math.inf < span[0] < span[1] < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: write START:STOP in s, for instance 22:30.5")
    return span


@contextlib.contextmanager
def stdout_for_json(options: argparse.Namespace) -> Iterator[None]:
    """With --json, stdout belongs to the JSON alone, and what is printed goes to stderr."""
    with contextlib.redirect_stdout(sys.stderr if options.json else sys.stdout):
        yield


def require_identifiable(verdict: "Verdict") -> None:
    """Raise `UndeterminedError`, which `main` turns into its exit code, for any other verdict."""
    from jaxquad.identify import UndeterminedError

    if not verdict.identifiable:
        raise UndeterminedError(verdict.summary)


def print_json(content: Any) -> None:
    from jaxquad.report import plain_content as plain

    print(json.dumps(plain(content), indent=2, allow_nan=False))


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """The first row is the heading; the first column is of words, the others of numbers."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for name, *cells in rows:
        padded = (f"{cell:>{width}}" for cell, width in zip(cells, widths[1:], strict=True))
        print("  ".join((f"{name:<{widths[0]}}", *padded)).rstrip())
