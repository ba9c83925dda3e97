from typing import Any

import numpy as np
import pytest

from jaxquad.records import Record, RecordError, RecordWarning, select, trim


TIME = np.arange(101) / 50.0
U = np.sin(3 * TIME)
Y = np.cos(3 * TIME)


def record(**changes):
    options: dict[str, Any] = dict(time=TIME, inputs=U, outputs=np.stack([Y, 2 * Y], axis=1))
    return Record(**options | changes)


def test_record_keeps_every_bit_of_float32_and_float64():
    single = U.astype(np.float32)
    kept = record(inputs=single)
    assert kept.inputs.dtype == np.float64
    np.testing.assert_array_equal(kept.inputs[:, 0].astype(np.float32), single)
    np.testing.assert_array_equal(kept.outputs[:, 1], 2 * Y)


def test_record_does_not_change_with_the_arrays_it_was_made_from():
    mine = U.copy()
    kept = record(inputs=mine)
    mine[:] = 0
    np.testing.assert_array_equal(kept.inputs[:, 0], U)


def test_record_knows_its_clock():
    kept = record()
    assert (kept.samples, kept.duration) == (101, 2.0)
    assert kept.dt == pytest.approx(0.02, rel=1e-14)
    assert kept.sample_rate == pytest.approx(50.0, rel=1e-14)


def test_channels_are_numbered_where_there_are_several():
    kept = record(references=Y)
    assert kept.names == ("u", "y1", "y2", "r")
    np.testing.assert_array_equal(kept.channel("y2"), 2 * Y)


def test_an_absent_reference_has_no_columns():
    assert record().references.shape == (101, 0)


def test_summary_says_names_units_and_clock():
    text = str(record(input_names="M", input_units="N m", source="flight.csv"))
    assert "flight.csv" in text and "inputs: M [N m]" in text
    assert "101 samples, 2 s at 50 Hz" in text and "references: none" in text


def test_a_missing_channel_is_answered_with_the_nearest():
    kept = record(output_names=["roll_rate", "pitch_rate"])
    with pytest.raises(
        RecordError, match="no channel 'rol_rate'. Did you mean 'roll_rate'.*u, roll"
    ):
        kept.channel("rol_rate")


def swapped(time):
    time = time.copy()
    time[[30, 31]] = time[[31, 30]]
    return time


def spoilt(values, value):
    values = values.copy()
    values[[20, 25]] = value
    return values


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (dict(inputs=U[:-1]), r"inputs has 100 rows for 101 time stamps.*Cut or resample"),
        (dict(outputs=np.stack([Y, Y])), "outputs has 2 rows for 101 time stamps.*Transpose it"),
        (dict(inputs=np.empty((101, 0))), "inputs has no channel"),
        (dict(inputs=U[:, None, None]), r"inputs has shape \(101, 1, 1\)"),
        (dict(inputs=U + 0j), "inputs is complex"),
        (dict(inputs=["a"] * 101), "inputs is not an array of numbers"),
        (dict(time=TIME[:, None]), r"time has shape \(101, 1\)"),
        (dict(time=swapped(TIME)), "time goes back at sample 31, from 0.62 s to 0.6 s"),
        (
            dict(time=np.minimum(TIME, 1.0)),
            "time repeats at sample 51, from 1 s to 1 s .in 50 places",
        ),
        (dict(time=spoilt(TIME, np.nan)), "time stamp 20 is nan"),
        (dict(time=np.delete(TIME, 50), inputs=U[1:], outputs=Y[1:]), "step is 0.04 s at t = 0.98"),
        (
            dict(time=np.delete(TIME, 50), inputs=U[1:], outputs=Y[1:], max_gap=1.0),
            r"jq.Record.from_dataframe\(.*\) or .*resample; as rows are missing, .* \(max_gap=",
        ),
        (dict(time=TIME**1.01), r"up to .* samples off a uniform.*jq.read.*jq.records.resample\.$"),
        (
            dict(inputs=spoilt(U, np.nan)),
            "channel 'u' holds 2 NaN and 0 inf, the first at t = 0.4 s, the longest gap 0.04 s. .* "
            r"\(start=, stop=\) in jq.read, or cut the arrays, or let gaps .* \(max_gap=\)",
        ),
        (
            dict(outputs=spoilt(Y, -np.inf)),
            "channel 'y' holds 0 NaN and 2 inf, the first at t = 0.4",
        ),
        (dict(input_names="y1"), "name 'y1' occurs 2 times"),
        (dict(output_names="q"), r"1 names \('q',\) for 2 channels"),
        (dict(output_units="rad/s"), "1 units"),
        (dict(time=TIME[:15], inputs=U[:15], outputs=Y[:15]), "15 samples: .* at least 16"),
    ],
)
def test_record_refuses(changes, said):
    with pytest.raises(RecordError, match=said):
        record(**changes)


def test_a_constant_channel_is_doubted_by_name():
    with pytest.warns(RecordWarning, match="channel 'u' is constant at 0.3: nothing can be"):
        record(inputs=np.full(101, 0.3))


def test_stamps_in_whole_microseconds_count_as_uniform():
    stamps = np.round(np.arange(5000) / 985.4, 6)
    kept = Record(stamps, np.sin(stamps), np.cos(stamps))
    assert kept.sample_rate == pytest.approx(985.4, rel=1e-6)


def test_trim_keeps_samples_and_their_time():
    part = trim(record(), 0.5, 1.5)
    np.testing.assert_array_equal(part.time, TIME[25:76])
    np.testing.assert_array_equal(part.channel("u"), U[25:76])


@pytest.mark.parametrize(
    ("start", "stop", "said"),
    [
        (-1.0, 1.0, r"-1 .. 1 s is out of range; the record covers 0 .. 2 s"),
        (1.0, 3.0, r"1 .. 3 s is out of range; the record covers 0 .. 2 s"),
        (1.0, 0.5, r"start 1 s is not before stop 0.5 s"),
        (1.0, 1.2, r"holds 11 samples: at least 16 are needed; the record covers 0 .. 2 s"),
    ],
)
def test_trim_refuses(start, stop, said):
    with pytest.raises(RecordError, match=said):
        trim(record(), start, stop)


def test_select_gives_channels_new_roles_and_keeps_their_units():
    before = record(references=Y**2, output_units=["rad/s", "deg/s"])
    after = select(before, inputs="r", outputs=["y2", "u"])
    assert (after.input_names, after.output_names) == (("r",), ("y2", "u"))
    assert after.output_units == ("deg/s", "") and after.reference_names == ()
    np.testing.assert_array_equal(after.outputs, np.stack([2 * Y, U], axis=1))


def test_select_refuses_one_channel_in_two_roles():
    with pytest.raises(RecordError, match="'u' occurs 2 times"):
        select(record(), inputs="u", outputs="u")


@pytest.mark.parametrize("size", [1e160, 1e-200])
def test_a_size_whose_square_is_no_number_is_refused(size):
    time = 0.01 * np.arange(100)
    with pytest.raises(RecordError, match="channel .y. reaches 1e.*another unit"):
        Record(time, np.sin(time), size * np.sin(time) / np.max(np.abs(np.sin(time))))


def test_a_hold_in_milliseconds_is_refused_and_one_that_the_input_keeps_is_not():
    time, noise = np.arange(1000) / 250, np.random.default_rng(0).standard_normal(1000)
    with pytest.raises(RecordError, match=r"hold is 4 s, but the input u changes every 0.004 s"):
        Record(time, noise, noise, hold=4)
    slow = np.repeat(noise[:2], 500)
    assert Record(time, slow, noise, hold=2.0).hold == 2.0
    assert Record(time, noise, noise, hold=0.004).hold == 0.004
