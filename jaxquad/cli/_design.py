import argparse
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING

from ._options import add_json, add_output, Command, print_json


if TYPE_CHECKING:
    from jaxquad.excitation import Excitation

BELOW_GUIDELINE = 4


def _add(declared: argparse.ArgumentParser) -> None:
    declared.add_argument("kind", choices=("sweep", "multisine"))
    add = declared.add_argument_group("the signal").add_argument
    text = "in Hz; 1 Hz is 6.28 rad/s"
    add("--band", type=float, nargs=2, required=True, metavar=("LOW", "HIGH"), help=text)
    add("--rate", type=float, required=True, metavar="HZ", help="samples per second")
    add("--amplitude", type=float, required=True, help="peak, in the unit of the command")
    text = (
        "of the excitation, without the 3 s of rest around a sweep; by default five of a sweep's "
    )
    text += "longest periods, ten of a multisine's"
    add("--duration", type=float, metavar="S", help=text)
    add("--lines", type=int, metavar="N", help="frequencies of a multisine; by default all")
    text = "expected bandwidth of the response, for the guideline on the lower end of the band"
    add("--bandwidth", type=float, metavar="HZ", help=text)
    text = "where the phase is expected to be -180 degrees, for the guideline on the upper end"
    add("--phase-crossover", type=float, metavar="HZ", help=text)
    output = add_output(declared)
    output.add_argument(
        "--out", type=Path, metavar="CSV", help="by default sweep.csv or multisine.csv"
    )
    text = "overwrite another signal; without it, that is kept, and CSV-2 written"
    output.add_argument("--force", action="store_true", help=text)
    add_json(output, "the guidelines")


def _run(options: argparse.Namespace) -> int:
    import numpy as np

    from jaxquad._core import write_file
    from jaxquad.excitation import check_guidelines

    signal = _sweep(options) if options.kind == "sweep" else _multisine(options)
    radian = lambda hertz: None if hertz is None else 2 * np.pi * hertz
    found = check_guidelines(
        signal,
        omega_bandwidth=radian(options.bandwidth),
        omega_180=radian(options.phase_crossover),
    )
    rows = (f"{t:.9g},{u:.9g}\n" for t, u in zip(signal.time, signal.signal, strict=True))
    content = f"time,signal\n{''.join(rows)}"
    out = _free_file(options, options.out or Path(f"{options.kind}.csv"), content)
    write_file(out, content)
    if options.json:
        rules = [rule._asdict() for rule in found]
        print_json({"file": str(out), "samples": signal.time.size, "ok": found.ok, "rules": rules})
    else:
        low, high = options.band
        band = f"{low:g} to {high:g} Hz ({2 * np.pi * low:.3g} to {2 * np.pi * high:.3g} rad/s)"
        print(f"{signal.time.size} samples, {signal.time[-1]:.4g} s, {band}\n{found}\n{out}")
    return 0 if found.ok else BELOW_GUIDELINE


def _free_file(options: argparse.Namespace, wanted: Path, content: str) -> Path:
    """The file that is wanted, or one beside it where that holds something else."""
    numbered = (wanted.with_stem(f"{wanted.stem}-{number}") for number in count(2))
    files = (
        path
        for path in chain([wanted], numbered)
        if options.force or not path.exists() or path.read_bytes() == content.encode()
    )
    return next(files)


def _sweep(options: argparse.Namespace) -> "Excitation":
    import numpy as np

    from jaxquad.excitation import sweep

    if options.lines is not None:
        raise ValueError("--lines is for a multisine: leave it out, or design a multisine")
    low, high = _band(options)
    return sweep(
        2 * np.pi * low,
        2 * np.pi * high,
        duration=5 / low if options.duration is None else options.duration,
        sample_rate=options.rate,
        amplitude=options.amplitude,
    )


def _multisine(options: argparse.Namespace) -> "Excitation":
    import numpy as np

    from jaxquad.excitation import harmonics, multisine

    low, high = _band(options)
    period = np.ceil(options.rate / low - 1e-9) / options.rate
    duration = 10 * period if options.duration is None else options.duration
    if not duration > 0:
        raise ValueError(f"--duration is {duration:g}: give a time above 0 s")
    periods = max(1, round(duration / period))
    lines = harmonics(2 * np.pi * low, 2 * np.pi * high, period=period, lines=options.lines)
    return multisine(
        lines,
        period=period,
        periods=periods,
        sample_rate=options.rate,
        amplitude=options.amplitude,
    )


def _band(options: argparse.Namespace) -> tuple[float, float]:
    low, high = options.band
    if not 0 < low < high:
        raise ValueError(f"--band is {low:g} {high:g}: give two frequencies above 0, rising")
    if not options.rate > 0:
        raise ValueError(f"--rate is {options.rate:g}: give a rate above 0 Hz")
    return low, high


DESIGN = Command(
    "design",
    "make a signal to excite the vehicle with, and check it against published guidelines",
    """examples:
  jaxquad design sweep --band 0.3 12 --rate 500 --amplitude 0.2 --out sweep.csv
  jaxquad design multisine --band 0.3 12 --rate 500 --amplitude 0.2 --lines 25 --json

exit codes: 0 done, 2 unusable input, 4 a guideline is not met (the signal is written all the same)
""",
    _add,
    _run,
)
