"""Weighted sums and powers of channels, and several segments of a file at once."""

from typing import Any

import numpy as np
import pytest

from jaxquad.records import parse_mix, read_segments, RecordError, RecordWarning


MIX = {"M": {"w": 0.5, "w^2": 2.0}}


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A moment M = 0.5 w + 2 w^2, and some rate; 20 s at 100 Hz."""
    time = np.arange(2000) / 100
    moment = 0.2 * np.sin(time**1.5)
    speed = (np.sqrt(0.25 + 8 * (moment + 1)) - 0.5) / 4  # 2 w^2 + 0.5 w = M + 1
    path = tmp_path_factory.mktemp("flight") / "flight.npz"
    np.savez(path, t=time, w=speed, q=np.cos(time), M=moment)
    return path


@pytest.mark.parametrize(
    ("text", "mix"),
    [
        ("M", {"M": {"M": 1.0}}),
        ("roll=-m1+0.5*m2", {"roll": {"m1": -1.0, "m2": 0.5}}),
        ("p = m[0] - 2 * m[1]", {"p": {"m[0]": 1.0, "m[1]": -2.0}}),
        ("r=u[deg/s]-.5*u[1]+u[1]", {"r": {"u[deg/s]": 1.0, "u[1]": 0.5}}),
        ("axis-rate", {"axis-rate": {"axis-rate": 1.0}}),
        ("d=a-a.b+1e-3*c", {"d": {"a": 1.0, "a.b": -1.0, "c": 0.001}}),
        ("f=.1*m[0]^2-m[0] ^ 2+m[0]", {"f": {"m[0]^2": -0.9, "m[0]": 1.0}}),
    ],
)
def test_a_mix_is_read(text, mix):
    assert parse_mix(text) == mix


@pytest.mark.parametrize(
    "text",
    ["", "roll=", "roll=a b", "roll=a+*b", "roll=2", "=a", "f=a^1", "f=a^22", "f=a^2^2", "f=a^"],
)
def test_a_mix_without_a_meaning_is_refused(text):
    with pytest.raises(ValueError, match="NAME=-a"):
        parse_mix(text)


def test_a_power_is_that_of_the_channel(flight):
    [record] = read_segments(flight, [(0, 15)], inputs=MIX, outputs={"q": {"q": 1.0}})
    with np.load(flight) as log:
        np.testing.assert_allclose(record.inputs[:, 0], log["M"][: record.samples] + 1, atol=1e-12)
        np.testing.assert_array_equal(record.outputs[:, 0], log["q"][: record.samples])


def test_a_channel_by_itself_may_have_the_name_of_a_power(tmp_path):
    time = np.arange(50) / 100
    np.savez(tmp_path / "odd.npz", **{"t": time, "w^2": np.sin(time), "q": np.cos(time)})
    inputs, outputs = ({name: {name: 1.0}} for name in ("w^2", "q"))
    [record] = read_segments(tmp_path / "odd.npz", [(None, None)], inputs=inputs, outputs=outputs)
    np.testing.assert_array_equal(record.inputs[:, 0], np.sin(time))


@pytest.mark.parametrize(
    ("segments", "complaint"),
    [
        ([(0, 10), (8, 19)], "0 .. 10 s and 8 .. 19 s overlap"),
        ([(15, 19), (5, 17)], "overlap"),
        ([(0, 10), (12, 900)], "12 .. 900 s is out of range"),
        ([(0, 10), (12, 12.05)], "makes 6 samples; 16 .. "),
    ],
)
def test_segments_that_cannot_be_say_why(flight, segments, complaint):
    one = {"q": {"q": 1.0}}
    with pytest.raises(RecordError, match=complaint):
        read_segments(flight, segments, inputs=MIX, outputs=one, sample_rate=100)


def test_segments_of_different_jitter_come_to_one_rate(tmp_path):
    """Two clocks that differ by 0.1 % between the parts of a log."""
    slow, fast = np.arange(100) / 100, 10 + np.arange(100) / 100.1
    time = np.concatenate([slow, fast])
    np.savez(tmp_path / "drift.npz", t=time, u=np.sin(time), y=np.cos(time))
    one = lambda name: {name: {name: 1.0}}
    first, second = read_segments(
        tmp_path / "drift.npz", [(0, 0.98), (10, 10.98)], inputs=one("u"), outputs=one("y")
    )
    assert first.dt == pytest.approx(second.dt, rel=1e-12) == pytest.approx(0.01)


def with_dropouts(path, *gaps, rate=500.0, **changed):
    """20 s of a sine and its integral, with rows missing between times in s."""
    time = np.arange(int(20 * rate)) / rate
    lost = np.any([(time > a) & (time < b) for a, b in gaps], axis=0)
    columns = {"u": np.cos(3 * time), "y": np.sin(3 * time) / 3} | changed
    np.savez(path, t=time[~lost], **{k: v[~lost] for k, v in columns.items()})
    return path


CHANNELS: dict[str, Any] = {"inputs": {"u": {"u": 1.0}}, "outputs": {"y": {"y": 1.0}}}


def test_a_record_is_cut_at_a_dropout_and_all_of_it_is_used(tmp_path):
    path = with_dropouts(tmp_path / "log.npz", (8.0, 8.066))
    said = r"one place, for up to 66 ms at t = 8 s: the record is cut there into 2 segments"
    with pytest.warns(RecordWarning, match=said):
        records = read_segments(path, [(None, None)], **CHANNELS)
    assert [x.time[0] for x in records] == pytest.approx([0.0, 8.066])
    assert [x.time[-1] for x in records] == pytest.approx([8.0, 19.998])
    for record in records:
        truth = np.sin(3 * record.time) / 3
        np.testing.assert_allclose(record.outputs[:, 0], truth, atol=1e-9)


def test_a_dropout_that_is_allowed_is_bridged(tmp_path):
    path = with_dropouts(tmp_path / "log.npz", (8.0, 8.066))
    with pytest.warns(RecordWarning, match="gaps filled by interpolation"):
        [record] = read_segments(path, [(None, None)], max_gap=0.07, **CHANNELS)
    assert record.duration == pytest.approx(19.998)


def test_parts_too_short_for_a_record_are_left_out_and_segments_are_cut_too(tmp_path):
    path = with_dropouts(tmp_path / "log.npz", (5.0, 5.1), (5.6, 5.7), (12.0, 12.2))
    with pytest.warns(RecordWarning, match="in 2 places|in one place, for up to 200 ms"):
        records = read_segments(path, [(1, 10), (11, 19)], **CHANNELS)
    spans = [(x.time[0], x.time[-1]) for x in records]
    np.testing.assert_allclose(spans, [(1, 5), (5.7, 10), (11, 12), (12.2, 19)], atol=2e-3)


def test_a_log_full_of_gaps_is_refused_with_its_first_one(tmp_path):
    gaps = [(a, a + 0.1) for a in np.arange(0.5, 19, 0.5)]
    with pytest.raises(RecordError, match="has a gap of 100 ms from t = 0.5 s"):
        read_segments(with_dropouts(tmp_path / "log.npz", *gaps), [(None, None)], **CHANNELS)


def test_a_missing_value_is_no_gap_in_time(tmp_path):
    holed = np.where(np.arange(10_000) == 40, np.nan, 1.0)
    path = with_dropouts(tmp_path / "log.npz", (8.0, 8.1), u=holed)
    with pytest.raises(RecordError, match="channel 'u' is nan at sample 40"):
        read_segments(path, [(None, None)], **CHANNELS)
