import bisect
import itertools

import blackbox_writer as writer
import numpy as np
import pytest
from blackbox_rows import decoded, log, rows, table
from hypothesis import given, settings, strategies as st
from log_writers import decode

from jaxquad.records import ReadError


ROWS = rows(320)
TRUTH = table(ROWS)
FRAMES = writer.frames(ROWS)
HEADER = writer.header()
BODY = b"".join(FRAMES)
SMALL = log(rows(24), interval=8)
FUZZ = settings(max_examples=500, deadline=None, derandomize=True, database=None)


def true_rows(data):
    """How many rows come out, after a check that each is one that was written."""
    result = decode("betaflight", data)
    found = decoded(result.tables[""])
    written = dict(zip(TRUTH[:, 1].tolist(), TRUTH, strict=True))
    for row in found:
        np.testing.assert_array_equal(row, written[row[1]])
    return len(found), result.remarks


def only_read_errors(data):
    try:
        result = decode("betaflight", data)
    except ReadError as error:
        assert error.offset is None or 0 <= error.offset <= len(data)
        return
    for each in result.tables.values():
        assert each.time is not None and np.isfinite(each.time).all()


def test_a_log_cut_off_anywhere_gives_the_whole_frames_before():
    ends = len(HEADER) + np.cumsum([len(frame) for frame in FRAMES])
    for stop in range(len(HEADER) + 100, len(HEADER) + len(BODY), 211):
        count, remarks = true_rows((HEADER + BODY)[:stop])
        assert count == np.searchsorted(ends, stop, "right") and remarks == ()


@pytest.mark.parametrize("size", [50, 100, 300, 1000])
def test_no_row_is_wrong_where_the_logger_lost_bytes(size):
    """Not in the last interval, which no key frame follows to compare with."""
    for cut in range(60, sum(map(len, FRAMES[:256])) - size, 293):
        count, remarks = true_rows(HEADER + BODY[:cut] + BODY[cut + size :] + writer.END)
        lost = size / len(BODY) * len(ROWS)
        assert len(ROWS) - lost - 66 <= count < len(ROWS)  # at most two intervals go with them
        assert remarks


@pytest.mark.parametrize("first", [5, 31, 32, 40])
@pytest.mark.parametrize("count", [1, 2, 31, 32, 33])
def test_frames_that_were_lost_as_a_whole_are_noticed(first, count):
    lost = FRAMES[:first] + FRAMES[first + count :]
    found, remarks = true_rows(HEADER + b"".join(lost) + writer.END)
    assert remarks and found >= len(ROWS) - count - 64


def test_foreign_bytes_between_frames_are_skipped_and_counted():
    random = np.random.default_rng(7)
    for size in (1, 10, 200, 3000):
        noise = random.integers(0, 256, size, np.uint8).tobytes()
        cut = sum(map(len, FRAMES[:100]))
        count, remarks = true_rows(HEADER + BODY[:cut] + noise + BODY[cut:] + writer.END)
        assert count >= len(ROWS) - 66 and remarks
        assert f"at byte {len(HEADER) + cut}" in remarks[0] or "frames" in remarks[0]


def test_a_key_frame_with_a_damaged_time_is_left_out_with_its_frames():
    wrong = [*ROWS[:64], {**ROWS[64], "time": ROWS[64]["time"] + 5_000_000}, *ROWS[65:]]
    frames = [*FRAMES[:64], writer.frames(wrong)[64], *FRAMES[65:]]
    count, remarks = true_rows(HEADER + b"".join(frames) + writer.END)
    assert (
        count == len(ROWS) - 32 and f"byte {len(HEADER) + sum(map(len, FRAMES[:64]))}" in remarks[0]
    )


def test_frames_at_other_intervals_than_the_header_says_are_kept_and_doubted():
    every_second = rows(0, iterations=range(0, 320, 2))
    result = decode("betaflight", log(every_second, logged="1/1"))
    found = decoded(result.tables[""])
    np.testing.assert_array_equal(found[:, 1:], table(every_second)[:, 1:])
    assert len(result.remarks) == 1 and "loopIteration is not reliable" in result.remarks[0]


BAD_HEADERS = {
    "I interval": ["0", "-32", "99999999999999999999", "x", ""],
    "P interval": ["1/0/2", "3/2", "x", "-1", "0/5"],
    "Data version": ["1", "3"],
    "Field I name": [
        "",
        "time,loopIteration",
        "loopIteration,time" + ",x" * 9,
        "loopIteration,time,\x1b[2J",
    ],
    "Field I encoding": ["1", "1,1" + ",99" * 23, "1,1" + ",-1" * 23, ",".join(["9"] * 25)],
    "Field P encoding": [",".join(["9", "0"] + ["7"] * 23), ",".join(["9"] * 25), "8" * 1000],
    "Field I predictor": [",".join(["2"] * 25), ",".join(["5"] * 25), ",".join(["11"] * 24)],
    "Field P predictor": [",".join(["77"] * 25), ",".join(["7"] * 25)],
    "motorOutput": ["", "x,y", "9" * 30],
}


@pytest.mark.parametrize(
    ("name", "text"), [(name, text) for name, texts in BAD_HEADERS.items() for text in texts]
)
def test_a_header_that_makes_no_sense_is_refused_with_its_place(name, text):
    data = b"xyz" + writer.header(changed={name: text}) + BODY
    with pytest.raises(ReadError) as caught:
        decode("betaflight", data)
    assert caught.value.offset == 3 and str(caught.value)


def test_huge_declarations_are_refused_before_they_take_memory():
    names = ",".join(["loopIteration", "time", *(f"x{i}" for i in range(600))])
    with pytest.raises(ReadError, match="602 fields"):
        decode("betaflight", writer.header(changed={"Field I name": names}) + BODY)
    with pytest.raises(ReadError, match="more than 1000 blackbox logs"):
        decode("betaflight", writer.MARKER.encode() * 1001)


def test_a_header_alone_and_frames_without_a_key_hold_nothing():
    for body in (b"", writer.END, b"".join(FRAMES[1:20]), bytes(5000), b"P" * 5000):
        with pytest.raises(ReadError, match="no readable frame"):
            decode("betaflight", HEADER + body)


@pytest.mark.slow
@FUZZ
@given(st.lists(st.tuples(st.integers(0, 8 * len(SMALL) - 1)), min_size=1, max_size=30))
def test_flipped_bits_raise_nothing_but_read_errors(flips):
    data = bytearray(SMALL)
    for (bit,) in flips:
        data[bit // 8] ^= 1 << bit % 8
    only_read_errors(bytes(data))


@pytest.mark.slow
@FUZZ
@given(st.binary(max_size=400), st.integers(0, len(SMALL)), st.integers(0, 400))
def test_bytes_put_in_the_place_of_others_raise_nothing_but_read_errors(new, at, gone):
    only_read_errors(SMALL[:at] + new + SMALL[at + gone :])


@pytest.mark.slow
@FUZZ
@given(st.binary(max_size=2000))
def test_any_payload_raises_nothing_but_read_errors(payload):
    only_read_errors(HEADER + payload)


@pytest.mark.parametrize("size", [1, 2, 7])
@pytest.mark.parametrize("after", [0, 32, 64, 96])
def test_stray_bytes_behind_a_key_frame_lose_no_frame(size, after):
    """Not even the key frame that they follow; which is the last one is never known."""
    cut = sum(map(len, FRAMES[: after + 1]))
    count, remarks = true_rows(HEADER + BODY[:cut] + b"\xff" * size + BODY[cut:] + writer.END)
    assert count == len(ROWS) and f"({size} bytes)" in remarks[0]


@pytest.mark.parametrize("after", [65, 70, 94, 95])
def test_stray_bytes_behind_another_frame_lose_no_more_than_up_to_the_next_key_frame(after):
    cut = sum(map(len, FRAMES[: after + 1]))
    count, _ = true_rows(HEADER + BODY[:cut] + b"\xff" + BODY[cut:] + writer.END)
    assert count >= len(ROWS) - (96 - after) - 4


@pytest.mark.slow
def test_a_stray_byte_in_a_real_log_costs_one_interval_at_most(data):
    """At a hundred places, behind frames of both kinds."""
    content = (data / "betaflight_firmware/A_hover.BFL").read_bytes()[:400_000]
    whole = decode("betaflight", content).tables[""]
    true = np.stack([np.asarray(x, np.int64) for x in whole.columns.values()], axis=1)
    rows = dict(zip(true[:, 0].tolist(), true, strict=True))
    lost = []
    for cut in range(20_000, 390_000, 3_700):
        found = decode("betaflight", content[:cut] + b"\xfe" + content[cut:]).tables[""]
        lost.append(true.shape[0] - found.columns["axisP[0]"].size)
    assert max(lost) <= 128 // 8 + 4 + 1
    for key in range(3):
        at = key_frame_end(content, whole, key)
        found = decode("betaflight", content[:at] + b"\xfe" + content[at:]).tables[""]
        values = np.stack([np.asarray(x, np.int64) for x in found.columns.values()], axis=1)
        np.testing.assert_array_equal(values, true)
        assert all((rows[row[0]] == row).all() for row in values)


def key_frame_end(content, whole, number):
    """Behind which byte a key frame ends, which has its counter and its time in full."""
    stamps = zip(whole.columns["loopIteration"].tolist(), np.round(1e6 * whole.time), strict=True)
    places = (
        (row, content.find(b"I" + writer.unsigned(counter) + writer.unsigned(int(time))))
        for row, (counter, time) in enumerate(stamps)
    )
    keys = [key for key in itertools.islice(places, 1000) if key[1] >= 0]
    row, start = keys[20 + number]
    cuts = range(start + 1, start + 400)
    held = lambda cut: decode("betaflight", content[:cut]).tables[""].columns["axisP[0]"].size
    return cuts[bisect.bisect_left(cuts, row + 1, key=held)]
