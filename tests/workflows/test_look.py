"""What a log holds, before anything is computed."""

import flight_logs
import numpy as np
import pytest

from jaxquad.workflows import AutopilotSettings, limits_of, look, SettingsError


def test_an_autopilots_log_shows_its_axes_with_their_traces(tmp_path):
    view = look(flight_logs.ardupilot(tmp_path, 10))
    assert (view.firmware, view.title) == ("ardupilot", "ArduPilot")
    assert view.first_axis == "roll" and view.can_be_tuned and not view.has_chirps_apart
    roll, pitch = view.axes["roll"], view.axes["pitch"]
    assert "chirp" in roll.excitation and "chirp" not in pitch.excitation
    start, stop = roll.span
    assert start == pytest.approx(22, abs=0.1) and stop == pytest.approx(30, abs=0.1)
    assert roll.channels == {"rate": "RATE.R", "set-point": "RATE.RDes", "command": "RATE.ROut"}
    shown = view.shown["RATE.R"]
    assert shown.time.size == shown.values.size == flight_logs.TIME.size


def test_another_log_has_its_channels_alone(tmp_path):
    path = tmp_path / "bench.npz"
    time = np.arange(1000) / 100
    np.savez(path, time=time, M=np.sin(time), q=np.cos(time))
    view = look(path)
    assert not view.axes and not view.can_be_tuned and view.first_axis == ""
    assert [channel.name for channel in view.channels] == ["M", "q"]


def test_a_flight_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="`flight` is 3, but the file holds flights 1 to 1"):
        look(flight_logs.ardupilot(tmp_path, 10), flight=3)


def test_sliders_in_the_middle_are_the_defaults_and_move_every_limit():
    middle, defaults = limits_of(0.5, 0.5), AutopilotSettings().content()
    assert middle == pytest.approx({name: defaults[name] for name in middle})
    calm, sharp = limits_of(0.0, 0.5), limits_of(1.0, 0.5)
    for name in ("sensitivity", "resonance"):
        assert 1 < calm[name] < middle[name] < sharp[name]
    assert limits_of(0.5, 0.0)["noise"] < middle["noise"] < limits_of(0.5, 1.0)["noise"]
    for limits in (calm, sharp):
        AutopilotSettings.from_mapping(limits)
