"""`jaxquad`: from a flight record to an identified model, on the command line."""

import argparse
import re
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn


_EXAMPLE = """examples:
  jaxquad channels flight.npz
  jaxquad identify flight.npz --input M --output q --reference x0 --rate 250 --start 50 --stop 76
  jaxquad identify flight.csv --input roll=-m1-m2+m3+m4 --output p --integrators 1 --band 0.7 12
"""
_TERM = re.compile(
    r"\s*([+-])?\s*(?:(\d+\.?\d*(?:[eE][+-]?\d+)?)\s*\*\s*)?([A-Za-z_][\w.\[\]]*)\s*"
)
_FAILED, _NOT_IDENTIFIABLE = 2, 3


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, 2 for bad input, 3 for what cannot be identified."""
    options = _parser().parse_args(arguments)
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxquad import NotIdentifiable

    with warnings.catch_warnings():
        warnings.showwarning = _warn
        try:
            return options.run(options)
        except NotIdentifiable as error:
            print(error)
            return _NOT_IDENTIFIABLE
        except ValueError as error:
            print(f"jaxquad: error: {error}", file=sys.stderr)
            return _FAILED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxquad",
        description=__doc__,
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=version("jaxquad"))
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    channels = commands.add_parser("channels", help="list what a file holds")
    channels.add_argument("file", type=Path)
    channels.set_defaults(run=_channels)
    identify = commands.add_parser(
        "identify",
        help="fit K e^(-delay s) / (s^n (lag s + 1)) to a record",
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_identify(identify)
    identify.set_defaults(run=_identify)
    return parser


def _add_identify(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("file", type=Path, help="CSV, NPZ or MAT (v5)")
    add("--input", required=True, type=parse_mix, help="a channel, or NAME=-a+b+0.5*c")
    add("--output", required=True, type=parse_mix, help="likewise")
    add("--reference", type=parse_mix, help="an outside signal that no feedback computes")
    add("--rate", type=float, help="Hz to resample to; by default the file's own")
    add("--start", type=float, help="s, in the file's time")
    add("--stop", type=float, help="s, in the file's time")
    add("--band", type=float, nargs=2, metavar=("LOW", "HIGH"), help="Hz to fit within")
    add("--integrators", type=int, default=1, help="n: 1 from moment to rate, 2 to angle")
    add("--window", type=float, help="s; by default a fifth of the record")
    add("--cost", choices=("ml", "coherence"), default="ml", help="ml, or Eq. (14)")
    add("--verify", type=Path, metavar="FILE", help="another record with the same channels")
    add("--verify-start", type=float, help="s")
    add("--verify-stop", type=float, help="s")
    add("--out", type=Path, help="folder of results; by default results/FILE")


def parse_mix(text: str) -> dict[str, dict[str, float]]:
    """`M` or `roll=-m1-m2+m3+0.5*m[4]` as a linear mix: name -> channel -> weight."""
    name, _, terms = text.partition("=") if "=" in text else (text, "", text)
    weights: dict[str, float] = {}
    place = 0
    while place < len(terms):
        term = _TERM.match(terms, place)
        if not term or (place > 0 and not term[1]):
            _refuse(f"{text!r}: cannot read {terms[place:]!r}; write NAME=-a+b+0.5*c")
        sign = -1.0 if term[1] == "-" else 1.0
        weights[term[3]] = weights.get(term[3], 0.0) + sign * float(term[2] or 1)
        place = term.end()
    if not name.strip() or not weights:
        _refuse(f"{text!r} names no channel; write NAME=-a+b+0.5*c")
    return {name.strip(): weights}


def _refuse(message: str) -> NoReturn:
    raise argparse.ArgumentTypeError(message)


def _warn(message: Any, *_: Any, **__: Any) -> None:
    print(f"! {message}", file=sys.stderr)


def _channels(options: argparse.Namespace) -> int:
    from jaxquad import channels

    for summary in channels(options.file):
        print(summary)
    return 0


def _read(options: argparse.Namespace, file: Path, start: float | None, stop: float | None) -> Any:
    import jaxquad as jq

    return jq.read(
        file,
        inputs=options.input,
        outputs=options.output,
        references=options.reference,
        sample_rate=options.rate,
        start=start,
        stop=stop,
    )


def _identify(options: argparse.Namespace) -> int:
    import jaxquad as jq

    record = _read(options, options.file, options.start, options.stop)
    print(record, "\n", sep="")
    frfs, fits = {}, {}
    for name in ("joint", "direct") if options.reference else ("direct",):
        frfs[name], fits[name] = _fit_twice(record, name, options)
    best = next(iter(fits))
    print(frfs[best], "\n\n", fits[best], sep="")
    for name, fit in fits.items():
        print(f"{name:>8}: {_late(fit)}")
    check = None
    if options.verify:
        other = _read(options, options.verify, options.verify_start, options.verify_stop)
        check = jq.verify(fits[best].model, other, band=_band(options))
        print(check)
    _write(options, frfs, fits[best], check)
    return 0 if fits[best].identifiable else _NOT_IDENTIFIABLE


def _band(options: argparse.Namespace) -> tuple[float, float] | None:
    tau = 6.283185307179586
    return (tau * options.band[0], tau * options.band[1]) if options.band else None


def _fit_twice(record: Any, name: str, options: argparse.Namespace) -> tuple[Any, Any]:
    """The second response is windowed with the delay that the first fit found."""
    import numpy as np

    import jaxquad as jq

    band, delay = _band(options), 0.0
    omega = np.geomspace(*band, 100) if band else None
    cost = jq.MaximumLikelihood() if options.cost == "ml" else jq.CoherenceWeighted()
    while True:
        welch = jq.Welch(options.window, integrators=options.integrators, delay=delay)
        estimator = jq.JointInputOutput(welch) if name == "joint" else welch
        frf = jq.frequency_response(record, omega, estimator=estimator)
        fit = jq.fit(jq.guess_lagged_integrator(frf, options.integrators), frf, cost=cost)
        late = float(fit.model.lag + fit.model.delay)
        if delay or not record.dt <= late < 0.1 * welch.length([record]) * record.dt:
            return frf, fit
        delay = late


def _late(fit: Any) -> str:
    """Gain, and the sum of lag and delay, which a record determines better than either."""
    import jaxquad as jq

    parts = []
    for name, quantity in (("gain", lambda m: m.gain), ("lag + delay", lambda m: m.lag + m.delay)):
        try:
            parts.append(str(fit.derived(quantity, name)))
        except jq.NotIdentifiable:
            parts.append(f"{name} not determined")
    return ";  ".join(parts)


def _write(options: argparse.Namespace, frfs: dict[str, Any], fit: Any, check: Any) -> None:
    from jaxquad.report import bode, overlay, write_results

    folder = options.out or Path("results") / options.file.stem
    first, *rest = frfs
    path = write_results(folder, fit=fit, frf=frfs[first], check=check)
    figure = bode(
        frfs[first], {"identified": fit.model}, others={name: frfs[name] for name in rest}
    )
    figure.savefig(folder / "bode.png", dpi=130)
    if check is not None:
        overlay(check).savefig(folder / "verification.png", dpi=130)
    print(f"\n{path} and figures beside it")


if __name__ == "__main__":
    sys.exit(main())
