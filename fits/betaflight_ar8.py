"""What a measured Betaflight log says of its rate loops, and why it is not enough for new gains.

17 s of acro on the sticks, without a chirp. The log is not part of this repository: JAXQUAD_DATA
names the folder that holds `betaflight_ar8/`.
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np

import jaxquad as jq
from jaxquad.autopilot import (
    AutopilotProposal,
    betaflight_loop,
    FilterChain,
    FlownBetaflight,
    replay_terms,
)
from jaxquad.records import read_settings
from jaxquad.records.formats import load_log
from jaxquad.workflows import autopilot, AutopilotSettings


jq.enable_x64()

AXES = ("roll", "pitch")
HOVER = 0.34  # throttle, which this flight held for 11 s
HERTZ = (5.0, 10.0, 20.0)
BAND = (2 * np.pi * 3.0, 2 * np.pi * 15.0)  # rad/s, of the loop again


def read_loop(path: Path) -> FlownBetaflight:
    """The loop of the header, at the throttle that was flown."""
    given = read_settings(path)
    return betaflight_loop(given.values, given.version, throttle=HOVER)


def loop_in_words(flown: FlownBetaflight) -> str:
    """Gains, filters with their delays, and what the law leaves out."""
    law, lines = flown.law, ["the loop that flew, by the log's header"]
    for k, axis in enumerate(AXES):
        gains = ", ".join(f"{n} {float(vars(law)[n.lower()][k]):.0f}" for n in "PID")
        lines.append(f"  {axis}: {gains}, at {1 / law.dt:.0f} Hz")
    for chain in (law.gyro, FilterChain(law.filters, 1 / law.dt)):
        for share in chain.shares(HERTZ)[:-1]:
            late = ", ".join(f"{x:.2f}" for x in share.delay_ms)
            lines.append(f"  gyro, {share.name}: {late} ms at {HERTZ[0]:g}, 10, 20 Hz")
    return "\n".join(lines + [f"  not modelled: {each}" for each in flown.unmodelled])


def terms_again(path: Path, flown: FlownBetaflight) -> dict[str, list[float]]:
    """Median difference of P, I and D, computed from set-point and gyro, to those of the log."""
    table = load_log(path).tables[""].columns
    columns = lambda kind: np.stack([table[f"{kind}[{k}]"] * 1.0 for k in range(3)], 1)
    throttle = np.clip((table["rcCommand[3]"] - 1000) / 1000, 0, 1)
    setpoint, gyro = (np.deg2rad(columns(name)) for name in ("setpoint", "gyroADC"))
    found = replay_terms(flown, setpoint, gyro, throttle, dt=1e-3, integral=columns("axisI"))
    off = {}
    for name in "PID":
        logged = np.stack([table[f"axis{name}[{k}]"] * 1.0 for k in range(2)], 1)
        off[name] = np.median(np.abs(np.asarray(found[name])[:, :2] - logged)[100:], 0).tolist()
    return off


def at_hover(path: Path, axis: str, flown: FlownBetaflight) -> str:
    """K, lag and delay at the throttles that were held, and the loop that they give."""
    proposal = jq.propose(path, axis=axis)
    record = jq.read(proposal.path, **proposal.options_with_throttle)
    chains = [flown.law.gyro, FilterChain(flown.law.filters, 1 / flown.law.dt)]
    found = jq.identify.gain_over_throttle(record, filters=chains)
    names = {"outputs": record.output_names, "references": record.reference_names}
    alone = jq.records.select(record, inputs=record.input_names[0], **names)
    again = jq.autopilot.reproduce_flight(
        found.fit, flown.law, alone, plant=lambda model: model.at(0),
        unit="deg/s", filters=chains, axis=AXES.index(axis), band=BAND,
    )  # fmt: skip
    return f"{found}\nflown loop with this plant, 3 to 15 Hz: {again}"


def answer(found: AutopilotProposal) -> str:
    """The plant behind the gyro's filters, the flown loop again, and the verdict."""
    fit, again = found.identification.fit, found.reproduction
    lines = [str(fit)]
    if again is not None:
        lines.append(f"flown loop: {again.verdict}")
    return "\n".join([*lines, f"=> {found.verdict}"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(os.environ.get("JAXQUAD_DATA", "../shared/data")) / "betaflight_ar8"
    parser.add_argument("--data", type=Path, default=default, help="folder of LOG00037.BFL")
    parser.add_argument("--out", type=Path, default=Path("results/betaflight_ar8"))
    options = parser.parse_args()
    path = options.data / "LOG00037.BFL"
    if not path.is_file():
        parser.error(f"no flight log at {path}: set JAXQUAD_DATA or give --data")
    began, flown = time.perf_counter(), read_loop(path)
    print(loop_in_words(flown), "\n\nmedian |term again - logged|, in units of pidsum")
    for name, off in terms_again(path, flown).items():
        print(f"  {name}: roll {off[0]:.2f}, pitch {off[1]:.2f}")
    for axis in AXES:
        found = autopilot(path, AutopilotSettings(axis=axis, throttle=HOVER))
        assert isinstance(found, AutopilotProposal)
        print(f"\n{axis}\n{answer(found)}\n\n{at_hover(path, axis, flown)}")
        names = [each.name for each in found.write(options.out / axis)]
        print(f"{options.out / axis}: {', '.join(names)}")
    print(f"\n{time.perf_counter() - began:.1f} s")


if __name__ == "__main__":
    jq.enable_compile_cache()
    main()
