"""What a measured Crazyflie log says of its rate loops: the plant, and which gains it cannot tell.

35 s of strong roll and pitch by hand, motors and gyro at 1 kHz. The log is not part of this
repository: JAXQUAD_DATA names the folder that holds `crazyflie_rollpitch/`.
"""

import argparse
import os
import time
from pathlib import Path

import jax
import numpy as np

import jaxquad as jq
from jaxquad.autopilot import CrazyflieRate, list_parameters
from jaxquad.report import write_results
from jaxquad.workflows import Identification, identify, IdentifySettings


jq.enable_x64()

# The mixer of the firmware, backwards: its commands from the motors, and rates in its own signs.
COMMANDS = {
    "roll": "u=-0.5*motor.m1-0.5*motor.m2+0.5*motor.m3+0.5*motor.m4",
    "pitch": "u=0.5*motor.m1-0.5*motor.m2-0.5*motor.m3+0.5*motor.m4",
}
RATES = {"roll": "p=gyro.x", "pitch": "q=-1*gyro.y"}  # deg/s
DEFAULTS = CrazyflieRate(kp=250.0, ki=500.0, kd=2.5)  # behind the gyro's filter, as the log is
OMEGA = np.geomspace(1.0, 1500.0, 300)  # rad/s
FLY = (
    "fly 20 s of quick stick, or a chirp that your own code adds to the rate set-point, with the "
    "set-point (controller.rollRate, controller.pitchRate), controller.cmd_roll, .cmd_pitch and "
    "the gyro in the log, and write down pid_rate.* of the flight"
)


def plant_of(path: Path, axis: str) -> Identification:
    """From the firmware's command to the rate, where the tilt's drift and the noise leave it."""
    settings = IdentifySettings(
        input=COMMANDS[axis], output=RATES[axis], units={RATES[axis][0]: "deg/s"},
        start=55.0, stop=90.0, rate=1010.0, band=(1.5, 15.0),
    )  # fmt: skip
    return identify(path, settings)


def law_in_words(path: Path, axis: str) -> str:
    """The command over the rate that was measured, beside what the default gains make of it."""
    parts = lambda text: {text.split("=")[0]: _terms(text.split("=")[1])}
    record = jq.read(
        path, inputs=parts(RATES[axis]), outputs=parts(COMMANDS[axis]), start=55.0, stop=90.0,
        sample_rate=1010.0,
    )  # fmt: skip
    omega = 2 * np.pi * np.array([2.0, 5.0, 10.0, 15.0, 20.0])
    found = jq.frequency_response(record, omega)
    measured, law = np.asarray(found.response)[:, 0, 0], _from_rate(omega)
    in_words = lambda x: f"{abs(x):6.0f} at {np.degrees(np.angle(x)):4.0f} deg"
    return "\n".join(
        f"  {w / (2 * np.pi):5.1f} Hz: measured {in_words(m)}, defaults {in_words(d)}"
        for w, m, d in zip(omega, measured, law, strict=True)
    )


def _terms(text: str) -> dict[str, float]:
    """Of a weighted sum of channels."""
    pieces = text.replace("-", "+-").split("+")
    pairs = [piece.rpartition("*") for piece in pieces if piece]
    return {name: float(weight or 1.0) for weight, _, name in pairs}


def _from_rate(omega: np.ndarray) -> np.ndarray:
    """The command of the default gains per deg/s of rate, without a set-point."""
    law = DEFAULTS.linear()
    z = np.exp(1j * omega * law.dt)[:, None, None]
    inner = np.linalg.solve(z * np.eye(len(law.A)) - np.asarray(law.A), law.measurement_in)
    return (inner @ np.asarray(law.C) + float(law.measurement_through)) * np.pi / 180


def judge_defaults(found: Identification, draws: int = 200) -> str:
    """Stability and Ms of the default gains on plants drawn from the fit."""
    models = found.fit.ensemble(draws, jax.random.key(0))
    one = lambda x: np.broadcast_to(np.asarray(x), (draws,))[:, None]
    s = 1j * OMEGA
    hold = np.sinc(OMEGA * DEFAULTS.dt / 2 / np.pi) * np.exp(-0.5j * OMEGA * DEFAULTS.dt)
    plant = one(models.gain) * np.exp(-one(models.delay) * s) * hold
    distance = 1 - plant / (s * (one(models.lag) * s + 1)) * _from_rate(OMEGA)
    stable = np.unwrap(np.angle(distance), axis=1)[:, [0, -1]] @ [1, -1] < 0  # Nyquist
    low, middle, high = np.percentile(1 / np.abs(distance).min(axis=1)[stable], [5, 50, 95])
    return (
        f"stable on {100 * stable.mean():.0f} % of the plants that the fit leaves, there Ms "
        f"{middle:.1f} ({low:.1f} .. {high:.1f})"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(os.environ.get("JAXQUAD_DATA", "../shared/data")) / "crazyflie_rollpitch"
    parser.add_argument("--data", type=Path, default=default, help="folder of log15")
    parser.add_argument("--out", type=Path, default=Path("results/crazyflie_rates"))
    options = parser.parse_args()
    path = options.data / "log15"
    if not path.is_file():
        parser.error(f"no flight log at {path}: set JAXQUAD_DATA or give --data")
    began = time.perf_counter()
    for axis in COMMANDS:
        found = plant_of(path, axis)
        print(f"{axis}, from cmd_{axis} to the rate in deg/s, 1.5 to 15 Hz\n{found}\n")
        print(f"from the rate to the command, per deg/s\n{law_in_words(path, axis)}")
        write_results(options.out / axis, fit=found.fit, frf=found.frf)
        if found.fit.identifiable:
            gains = ", ".join(
                f"{k} {v:g}" for k, v in list_parameters(DEFAULTS).items() if axis in k
            )
            print(f"the defaults ({gains}) would be {judge_defaults(found)}\n")
    print(
        "\n=> this log cannot tell which gains flew: it holds neither set-points nor parameters,\n"
        "and what the command makes of the rate is pilot and plant as much as law. Nothing is\n"
        f"proposed; {FLY}.\n{options.out}; {time.perf_counter() - began:.1f} s"
    )


if __name__ == "__main__":
    jq.enable_compile_cache()
    main()
