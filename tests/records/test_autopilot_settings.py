"""Firmware and parameters of a log."""

import struct

import flight_logs
import pytest
from log_writers import ULog

from jaxquad.records import read_settings, ReadError


def test_ardupilots_parameters_are_those_that_were_logged(tmp_path):
    found = read_settings(flight_logs.ardupilot(tmp_path, 8, gain="0.25"))
    assert found.vehicle == "ardupilot" and found.version == ()
    assert float(found.values["ATC_RAT_PIT_I"]) == 0.25


def test_px4s_parameters_and_version_are_those_that_were_logged(tmp_path):
    path = flight_logs.px4(tmp_path)
    log = ULog()
    log.info("uint32_t ver_sw_release", struct.pack("<I", 1 << 24 | 15 << 16 | 4 << 8 | 255))
    log.info("float MC_YAWRATE_K", struct.pack("<f", 0.16), kind="P")
    head = len(ULog().content)
    content = path.read_bytes()
    path.write_bytes(bytes(log.content) + content[head:])
    found = read_settings(path)
    assert found.vehicle == "px4" and found.version == (1, 15, 4)
    assert float(found.values["MC_YAWRATE_K"]) == pytest.approx(0.16, rel=1e-7)


def test_betaflights_header_tells_gains_and_version(data):
    found = read_settings(data / "betaflight_ar8" / "LOG00037.BFL")
    assert found.vehicle == "betaflight" and found.version == (4, 2, 0)
    assert found.values["rollPID"] == "77,119,83" and found.values["looptime"] == "125"


def test_a_file_without_parameters_is_refused(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time,u\n0,1\n0.1,2\n")
    with pytest.raises(ReadError, match="no parameters"):
        read_settings(path)
