"""What docs/autopilots.md says of the instants of messages, on logs that firmware flew."""

import numpy as np
import pytest

from jaxquad.records.formats import load_log


def rms(signal):
    return np.sqrt(np.mean(np.square(signal)))


@pytest.fixture(scope="module")
def betaflight(data):
    path = data / "betaflight_firmware" / "A_chirp_roll.BFL"
    if not path.exists():
        pytest.skip(f"no {path.name}: it is not part of the repository")
    return {name: x[3000:23_000] * 1.0 for name, x in load_log(path).tables[""].columns.items()}


def test_betaflights_p_is_of_the_set_point_with_chirp_and_the_gyro_of_its_own_row(betaflight):
    r, y, p = (betaflight[f"{name}[0]"] for name in ("setpoint", "gyroADC", "axisP"))
    law = 0.032029 * 45 * (r - y)
    assert np.max(np.abs(law - p)) <= 0.032029 * 45 + 0.5 + 1e-6  # rounding, in each row
    late, early = law[:-1] - p[1:], law[1:] - p[:-1]
    assert min(rms(late), rms(early)) > 4 * rms(law - p)
    assert not betaflight["axisF[0]"].any()


def test_betaflights_gyro_is_late_by_its_filters_and_a_gyro_sample(betaflight):
    """Two pt1, 500 Hz and 354 Hz (throttle .32), and 1 of 2 gyro samples of 125 us."""
    raw, smooth = (np.fft.rfft(betaflight[f"{x}[0]"][:12_000]) for x in ("gyroUnfilt", "gyroADC"))
    hz = np.fft.rfftfreq(12_000, 1e-3)
    strong = (hz > 2) & (hz < 10)
    late = -np.angle(smooth[strong] / raw[strong]) / (2 * np.pi * hz[strong])
    assert 1e3 * np.median(late) == pytest.approx(0.318 + 0.450 + 0.125, abs=0.09)


@pytest.fixture(scope="module", params=["mixer_chirp_roll", "rate_chirp_pitch"])
def ardupilot(request, data):
    path = data / "ardupilot_firmware" / f"{request.param}.BIN"
    if not path.exists():
        pytest.skip(f"no {path.name}: it is not part of the repository")
    tables = load_log(path).tables
    axis = "R" if "roll" in request.param else "P"
    rate, terms = (tables[name].columns for name in ("RATE", f"PID{axis}"))
    time, chirped = (np.asarray(tables[name].time) for name in ("RATE", "SIDD"))
    chirp = np.zeros_like(rate["R"])
    if "mixer" in request.param:  # SIDD begins with the mode
        chirp[np.searchsorted(time, chirped)] = tables["SIDD"].columns["Targ"]
    return axis, rate, terms, chirp


def test_ardupilots_output_is_its_terms_and_the_mixer_chirp_of_the_pass_before(ardupilot):
    axis, rate, terms, chirp = ardupilot
    law = sum(terms[name] for name in ("P", "I", "D", "FF", "DFF"))
    assert rms((law - rate[f"{axis}Out"])[1:] + chirp[:-1]) < 1e-6
    if chirp.any():
        assert rms((law - rate[f"{axis}Out"]) + chirp) > 1e-3  # that of its own pass


def test_ardupilots_set_point_acts_a_pass_later(ardupilot):
    """PIDx.Tar is RATE.xDes of the pass before behind FLTT, 20 Hz."""
    axis, rate, terms, _ = ardupilot
    wanted, used = np.deg2rad(rate[f"{axis}Des"]), terms["Tar"]
    share = 1 / (1 + 400 / (2 * np.pi * 20))

    def missing(shift):
        r = np.roll(wanted, shift)[10:-10]
        law = used[9:-11] + share * (r - used[9:-11])
        return rms(law - used[10:-10]) / rms(np.diff(used))

    assert missing(1) < 0.02 < 0.1 < min(missing(0), missing(2))


def test_ardupilots_derivative_is_of_the_filtered_error_and_its_integral_is_used_at_once(ardupilot):
    _, _, terms, _ = ardupilot
    error = terms["Tar"] - terms["Act"]
    assert rms(error - terms["Err"]) < 1e-5 * rms(error)  # FLTE is off
    assert rms(np.diff(terms["I"]) - 0.07 / 400 * error[1:]) < 0.02 * rms(np.diff(terms["I"]))
    assert rms(np.diff(terms["I"]) - 0.07 / 400 * error[:-1]) > 0.04 * rms(np.diff(terms["I"]))
