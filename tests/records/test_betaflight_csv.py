import numpy as np
import pytest
from blackbox_rows import clock
from hypothesis import given, settings, strategies as st

from jaxquad.records import channels, propose, read, ReadError
from jaxquad.records.formats import READERS


load = READERS["betaflight_csv"].load
HEADER = "loopIteration, time (us), axisP[0], axisI[0], gyroADC[0] (deg/s), flightModeFlags (flags)"
GYRO = [k % 17 - 8 for k in range(100)]
LINES = [f"{8 * k}, {5_000_000 + 1000 * k}, {k}, {-2 * k}, {g}, 0" for k, g in enumerate(GYRO)]
FUZZ = settings(max_examples=200, deadline=None, derandomize=True, database=None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("csv")


def written(folder, lines, *, header=HEADER):
    path = folder / "log.csv"
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


def test_names_lose_their_units_and_time_is_in_seconds(tmp_path):
    result = load(written(tmp_path, LINES))
    table = result.tables[""]
    assert result.remarks == () and result.vehicle == "betaflight"
    np.testing.assert_array_equal(table.time, 5 + np.arange(100) / 1e3)
    np.testing.assert_array_equal(table.columns["gyroADC[0]"], GYRO)
    np.testing.assert_array_equal(table.columns["axisSum[0]"], -np.arange(100.0))
    assert table.units["gyroADC[0]"] == "deg/s" and "flightModeFlags" not in table.columns


def test_text_in_flags_and_missing_trailing_cells_change_no_number(tmp_path):
    lines = [line if k % 2 else line[:-1] + "ANGLE_MODE|ARM" for k, line in enumerate(LINES)]
    lines = [line.rpartition(",")[0] if k % 3 else line for k, line in enumerate(lines)]
    table = load(written(tmp_path, lines)).tables[""]
    np.testing.assert_array_equal(table.columns["gyroADC[0]"], GYRO)
    assert clock(table).size == 100


def test_rows_cut_off_have_nan_and_rows_without_a_time_are_left_out(tmp_path):
    lines = [*LINES[:50], "400, 5050000, 50", "garbage", "", *LINES[53:]]
    result = load(written(tmp_path, lines))
    table = result.tables[""]
    assert clock(table).size == 98
    assert np.isnan(table.columns["gyroADC[0]"]).sum() == 1
    np.testing.assert_array_equal(table.columns["axisP[0]"][[49, 50, 51]], [49, 50, 53])
    assert result.remarks == ("2 lines without a time were left out, first line 53",)


def test_the_table_of_blackbox_explorer_brings_its_settings(tmp_path):
    above = '"Product","Blackbox flight data recorder by Nicholas Sherlock"\n"looptime",125\n'
    header = above + '"loopIteration","time","axisP[0]","axisI[0]","gyroADC[0]","flags"'
    path = written(tmp_path, LINES, header=header)
    result = load(path)
    assert result.settings["looptime"] == "125"
    assert {each.name for each in channels(path)} >= {"gyroADC[0]", "axisSum[0]"}


def test_read_takes_the_table_for_what_it_is(tmp_path):
    record = read(written(tmp_path, LINES), inputs="axisP[0]", outputs="gyroADC[0]")
    assert record.sample_rate == pytest.approx(1000) and record.unit("gyroADC[0]") == "deg/s"


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        ("loopIteration, axisP[0]", "one must be 'time'"),
        ("loopIteration, time (us), axisP[0], axisP[0]", "none twice"),
        ("loopIteration, time (parsec), x, y, z", "'parsec'"),
        ("loopIteration, time" + ", x" * 3000, "3002 names"),
        ("loop, time", "begins with loopIteration"),
    ],
)
def test_a_header_that_makes_no_sense_is_refused(tmp_path, header, reason):
    with pytest.raises(ReadError, match=reason):
        load(written(tmp_path, LINES, header=header))


def test_a_table_without_rows_is_refused(tmp_path):
    with pytest.raises(ReadError, match="no line after line 1"):
        load(written(tmp_path, []))


@pytest.mark.slow
@FUZZ
@given(st.binary(max_size=60), st.integers(0, 700), st.integers(0, 100))
def test_damage_raises_nothing_but_read_errors(folder, new, at, gone):
    data = "\n".join([HEADER, *LINES[:20]]).encode()
    path = folder / "damaged.csv"
    path.write_bytes(data[:at] + new + data[at + gone :])
    try:
        result = load(path)
    except ReadError:
        return
    assert np.isfinite(clock(result.tables[""])).all()


def flown(folder, mode):
    """An acro or a levelled flight as blackbox_decode writes it, its modes as text."""
    header = "loopIteration, time (us), axisP[0], setpoint[0], gyroADC[0] (deg/s), "
    header += "flightModeFlags (flags), stateFlags (flags)"
    lines = [
        f"{8 * k}, {5_000_000 + 1000 * k}, {k % 7}, {k % 11}, {g}, {mode(k)}, 0"
        for k, g in enumerate(GYRO)
    ]
    return written(folder, lines, header=header)


@pytest.mark.parametrize(
    ("mode", "reference"),
    [
        (lambda k: "ARM", "setpoint[0]"),
        (lambda k: "ARM|AIRMODE", "setpoint[0]"),
        (lambda k: "0" if k < 9 else "ARM", "setpoint[0]"),
        (lambda k: "1", "setpoint[0]"),  # --raw
        (lambda k: "ANGLE_MODE", "setpoint[0]"),  # an old blackbox_decode's name of ARM
        (lambda k: "ANGLE_MODE|HORIZON_MODE" if k > 50 else "ANGLE_MODE", ""),  # of ANGLE
        (lambda k: "ARM|ANGLE" if k > 50 else "ARM", ""),
        (lambda k: "ARM|HORIZON", ""),
        (lambda k: "3", ""),
        (lambda k: "ARM|SOMETHING", ""),  # not understood, so that it may be anything
        (lambda k: "", ""),
    ],
)
def test_the_modes_of_a_table_say_whether_the_set_point_is_the_pilots(tmp_path, mode, reference):
    assert propose(flown(tmp_path, mode), axis="roll").setup.reference == reference


def test_the_modes_of_a_table_are_those_of_its_native_log(tmp_path):
    modes = load(flown(tmp_path, lambda k: "ARM|ANGLE" if k >= 40 else "ARM")).tables["slow"]
    assert modes.columns["flightModeFlags"].tolist() == [1, 3]
    np.testing.assert_allclose(clock(modes), [5.0, 5.04])
