import numpy as np
import pytest
from log_writers import DataFlash

from jaxquad.records import channels, read, ReadError, RecordWarning
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


def test_a_log_cut_off_in_flight_is_read_up_to_there(tmp_path):
    content = bytes(written().content)
    path = tmp_path / "log.bin"
    path.write_bytes(content[:-5])
    with pytest.warns(
        RecordWarning, match=f"cut off: the last 16 bytes, from byte {len(content) - 21}"
    ):
        assert {each.samples for each in channels(path)} == {200, 199}


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
