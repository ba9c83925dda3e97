"""Missing values and values out of range, and time stamps that say their unit."""

import warnings
from typing import Any

import numpy as np
import pytest

from jaxquad.records import (
    Channel,
    read,
    read_segments,
    Record,
    RecordError,
    RecordWarning,
    select,
    trim,
)


TIME = np.arange(500) / 100.0
U, Y = np.sin(3 * TIME), np.cos(3 * TIME)
SPIKE = 40


def spoilt(*places, value=np.nan):
    values = Y.copy()
    values[list(places)] = value
    return values


def record(**changes):
    options: dict[str, Any] = dict(time=TIME, inputs=U, outputs=Y)
    return Record(**options | changes)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e6])
def test_what_is_missing_or_out_of_range_is_interpolated_and_counted(value):
    kept = record(outputs=spoilt(SPIKE, 90, 91, value=value), valid={"y": (-2, 2)})
    np.testing.assert_allclose(kept.outputs[:, 0], Y, atol=2e-3)  # third order in three steps
    np.testing.assert_array_equal(
        np.delete(kept.outputs[:, 0], [40, 90, 91]), np.delete(Y, [40, 90, 91])
    )
    np.testing.assert_array_equal(kept.repaired["y"], TIME[[SPIKE, 90, 91]])
    assert "repaired by interpolation: y 3 samples" in str(kept)


def test_no_value_is_repaired_unless_asked():
    with pytest.raises(RecordError, match="'y' holds 1 NaN and 0 inf.*length in s .*max_gap="):
        record(outputs=spoilt(SPIKE))
    assert "repaired" not in str(record()) and record().repaired == {}
    assert record(outputs=spoilt(SPIKE, value=1e6)).outputs[SPIKE, 0] == 1e6


def test_gaps_up_to_the_longest_are_filled_and_longer_ones_refused():
    hole = list(range(SPIKE, SPIKE + 4))  # 0.05 s between the good neighbours
    assert record(outputs=spoilt(*hole), max_gap=0.05).repaired["y"].size == 4
    with pytest.raises(RecordError, match="'y' holds 4 NaN"):
        record(outputs=spoilt(*hole), max_gap=0.04)


def test_an_end_without_a_neighbour_is_not_extrapolated():
    for place in (0, TIME.size - 1):
        with pytest.raises(RecordError, match="'y' holds 1 NaN"):
            record(outputs=spoilt(place), max_gap=1.0)


def test_a_range_without_a_neighbour_in_it_is_refused():
    said = r"'y' holds no usable number: all 500 .* out of the range .*valid="
    with pytest.raises(RecordError, match=said):
        record(valid={"y": (5, 6)})


@pytest.mark.parametrize(
    "valid, message",
    [({"y": (2, 1)}, r"range of 'y' is \(2, 1\): give"), ({"z": (0, 1)}, "names 'z'.*no channel")],
)
def test_a_range_that_cannot_be_meant_is_refused(valid, message):
    with pytest.raises(RecordError, match=message):
        record(valid=valid)


def test_more_than_a_hundredth_is_said():
    with pytest.warns(RecordWarning, match="'y': 10 of 500 samples are interpolated"):
        record(outputs=spoilt(*range(40, 240, 20)), max_gap=0.1)


def test_parts_of_a_record_know_their_own_repairs():
    whole = record(outputs=spoilt(SPIKE, 200), max_gap=0.1)
    np.testing.assert_array_equal(trim(whole, 1.0, 3.0).repaired["y"], [2.0])
    assert trim(whole, 2.5, 4.0).repaired == {}
    assert select(whole, inputs="u", outputs="y").repaired["y"].size == 2


def test_what_is_masked_is_a_gap():
    masked = np.ma.masked_array(Y, mask=np.arange(500) == SPIKE)
    with pytest.raises(RecordError, match="holds 1 NaN"):
        record(outputs=masked)
    kept = record(outputs=masked, max_gap=0.1)
    assert abs(kept.outputs[SPIKE, 0] - Y[SPIKE]) < 1e-4
    whole = np.ma.masked_array(np.arange(500), mask=np.arange(500) == SPIKE)
    assert record(outputs=whole, max_gap=0.1).outputs[SPIKE, 0] == SPIKE


def test_a_channel_takes_masks_and_dates_as_a_record_does():
    masked = np.ma.masked_array(Y, mask=np.arange(500) == SPIKE)
    stamps = np.datetime64("2026-05-04T10:00") + (1e9 * TIME).astype("m8[ns]")
    channel = Channel("y", stamps, masked)
    assert np.isnan(channel.values[SPIKE]) and channel.rate == pytest.approx(100, rel=1e-4)
    assert channel.time[0] == 1777888800.0
    with pytest.raises(RecordError, match="'y' is a structured array"):
        Channel("y", TIME, np.zeros(500, dtype=[("p", "f8")]))


def test_a_structured_array_is_refused_with_its_fields():
    table = np.zeros(500, dtype=[("p", "f8"), ("q", "f8")])
    for fields in (["p", "q"], ["q"]):  # NumPy itself takes a single field for the array.
        with pytest.raises(RecordError, match=r"fields .*q: stack .*\[x\['q'\]"):
            record(outputs=table[fields])


def test_dates_and_durations_are_seconds_whatever_their_unit():
    for unit in ("ns", "us", "ms"):
        steps = np.arange(500) * np.timedelta64(10_000_000, "ns").astype(f"m8[{unit}]")
        for stamps in (steps, np.datetime64("2026-05-04T10:00") + steps):
            np.testing.assert_allclose(record(time=stamps).time, TIME, rtol=1e-15)
    with pytest.raises(RecordError, match="dates or durations .*not numbers"):
        record(outputs=np.arange(500).astype("m8[s]"))
    with pytest.raises(RecordError, match="time_unit= to plain numbers only"):
        record(time=np.arange(500).astype("m8[ms]"), time_unit="ms")


def test_a_date_that_is_none_is_a_time_stamp_that_is_not_finite():
    stamps = np.datetime64("2026-05-04") + np.arange(500).astype("m8[ms]")
    stamps[7] = np.datetime64("NaT", "ms")
    with pytest.raises(RecordError, match="time stamp 7 is nan"):
        record(time=stamps)


@pytest.mark.parametrize("step", [0.25, 0.5, 1.0])
def test_steps_that_may_be_milliseconds_are_asked_about(tmp_path, step):
    time = step * np.arange(500)
    with pytest.raises(RecordError, match=f"time steps by {step:g}.*time_unit="):
        record(time=time)
    assert record(time=time, time_unit="s").dt == step
    assert record(time=time, time_unit="ms").dt == pytest.approx(step / 1000, rel=1e-12)
    np.savez(tmp_path / "log.npz", t=time, u=U, y=Y)
    with pytest.raises(RecordError, match=f"'t' steps by {step:g}.*time_unit="):
        read(tmp_path / "log.npz", inputs="u", outputs="y")
    assert read(tmp_path / "log.npz", inputs="u", outputs="y", time_unit="s").dt == step


def test_steps_below_a_quarter_are_not_asked_about():
    assert record(time=0.2 * np.arange(500)).sample_rate == pytest.approx(5)
    assert trim(record(time=np.arange(500.0), time_unit="s"), 10, 60).samples == 51


def test_a_file_with_dates_needs_no_unit(tmp_path):
    steps = (1e9 * TIME).astype("m8[ns]")
    np.savez(tmp_path / "log.npz", t=np.datetime64("2026-05-04T10:00", "ns") + steps, u=U, y=Y)
    kept = read(tmp_path / "log.npz", inputs="u", outputs="y")
    # A float64 holds the s since 1970 to 0.24 us.
    np.testing.assert_allclose(kept.time - kept.time[0], TIME, atol=5e-7)


def test_a_file_is_repaired_where_it_is_read_and_nowhere_else(tmp_path):
    np.savez(tmp_path / "log.npz", t=TIME, u=U, y=spoilt(SPIKE, value=1e6), z=spoilt(300, 301))
    path = tmp_path / "log.npz"
    options: dict[str, Any] = dict(inputs="u", outputs=["y", "z"])
    kept = read(path, **options, valid={"y": (-2, 2)}, max_gap=0.05)
    assert {name: times.size for name, times in kept.repaired.items()} == {"y": 1, "z": 2}
    np.testing.assert_allclose(kept.outputs, np.stack([Y, Y], axis=1), atol=2e-3)
    np.testing.assert_array_equal(kept.inputs[:, 0], U)
    assert set(read(path, **options, max_gap=0.05, stop=2.0).repaired) == set()
    with pytest.raises(RecordError, match="names 'x'"):
        read(path, **options, valid={"x": (0, 1)})


def test_a_repaired_channel_is_resampled_like_a_sound_one(tmp_path):
    np.savez(tmp_path / "log.npz", t=TIME, u=U, y=spoilt(SPIKE, 90), z=Y)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kept = read(
            tmp_path / "log.npz", inputs="u", outputs=["y", "z"], max_gap=0.05, sample_rate=50.0
        )
    np.testing.assert_allclose(kept.outputs[:, 0], kept.outputs[:, 1], atol=1e-3)
    assert kept.repaired["y"].size == 2


def test_segments_and_powers_are_of_repaired_channels(tmp_path):
    np.savez(tmp_path / "log.npz", t=TIME, u=U, y=spoilt(SPIKE, value=1e6))
    first, second = read_segments(
        tmp_path / "log.npz",
        [(0, 2), (2, 4)],
        inputs={"u2": {"y^2": 1.0}},
        outputs={"u": {"u": 1.0}},
        valid={"y": (-2, 2)},
        max_gap=0.05,
    )
    np.testing.assert_allclose(first.inputs[:, 0], Y[:201] ** 2, atol=1e-3)
    assert first.repaired["y"].size == 1 and not second.repaired
