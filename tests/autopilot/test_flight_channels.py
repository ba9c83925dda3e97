"""What a proposal reads beside the record."""

import dataclasses

import numpy as np
import pytest
from flight_logs import ardupilot

from jaxquad.autopilot import FlightChannels, read_channels_if_any
from jaxquad.records import propose, read_settings
from jaxquad.workflows import IdentifySettings


@pytest.mark.parametrize(
    ("gyros", "core", "parameters", "used"),
    [
        ((0, 1), None, (), 0),
        ((0, 1), 1, (), 1),
        (
            (0, 1),
            1,
            (("EK3_IMU_MASK", 2.0),),
            0,
        ),  # there is one filter, of IMU 1
        ((0, 1), 0, (("EK3_IMU_MASK", 2.0),), 1),
        ((1,), None, (("INS_RAW_LOG_OPT", 1.0),), 1),
        ((1, 3), None, (("INS_RAW_LOG_OPT", 9.0),), 1),  # 3 is behind the filters
        ((0,), None, (("INS_RAW_LOG_OPT", 6.0),), None),  # behind the filters only
        ((), None, (), None),
    ],
)
def test_ardupilots_unfiltered_gyro_is_that_which_flew(tmp_path, gyros, core, parameters, used):
    path = ardupilot(tmp_path, 10, gyros=gyros, core=core, settings=parameters)
    settings = IdentifySettings(start=22, stop=30)
    flight = read_channels_if_any(path, propose(path), settings, read_settings(path).values)
    assert flight is not None
    if used is None:
        assert flight.unfiltered == () and flight.names == ("RATE.R", "")
        return
    assert flight.names == ("RATE.R", f"GYR[{used}].GyrX")
    assert len(flight.unfiltered) == 3
    assert np.mean(flight.unfiltered[0]) == pytest.approx(used, abs=0.1)


@pytest.mark.parametrize(
    ("amplitude", "injected", "rests"), [(6.9, 0.0, True), (7.3, 0.0, False), (0.0, 0.1, False)]
)
def test_an_axis_rests_below_5_degrees_per_second_without_an_injection(amplitude, injected, rests):
    wave = np.sin(2 * np.pi * np.arange(1000) / 100)  # whole periods: 1 / sqrt(2) rms
    flight = FlightChannels(
        (wave,) * 3, 0.01, np.radians(amplitude) * wave, injected=injected * wave
    )
    assert flight.rests == rests
    later = dataclasses.replace(flight, start=3.0, axis=2)
    assert later.rest_text == "you did not move yaw from 3 to 13 s"
