"""Several flights in one file, and the part of a log in which the vehicle flies."""

import numpy as np
import pytest
from blackbox_rows import clock
from html_pages import read_page

from jaxquad.cli import main
from jaxquad.records import (
    AXES,
    flights,
    propose,
    read,
    read_settings,
    Record,
    RecordError,
    RecordWarning,
)
from jaxquad.records.formats import load_log
from jaxquad.spectra import frequency_response, JointInputOutput
from jaxquad.workflows import (
    autopilot,
    AutopilotSettings,
    identify,
    IdentifySettings,
    open_logs,
    SettingsError,
)


FIRMWARE = "betaflight_firmware"


@pytest.fixture
def joined(data, tmp_path):
    """Flights in one file, as a flash chip holds them."""

    def join(*names, change=lambda name, content: content):
        parts = [(data / FIRMWARE / f"{name}.BFL").read_bytes() for name in names]
        path = tmp_path / "flash.BFL"
        path.write_bytes(b"".join(map(change, names, parts)))
        return path

    return join


def test_the_flights_of_a_file_are_listed_with_throttle_and_excitation(joined):
    hover, chirp, levels = flights(joined("A_hover", "A_chirp_roll", "A_throttle"))
    assert [each.number for each in (hover, chirp, levels)] == [1, 2, 3]
    assert chirp.duration == pytest.approx(24.34, abs=0.01) and chirp.log == "log2"
    assert chirp.chirps == {"roll": pytest.approx(20, abs=0.01)} and not levels.chirps
    assert levels.throttle == (0.0, pytest.approx(0.64, abs=0.01))
    assert levels.sticks["roll"] > 0.2 and levels.sticks["pitch"] < 0.01
    assert [each.rank("roll") for each in (hover, chirp, levels)] == [0, 2, 1]
    assert str(chirp) == "flight 2: 24.3 s, throttle 0.00 .. 0.41, chirp on roll 20 s"


@pytest.mark.parametrize(
    ("names", "axis", "number"),
    [
        (("A_throttle", "A_chirp_roll"), None, 2),  # a chirp before longer sticks
        (("A_chirp_roll", "B_chirp_three_axes"), "roll", 2),
        (("A_chirp_roll", "A_sticks", "A_hover"), "pitch", 2),  # the chirp is on roll
        (("B_chirp_three_axes", "A_hover"), "yaw", 1),
    ],
)
def test_the_longest_flight_with_excitation_is_proposed_and_the_others_are_told(
    joined, names, axis, number
):
    proposal = propose(joined(*names), axis=axis)
    assert proposal.setup.rate.startswith(f"log{number}.")
    said = proposal.setup.remarks[0]
    assert said.startswith(f"flight {number}: ") and ", the longest with" in said
    assert all(f"flight {k}: " in said for k in range(1, len(names) + 1))


@pytest.mark.parametrize("number", [1, 2])
def test_everything_of_a_proposal_is_of_the_flight_that_is_chosen(joined, data, number):
    """Rates, throttle, hold and parameters are as those of the file with this flight alone."""
    names = ("A_sticks", "B_chirp_three_axes")
    slower = lambda name, content: content.replace(
        b"H looptime:125\n", b"H looptime:125\n" if name == "A_sticks" else b"H looptime:126\n"
    )
    path = joined(*names, change=slower)
    proposal = propose(path, axis="pitch", flight=number)
    alone = propose(data / FIRMWARE / f"{names[number - 1]}.BFL", axis="pitch")
    ours, theirs = proposal.setup, alone.setup
    label = f"log{number}."
    assert ours.rate == label + theirs.rate and ours.reference == label + theirs.reference
    assert ours.throttle == {label + name: x for name, x in theirs.throttle.items()}
    assert ours.hold == pytest.approx({1: 250e-6, 2: 252e-6}[number], rel=1e-9)
    assert (ours.spans, ours.band) == (theirs.spans, theirs.band)
    assert ours.remarks[1:] == tuple(
        x.replace("gyroADC", f"{label}gyroADC") for x in theirs.remarks
    )
    assert proposal.sample_rate == alone.sample_rate
    both = [read(x.path, **x.options_with_throttle) for x in (proposal, alone)]
    np.testing.assert_array_equal(both[0].inputs, both[1].inputs)
    np.testing.assert_array_equal(both[0].outputs, both[1].outputs)
    values = read_settings(path, log=f"log{number}").values
    assert values["looptime"] == {1: "125", 2: "126"}[number]


def test_the_workflows_take_the_number_of_a_flight(joined):
    path = joined("A_chirp_roll", "A_sticks")
    opened = open_logs(path, IdentifySettings(flight=2, axis="roll"))
    assert opened.settings.output == "log2.gyroADC[0]" and opened.settings.flight is None
    assert opened.settings.hold == 250e-6
    assert opened.records[0].time[-1] == pytest.approx(33.999, abs=1e-3)
    with pytest.raises(ValueError, match=r"flight is 3, but the file holds: flight 1: 24.3 s"):
        autopilot(path, AutopilotSettings(flight=3))
    with pytest.raises(SettingsError, match="`flight` is for a proposal"):
        IdentifySettings(input="log1.axisSum[0]", output="log1.gyroADC[0]", flight=1)


def test_a_file_of_one_flight_has_number_1_alone(data):
    path = data / FIRMWARE / "A_chirp_roll.BFL"
    assert propose(path, flight=1) == propose(path)
    with pytest.raises(RecordError, match="flight is 2, but the file holds: flight 1: 24.3 s"):
        propose(path, flight=2)


@pytest.mark.parametrize("name", ["A_sticks", "A_throttle", "A_doublets", "A_hover"])
def test_the_ground_before_take_off_is_left_out_and_flight_is_kept(data, name):
    """The motors arm at 6.5 s, throttle comes at 7.6 s, and flight begins at 8 s."""
    setup = propose(data / FIRMWARE / f"{name}.BFL", axis="roll").setup
    start, stop = setup.longest
    assert start is not None and 7.3 < start <= 8 and stop is None
    assert any("left out, as no flight: t = 6.65516 .. 7" in each for each in setup.remarks)


def test_a_chirp_keeps_its_own_window(data):
    setup = propose(data / FIRMWARE / "A_chirp_roll.BFL").setup
    assert setup.longest == (pytest.approx(9.0, abs=2e-3), pytest.approx(29, abs=2e-3))
    assert not any("left out" in each for each in setup.remarks)


RATES = tuple(f"gyroADC[{k}]" for k in range(3))
SETPOINTS = tuple(f"setpoint[{k}]" for k in range(4))


def written(path, time, columns):
    """A log of one flight, as blackbox_decode writes it."""
    values = [np.arange(time.size), np.round(1e6 * time), *columns.values()]
    head = ",".join(["loopIteration", "time", *columns])
    np.savetxt(path, np.stack(values, axis=1), "%d", ",", header=head, comments="")
    return path


@pytest.fixture(scope="module")
def sticks(data):
    return load_log(data / FIRMWARE / "A_sticks.BFL").tables[""]


@pytest.fixture
def flown(sticks, tmp_path):
    """The set-up for the flight with sticks, with other values in some rows."""

    def setup_of(rows=(), **changed):
        names = (*RATES, *SETPOINTS, "axisSum[0]")
        columns = {name: np.array(sticks.columns[name], float) for name in names}
        for name, values in changed.items():
            columns[name][rows] = values
        return propose(written(tmp_path / "log.csv", sticks.time, columns), axis="roll").setup

    return setup_of


def left_out(setup):
    return next((x for x in setup.remarks if x.startswith("left out, as no flight")), "")


def test_a_landing_is_left_out(flown, sticks):
    """On the ground from 30 s on, as it was before take-off."""
    rows = sticks.time > 30
    still = 0.1 * np.sin(50 * sticks.time[rows])
    setup = flown(rows, **dict.fromkeys(RATES, still), **{"setpoint[3]": 0.0})
    stop = setup.longest[1]
    assert stop is not None and 30 - 0.25 <= stop < 30.5
    assert "(landed)" in left_out(setup)


def test_a_crash_is_left_out_although_the_motors_still_run(flown, sticks):
    setup = flown(sticks.time > 32, **{"gyroADC[0]": 1500})
    assert setup.longest[1] == pytest.approx(32, abs=0.26) and "(a crash)" in left_out(setup)


def test_a_dive_without_throttle_is_flight(flown, sticks):
    dived, plain = flown((sticks.time > 15) & (sticks.time < 20), **{"setpoint[3]": 0}), flown()
    assert dived.spans == plain.spans


def test_a_log_that_never_leaves_the_ground_says_so(flown):
    setup = flown(slice(None), **{"setpoint[3]": 0})
    assert setup.longest == (None, None)
    assert any("no flight" in each for each in setup.remarks)


def test_start_and_stop_of_the_user_win(data):
    path = data / FIRMWARE / "A_sticks.BFL"
    setup = propose(path, start=6.7, stop=20).setup
    assert setup.longest == (6.7, 20)
    assert not any("left out" in each for each in setup.remarks)
    opened = open_logs(path, IdentifySettings(stop=20.0))
    assert 7.3 < (opened.settings.start or 0) < 8 and opened.settings.stop == 20
    chirp = open_logs(data / FIRMWARE / "A_chirp_roll.BFL", IdentifySettings(start=12.0))
    assert chirp.settings.start == 12 and chirp.settings.stop == pytest.approx(29, abs=2e-3)


def test_samples_beyond_the_limit_count_within_the_part_that_is_used(data):
    """The firmware saturates in a doublet, from time to time; never between two of them."""
    path = data / FIRMWARE / "A_doublets.BFL"
    beyond = lambda **span: [x for x in propose(path, **span).setup.remarks if "pidsum_limit" in x]
    [whole] = beyond(axis="roll")
    assert whole.startswith("140 of 22595 samples")
    assert beyond(axis="roll", start=11.0, stop=14.0) == []
    part, samples = beyond(axis="roll", stop=11.0)[0].split(" samples")[0].split(" of ")
    assert 0 < int(part) < 140 and int(samples) < 4000


@pytest.mark.parametrize(("stated", "held"), [("125", 250e-6), ("127", 254e-6), ("16", 250e-6)])
def test_the_hold_is_that_of_the_stamps_where_the_header_contradicts_them(joined, stated, held):
    said = f"H looptime:{stated}\n".encode()
    path = joined("A_sticks", change=lambda _, x: x.replace(b"H looptime:125\n", said)[:600_000])
    setup = propose(path, axis="roll").setup
    assert setup.hold == pytest.approx(held, rel=1e-4)
    assert any("32 us" in x and "250 us" in x for x in setup.remarks) == (stated == "16")


def test_stamps_that_are_as_the_header_says_leave_the_hold_as_it_is(data):
    """LOG00037 lost frames, which its counters of loops and of time both show."""
    setup = propose(data / "betaflight_ar8/LOG00037.BFL").setup
    assert setup.hold == 125e-6 and not any(" us" in each for each in setup.remarks)


def test_what_was_injected_outside_of_start_and_stop_is_not_used(data):
    for start, stop in ((10.0, 12.0), (29.5, 30.5)):
        setup = propose(data / FIRMWARE / "A_chirp_roll.BFL", start=start, stop=stop).setup
        assert setup.spans == ((start, stop),)


def test_a_set_point_that_rests_is_no_reference(data):
    setup = propose(data / FIRMWARE / "A_hover.BFL", axis="roll").setup
    assert setup.reference == ""
    assert any("setpoint[0] never moves" in each for each in setup.remarks)


def of_phase_alone(log, folder):
    """The log as firmware writes it that fills nothing but the phase of its chirp."""
    table = log.tables[""]
    names = ("debug[0]", *RATES, *SETPOINTS, *(f"axisSum[{k}]" for k in range(3)))
    columns = {name: table.columns[name] for name in names}
    columns |= {f"debug[{k}]": np.zeros(table.time.size) for k in range(1, 8)}
    return written(folder / "log.csv", table.time, columns)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "axes"), [("A_chirp_roll", 1), ("B_chirp_three_axes", 3)])
def test_a_chirp_whose_phase_alone_is_logged_is_the_same_chirp(data, tmp_path, name, axes):
    whole = data / FIRMWARE / f"{name}.BFL"
    log = load_log(whole)
    path = of_phase_alone(log, tmp_path)
    sine, axis, tenths, excitation = (
        load_log(path).tables[""].columns["chirp"],
        *(log.tables[""].columns[f"debug[{k}]"] for k in (1, 2, 3)),
    )
    above = tenths > 11  # 0.1 Hz; this firmware injects the cosine
    np.testing.assert_allclose(sine[above] ** 2 + (excitation[above] / 1e3) ** 2, 1, atol=3e-3)
    assert not sine[axis == -1].any()
    assert "chirp" not in log.tables[""].columns
    for each in AXES[:axes]:
        ours, theirs = (propose(x, axis=each).setup for x in (path, whole))
        assert ours.reference == "chirp" and ours.band is not None and theirs.band is not None
        assert ours.longest == pytest.approx(theirs.longest, abs=0.05)
        np.testing.assert_allclose(ours.band, theirs.band, rtol=0.2)


@pytest.mark.slow
def test_a_response_with_the_sine_of_the_phase_is_that_with_the_excitation(data, tmp_path):
    """To three standard errors, at all frequencies that both see."""
    log = load_log(data / FIRMWARE / "A_chirp_roll.BFL")
    table, wanted = load_log(of_phase_alone(log, tmp_path)).tables[""], log.tables[""]
    time = clock(wanted)
    used = (time > 9) & (time < 29)
    u, y = (np.asarray(wanted.columns[x], float) for x in ("axisSum[0]", "gyroADC[0]"))
    omega = 2 * np.pi * np.geomspace(1.5, 25, 20)
    both = [
        frequency_response(
            Record(1e-3 * np.arange(used.sum()), u[used], y[used], np.asarray(r, float)[used]),
            omega, estimator=JointInputOutput(),
        )
        for r in (table.columns["chirp"], wanted.columns["debug[3]"])
    ]  # fmt: skip
    (a, b), error = (np.asarray(x.response).ravel() for x in both), both[1].random_error
    np.testing.assert_array_less(np.abs(a / b - 1), 3 * np.asarray(error).ravel())


@pytest.mark.slow
def test_a_gap_that_is_allowed_is_allowed_for_the_spectrum_over_the_throttle(tmp_path):
    time = np.arange(20_000) / 1000
    wave = 50 * np.sin(20 * time)
    columns = {
        "loopIteration": np.arange(20_000), "time (us)": np.round(1e6 * time),
        "axisP[0]": 50 * np.cos(20 * time), "gyroADC[0] (deg/s)": wave,
        "setpoint[0]": wave, "setpoint[3]": 300 + 100 * np.sin(time),
    }  # fmt: skip
    kept = (time < 9) | (time > 9.08)
    path, table = tmp_path / "log.csv", np.column_stack(list(columns.values()))[kept]
    np.savetxt(path, table, fmt="%.9g", delimiter=", ", header=", ".join(columns), comments="")
    with pytest.warns(RecordWarning, match="gaps filled"):
        found = identify(path, IdentifySettings(axis="roll", max_gap=0.1))
    found.write(tmp_path)
    images = [each["alt"] for each in read_page(tmp_path / "report.html").of("img")]
    assert any("over throttle" in each for each in images)


def test_the_list_of_channels_ends_with_the_flights_of_a_file(joined, capsys):
    path = joined("A_hover", "A_sticks")
    assert main(["channels", str(path)]) == 0
    *_, first, second, advice = capsys.readouterr().out.splitlines()
    assert [first, second] == [str(each) for each in flights(path)] and "--flight N" in advice
