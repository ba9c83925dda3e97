"""From a log of a simulated PX4 to its parameters: what is tuned, refused, and written."""

import json
import struct
from pathlib import Path

import flight_logs
import numpy as np
import pytest
from log_writers import structured, ULog

from jaxquad.cli import main
from jaxquad.control.autopilots import px4_loop
from jaxquad.workflows import AutopilotSettings, SettingsError


GYRO_HZ, EACH = 8000, 20  # samples of the gyro for one of the loop, at 400 Hz
GAIN, LAG, LATE = 60.0, 0.03, 32  # rad/s^2 per unit of torque, s, samples of the gyro
P, I, D, CUTOFF, SLOPE_HZ = 0.15, 0.2, 0.003, 40.0, 30.0
PARAMETERS = {
    **{f"MC_{axis}RATE_{k}": x for axis in ("ROLL", "PITCH", "YAW") for k, x in
       (("P", P), ("I", I), ("D", D))},
    "IMU_GYRO_RATEMAX": 400.0, "IMU_GYRO_CUTOFF": CUTOFF, "IMU_DGYRO_CUTOFF": SLOPE_HZ,
}  # fmt: skip


def low_pass():
    """LowPassFilter2p: bilinear Butterworth, as its coefficients."""
    k = np.tan(np.pi * CUTOFF / GYRO_HZ)
    c = 1 + np.sqrt(2) * k + k * k
    return k * k / c, 2 * (k * k - 1) / c, (1 - np.sqrt(2) * k + k * k) / c


def fly(seconds=30.0, amplitude=1.5, noise=0.05, gains=(P, I, D), seed=3):
    """Set-point, torque and filtered rate at 400 Hz: PX4's equations in plain numbers."""
    p, i, d = gains
    rng = np.random.default_rng(seed)
    steps = int(seconds * GYRO_HZ)
    time = np.arange(steps) / GYRO_HZ
    rise = np.log(60.0) / seconds
    sweep = np.sin(2 * np.pi * 0.5 * (np.exp(rise * time) - 1) / rise)
    r = (amplitude * sweep[::EACH]).tolist()
    jitter = (noise * rng.standard_normal(steps)).tolist()
    gusts = np.repeat(0.02 * rng.standard_normal(steps // 160 + 1), 160).tolist()
    decay = float(np.exp(-1 / (GYRO_HZ * LAG)))
    b, a1, a2 = map(float, low_pass())
    share = 2 * np.pi * SLOPE_HZ / GYRO_HZ / (1 + 2 * np.pi * SLOPE_HZ / GYRO_HZ)
    sent, push, rate, u, integral = [0.0] * (steps + LATE), 0.0, 0.0, 0.0, 0.0
    s1 = s2 = y = slope = 0.0
    rates, torques = [], []
    for k in range(steps):
        before = y
        now = rate + jitter[k]
        y = b * now + s1
        s1, s2 = 2 * b * now - a1 * y + s2, b * now - a2 * y
        slope += share * ((y - before) * GYRO_HZ - slope)
        if k % EACH == 0:
            error = r[k // EACH] - y
            u = p * error + integral - d * slope
            integral += max(0.0, 1 - (error / np.deg2rad(400.0)) ** 2) * i * error * EACH / GYRO_HZ
            rates.append(y)
            torques.append(u)
        sent[k + LATE] = u
        wanted = GAIN * (sent[k] + gusts[k])
        rate += (wanted + (push - wanted) * LAG * GYRO_HZ * (1 - decay)) / GYRO_HZ
        push = wanted + (push - wanted) * decay
    return np.array(r), np.array(torques), np.array(rates)


def write_log(path: Path, flown, parameters=PARAMETERS) -> Path:
    """A ULog of a flight in acro."""
    r, u, y = flown
    log = ULog()
    for name, value in parameters.items():
        log.info(f"float {name}", struct.pack("<f", value), kind="P")
    log.define("vehicle_angular_velocity:uint64_t timestamp;float[3] xyz;")
    log.define("vehicle_torque_setpoint:uint64_t timestamp;float[3] xyz;")
    log.define("vehicle_rates_setpoint:uint64_t timestamp;float roll;float pitch;float yaw;")
    log.define("vehicle_status:uint64_t timestamp;uint8_t nav_state;")
    stamps = np.round(1e6 * (10 + np.arange(len(r)) / 400)).astype("<u8")
    clock, three = {"timestamp": ("<u8", stamps)}, np.array([[1.0, 0.0, 0.0]])
    tables = {
        "vehicle_angular_velocity": {"xyz": ("(3,)<f4", (y[:, None] * three).astype("<f4"))},
        "vehicle_torque_setpoint": {"xyz": ("(3,)<f4", (u[:, None] * three).astype("<f4"))},
        "vehicle_rates_setpoint": {
            name: ("<f4", r if name == "roll" else 0 * r) for name in ("roll", "pitch", "yaw")
        },
        "vehicle_status": {"nav_state": ("u1", np.full(len(r), 10))},
    }
    for number, (name, columns) in enumerate(tables.items()):
        log.subscribe(number, name)
        log.write_rows(number, structured(clock | columns))
    path.write_bytes(log.content)
    return path


def true_loop(gains, omega):
    """L of the simulated loop, from the same equations in the frequency domain."""
    p, i, d = gains
    z = np.exp(1j * omega * EACH / GYRO_HZ)
    s, gyro = 1j * omega, np.exp(1j * omega / GYRO_HZ)
    hold = (1 - 1 / z) / (s * EACH / GYRO_HZ)
    plant = GAIN / (s * (LAG * s + 1)) * np.exp(-s * LATE / GYRO_HZ) * hold
    b, a1, a2 = low_pass()
    smooth = b * (1 + 1 / gyro) ** 2 / (1 + a1 / gyro + a2 / gyro**2)
    share = 2 * np.pi * SLOPE_HZ / GYRO_HZ / (1 + 2 * np.pi * SLOPE_HZ / GYRO_HZ)
    slope = (1 - 1 / gyro) * GYRO_HZ * share / (1 - (1 - share) / gyro)
    return plant * smooth * (p + i * EACH / GYRO_HZ / (z - 1) + d * slope)


def read_params(text: str) -> dict[str, float]:
    """QGroundControl's tab-separated file."""
    rows = [row.split("\t") for row in text.splitlines() if not row.startswith("#")]
    return {name: float(value) for _, _, name, value, _ in rows}


def fly_again(gains) -> float:
    """Root mean square of the rate in gusts alone: it grows without bound where unstable."""
    return float(np.sqrt(np.mean(fly(seconds=5.0, amplitude=0.0, noise=0.0, gains=gains)[2] ** 2)))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [({"sensitivity": 1.0}, "no loop"), ({"change": 0.5}, "above 1"), ({"throttle": 30}, "share"),
     ({"axis": "rol"}, "roll")],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused(wrong, words):
    with pytest.raises(SettingsError, match=words):
        AutopilotSettings(**wrong)


def test_settings_are_options_and_back():
    settings = AutopilotSettings(axis="roll", band=(1, 40), noise=1)
    assert settings.words() == ["--axis", "roll", "--band", "1", "40", "--noise", "1"]
    assert AutopilotSettings.from_mapping(settings.content()) == settings


def test_a_log_without_gains_is_refused_in_one_line(tmp_path, capsys):
    path = flight_logs.px4(tmp_path, nav_state=10)  # it holds MC_ROLLRATE_P alone
    assert main(["autopilot", str(path), "--axis", "roll", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("jaxquad: error:") and "MC_PITCHRATE_P" in said
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_log(tmp_path_factory.mktemp("px4") / "flight.ulg", fly())


@pytest.mark.slow
def test_the_written_parameters_hold_on_the_true_plant(log, tmp_path, capsys):
    code = main(["autopilot", str(log), "--axis", "roll", "--out", str(tmp_path)])
    printed = capsys.readouterr()
    assert code == 0, printed
    content = json.loads((tmp_path / "autopilot.json").read_text())
    assert content["kind"] == "proposed" and content["reproduction"]["kind"] == "flown"
    whole = read_params((tmp_path / "proposal_100.params").read_text())
    back = read_params((tmp_path / "proposal_revert.params").read_text())
    assert set(whole) == set(back) <= {"MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_ROLLRATE_D"}
    for name, value in back.items():
        assert value == pytest.approx(PARAMETERS[name], rel=1e-6)
    # The file gives the loop that was certified.
    law = px4_loop({k: str(x) for k, x in (PARAMETERS | whole).items()}).law
    before, _, after = content["stages"]
    assert after["gains"] == pytest.approx([float(x[0]) for x in (law.p, law.i, law.d)])
    omega = np.geomspace(0.1, 400 * np.pi * 0.99, 2000)
    peaks = [1 / np.min(np.abs(1 + true_loop(x["gains"], omega))) for x in (before, after)]
    assert peaks[0] <= before["peak"] and peaks[1] <= after["peak"] <= 1.8
    # The certificate is of the truth's size, and torque moves the rate less.
    assert after["peak"] < 1.25 * peaks[1]
    assert after["rejection"] < 0.7 and fly_again(after["gains"]) < 0.8 * fly_again((P, I, D))
    assert "searching gains on" in printed.err


@pytest.mark.slow
def test_other_gains_than_those_of_the_log_are_noticed(tmp_path, capsys):
    path = write_log(tmp_path / "other.ulg", fly(gains=(1.6 * P, I, D)))
    assert main(["autopilot", str(path), "--axis", "roll", "--out", str(tmp_path / "out")]) == 3
    written = sorted(each.name for each in (tmp_path / "out").iterdir())
    assert written == ["autopilot.json", "proposal_revert.params"]
    assert "this log cannot tell" in capsys.readouterr().out
