import numpy as np
import pytest
from log_writers import DataFlash

from jaxquad.records import channels, read, read_settings, ReadError, RecordWarning
from jaxquad.records.formats import load_log


TIME = (7.0 + np.arange(200) / 400.0).round(6)
STAMPS = np.round(TIME * 1e6).astype(int)
RNG = np.random.default_rng(5)
GYRO = RNG.standard_normal((200, 3)).astype(np.float32)
ANGLE = RNG.integers(-9000, 9000, 200)


def written(*, first=0, rows=200):
    log = DataFlash()
    log.define("IMU", "QBfff", "TimeUS,I,GyrX,GyrY,GyrZ", units="s#EEE", mults="F-000")
    log.define("ATT", "Qcd", "TimeUS,Roll,Lean", units="skk", mults="FBB")
    log.define("MSG", "QZ", "TimeUS,Message")
    log.write("PARM", 0, b"SID_AXIS", 10.0)
    log.write("MSG", 1, b"ArduCopter V4.5")
    for k in range(first, first + rows):
        log.write("IMU", STAMPS[k], 0, *GYRO[k].tolist())
        log.write("IMU", STAMPS[k] + 50, 1, *(2 * GYRO[k]).tolist())
        log.write("ATT", STAMPS[k] + 100, ANGLE[k], ANGLE[k])
    return log


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "log.bin"
    path.write_bytes(written().content)
    return path


def test_instances_units_and_rates_are_listed(path):
    found = {each.name: each for each in channels(path)}
    assert set(found) == {
        *(f"IMU[{i}].Gyr{axis}" for i in range(2) for axis in "XYZ"), "ATT.Roll", "ATT.Lean"
    }  # fmt: skip
    assert found["IMU[1].GyrY"].unit == "rad/s" and found["ATT.Roll"].unit == "deg/s"
    assert found["IMU[0].GyrX"].rate == pytest.approx(400.0)
    assert found["IMU[1].GyrX"].start == pytest.approx(7.00005)


def test_values_are_those_that_pymavlink_reads(path):
    mavlink = pytest.importorskip("pymavlink.DFReader")
    reader = mavlink.DFReader_binary(str(path))
    other = {"IMU": [], "ATT": []}
    while (message := reader.recv_match(type=["IMU", "ATT"])) is not None:
        other[message.get_type()].append(message)
    reader.close()
    record = read(path, inputs="IMU[1].GyrX", outputs="IMU[1].GyrZ")
    mine = [m for m in other["IMU"] if m.I == 1]
    np.testing.assert_array_equal(record.inputs[:, 0], [m.GyrX for m in mine])
    np.testing.assert_array_equal(record.outputs[:, 0], [m.GyrZ for m in mine])
    np.testing.assert_allclose(record.time, [m.TimeUS * 1e-6 for m in mine], rtol=1e-15)
    record = read(path, inputs="ATT.Roll", outputs="ATT.Lean")
    # pymavlink divides by 100, which rounds otherwise than multiplying by 0.01 does.
    np.testing.assert_allclose(record.inputs[:, 0], [m.Roll for m in other["ATT"]], rtol=1e-15)
    # It leaves the multipliers of FMTU to its caller.
    np.testing.assert_allclose(record.outputs[:, 0], 0.01 * ANGLE, rtol=1e-15)


@pytest.mark.parametrize("letters", ["bBhHiIfdcC", "eELqQg"])
def test_every_number_format_is_read_as_pymavlink_reads_it(tmp_path, letters):
    mavlink = pytest.importorskip("pymavlink.DFReader")
    extremes = {"b": "i1", "B": "u1", "h": "i2", "H": "u2", "i": "i4", "I": "u4", "c": "i2",
                "C": "u2", "e": "i4", "E": "u4", "L": "i4", "q": "i8", "Q": "u8"}  # fmt: skip
    log = DataFlash()
    log.define("ALL", "Q" + letters, ",".join(["TimeUS", *(f"F{k}" for k in letters)]))
    for k in range(20):
        kinds = [np.iinfo(extremes[each]) if each in extremes else None for each in letters]
        row = [
            0.1 * k if kind is None else int(kind.min if k % 2 else kind.max) // (k + 1)
            for kind in kinds
        ]
        log.write("ALL", 1000 * (k + 1), *row)
    (tmp_path / "log.bin").write_bytes(log.content)
    reader = mavlink.DFReader_binary(str(tmp_path / "log.bin"))
    other = []
    while (message := reader.recv_match(type="ALL")) is not None:
        other.append(message)
    reader.close()
    table = load_log(tmp_path / "log.bin").tables["ALL"]
    for each in letters:
        mine = table.columns[f"F{each}"] * table.scales[f"F{each}"]
        theirs = np.array([float(getattr(m, f"F{each}")) for m in other])
        np.testing.assert_allclose(mine.astype(float), theirs, rtol=1e-15)


def test_damaged_blocks_are_skipped_and_told_with_their_bytes(tmp_path):
    parts = [bytes(written(first=k, rows=100).content) for k in (0, 100)]
    definitions = len(written(rows=0).content)
    path = tmp_path / "log.bin"
    path.write_bytes(parts[0] + b"\xa3 noise \xa3\x95\x80" + bytes(40) + parts[1][definitions:])
    begin = len(parts[0])
    with pytest.warns(
        RecordWarning, match=f"1 damaged block .51 bytes. skipped: bytes {begin} .. "
    ):
        record = read(path, inputs="IMU[0].GyrX", outputs="IMU[0].GyrY")
    np.testing.assert_array_equal(record.inputs[:, 0], GYRO[:, 0])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("filling", [b"", bytes(500), b"\xff" * 500])
def test_a_log_that_ends_within_a_message_or_before_its_space_is_whole(tmp_path, filling):
    """The writer's buffer ends where it does, and a file may be prepared longer than it gets."""
    content = bytes(written().content)
    path = tmp_path / "log.bin"
    path.write_bytes(content + filling if filling else content[:-5])
    last = 200 if filling else 199
    assert {each.samples for each in channels(path)} == {200, last}


@pytest.mark.filterwarnings("ignore:.*holds 2 logs")
@pytest.mark.parametrize("cut", [0, 5, 16])
def test_a_file_of_two_boots_is_read_as_the_longest_with_a_chirp(tmp_path, cut):
    """The first log may end within a message, and the second one may define others."""
    first = written()
    second = DataFlash()
    second.define("SIDD", "Qf", "TimeUS,Targ")
    second.define("IMU", "QBfff", "TimeUS,I,GyrX,GyrY,GyrZ", units="s#EEE", mults="F-000")
    for k in range(100):
        second.write("SIDD", 1_000_000 + 25_000 * k, 1.0)
        second.write("IMU", 1_000_000 + 25_000 * k, 0, float(k), 0.0, 0.0)
    parts = [bytes(first.content)[: len(first.content) - cut], bytes(second.content)]
    path = tmp_path / "log.bin"
    path.write_bytes(parts[0] + parts[1])
    with pytest.warns(RecordWarning, match="holds 2 logs.*: number 2 is read .t = 1") as caught:
        log = load_log(path)
    assert len(caught) == 1
    assert f"bytes 0 .. {len(parts[0]) - 1}" in str(caught[0].message)
    np.testing.assert_array_equal(log.tables["IMU[0]"].columns["GyrX"], np.arange(100.0))
    assert "ATT" not in log.tables and log.settings == {}
    path.write_bytes(parts[1] + parts[1] if cut else parts[1] + parts[0])
    with pytest.warns(RecordWarning, match="number 1 is read"):
        assert load_log(path).tables["IMU[0]"].columns["GyrX"].size == 100
    # Where the clock goes on, it is one log.
    short, later = (bytes(written(first=a, rows=b).content) for a, b in ((0, 100), (100, 100)))
    path.write_bytes(short + later)
    log = load_log(path)
    np.testing.assert_array_equal(log.tables["IMU[0]"].columns["GyrX"], GYRO[:, 0])


@pytest.mark.filterwarnings("ignore:.*the unit of RATE")
def test_a_text_file_of_two_boots_is_read_as_the_longest(tmp_path):
    head = "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n"
    head += "FMT, 146, 21, RATE, Qf, TimeUS,R\n"
    logs = [
        head + "".join(f"RATE, {10_000 * k + 5_000_000}, {k}\n" for k in range(count))
        for count in (150, 300)
    ]
    path = tmp_path / "log.log"
    path.write_text("".join(logs))
    with pytest.warns(RecordWarning, match="number 2 is read .*, the longest one. Left out: numb"):
        log = load_log(path)
    np.testing.assert_array_equal(log.tables["RATE"].columns["R"], np.arange(300.0))


@pytest.mark.parametrize("text", [False, True])
def test_a_log_names_its_firmware(tmp_path, text):
    path = tmp_path / ("log.log" if text else "log.bin")
    if text:
        path.write_text(
            "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n"
            "FMT, 147, 75, MSG, QZ, TimeUS,Message\nPARM, 1, SID_AXIS, 10\n"
            "MSG, 1, Barometer calibrated\nMSG, 2, ArduPlane V4.5.7 (2a3dc4b7)\n"
        )
    else:
        path.write_bytes(written().content)
    settings = read_settings(path)
    assert settings.version == ((4, 5, 7) if text else (4, 5, 0))
    assert load_log(path).firmware == ("ArduPlane V4.5.7 (2a3dc4b7)" if text else "ArduCopter V4.5")


def test_other_definitions_further_on_are_refused_with_their_place(tmp_path):
    log = written()
    place = len(log.content)
    log.define("IMU", "Qfff", "TimeUS,GyrX,GyrY,GyrZ", kind=log.kind("IMU"))
    path = tmp_path / "log.bin"
    path.write_bytes(log.content)
    with pytest.raises(ReadError, match=rf"defined a second time, differently .*at byte {place}"):
        channels(path)


def test_a_format_that_contradicts_itself_is_left_out_by_name(tmp_path):
    log = written()
    log.define("BAD", "Qff", "TimeUS,One")
    log.write("BAD", 1, 2.0, 3.0)
    path = tmp_path / "log.bin"
    path.write_bytes(log.content)
    with pytest.warns(RecordWarning, match="an inconsistent format were left out: BAD"):
        assert not any(each.name.startswith("BAD") for each in channels(path))


def test_the_text_form_gives_the_same_channels(path, tmp_path):
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 145, 24, IMU, QBfff, TimeUS,I,GyrX,GyrY,GyrZ",
        "FMT, 146, 21, ATT, Qcd, TimeUS,Roll,Lean",
        "FMT, 147, 75, MODE, QMZ, TimeUS,Mode,Why",
        "UNIT, 0, 69, rad/s", "UNIT, 0, 107, deg/s", "MULT, 0, 66, 0.01", "MULT, 0, 70, 1E-06",
        "FMTU, 0, 145, s#EEE, F-000", "FMTU, 0, 146, skk, FBB",
        "MODE, 7000000, Stabilize, 1", "IMU, 1, 2",
    ]  # fmt: skip
    for k in range(200):
        x, y, z = GYRO[k].tolist()
        lines.append(f"IMU, {STAMPS[k]}, 0, {x!r}, {y!r}, {z!r}")
        lines.append(f"ATT, {STAMPS[k] + 100}, {ANGLE[k] / 100:.2f}, {ANGLE[k]}")
    other = tmp_path / "log.log"
    other.write_text("\r\n".join(lines))
    with pytest.warns(RecordWarning, match="1 lines that match no format were left out"):
        units = {each.name: each.unit for each in channels(other)}
    assert units["IMU[0].GyrX"] == "rad/s" and units["ATT.Lean"] == "deg/s"
    for names in (("IMU[0].GyrX", "IMU[0].GyrY"), ("ATT.Roll", "ATT.Lean")):
        with pytest.warns(RecordWarning, match="match no format"):
            mine = read(other, inputs=names[0], outputs=names[1])
        binary = read(path, inputs=names[0], outputs=names[1])
        np.testing.assert_allclose(mine.inputs, binary.inputs, rtol=1e-15)
        np.testing.assert_allclose(mine.outputs, binary.outputs, rtol=1e-15)


@pytest.mark.parametrize("kept", [1, 4, 50, 89])
def test_a_log_without_messages_is_refused(tmp_path, kept):
    path = tmp_path / "log.bin"
    path.write_bytes(bytes(written().content)[:kept])
    with pytest.raises(ReadError):
        channels(path)


def test_a_file_with_too_many_definitions_is_refused(tmp_path):
    log = DataFlash()
    log.define("IMU", "Qf", "TimeUS,GyrX")
    path = tmp_path / "log.bin"
    path.write_bytes(bytes(log.content) * 101)
    with pytest.raises(ReadError, match="defines its messages more than 100 times"):
        channels(path)


@pytest.mark.filterwarnings("error")
def test_short_numbers_are_scaled_without_an_overflow(tmp_path):
    log = DataFlash()
    log.write("MULT", 0, ord("/"), 3600.0)
    log.define("BAT", "Qfg", "TimeUS,Tot,Half", units="s--", mults="F//")
    for k in range(20):
        log.write("BAT", 10_000 * k, 3e38, 100.0 + k)
    path = tmp_path / "log.bin"
    path.write_bytes(log.content)
    listed = {channel.name: channel for channel in channels(path)}
    assert listed["BAT.Tot"].maximum == pytest.approx(3e38 * 3600)
    assert listed["BAT.Half"].maximum == pytest.approx(119 * 3600)
