"""From a log of a simulated PX4 to its parameters: what is tuned, refused, and written."""

import json
from types import SimpleNamespace

import blackbox_rows
import blackbox_writer
import flight_logs
import numpy as np
import pytest
from log_writers import DataFlash
from px4_flights import GYRO_HZ as SAMPLED_HZ, Vehicle, write_log
from scipy import signal

from jaxquad._core import Message
from jaxquad.autopilot import AutopilotProposal, betaflight_loop, design_gains, px4_loop
from jaxquad.cli import main
from jaxquad.workflows import autopilot, AutopilotSettings, SettingsError


VEHICLE = Vehicle()
PARAMETERS = VEHICLE.parameters


def read_params(text: str) -> dict[str, float]:
    """QGroundControl's tab-separated file."""
    rows = [row.split("\t") for row in text.splitlines() if not row.startswith("#")]
    return {name: float(value) for _, _, name, value, _ in rows}


@pytest.mark.parametrize(
    ("wrong", "words"),
    [({"sensitivity": 1.0}, "no loop"), ({"resonance": 0.9}, "above 1"),
     ({"change": 0.5}, "above 1"), ({"throttle": 30}, "share"), ({"axis": "rol"}, "roll")],
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
    return write_log(tmp_path_factory.mktemp("px4") / "flight.ulg", VEHICLE.fly(), PARAMETERS)


@pytest.mark.slow
def test_the_written_parameters_hold_on_the_true_plant(log, tmp_path, capsys, caplog):
    code = main(["autopilot", str(log), "--axis", "roll", "--out", str(tmp_path)])
    printed = capsys.readouterr()
    assert code == 0, printed
    content = json.loads((tmp_path / "autopilot.json").read_text())
    assert content["kind"] == "proposed" and content["reproduction"]["kind"] == "flown"
    # The plant is the vehicle's own, though the log is behind a low-pass of 40 Hz.
    assert content["plant"]["gain"] == pytest.approx(VEHICLE.gain, rel=0.03)
    assert content["plant"]["lag"] == pytest.approx(VEHICLE.lag, rel=0.05)
    assert content["plant"]["delay"] == pytest.approx(VEHICLE.late / SAMPLED_HZ, abs=4e-4)
    whole = read_params((tmp_path / "proposal_100.params").read_text())
    back = read_params((tmp_path / "proposal_revert.params").read_text())
    assert set(whole) == set(back) <= {"MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_ROLLRATE_D"}
    assert content["filters"]["text"].startswith("as they flew: ")  # the noise's limit is reached
    assert 100 < content["noise"]["known_hz"] < 200  # behind a low-pass of 40 Hz, in a log of 400
    for name, value in back.items():
        assert value == pytest.approx(PARAMETERS[name], rel=1e-6)
    # The file gives the loop that was certified.
    law = px4_loop({k: str(x) for k, x in (PARAMETERS | whole).items()}).law
    before, _, after = content["stages"]
    assert after["gains"] == pytest.approx([float(x[0]) for x in (law.p, law.i, law.d)])
    omega = np.geomspace(0.1, 400 * np.pi * 0.99, 2000)
    both = VEHICLE, VEHICLE.proposed(whole)
    peaks = [1 / np.min(np.abs(1 + vehicle.loop(omega))) for vehicle in both]
    assert peaks[0] <= before["peak"] and peaks[1] <= after["peak"] <= 1.8
    # The certificate is of the truth's size, and torque moves the rate less.
    assert after["peak"] < 1.25 * peaks[1]
    moved = [vehicle.effect() for vehicle in both]
    assert after["rejection"] < 0.7 and moved[1] < 0.8 * moved[0]
    assert any(said.startswith("searching gains on") for said in caplog.messages)


@pytest.mark.slow
def test_other_gains_than_those_of_the_log_are_noticed(tmp_path, capsys):
    p, i, d = VEHICLE.gains
    flown = VEHICLE._replace(gains=(1.6 * p, i, d)).fly()
    path = write_log(tmp_path / "other.ulg", flown, PARAMETERS)
    assert main(["autopilot", str(path), "--axis", "roll", "--out", str(tmp_path / "out")]) == 3
    written = sorted(each.name for each in (tmp_path / "out").iterdir())
    assert written == ["autopilot.html", "autopilot.json", "proposal_revert.params"]
    text = capsys.readouterr().out
    assert "this log cannot tell" in text and text.count("not the gains that flew") == 1


POOR = "not identifiable from this record: coherence reaches 0.6 at 0 of 100 frequencies"
AGAIN = "these are not the gains that flew: P in the log is 1.31 times what they make"


class PoorFit(SimpleNamespace):
    verdict = SimpleNamespace(summary=POOR)

    def __str__(self):
        return f"NOT {POOR}"


CANNOT_TELL = Message(f"this log cannot tell: «plant|{POOR}». Fly a chirp")


@pytest.mark.parametrize(("verdict", "kind"), [(CANNOT_TELL, "flown"), (AGAIN, "not flown")])
def test_the_printed_verdict_repeats_nothing_of_what_is_above_it(verdict, kind):
    """Of stand-ins: such fits and loops were printed of a measured flight, each sentence twice."""
    flown = SimpleNamespace(version=(4, 2), axis=0, firmware="betaflight", old={}, filters_text="")
    vars(flown).update(loop=SimpleNamespace(unmodelled=()), angle=None, measured=None)
    found = object.__new__(AutopilotProposal)
    vars(found).update(
        kind="cannot tell", verdict=verdict, flown=flown, stages=(), throttle=None, filters=None,
        new={},
        identification=SimpleNamespace(fit=PoorFit()),
        reproduction=SimpleNamespace(verdict=AGAIN, kind=kind),
    )  # fmt: skip
    text = str(found)
    assert text.count(AGAIN) == text.count(POOR) == 1
    assert ("cannot tell: it does not determine the plant" in text) == (POOR in verdict)


RATE, LAG, GAIN, LATE = 1000, 0.025, 60.0, 3  # Hz, s, deg/s^2 per pidsum, samples
PID, RAISED, SLOPE_HZ = (28, 40, 18), 26, 105.0  # D_MAX above D, which steady moves do not reach
BETAFLIGHT = {
    "Firmware type": "Betaflight", "Firmware revision": "Betaflight 4.5.1 (abc) STM32F7X2",
    "looptime": "1000", "pid_process_denom": "1", "rollPID": f"28,40,{RAISED}",
    "pitchPID": "47,84,46", "yawPID": "45,80,0", "d_min": "18,30,0", "d_max_gain": "0",
    "d_max_advance": "0", "dterm_lpf1_static_hz": "105", "tpa_rate": "0",
}  # fmt: skip


def fly_betaflight(seconds=24.0, noise=2.0, gyro_hz=0.0, line=(0.0, 0.0), parts=((1.0, 1.0),)):
    """Set-point, pidsum, filtered and unfiltered rate in deg/s at 1 kHz, by its equations.

    The gyro has a pt1 at `gyro_hz` (0: none), and a line of so many Hz and deg/s. Each of the
    `parts` has a chirp, and factors of the plant's gain and of D.
    """
    rng, each = np.random.default_rng(5), int(seconds * RATE) // len(parts)
    samples = each * len(parts)
    gains, damping = np.repeat(parts, each, axis=0).T.tolist()
    time, rise = np.arange(samples) % each / RATE, np.log(50.0) / (each / RATE)
    r = np.round(150 * np.sin(2 * np.pi * (np.exp(rise * time) - 1) / rise)).tolist()
    hum = line[1] * np.sin(2 * np.pi * line[0] * np.arange(samples) / RATE)
    jitter = (noise * rng.standard_normal(samples) + hum).tolist()
    decay = float(np.exp(-1 / RATE / LAG))
    passed = 1 - 1 / (1 + 2 * np.pi * gyro_hz / RATE) if gyro_hz else 1.0
    p, i, d = 0.032029 * PID[0], 0.244381 * PID[1], 0.000529 * PID[2]
    share = 1 - 1 / (1 + 2 * np.pi * SLOPE_HZ / RATE)
    push = rate = smooth = integral = y = 0.0
    sent, rates, unfiltered = [0.0] * LATE, [], []
    for k in range(samples):
        unfiltered.append(rate + jitter[k])
        y += passed * (rate + jitter[k] - y)
        integral += i * (r[k] - y) / RATE
        before, smooth = smooth, smooth + share * (y - smooth)
        sent.append(p * (r[k] - y) + integral - damping[k] * d * (smooth - before) * RATE)
        rates.append(y)
        wanted = GAIN * gains[k] * sent[k]
        rate += (wanted + (push - wanted) * LAG * RATE * (1 - decay)) / RATE
        push = wanted + (push - wanted) * decay
    return r, sent[LATE:], rates, unfiltered


def betaflight_loop_of(gains, omega, slope_hz=SLOPE_HZ):
    """L of these gains of the CLI, in the frequency domain, without the gyro's filters."""
    s, z = 1j * omega, np.exp(1j * omega / RATE)
    p, i, d = 0.032029 * gains[0], 0.244381 * gains[1], 0.000529 * gains[2]
    share = 1 - 1 / (1 + 2 * np.pi * slope_hz / RATE)
    slope = RATE * (1 - 1 / z) * share / (1 - (1 - share) / z)
    # The lag of 25 ms lets no alias through.
    plant = GAIN / (s * (LAG * s + 1)) * (1 - 1 / z) / (s / RATE) * z**-LATE
    return plant * (p + i / RATE / (1 - 1 / z) + d * slope)


def write_blackbox(path, flown, changed, every=1, throttle=None):
    """A log of roll; axisI is put aside for the unfiltered gyro, with as many bits.

    So is rssi for a throttle of 0 to 1.
    """
    names = [name.replace("axisI", "gyroUnfilt") for name in blackbox_writer.NAMES]
    if throttle is not None:
        names = [name.replace("rssi", "setpoint[3]") for name in names]
    level = {name: blackbox_rows.LEVEL.get(name, 0) for name in blackbox_writer.NAMES}
    rows = [
        level | {
            "loopIteration": every * k, "time": 5_000_000 + 1000 * every * k, "axisP[0]": round(u),
            "rcCommand[0]": round(r), "setpoint[0]": round(r), "gyroADC[0]": round(y),
            "axisI[0]": round(x),
            **({} if throttle is None else {"rssi": round(1000 * throttle[every * k])}),
        }
        for k, (r, u, y, x) in enumerate(list(zip(*flown, strict=True))[::every])
    ]  # fmt: skip
    named = BETAFLIGHT | {"Field I name": ",".join(names)} | changed
    path.write_bytes(blackbox_rows.log(rows, logged=f"1/{every}", changed=named))
    return path


def read_cli(path):
    """What a file for the CLI sets to a number."""
    words = [line.split() for line in path.read_text().splitlines() if line.startswith("set ")]
    return {name: int(value) for _, name, _, value in words if value != "OFF"}


@pytest.mark.slow
def test_betaflights_file_holds_whole_numbers_that_keep_the_limit_with_d_raised(tmp_path):
    path = write_blackbox(tmp_path / "flight.bbl", fly_betaflight(), {})
    options = ["--axis", "roll", "--keep-filters", "--out", str(tmp_path)]
    assert main(["autopilot", str(path), *options]) == 0
    old = {"p_roll": 28, "i_roll": 40, "d_min_roll": 18, "d_roll": 26}
    changed = read_cli(tmp_path / "proposal_100.txt")
    new = old | changed
    assert new != old and set(new) == set(old)
    omega = np.geomspace(0.1, 0.99 * np.pi * RATE, 2000)
    for d in (new["d_min_roll"], new["d_roll"]):
        gains = new["p_roll"], new["i_roll"], d
        assert 1 / np.min(np.abs(1 + betaflight_loop_of(gains, omega))) < 1.8
    changed = {"rollPID": f"{new['p_roll']},{new['i_roll']},{new['d_roll']}",
               "d_min": f"{new['d_min_roll']},30,0"}  # fmt: skip
    law = betaflight_loop(BETAFLIGHT | changed, (4, 5, 1)).law
    content = json.loads((tmp_path / "autopilot.json").read_text())
    assert content["stages"][-1]["gains"] == [float(x[0]) for x in (law.p, law.i, law.d)]
    assert "keep_filters" in content["filters"]["text"]


GYRO_HZ, LINE = 80.0, (160.0, 30.0)  # Hz; of a frame that rings, Hz and deg/s


def gyro_of(parameters, omega):
    """The gyro's pt1 and the static notch of these parameters, written once more."""
    z = np.exp(1j * omega / RATE)
    share = 1 - 1 / (1 + 2 * np.pi * parameters.get("gyro_lpf1_static_hz", GYRO_HZ) / RATE)
    passed = share / (1 - (1 - share) / z)
    centre, low = (parameters.get(f"gyro_notch1_{end}", 0.0) for end in ("hz", "cutoff"))
    if centre:
        b, a = signal.iirnotch(centre, centre * low / (centre**2 - low**2), fs=RATE)
        passed = passed * np.polyval(b, z) / np.polyval(a, z)
    return passed


@pytest.mark.slow
def test_a_line_of_the_gyro_gets_a_notch_and_the_low_passes_open(tmp_path, capsys):
    filters = {
        "gyro_lpf1_static_hz": "80", "gyro_notch_hz": "0,0", "gyro_notch_cutoff": "0,0",
    }  # fmt: skip
    flown = fly_betaflight(gyro_hz=GYRO_HZ, line=LINE)
    path = write_blackbox(tmp_path / "flight.bbl", flown, filters)
    assert main(["autopilot", str(path), "--axis", "roll", "--out", str(tmp_path)]) == 0
    new, third, back = (
        read_cli(tmp_path / f"proposal_{end}.txt") for end in ("100", "033", "revert")
    )
    # The notch is where the line is, at once; the low-pass opens, in two steps.
    assert abs(new["gyro_notch1_hz"] - LINE[0]) <= 2 and third["gyro_notch1_hz"] == LINE[0]
    assert GYRO_HZ < third["gyro_lpf1_static_hz"] < new["gyro_lpf1_static_hz"]
    assert (back["gyro_notch1_hz"], back["gyro_lpf1_static_hz"]) == (0, GYRO_HZ)
    before, _, after = json.loads((tmp_path / "autopilot.json").read_text())["stages"]
    # Ms of the true plant with the written filters, which turn the plant of the log.
    omega = np.geomspace(0.1, 0.99 * np.pi * RATE, 4000)
    slope = new.get("dterm_lpf1_static_hz", SLOPE_HZ)
    loop = betaflight_loop_of(after["gains"], omega, slope) * gyro_of(new, omega)
    assert 1 / np.min(np.abs(1 + loop)) <= after["peak"] <= 1.8
    # The command's noise, flown again: the line is gone, and the lag has not grown.
    said = capsys.readouterr().out
    assert after["noise"] < 1 and "with filters it is" in said
    at = np.array([2 * np.pi * 5.0])
    late = [-np.angle(gyro_of(x, at))[0] for x in ({}, new)]
    assert late[1] <= late[0]


@pytest.mark.slow
def test_a_notch_for_the_line_of_another_axis_is_taken_where_this_one_has_no_line(tmp_path):
    flown = fly_betaflight(gyro_hz=GYRO_HZ)
    off = {"gyro_lpf1_static_hz": "80", "gyro_notch_hz": "0,0", "gyro_notch_cutoff": "0,0"}
    path = write_blackbox(tmp_path / "flight.bbl", flown, off)
    roll = autopilot(path, AutopilotSettings(axis="roll"))
    assert isinstance(roll, AutopilotProposal)
    notch = {"gyro_notch1_hz": float(LINE[0]), "gyro_notch1_cutoff": float(LINE[0] - 20)}
    again = design_gains(roll, notch)
    assert again.filters is not None and again.filters.flown == {
        "gyro_notch1_hz": 0.0,
        "gyro_notch1_cutoff": 0.0,
    }
    assert again.new["gyro_notch1_hz"] == LINE[0]


@pytest.mark.slow
def test_a_log_that_is_too_slow_for_the_noise_keeps_its_filters_and_says_why(tmp_path, capsys):
    flown = fly_betaflight(gyro_hz=GYRO_HZ)
    path = write_blackbox(tmp_path / "slow.bbl", flown, {"gyro_lpf1_static_hz": "80"}, every=4)
    assert main(["autopilot", str(path), "--axis", "roll", "--out", str(tmp_path)]) in (0, 3)
    said = capsys.readouterr().out
    assert "as they flew: the gyro of the log shows its noise up to 112 Hz" in said
    assert not any("lpf" in name for name in read_cli(tmp_path / "proposal_revert.txt"))


CUBIC, CURVE, TPA = 0.3, 0.6, (65.0, 0.35)  # thrust_linear / 100 and TPA that flew; f of the truth


def at_throttle(throttle):
    """Of the plant's gain and of D, which factors Betaflight 4.5 has at a throttle.

    The mixer takes thrust_linear's work out of the throttle, t, and adds it to the motors' commands
    t (1 + e (1 - t)^2).
    """
    t = throttle / (1 + (CUBIC - CUBIC**2 / 2) * (1 - throttle) ** 2)
    x = t * (1 + CUBIC * (1 - t) ** 2)
    slope = 1 + CUBIC * (1 - t) ** 2 - 2 * CUBIC * t * (1 - t)
    rate, start = TPA
    damping = 1 - rate / 100 * max(0.0, (throttle - start) / (1 - start))
    return (1 - CURVE + 2 * CURVE * x) * slope, damping


@pytest.mark.slow
def test_betaflights_gains_hold_at_every_throttle_with_the_tpa_of_each(tmp_path, capsys):
    throttles = (0.25, 0.45, 0.65)
    parts = [at_throttle(x) for x in throttles]
    flown = fly_betaflight(seconds=36.0, parts=parts)
    settings = {"tpa_rate": "65", "tpa_breakpoint": "1350", "thrust_linear": "30"}
    path = write_blackbox(
        tmp_path / "flight.bbl", flown, settings, throttle=np.repeat(throttles, 12 * RATE)
    )
    options = ["--axis", "roll", "--keep-filters", "--out", str(tmp_path)]
    assert main(["autopilot", str(path), *options]) == 0, capsys.readouterr()
    content = json.loads((tmp_path / "autopilot.json").read_text())
    *_, after = content["stages"]
    omega = np.geomspace(0.1, 0.99 * np.pi * RATE, 2000)
    for (gain, damping), certified in zip(parts, after["peaks"], strict=True):
        p, i, d = after["gains"]
        loop = gain * betaflight_loop_of((p, i, damping * d), omega)
        assert 1 / np.min(np.abs(1 + loop)) < 1.05 * certified <= 1.05 * 1.8
    # The curve is that of the propellers, however much of it the firmware inverted.
    curve = content["throttle"]["thrust_curve"]
    assert content["throttle"]["gain_over_throttle"]["curve"]["value"] == pytest.approx(
        CURVE,
        abs=0.08,  # 4.5's cubic is only near the curve that is taken for it
    )
    low, high = curve["interval_95"]
    assert low > 30 and curve["flown"] == 30 and curve["proposed"]
    new = read_cli(tmp_path / "thrust_curve.txt")
    assert set(new) == {"thrust_linear"} and low < new["thrust_linear"] < high
    assert read_cli(tmp_path / "thrust_curve_revert.txt") == {"thrust_linear": 30}
    assert "thrust_linear" not in read_cli(tmp_path / "proposal_100.txt")


AVERAGE, SPEED = 0.25, 150.0  # throttle; of the motors, Hz
NOTCHED = {
    "INS_HNTCH_ENABLE": 1.0, "INS_HNTCH_MODE": 1.0, "INS_HNTCH_REF": 0.16, "INS_HNTCH_FREQ": 80.0,
    "INS_HNTCH_BW": 40.0, "INS_HNTCH_ATT": 40.0, "INS_HNTCH_HMNCS": 3.0, "INS_HNTCH_OPTS": 0.0,
    "INS_HNTCH_FM_RAT": 1.0,
    "INS_HNTC2_ENABLE": 1.0, "INS_HNTC2_MODE": 3.0, "INS_HNTC2_REF": 1.0, "INS_HNTC2_FREQ": 60.0,
    "INS_HNTC2_BW": 20.0, "INS_HNTC2_ATT": 20.0, "INS_HNTC2_HMNCS": 1.0, "INS_HNTC2_OPTS": 0.0,
}  # fmt: skip
# Centre in Hz, FREQ and BW, the gain left: 80 Hz sqrt(0.25 / 0.16) with its octave, and the motors.
NOTCHES = [(100.0, 80.0, 40.0, 0.01), (200.0, 80.0, 40.0, 0.01), (SPEED, 60.0, 20.0, 0.1)]


def notch_of(centre, frequency, bandwidth, left):
    """b0, b1 = a1, b2 and a2 at 2 kHz."""
    octaves = 2 * np.log2(frequency / (frequency - bandwidth / 2))
    w, wide = 2 * np.pi * centre / 2000, (2**octaves - 1) / np.sqrt(2**octaves) / 2
    wide *= np.sin(w)
    found = np.array([1 + wide * left, -2 * np.cos(w), 1 - wide * left, 1 - wide]) / (1 + wide)
    return found.tolist()


def fly_ardupilot(gains, seconds=30.0, noise=0.01, plant=80.0, notches=None):
    """Chirp, set-point, rate in rad/s and output at 400 Hz: a loop that holds the level.

    The gyro is filtered at 2 kHz, by `NOTCHES` too; the chirp of 0.5 to 30 Hz enters at the mixer.
    As in the firmware, set-point and chirp act one loop after they are logged, and the output
    contains the chirp.
    """
    rng, parts, dt = np.random.default_rng(7), 5, 1 / 400
    count = int(seconds / dt)
    time, rise = np.arange(count) * dt, np.log(60.0) / seconds
    chirp = (0.1 * np.sin(2 * np.pi * 0.5 * (np.exp(rise * time) - 1) / rise)).tolist()
    jitter = (noise * rng.standard_normal(parts * count)).tolist()
    k = float(np.tan(np.pi * 80.0 / 2000))
    c = 1 + 2**0.5 * k + k * k
    b, a1, a2 = k * k / c, 2 * (k * k - 1) / c, (1 - 2**0.5 * k + k * k) / c
    p, i, d = gains
    share, fine, late = 1 - 1 / (1 + 2 * np.pi * 20.0 * dt), dt / parts, 10
    decay = float(np.exp(-fine / 0.03))
    s1 = s2 = y = push = rate = angle = target = error = slope = integral = 0.0
    sent, rows, wanted = [0.0] * late, [], 0.0
    banks = [[notch_of(*x), 0.0, 0.0] for x in (NOTCHES if notches is None else notches)]
    for n in range(count):
        target += share * (wanted - target)
        before, error = error, target - y
        slope += share * ((error - before) / dt - slope)
        integral += i * error * dt
        u = p * error + integral + d * slope + (chirp[n - 1] if n else 0.0)
        wanted = -4.5 * angle
        rows.append((chirp[n], wanted, y, u))
        for m in range(parts):
            sent.append(u)
            moved = plant * sent[parts * n + m]
            step = moved * fine + (push - moved) * 0.03 * (1 - decay)
            push, rate, angle = moved + (push - moved) * decay, rate + step, angle + rate * fine
            now = rate + jitter[parts * n + m]
            for bank in banks:
                (c0, c1, c2, c3), first, second = bank
                after = c0 * now + first
                bank[1:] = c1 * (now - after) + second, c2 * now - c3 * after
                now = after
            y = b * now + s1
            s1, s2 = 2 * b * now - a1 * y + s2, b * now - a2 * y
    return np.array(rows).T


def write_dataflash(path, flights, gains, throttles=(AVERAGE,), changed=None):
    """ArduPilot's log of SystemID flights with SID_AXIS 10, one after the other."""
    log = DataFlash()
    log.define("SIDS", "QBfff", "TimeUS,Ax,Mag,FSt,FSp", units="s----", mults="F----")
    log.define("SIDD", "Qff", "TimeUS,Targ,F", units="s--", mults="F--")
    log.define(
        "RATE", "Qfffffff", "TimeUS,RDes,R,ROut,PDes,P,POut,AOut", units="skk-kk--",
        mults="F-------",
    )  # fmt: skip
    log.define("ESC", "QBf", "TimeUS,Instance,RPM", units="s#-", mults="F--")
    kept = {f"ATC_RAT_{axis}_{k}": x for axis in ("RLL", "PIT", "YAW")
            for k, x in zip("PID", gains, strict=True)}  # fmt: skip
    kept |= {"INS_GYRO_RATE": 1.0, "INS_GYRO_FILTER": 80.0, "SCHED_LOOP_RATE": 400.0, **NOTCHED}
    kept |= changed or {}
    for name, value in kept.items():
        log.write("PARM", 0, name.encode(), value)
    begin = 10_000_000
    for flown, throttle in zip(flights, throttles, strict=True):
        log.write("SIDS", begin - 1000, 10, 0.1, 0.5, 30.0)
        for n, (chirp, wanted, y, u) in enumerate(flown.T.tolist()):
            stamp = begin + 2500 * n
            log.write("SIDD", stamp, chirp, 1.0)
            log.write("RATE", stamp, np.degrees(wanted), np.degrees(y), u, 0.0, 0.0, 0.0, throttle)
            if n % 40 == 0:
                for motor in range(4):
                    log.write("ESC", stamp, motor, 60 * (SPEED + 4 * motor - 6))
        begin = stamp + 3_000_000
    path.write_bytes(log.content)
    return path


@pytest.mark.slow
def test_ardupilots_chirp_at_the_mixer_shows_its_law(tmp_path, capsys):
    gains = (0.135, 0.135, 0.0036)
    path = write_dataflash(tmp_path / "flight.bin", [fly_ardupilot(gains)], gains)
    options = ["--axis", "roll", "--out"]
    assert main(["autopilot", str(path), *options, str(tmp_path)]) == 0, capsys.readouterr()
    content = json.loads((tmp_path / "autopilot.json").read_text())
    assert content["axis"] == "roll" and content["reproduction"]["misfit"] < 0.05
    output = content["reproduction"]["law"]["terms"]["output"]
    assert output["size"] == pytest.approx(1, abs=0.01) and output["share"] < 0.01
    assert (tmp_path / "proposal_100.param").read_text().count("ATC_RAT_RLL_") >= 4
    # The gyro's notches are part of the loop, and stay; beyond them the log shows the noise.
    assert content["unmodelled"] == [] and not any("HNTC" in name for name in content["new"])
    page = (tmp_path / "autopilot.html").read_text()
    assert "harmonic notch 100, 200 Hz" in page and "harmonic notch 150 Hz" in page
    assert content["noise"]["known_hz"] > 120
    # The log of other gains.
    path = write_dataflash(tmp_path / "other.bin", [fly_ardupilot((0.2, 0.2, 0.0036))], gains)
    assert main(["autopilot", str(path), *options, str(tmp_path / "other")]) == 3
    assert "not the gains that flew" in capsys.readouterr().out


@pytest.mark.slow
def test_ardupilots_runs_at_three_throttles_show_what_its_curve_leaves(tmp_path, capsys):
    """MOT_THST_EXPO 0.65 inverts more than there is, so that the gain falls with the throttle."""
    gains, flown, true = (0.135, 0.135, 0.0036), 0.65, 0.3
    throttles = np.array([0.15, 0.3, 0.5])  # of the thrust that is asked for
    half = (1 - flown) / (2 * flown)
    x = np.sqrt(half**2 + throttles / flown) - half
    slope = (1 - true + 2 * true * x) / (1 - flown + 2 * flown * x)
    flights = [fly_ardupilot(gains, seconds=15.0, plant=80.0 * each, notches=()) for each in slope]
    settings = {"MOT_THST_EXPO": flown, "INS_HNTCH_ENABLE": 0.0, "INS_HNTC2_ENABLE": 0.0}
    path = write_dataflash(tmp_path / "flight.bin", flights, gains, throttles.tolist(), settings)
    options = ["--axis", "roll", "--out", str(tmp_path)]
    assert main(["autopilot", str(path), *options]) == 0, capsys.readouterr()
    throttle = json.loads((tmp_path / "autopilot.json").read_text())["throttle"]
    low, high = throttle["ratio_of_gains"][1:]
    assert low < slope[2] / slope[0] < high < 0.8
    low, high = throttle["thrust_curve"]["interval_95"]
    assert low < true < high < flown
    assert "MOT_THST_EXPO,0." in (tmp_path / "thrust_curve.param").read_text()
    assert "MOT_THST_EXPO,0.65" in (tmp_path / "thrust_curve_revert.param").read_text()
