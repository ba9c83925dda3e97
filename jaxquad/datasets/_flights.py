"""The published flights as records, with the channels and the part of the flight that are meant."""

from typing import Literal

import numpy as np

from jaxquad.records import read, Record

from ._files import FILES, locate


_RADIANS = np.pi / 180
_AXES = ("roll", "pitch", "yaw")
_RATES = ("p", "q", "r")


def antx_pitch(flight: Literal["prbs", "sweep"] = "prbs") -> Record:
    """A quadrotor on a pitch rig (ANT-X, Politecnico di Milano): moment `M` to rate `q`.

    Closed loop at 250 Hz. The reference `x0` is the set-point of the position in m, outside of
    every feedback: for 26 s as a binary sequence, or for 25 s as a sweep of 0.14 to 1 Hz.
    Licence: MIT, for educational purposes.

    **Arguments:**

    - `flight`: "prbs" to identify, "sweep" to verify.

    **Raises:**

    - `ReadError`: as `jq.datasets.locate`. Its publisher's file has no known checksum: it is not
        downloaded.
    """
    path = locate(FILES[f"antx_pitch {flight}"])
    start, stop = {"prbs": (50.0, 76.0), "sweep": (132.8, 158.0)}[flight]
    field = ".value" if path.suffix == ".mat" else ""
    pick = lambda name: {name: {f"{name}{field}": 1.0}}
    return read(
        path, inputs=pick("M"), outputs=pick("q"), references=pick("x0"), sample_rate=250.0,
        start=start, stop=stop, units={"q": "rad/s", "x0": "m"},
    )  # fmt: skip


_ARM = 0.028  # m
_THRUST = (0.02126557, -0.01117503, 0.12012994)  # N by powers of a motor's command
_MIXES = {"roll": (-1, -1, 1, 1), "pitch": (-1, 1, 1, -1)}


def crazyflie_rollpitch(axis: Literal["roll", "pitch"] = "roll") -> Record:
    """A Crazyflie 2 under strong manual manoeuvres: torque in N m to rate in rad/s.

    Closed loop at 1 kHz, 35 s, without a set-point. The torque is that of the four motors by their
    thrust curve. Licence: MIT. Source: Eschmann, Albani, Loianno, "Data-Driven System
    Identification of Quadrotors Subject to Motor Delays" (2024).

    **Arguments:**

    - `axis`: "roll" or "pitch".

    **Raises:**

    - `ReadError`: as `jq.datasets.locate`.
    """
    rate = {"roll": {"p": {"gyro.x": _RADIANS}}, "pitch": {"q": {"gyro.y": _RADIANS}}}[axis]
    motors = [f"motor.m{k}" for k in (1, 2, 3, 4)]
    path = locate(FILES["crazyflie_rollpitch"])
    log = read(path, inputs=motors, outputs=rate, start=55.0, stop=90.0, sample_rate=1010.0)
    thrust = np.polynomial.Polynomial(_THRUST)(log.inputs / 65535)  # N
    return Record(
        log.time, _ARM * thrust @ np.array(_MIXES[axis]), log.outputs,
        input_names="torque", output_names=log.output_names,
        input_units="N m", output_units="rad/s", source=log.source,
    )  # fmt: skip


def betaflight_ar8(axis: Literal["roll", "pitch", "yaw"] = "pitch") -> Record:
    """A racing quadrotor under Betaflight 4.2: sum of the PID terms to rate in rad/s.

    Closed loop at 985 Hz, 17 s, without excitation: its coherence comes from the feedback, and a
    direct estimate tends to that of the controller. Licence: MIT or Apache 2.0.

    **Arguments:**

    - `axis`: "roll", "pitch" or "yaw".

    **Raises:**

    - `ReadError`: as `jq.datasets.locate`.
    """
    k = _AXES.index(axis)
    return read(
        locate(FILES["betaflight_ar8"]),
        inputs={"pid_sum": {f"axisSum[{k}]": 1.0}},
        outputs={_RATES[k]: {f"gyroADC[{k}]": _RADIANS}},
        references={"setpoint": {f"setpoint[{k}]": _RADIANS}},
        units={_RATES[k]: "rad/s", "setpoint": "rad/s"},
    )


def crazypad_hover(
    flight: Literal["E8_log00", "E8_log01", "E9_log00"] = "E8_log00",
    axis: Literal["roll", "pitch", "yaw"] = "roll",
) -> Record:
    """A Crazyflie 2.1 in hover: command of the rate controller to rate in rad/s.

    Closed loop at 100 Hz, 26 s, without excitation: nothing can be identified from it. Licence:
    MIT. Source: Masalimov, Muslimov et al., Data 2024, 9, 79.

    **Arguments:**

    - `flight`: one of three.
    - `axis`: "roll", "pitch" or "yaw".

    **Raises:**

    - `ReadError`: as `jq.datasets.locate`.
    """
    rate, group = _RATES[_AXES.index(axis)], "fixedFrequency.controller"
    return read(
        locate(FILES[f"crazypad_hover {flight}"]),
        inputs={"command": {f"{group}.cmd_{axis}": 1.0}},
        outputs={rate: {f"{group}.r_{axis}": 1.0}},
        units={rate: "rad/s"},
    )


def cessna_xplane() -> Record:
    """A Cessna 172 of the simulator X-Plane: elevator to pitch rate in rad/s.

    Open loop, a sweep of 290 s, logged every 20 to 50 ms and resampled to 40 Hz. CIFER's numbers
    for it are in `fits/cessna_navfit.py`. Licence: MIT, by the README of its publisher.

    **Raises:**

    - `ReadError`: as `jq.datasets.locate`.
    """
    return read(
        locate(FILES["cessna_xplane"]),
        inputs={"elevator": {"data[1]": 1.0}},
        outputs={"q": {"data[4]": _RADIANS}},
        units={"q": "rad/s"},
        time="data[0]",
        sample_rate=40.0,
    )
