"""Logs that ArduCopter's own firmware wrote: which value of which message acts when."""

import numpy as np
import pytest
from scipy.signal import lfilter

from jaxquad.records import propose, read_settings
from jaxquad.records.formats import load_log


FLIGHTS = {"mixer_chirp_roll": ("R", "RLL"), "rate_chirp_pitch": ("P", "PIT")}


@pytest.fixture(params=FLIGHTS)
def flight(request, data):
    """The proposal, the log, the axis's letter and its parameters."""
    letter, short = FLIGHTS[request.param]
    path = data / "ardupilot_firmware" / f"{request.param}.BIN"
    log = load_log(path)
    gains = {name: float(log.settings[f"ATC_RAT_{short}_{name}"]) for name in
             ("P", "I", "D", "FF", "FLTT", "FLTE", "FLTD", "SMAX")}  # fmt: skip
    return propose(path), log, letter, gains


def acting(log, channel, setup, clock):
    """The value of a channel that acts at each stamp of `clock`; 0 where it is not logged."""
    name, _, column = channel.partition(".")
    table = log.tables[name]
    at = table.time + setup.late_s.get(channel, 0.0)
    rows = np.clip(np.searchsorted(at, clock - 1e-6), 0, at.size - 1)
    return np.where(np.abs(at[rows] - clock) < 1e-6, table.columns[column][rows], 0.0)


def test_the_logged_output_contains_the_chirp_at_the_mixer(flight):
    proposal, log, letter, _ = flight
    setup, rate, terms = proposal.setup, log.tables["RATE"], log.tables[f"PID{letter}"].columns
    total = sum(terms[name].astype(float) for name in ("P", "I", "D", "FF"))
    if setup.injected_at == "mixer":
        total = total + acting(log, setup.reference, setup, rate.time)
        assert np.abs(acting(log, setup.reference, setup, rate.time)).max() > 0.04
    assert setup.command == {f"RATE.{letter}Out": 1.0}
    assert np.abs(rate.columns[f"{letter}Out"] - total)[2:].max() < 4e-5


def test_the_law_gives_the_output_where_the_set_point_acts_one_loop_later(flight):
    proposal, log, letter, gains = flight
    setup, rate, dt = proposal.setup, log.tables["RATE"], 1 / 400
    assert setup.late_s == {f"RATE.{letter}Des": dt, "SIDD.Targ": dt}
    assert gains["FF"] == gains["FLTE"] == gains["SMAX"] == 0
    output = rate.columns[f"{letter}Out"].astype(float)
    if setup.injected_at == "mixer":
        output = output - acting(log, setup.reference, setup, rate.time)

    def left(setup):
        wanted = np.radians(acting(log, f"RATE.{letter}Des", setup, rate.time))
        low_pass = lambda hz, x: lfilter([share := 1 - 1 / (1 + 2 * np.pi * hz * dt)],
                                         [1, share - 1], x)  # fmt: skip
        error = low_pass(gains["FLTT"], wanted) - np.radians(rate.columns[letter])
        slope = low_pass(gains["FLTD"], np.diff(error, prepend=error[0]) / dt)
        law = gains["P"] * error + gains["I"] * dt * np.cumsum(error) + gains["D"] * slope
        inside = slice(400, -400)  # behind the filters' beginning
        off = (law - output)[inside]
        return np.std(off) / np.std(output[inside])

    assert left(setup) < 0.001
    # A chirp at the mixer moves the set-point only by way of the angle.
    assert left(setup._replace(late_s={})) > (0.1 if setup.injected_at == "rate" else 0.009)


def test_the_window_ends_with_the_chirp(flight):
    proposal, log, _, _ = flight
    table = log.tables["SIDD"]
    moving = table.time[table.columns["Targ"] != 0]
    [(start, stop)] = proposal.setup.spans
    assert start == table.time[0] and stop == moving[-1]
    assert table.time[-1] - moving[-1] > 9 and moving[-1] - start < 27


def test_version_and_point_are_what_the_firmware_says(flight):
    proposal, log, letter, _ = flight
    assert log.remarks == () and log.firmware == "ArduCopter V4.7.0-dev (656cba24)"
    assert read_settings(proposal.path).version == (4, 7, 0)
    assert proposal.setup.injected_at == ("mixer" if letter == "R" else "rate")
    assert not proposal.changes and not proposal.segments[1:]
