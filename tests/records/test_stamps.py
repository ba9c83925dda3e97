import warnings
from typing import Any

import numpy as np
import pytest

from jaxquad.plot import headless, record_figure
from jaxquad.records import channels, read, RecordError, RecordWarning, trim


TIME = 2.0 + np.arange(500) / 100.0
U, Y = np.sin(3 * TIME), np.cos(5 * TIME)


def saved(folder, time, u=U, y=Y):
    np.savez(folder / "log.npz", t=time, u=u, y=y)
    return folder / "log.npz"


@pytest.mark.parametrize(
    ("kind", "unit", "scale", "end"),
    [
        ("u4", "us", 1e6, 2**32),
        ("i4", "us", 1e6, 2**31),
        ("u2", "ms", 1e3, 2**16),
        ("f8", "us", 1e6, 2**32),
    ],
)
def test_a_counter_that_wraps_goes_on(tmp_path, kind, unit, scale, end):
    ticks = np.round((TIME - TIME[0]) * scale).astype(np.int64) + end - 2500
    wrapped = np.where(ticks < end, ticks, ticks - (2**16 if kind == "u2" else 2**32))
    path = saved(tmp_path, wrapped.astype(kind))
    with pytest.warns(RecordWarning, match="time base 't': the counter overflowed once"):
        record = read(path, inputs="u", outputs="y", time_unit=unit)
    np.testing.assert_allclose(np.diff(record.time), 0.01, rtol=1e-6)
    np.testing.assert_array_equal(record.inputs[:, 0], U)


def test_a_restart_is_no_wrap_and_is_refused(tmp_path):
    path = saved(tmp_path, np.concatenate([TIME[:250], TIME[:250]]))
    with pytest.raises(RecordError, match="time goes back at sample 250, from 4.49 s to 2 s"):
        read(path, inputs="u", outputs="y")


@pytest.mark.parametrize(
    ("rows", "stamp"),
    [([100], TIME[99]), ([100, 300], TIME[50]), ([100], 1e6), ([0], 1e6), ([7], np.nan)],
    ids=["repeated", "gone back", "far ahead", "far ahead at first", "not a number"],
)
def test_a_few_wrong_stamps_are_dropped_with_their_rows(tmp_path, rows, stamp):
    time = TIME.copy()
    time[rows] = stamp
    path = saved(tmp_path, time)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        record = read(path, inputs="u", outputs="y", sample_rate=100, start=2.5, stop=6.5)
    said = f"{len(rows)} of 500 time stamps repeat or go back; these rows were dropped"
    assert said in str(told[0].message) and f"first of them row {rows[0]} " in str(told[0].message)
    # A cubic bridges the hole.
    np.testing.assert_allclose(record.inputs[:, 0], np.sin(3 * record.time), atol=1e-5)


def test_many_wrong_stamps_are_refused(tmp_path):
    time = TIME.copy()
    time[1::20] = time[::20]
    with pytest.raises(RecordError, match="time repeats at sample 1, .*in 25 places"):
        read(saved(tmp_path, time), inputs="u", outputs="y")


def test_an_intact_clock_is_passed_on_bit_by_bit(tmp_path):
    np.testing.assert_array_equal(read(saved(tmp_path, TIME), inputs="u", outputs="y").time, TIME)


EPOCH = 1_710_771_234.5


@pytest.fixture
def dated(tmp_path):
    """20 s at 100 Hz whose stamps are dates, with a gap of 0.2 s after 8 s."""
    time = np.arange(2000) / 100
    kept = (time <= 8) | (time >= 8.2)
    path = tmp_path / "dated.npz"
    np.savez(path, t=EPOCH + time[kept], u=np.cos(time)[kept], y=np.sin(time)[kept])
    return path


def test_dates_are_shown_from_the_start_of_the_log(dated):
    """In lists, records, warnings and errors alike, with the date that they count from."""
    assert "t = 0 .. 19.99 s after 1710771234.500 s" in str(channels(dated)[0])
    with pytest.warns(RecordWarning, match="longest 200 ms at t = 8 s after 1710771234.500 s"):
        record = read(dated, inputs="u", outputs="y", max_gap=0.3)
    assert "(t = 0 .. 19.99 s after 1710771234.500 s)" in str(record)
    assert record.time[0] == EPOCH
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({}, "from t = 8 s to 8.2 s after 1710771234.500 s"),
        ({"start": 30}, "start 30 s after 1710771234.500 s is not before stop 19.99 s"),
        ({"stop": 25}, "0 .. 25 s after 1710771234.500 s is out of range; the record covers 0"),
    )
    for options, said in cases:
        with pytest.raises(RecordError, match=said):
            read(dated, inputs="u", outputs="y", **options)


@pytest.mark.parametrize("origin", [0.0, EPOCH])
def test_start_and_stop_may_count_from_where_dates_are_shown_from(dated, origin):
    record = read(dated, inputs="u", outputs="y", start=origin + 1, stop=origin + 7)
    np.testing.assert_allclose(record.time[[0, -1]] - EPOCH, [1, 7], atol=1e-5)
    whole = read(dated, inputs="u", outputs="y", stop=7.5)
    cut = trim(whole, origin + 1, origin + 2)
    np.testing.assert_allclose(cut.time[[0, -1]] - EPOCH, [1, 2], atol=1e-5)


def test_a_record_of_dates_is_drawn_from_its_start(dated):
    record = read(dated, inputs="u", outputs="y", stop=7.0)
    with headless():
        line = record_figure(record)[0].lines[0]
    np.testing.assert_allclose(np.asarray(line.get_xdata())[[0, -1]], [0, 7], atol=0.1)
