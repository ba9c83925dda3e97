import argparse
from pathlib import Path
from typing import Any

from ._options import add_json, command, print_json, SECONDS


EXAMPLES = """examples:
  jaxquad design sweep --band 0.3 12 --rate 500 --amplitude 0.2 --out sweep.csv
  jaxquad design multisine --band 0.3 12 --rate 500 --amplitude 0.2 --lines 25 --json

Without --duration, a sweep lasts five, a multisine ten of its longest periods.
exit codes: 0 done, 2 for what cannot be designed, 4 where a guideline of the field is broken
"""
BROKEN = 4


def add(commands: Any) -> None:
    text = "a signal to excite the vehicle with, held against the rules of the field"
    declared = command(commands, "design", run, text, EXAMPLES)
    add = declared.add_argument
    add("kind", choices=("sweep", "multisine"))
    add("--band", type=float, nargs=2, required=True, metavar=("LOW", "HIGH"), help="Hz")
    add("--rate", type=float, required=True, metavar="HZ", help="samples per second")
    add("--amplitude", type=float, required=True, help="peak, in the unit of the command")
    add("--duration", help="of the excitation, without the rests of 3 s around a sweep", **SECONDS)
    add("--lines", type=int, metavar="N", help="frequencies of a multisine; by default all")
    add("--bandwidth", type=float, metavar="HZ", help="expected of the response, for its rule")
    add("--phase-crossover", type=float, metavar="HZ", help="where the phase is -180 degrees")
    add("--out", type=Path, metavar="CSV", help="by default KIND.csv")
    add_json(declared, "the rules")


def run(options: argparse.Namespace) -> int:
    import numpy as np

    from jaxquad.excitation import check_guidelines

    signal = (_sweep if options.kind == "sweep" else _multisine)(options)
    radian = lambda hertz: None if hertz is None else 2 * np.pi * hertz
    rules = check_guidelines(
        signal,
        omega_bandwidth=radian(options.bandwidth),
        omega_180=radian(options.phase_crossover),
    )
    out = _write(options, signal)
    if options.json:
        found = [rule._asdict() for rule in rules]
        print_json({"file": str(out), "samples": signal.time.size, "ok": rules.ok, "rules": found})
    else:
        print(f"{signal.time.size} samples, {signal.time[-1]:.4g} s\n{rules}\n{out}")
    return 0 if rules.ok else BROKEN


def _sweep(options: argparse.Namespace):
    import numpy as np

    from jaxquad.excitation import sweep

    low, high = _band(options)
    return sweep(
        2 * np.pi * low,
        2 * np.pi * high,
        duration=options.duration or 5 / low,
        sample_rate=options.rate,
        amplitude=options.amplitude,
    )


def _multisine(options: argparse.Namespace):
    import numpy as np

    from jaxquad.excitation import harmonics, multisine

    low, high = _band(options)
    period = np.ceil(options.rate / low - 1e-9) / options.rate
    periods = max(1, round((options.duration or 10 * period) / period))
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
        raise ValueError(f"the band {low:g} .. {high:g} Hz has to rise from above 0")
    if not options.rate > 0:
        raise ValueError(f"the rate is {options.rate:g} Hz: give one above 0")
    return low, high


def _write(options: argparse.Namespace, signal: Any) -> Path:
    from jaxquad.workflows import write_whole

    out = options.out or Path(f"{options.kind}.csv")
    rows = (f"{t:.9g},{u:.9g}\n" for t, u in zip(signal.time, signal.signal, strict=True))
    write_whole(out, f"time,signal\n{''.join(rows)}".encode())
    return out
