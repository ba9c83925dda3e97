import numpy as np
import pytest
from blackbox_rows import clock
from hypothesis import given, settings, strategies as st
from log_writers import crazyflie_log as log, decode

from jaxquad.records import channels, propose, read, ReadError, RecordError
from jaxquad.records.formats import load_log
from jaxquad.workflows import IdentifySettings, open_logs


FIXED = (0xFFFF, "fixedFrequency", [("gyro.x", "f"), ("motor.m1", "H"), ("pm.state", "b")])
EVENT = (7, "estTDOA", [("idA", "B"), ("distanceDiff", "f")])
FUZZ = settings(max_examples=300, deadline=None, derandomize=True, database=None)


EVENTS = [(0, 1000 * i, (i / 8, 500 + i, i % 100 - 50)) for i in range(60)]
PLAIN = log([FIXED], EVENTS)
MIXED = log([FIXED, EVENT], sorted([*EVENTS, *((1, 3700 * i, (i, -i / 4)) for i in range(15))],
                                   key=lambda each: each[1]))  # fmt: skip
HEAD = len(log([FIXED], [])) - 4
SIZE = (len(PLAIN) - HEAD - 4) // 60


def test_events_of_one_type_are_read_back_bit_by_bit():
    result = decode("crazyflie", PLAIN)
    table = result.tables[""]
    assert result.remarks == () and result.vehicle == "crazyflie" and list(result.tables) == [""]
    np.testing.assert_array_equal(table.time, np.arange(60) / 1e3)
    np.testing.assert_array_equal(table.columns["gyro.x"], np.arange(60) / 8)
    assert table.columns["motor.m1"].dtype == np.uint16
    np.testing.assert_array_equal(table.columns["motor.m1"], 500 + np.arange(60))
    np.testing.assert_array_equal(table.columns["pm.state"], np.arange(60) % 100 - 50)
    assert table.units["gyro.x"] == "deg/s"


def test_events_of_several_types_come_apart_with_clocks_of_their_own():
    tables = decode("crazyflie", MIXED).tables
    assert list(tables) == ["fixedFrequency", "estTDOA"]
    np.testing.assert_array_equal(tables["fixedFrequency"].columns["gyro.x"], np.arange(60) / 8)
    np.testing.assert_array_equal(tables["estTDOA"].time, 3700 * np.arange(15) / 1e6)
    np.testing.assert_array_equal(tables["estTDOA"].columns["distanceDiff"], -np.arange(15) / 4)


def test_version_1_counts_milliseconds():
    table = decode("crazyflie", log([FIXED], EVENTS, version=1)).tables[""]
    np.testing.assert_array_equal(table.time, np.arange(60.0))


def test_a_log_cut_off_anywhere_gives_its_whole_events_and_says_so():
    for stop in range(HEAD + SIZE, len(PLAIN) - 4):
        result = decode("crazyflie", PLAIN[:stop])
        count = (stop - HEAD) // SIZE
        np.testing.assert_array_equal(result.tables[""].columns["motor.m1"], 500 + np.arange(count))
        assert "checksum" in result.remarks[0]


@pytest.mark.parametrize("lost", [1, 7, 30])
def test_after_lost_bytes_reading_goes_on_with_the_next_events(lost):
    cut = HEAD + 20 * SIZE + 5
    result = decode("crazyflie", PLAIN[:cut] + PLAIN[cut + lost :])
    table = result.tables[""]
    truth = np.array([*range(20), *range(20 + -(-(lost + 5) // SIZE), 60)])
    np.testing.assert_array_equal(table.columns["motor.m1"], 500 + truth)
    np.testing.assert_array_equal(table.columns["gyro.x"], truth / 8)
    assert len(result.remarks) == 2 and "skipped" in result.remarks[1]


@pytest.mark.parametrize(
    ("data", "offset", "reason"),
    [
        (b"\xbc\x03\0\1\0" + PLAIN[5:], 0, "version 1 or 2"),
        (b"\xbc\2\0", 0, "version 1 or 2"),
        (b"\xbc\2\0\xff\xff" + PLAIN[5:], 3, "65535 types"),
        (b"\xbc\2\0\0\0" + PLAIN[5:], 3, "0 types"),
        (log([FIXED, FIXED], []), HEAD, "described twice"),
        (log([(1, "a", [("x", "z")])], []), 11, "not a new name with a type"),
        (log([(1, "a", [("x", "f"), ("x", "f")])], []), 16, "not a new name with a type"),
        (PLAIN[:7] + b"\0" + PLAIN[8:], 7, "a name in the description"),
        (PLAIN[:22] + b"\xff\xff" + PLAIN[24:], 22, "65535 variables"),
        (PLAIN[:15], 7, "a name in the description"),
        (log([FIXED], []), HEAD, "no event"),
    ],
)
def test_a_damaged_head_is_refused_with_its_place(data, offset, reason):
    with pytest.raises(ReadError, match=reason) as caught:
        decode("crazyflie", data)
    assert caught.value.offset == offset


@pytest.mark.slow
@FUZZ
@given(
    st.sampled_from([PLAIN, MIXED]),
    st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=9),
    st.integers(0, 40),
)
def test_damage_raises_nothing_but_read_errors(data, changes, cut):
    data = bytearray(data[: len(data) - cut])
    for place, byte in changes:
        data[int(place * len(data))] = byte
    try:
        result = decode("crazyflie", bytes(data))
    except ReadError as error:
        assert error.offset is not None and 0 <= error.offset <= len(data)
        return
    assert all(each.time is not None and each.time.size for each in result.tables.values())
    assert result.remarks or bytes(data) in (PLAIN, MIXED)


def test_the_real_log_equals_its_decoded_copy(data):
    table = load_log(data / "crazyflie_rollpitch/log15").tables[""]
    copy = np.load(data / "crazyflie_rollpitch/log15.npz")
    np.testing.assert_allclose(clock(table), copy["t"], rtol=1e-15)  # 1e-6 times, not 1e6 divided
    names = {"acc_g": "acc.{}", "gyro_dps": "gyro.{}", "motor_u16": "motor.m{}"}
    for theirs, ours in names.items():
        for suffix, column in zip("1234" if "m{" in ours else "xyz", copy[theirs].T, strict=True):
            np.testing.assert_array_equal(table.columns[ours.format(suffix)], column)


def test_the_real_log_is_listed_and_read_although_its_name_has_no_ending(data):
    path = data / "crazyflie_rollpitch/log15"
    rates = {each.name: each.rate for each in channels(path)}
    record = read(path, inputs="motor.m1", outputs="gyro.x", start=60, stop=60.5)
    assert rates["gyro.x"] == pytest.approx(1009.8, abs=0.5) and record.unit("gyro.x") == "deg/s"


def slow_log(path, rate, slow):
    """A rate and a command of 10 s, whose stamps run slow by a factor."""
    kind = (0xFFFF, "fixedFrequency", [("controller.cmd_roll", "f"), ("gyro.x", "f")])
    time = np.arange(round(10 * rate)) / rate
    stamps = np.round(1e6 * time * slow).astype(int).tolist()
    values = zip(np.cos(7 * time), np.sin(7 * time), strict=True)
    path.write_bytes(log([kind], [(0, s, v) for s, v in zip(stamps, values, strict=True)]))
    return path


@pytest.mark.parametrize(("rate", "said"), [(500, "505.9"), (1000, "101"), (100, "101")])
def test_stamps_that_run_slow_are_recognised_by_the_rate_of_the_log(tmp_path, rate, said):
    remarks = propose(slow_log(tmp_path / "log00", rate, 84 / 85), axis="roll").setup.remarks
    assert any(each.startswith(f"the time stamps say {said}") for each in remarks)
    remarks = propose(slow_log(tmp_path / "log01", rate, 1.0), axis="roll").setup.remarks
    assert not any("time stamps say" in each for each in remarks)


def test_the_factor_that_is_offered_brings_back_the_true_time(tmp_path):
    path, names = slow_log(tmp_path / "log00", 500, 84 / 85), ("controller.cmd_roll", "gyro.x")
    record = read(path, inputs=names[0], outputs=names[1], time_factor=85 / 84, start=1, stop=8)
    assert record.sample_rate == pytest.approx(500, rel=1e-5)
    np.testing.assert_allclose(record.outputs[:, 0], np.sin(7 * record.time), atol=2e-5)
    given = IdentifySettings(axis="roll", time_factor=85 / 84, start=1.0)
    opened = open_logs(path, given)
    assert opened.settings.rate == 500 and opened.settings.start == pytest.approx(1.0)
    assert opened.records[0].sample_rate == pytest.approx(500, rel=1e-5)
    with pytest.raises(RecordError, match="time_factor is 1000: give a number near 1"):
        read(path, inputs=names[0], outputs=names[1], time_factor=1000)


def test_the_measured_log_has_such_stamps(data):
    remarks = propose(data / "crazyflie_rollpitch/log15", axis="roll").setup.remarks
    assert any("85/84 of 1000 Hz" in each for each in remarks)
