"""`jaxquad`: from a flight record to an identified model, on the command line."""

import argparse
import contextlib
import re
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any


_LIST = """example:
  jaxquad channels flight.npz
"""
_FIT = """examples:
  jaxquad identify flight.npz --input M --output q --reference x0 --rate 250 --start 50 --stop 76
  jaxquad identify flight.csv --input "roll=-m1-m2+m3+0.5*m4" --output p --band 0.7 12 --no-lag
  jaxquad identify flight.csv --input elevator --output q --integrators 0 --poles 3 --zeros 1
  jaxquad identify a.npz --input "cmd[0]" --output "rate[0]" --verify b.npz --json > fit.json

exit codes: 0, 2 for what cannot be used, 3 where the record does not determine the parameters
"""
_NAME = r"(?![\d.])(?:\[[^\]]*\]|[^\s+*\[\]-])+"  # a channel; within brackets anything goes
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_TERM = re.compile(rf"\s*([+-]?)\s*(?:({_NUMBER})\s*\*\s*)?({_NAME})\s*")
_UNUSABLE, _NOT_IDENTIFIABLE = 2, 3


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, 2 for bad input, 3 for what cannot be identified."""
    options = _parser().parse_args(argv)
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxquad import NotIdentifiable, RecordWarning

    with warnings.catch_warnings():
        warnings.simplefilter("always", RecordWarning)
        warnings.showwarning = _warn
        try:
            options.run(options)
        except (ValueError, OSError) as error:
            print("jaxquad: error:", *str(error).split(), file=sys.stderr)
            return _NOT_IDENTIFIABLE if isinstance(error, NotIdentifiable) else _UNUSABLE
    return 0


def _warn(message: Warning | str, *_: Any) -> None:
    print("!", *str(message).split(), file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxquad",
        description="From a flight record to an identified model with honest error bars.",
        epilog=f"{_LIST}\n{_FIT}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {version('jaxquad')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, run, text, epilog in (
        ("channels", _channels, "list what a file holds", _LIST),
        ("identify", _identify, "fit K e^(-delay s) / (s^n (lag s + 1)) to a record", _FIT),
    ):
        command = commands.add_parser(
            name,
            help=text,
            description=text,
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.set_defaults(run=run)
        command.add_argument("file", type=Path, help="CSV, NPZ or MAT (version 5)")
        command.add_argument("--time", help="the channel that holds the time")
        command.add_argument("--time-unit", choices=("s", "ms", "us", "ns"), help="its unit")
        if run is _identify:
            _add_identify(command)
    return parser


def _add_identify(command: argparse.ArgumentParser) -> None:
    add, seconds = command.add_argument, {"type": float, "metavar": "S"}
    add("--input", required=True, type=parse_mix, help="a channel, or NAME=-a+b+0.5*c")
    add("--output", required=True, type=parse_mix, help="likewise")
    add("--reference", type=parse_mix, help="an outside signal that no feedback computes")
    add("--unit", type=parse_unit, action="append", default=[], metavar="NAME=UNIT",
        help="of a channel, such as q=rad/s; may be repeated")  # fmt: skip
    add("--rate", type=float, metavar="HZ", help="to resample to; by default the file's own")
    add("--start", help="in the file's time", **seconds)
    add("--stop", help="in the file's time", **seconds)
    band = command.add_mutually_exclusive_group()
    for name, unit in (("--band", "Hz"), ("--band-rad", "rad/s")):
        text = f"{unit}, to fit within; by default what the record resolves"
        band.add_argument(name, type=float, nargs=2, metavar=("LOW", "HIGH"), help=text)
    add("--integrators", type=int, default=1, help="n: 1 from a moment to a rate, 2 to an angle")
    add("--no-lag", action="store_true", help="a model without a lag")
    add("--no-delay", action="store_true", help="a model without a delay")
    add("--poles", type=int, metavar="N", help="fit a transfer function of so many poles beside "
        "the integrators, instead of a lag")  # fmt: skip
    add("--zeros", type=int, metavar="N", default=0, help="and of so many zeros")
    add("--estimator", choices=("local", "composite", "welch"), default="local",
        help="local polynomials, composite windows, or windows of one length")  # fmt: skip
    add("--window", help="length of a window for welch, a fifth of the record by default",
        **seconds)  # fmt: skip
    add("--cost", choices=("ml", "coherence"), default="ml",
        help="maximum likelihood, or CIFER's coherence-weighted cost, Eq. (14)")  # fmt: skip
    add("--verify", type=Path, metavar="FILE", help="a record with the same channels to simulate")
    add("--verify-start", help="in that file's time", **seconds)
    add("--verify-stop", help="in that file's time", **seconds)
    add("--out", type=Path, metavar="FOLDER", help="by default results/NAME of the file")
    add("--json", action="store_true", help="result.json to stdout, and the report to stderr")


def parse_mix(text: str) -> dict[str, dict[str, float]]:
    """`M`, or `roll=-m1-m2+0.5*m[4]` as a weighted sum: name -> channel -> weight."""
    name, sign, terms = (part.strip() for part in text.partition("="))
    weights: dict[str, float] = {} if sign or not name else {name: 1.0}
    place = 0
    while place < len(terms):
        term = _TERM.match(terms, place)
        if not term or (place and not term[1]):
            raise argparse.ArgumentTypeError(
                f"{text!r}: cannot read {terms[place:]!r}; write NAME=-a+b+0.5*c"
            )
        weight = float(f"{term[1]}{term[2] or 1}")
        weights[term[3]] = weights.get(term[3], 0.0) + weight
        place = term.end()
    if not name or not weights:
        raise argparse.ArgumentTypeError(f"{text!r} names no channel; write NAME=-a+b+0.5*c")
    return {name: weights}


def parse_unit(text: str) -> tuple[str, str]:
    """`q=rad/s` as a name and its unit."""
    name, sign, unit = (part.strip() for part in text.partition("="))
    if not (name and sign and unit):
        raise argparse.ArgumentTypeError(f"{text!r}: write NAME=UNIT, for instance q=rad/s")
    return name, unit


def _channels(options: argparse.Namespace) -> None:
    from jaxquad import channels

    found = channels(options.file, time=options.time, time_unit=options.time_unit)
    rows = [("channel", "samples", "rate, Hz", "from, s", "to, s", "minimum", "maximum", "unit")]
    for c in found:
        numbers = (f"{c.rate:.5g}", f"{c.start:.6g}", f"{c.stop:.6g}", f"{c.minimum:.4g}")
        rows.append((c.name, f"{c.samples}", *numbers, f"{c.maximum:.4g}", c.unit))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for name, *cells in rows:
        padded = (f"{cell:>{width}}" for cell, width in zip(cells, widths[1:], strict=True))
        print("  ".join((f"{name:<{widths[0]}}", *padded)).rstrip())


def _identify(options: argparse.Namespace) -> None:
    from ._identification import report_identification

    # With --json, stdout belongs to the JSON alone.
    with contextlib.redirect_stdout(sys.stderr if options.json else sys.stdout):
        path, failure = report_identification(options)
    if options.json:
        print(path.read_text(), end="")
    if failure is not None:
        raise failure


if __name__ == "__main__":
    sys.exit(main())
