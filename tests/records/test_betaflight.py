import blackbox_writer as writer
import numpy as np
import pytest
from blackbox_rows import clock, decoded, log, rows, table
from log_writers import decode

from jaxquad.records import channels, propose, read, ReadError
from jaxquad.records.formats import load_log


AR8 = "betaflight_ar8/LOG00037"
LARGEST = {0: 2**31 - 1, 3: 8191, 6: 2**31 - 1, 7: 2**31 - 1, 8: 32767, 10: 2**31 - 1}


@pytest.mark.parametrize("largest", [40, 3000, 2**20])
def test_what_was_written_is_read_back_whatever_the_size_of_the_steps(largest):
    written = rows(200, largest=largest)
    result = decode("betaflight", log(written))
    np.testing.assert_array_equal(decoded(result.tables[""]), table(written))
    assert result.remarks == () and result.vehicle == "betaflight"


@pytest.mark.parametrize("encoding", [0, 1, 3, 6, 7, 8, 10])
def test_every_encoding_gives_back_numbers_of_every_width(encoding):
    count = {6: 8, 7: 3, 8: 4, 10: 3}.get(encoding, 1)
    random = np.random.default_rng(encoding)
    top = LARGEST.get(encoding, 2**31 - 1)
    sizes = 2.0 ** random.uniform(-1, np.log2(top), (400, count))
    numbers = (sizes * random.choice([-1, 0, 1], (400, count))).astype(np.int64)
    numbers[:3] = np.array([[top], [-top], [-top - (encoding not in (1, 3))]])
    numbers = np.abs(numbers) if encoding == 1 else numbers
    # Key frames only, with so many fields after iteration and time.
    names = ["loopIteration", "time", *(f"x{i}" for i in range(count))]
    zeros = ",".join("0" * len(names))
    lines = {"Field I name": ",".join(names), "Field I signed": ",".join("00" + "1" * count)}
    lines |= dict.fromkeys(("Field I predictor", "Field P predictor", "Field P encoding"), zeros)
    lines["Field I encoding"] = ",".join(["1", "1", *[str(encoding)] * count])
    frames = [
        b"I" + writer.unsigned(32 * k) + writer.unsigned(4000 * k)
        + writer.ENCODERS[encoding](row.tolist())
        for k, row in enumerate(numbers)
    ]  # fmt: skip
    header = writer.header(logged="0", changed=lines)
    main = decode("betaflight", header + b"".join(frames) + writer.END).tables[""]
    values = np.stack([main.columns[name] for name in names[2:]], axis=1)
    np.testing.assert_array_equal(values, numbers)


def test_the_writer_agrees_with_the_examples_of_the_documentation():
    assert writer.unsigned(23456) == bytes([0xA0, 0xB7, 0x01])
    assert [writer.signed(v) for v in (0, -1, 1, -2)] == [b"\0", b"\1", b"\2", b"\3"]
    assert writer.signed(-(2**31)) == writer.unsigned(4294967295)
    assert writer.ENCODERS[6]([0, 0, 4, 0, 8]) == bytes([0b00010100, 8, 16])
    assert writer.ENCODERS[8]([13, 0, 4, 2]) == bytes([0b01010010, 0x0D, 0x42])


@pytest.mark.parametrize(
    ("logged", "numerator", "denominator"),
    [("1/1", 1, 1), ("1/2", 1, 2), ("2/3", 2, 3), ("5/6", 5, 6), ("8", 1, 8), ("1/32", 1, 32)],
)
def test_iterations_follow_the_logging_rate_of_the_header(logged, numerator, denominator):
    every = range(32 * 8)
    chosen = [i for i in every if i % 32 == 0 or (i % 32 + numerator - 1) % denominator < numerator]
    written = rows(0, iterations=chosen)
    result = decode("betaflight", log(written, logged=logged))
    np.testing.assert_array_equal(decoded(result.tables[""]), table(written))
    assert result.remarks == ()


def test_time_goes_on_where_the_counter_of_32_bits_overflows():
    written = rows(200, start=2**32 - 12_345)
    main = decode("betaflight", log(written)).tables[""]
    np.testing.assert_array_equal(decoded(main), table(written))
    assert (np.diff(clock(main)) > 0).all() and clock(main)[-1] > 2**32 / 1e6


def test_logs_in_one_file_become_tables_of_their_own():
    first, second = rows(64), rows(96, seed=1)
    broken = writer.header(interval=0) + b"Psome bytes"
    result = decode("betaflight", b"noise" + log(first) + b"more noise" + broken + log(second))
    np.testing.assert_array_equal(decoded(result.tables["log1"]), table(first))
    np.testing.assert_array_equal(decoded(result.tables["log3"]), table(second))
    assert len(result.tables) == 2 and len(result.remarks) == 1
    assert "log2" in result.remarks[0] and "I interval '0'" in result.remarks[0]
    assert result.settings["log3 looptime"] == "125"


def test_slow_and_gps_frames_are_stamped_and_refer_to_home():
    extra = "".join(
        f"H Field {letter} {kind}:{text}\n"
        for letter, lines in {
            "S": {"name": "flightModeFlags,stateFlags", "predictor": "0,0", "encoding": "1,1"},
            "H": {"name": "home[0],home[1]", "predictor": "0,0", "encoding": "0,0"},
            "G": {"name": "time,GPS_coord[0],GPS_coord[1]", "predictor": "10,7,7",
                  "encoding": "1,0,0", "signed": "0,1,1"},
        }.items()
        for kind, text in lines.items()
    )  # fmt: skip
    written = rows(64)
    frames = writer.frames(written)
    position = b"G" + writer.unsigned(7) + writer.signed(3) + writer.signed(-4)
    home = b"H" + writer.signed(500_000_000) + writer.signed(-70_000_000)
    slow = b"S" + writer.unsigned(3) + writer.unsigned(9)
    payload = [slow, *frames[:9], position, home, slow, *frames[9:20], position, *frames[20:]]
    tables = decode("betaflight", writer.header(extra=extra) + b"".join(payload)).tables
    np.testing.assert_array_equal(decoded(tables[""]), table(written))
    assert tables["slow"].columns["flightModeFlags"].tolist() == [3, 3]
    assert clock(tables["slow"]).tolist() == [written[i]["time"] / 1e6 for i in (0, 8)]
    assert tables["gps"].columns["GPS_coord[0]"].tolist() == [500_000_003]
    assert tables["gps"].columns["GPS_coord[1]"].tolist() == [-70_000_004]
    assert tables["gps"].scales["GPS_coord[0]"] == 1e-7 and clock(tables["gps"]).size == 1


def test_events_between_frames_are_understood_and_the_log_ends_at_its_end():
    written = rows(96)
    frames = writer.frames(written)
    beep = b"E\0" + writer.unsigned(123456)
    adjustment = b"E\x0d\x05" + writer.signed(-60)
    scaled = b"E\x0d\x85\0\0\x80?"
    mode = b"E\x1e" + writer.unsigned(3) + writer.unsigned(1)
    payload = [beep, *frames[:7], adjustment, *frames[7:40], scaled, mode, *frames[40:]]
    after = writer.END + b"IIIPPP\xff" * 9
    result = decode("betaflight", writer.header() + b"".join(payload) + after)
    np.testing.assert_array_equal(decoded(result.tables[""]), table(written))
    assert len(result.remarks) == 1 and "2 settings changed in flight" in result.remarks[0]


def test_frames_between_a_pause_and_its_resumption_are_believed():
    before, after = rows(43), rows(0, iterations=range(320, 400), seed=1)
    resume = b"E\x0e" + writer.unsigned(320) + writer.unsigned(after[0]["time"])
    frames = [*writer.frames(before), resume, *writer.frames(after)]
    main = decode("betaflight", writer.header() + b"".join(frames)).tables[""]
    np.testing.assert_array_equal(decoded(main), table([*before, *after]))


def test_units_follow_the_header_and_axis_sums_are_added():
    written = rows(40)
    changed = {"gyro_scale": "0x3d79c190", "blackbox_high_resolution": "1"}
    main = decode("betaflight", log(written, changed=changed)).tables[""]
    scale = 0.1 * np.frombuffer(bytes.fromhex("3d79c190"), ">f4")[0]
    assert main.scales["gyroADC[1]"] == pytest.approx(scale) and main.units["gyroADC[1]"] == "deg/s"
    assert main.scales["setpoint[0]"] == 0.1 and main.units["setpoint[0]"] == "deg/s"
    truth = [row["axisP[2]"] + row["axisI[2]"] for row in written]
    np.testing.assert_array_equal(main.columns["axisSum[2]"], truth)


def test_the_real_log_equals_its_decoded_copy(data):
    main = load_log(data / f"{AR8}.BFL").tables[""]
    copy = np.load(data / f"{AR8}.npz")
    np.testing.assert_allclose(clock(main), copy["t"], rtol=1e-15)  # 1e-6 times, not 1e6 divided
    groups = {"gyroADC": "gyro_dps", "setpoint": "setpoint_dps", "axisSum": "pid_sum"}
    for ours, theirs in {**groups, "motor": "motor"}.items():
        for i, column in enumerate(copy[theirs].T):
            np.testing.assert_array_equal(main.columns[f"{ours}[{i}]"], column)
    np.testing.assert_array_equal(main.columns["rcCommand[3]"], copy["throttle"])


def test_the_real_log_is_listed_and_read_by_its_channels(data):
    path = data / f"{AR8}.BFL"
    rate = {each.name: each.rate for each in channels(path)}["gyroADC[0]"]
    record = read(path, inputs="axisSum[0]", outputs="gyroADC[0]", references="setpoint[0]")
    assert rate == pytest.approx(985, abs=1) and record.unit("gyroADC[0]") == "deg/s"


def test_a_chirp_shows_in_the_debug_channels_of_its_mode(tmp_path):
    time = np.arange(4000) / 1000
    active = (time >= 1) & (time < 3)
    debug = [
        np.zeros(4000), np.where(active, 1, -1),
        np.where(active, 10 * (1 + 20 * (time - 1)), 0).astype(int),
        np.where(active, 1000 * np.sin(50 * time**2), 0),
    ]  # fmt: skip

    def said(**changed):
        columns = {f"debug[{i}]": column for i, column in enumerate(debug)} | changed
        columns |= {"axisP[1]": 10 * np.sin(20 * time), "gyroADC[1]": np.sin(20 * time)}
        names = ["loopIteration", "time (us)", *columns]
        table = np.column_stack([np.arange(4000), np.round(1e6 * time), *columns.values()])
        path = tmp_path / "log.csv"
        np.savetxt(path, table, delimiter=",", header=", ".join(names), comments="", fmt="%.9g")
        setup = propose(path, axis="pitch").setup
        return *setup.longest, setup.band

    assert said() == (1.0, 2.999, (1.0, 40.9))
    assert said(**{"debug[1]": 7 * active}) == (None, None, None)
    assert said(**{"debug[2]": 10 + 5 * np.sin(time)}) == (None, None, None)


def test_a_file_without_a_log_says_so(tmp_path):
    path = tmp_path / "empty.bbl"
    path.write_bytes(b"no log in here")
    with pytest.raises(ReadError, match="empty.bbl: the file holds no blackbox log"):
        channels(path)
