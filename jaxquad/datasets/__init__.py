"""Measured flights that others have published: found on this machine, or downloaded."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import platformdirs

from jaxquad.records import read, ReadError, Record


__all__ = [
    "antx_pitch",
    "betaflight_ar8",
    "cessna_xplane",
    "crazyflie_rollpitch",
    "crazypad_hover",
    "DataFile",
    "FILES",
    "locate",
]
_FOLDER = "JAXQUAD_DATA"
_RAW = "https://raw.githubusercontent.com"


class DataFile(NamedTuple):
    """A published file."""

    folder: str  # of the data set, within the folder that JAXQUAD_DATA names
    name: str
    origin: str  # an address; one that ends with the file can be downloaded
    sha256: str = ""  # empty where nobody has taken it, and then it is not downloaded
    others: tuple[str, ...] = ()  # names of the same flight in other formats, which count as well


_ANTX = "https://github.com/MattiaDiMauro/Model-identification-and-state-estimation-for-a-multirotor-UAV"
_CRAZYFLIE = (
    "arplaboratory/data-driven-system-identification/2d267dd07b4262f579ee223d20b26a6dc9d17147"
)
_BLACKBOX = "ilya-epifanov/fc-blackbox/de08350b2bd95f7af93b1b4adf0f27dc3dfd227a"
_CESSNA = "xuhao1/pyAircraftIden/0aebfb7db67d1ccc258844914a56141242975ce6"
_SWEEP = "sweep_data_2017_12_10_19_05.npy"
_CRAZYPAD = "AerialRoboticsUUST/CrazyPAD/5448265fa1bbb3ce983a73a9336cc6e887886360"


_HOVERS = {
    "E8_log00": "f53df39f807f3ffdeab37efa3a2a463a239a4d79703c92a8a93db1fe24001510",
    "E8_log01": "fea67514d5960352ce7944dd7a07eff22aa19e9118446c39382b9f7d3ab53b70",
    "E9_log00": "358100a9845755841fa0ab1febc8238e8d0a6515ff387b5b6a2bba0c3aaeb904",
}
_NORMAL = f"{_RAW}/{_CRAZYPAD}/data/controller_data/normal_flight"

FILES: Mapping[str, DataFile] = {
    "antx_pitch prbs": DataFile(
        "antx_pitch", "log_3_2024-5-22-17-30-40_2dd (1).mat", _ANTX,
        others=("antx_log3_prbs.npz",),
    ),
    "antx_pitch sweep": DataFile(
        "antx_pitch", "log_2_2024-5-22-17-28-50_2dd (1).mat", _ANTX,
        others=("antx_log2_sweep.npz",),
    ),
    "crazyflie_rollpitch": DataFile(
        "crazyflie_rollpitch", "log15", f"{_RAW}/{_CRAZYFLIE}/logs_crazyflie/log15",
        "364dea627205f4eee3e8d54f72b0ba8fd93442dcea9c8cc4a42b59004ecf3a31",
    ),
    "betaflight_ar8": DataFile(
        "betaflight_ar8", "LOG00037.BFL", f"{_RAW}/{_BLACKBOX}/src/test-data/LOG00037.BFL",
        "5fb78729580c414f41654d3b2103417088a972c9049ce873303835fc5c66c8f2",
    ),
    "cessna_xplane": DataFile(
        "cessna_xplane", _SWEEP, f"{_RAW}/{_CESSNA}/data/{_SWEEP}",
        "8f64fc161750af94febf9f5da4cb5a1ecc47d09ce039e8c79e13aa8c8d85df38",
    ),
    **{
        f"crazypad_hover {name}": DataFile("crazypad_hover", name, f"{_NORMAL}/{name}", sha256)
        for name, sha256 in _HOVERS.items()
    },
}  # fmt: skip


def locate(file: DataFile) -> Path:
    """The path of a published file: on this machine, or after a download.

    Looked for in the folder of the data set within `JAXQUAD_DATA`, then in the user's cache folder
    (`jaxquad/datasets`). Otherwise it is downloaded into the latter (extra `datasets`), where its
    SHA-256 is known, and refused if it is another one.

    **Arguments:**

    - `file`: one of `jq.datasets.FILES`, or of your own.

    **Raises:**

    - `ReadError`: the file is nowhere, cannot be downloaded, or is not what was published.
    """
    cache = Path(platformdirs.user_cache_dir("jaxquad")) / "datasets" / file.folder
    data = os.environ.get(_FOLDER)
    folders = ([Path(data) / file.folder] if data else []) + [cache]
    for folder in folders:
        for name in (*file.others, file.name):
            if (folder / name).is_file() and (folder != cache or not file.sha256):
                return folder / name
    unset = "" if _FOLDER in os.environ else f" ({_FOLDER} is not set)"
    missing = f"{file.name} is not in {' nor in '.join(map(str, folders))}{unset}"
    if not file.sha256:
        raise ReadError(
            f"{missing}. It cannot be checked after a download, as no checksum of it "
            f"is known: take it from {file.origin} and put it into {folders[0]}"
        )
    try:
        import pooch
    except ImportError as error:
        raise ReadError(
            f"{missing}, and pooch, which downloads it, is not installed: pip install "
            f'"jaxquad[datasets]", or set {_FOLDER} to the folder that holds {file.folder}'
        ) from error
    pooch.get_logger().setLevel("WARNING")
    try:  # a sound file in the cache stays as it is
        path = pooch.retrieve(
            file.origin, f"sha256:{file.sha256}", fname=file.name, path=cache, progressbar=False
        )
    except ValueError as error:
        raise ReadError(
            f"{file.origin} is not the file that was published: its SHA-256 differs from "
            f"{file.sha256}. Nothing was kept; try again, or take the file from elsewhere"
        ) from error
    except OSError as error:
        raise ReadError(
            f"{missing}, and {file.origin} cannot be downloaded ({type(error).__name__}). Look at "
            f"the connection, or set {_FOLDER} to the folder that holds {file.folder}"
        ) from error
    return Path(path)


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

    Its publisher's file has no known checksum: it is not downloaded.
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
    """
    rate, group = _RATES[_AXES.index(axis)], "fixedFrequency.controller"
    return read(
        locate(FILES[f"crazypad_hover {flight}"]), inputs={"command": {f"{group}.cmd_{axis}": 1.0}},
        outputs={rate: {f"{group}.r_{axis}": 1.0}}, units={rate: "rad/s"},
    )  # fmt: skip


def cessna_xplane() -> Record:
    """A Cessna 172 of the simulator X-Plane: elevator to pitch rate in rad/s.

    Open loop, a sweep of 290 s, logged every 20 to 50 ms and resampled to 40 Hz. CIFER's numbers
    for it are in `fits/cessna_navfit.py`. Licence: MIT, by the README of its publisher.
    """
    return read(
        locate(FILES["cessna_xplane"]), inputs={"elevator": {"data[1]": 1.0}},
        outputs={"q": {"data[4]": _RADIANS}}, units={"q": "rad/s"}, time="data[0]",
        sample_rate=40.0,
    )  # fmt: skip
