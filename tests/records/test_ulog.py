import warnings

import numpy as np
import pytest
from log_writers import structured, ULog

from jaxquad.records import channels, read, ReadError, RecordWarning


ROWS = 120
STAMPS = (2_000_000 + 4000 * np.arange(ROWS)).astype("<u8")
RNG = np.random.default_rng(6)
XYZ = RNG.standard_normal((ROWS, 3)).astype("<f4")
RATES = structured(
    {"timestamp": ("<u8", STAMPS), "sample": ("<u8", STAMPS - 300), "xyz": ("(3,)<f4", XYZ)}
)
GAINS = structured(
    {"timestamp": ("<u8", STAMPS)} | {f"g{i}": ("<f4", (i + 1) * XYZ[:, 0]) for i in range(6)}
)


def begun(**options):
    log = ULog(**options)
    log.define("gain:float p;float i;")
    log.define("rate_ctrl_status:uint64_t timestamp;gain[2] axis;gain other;")
    log.define(
        "vehicle_angular_velocity:uint64_t timestamp;uint64_t timestamp_sample;float[3] xyz;"
        "uint8_t[4] _padding0;"
    )
    log.info("char[4] sys_name", b"PX4\0")
    log.info("float MC_ROLLRATE_P", np.float32(0.15).tobytes(), kind="P")
    log.subscribe(7, "vehicle_angular_velocity")
    log.subscribe(9, "rate_ctrl_status", 1)
    return log


def saved(folder, log):
    path = folder / "log.ulg"
    path.write_bytes(log.content)
    return path


@pytest.fixture
def path(tmp_path):
    log = begun()
    for k in range(0, ROWS, 40):
        log.write_rows(7, RATES[k : k + 40])
        log.sync()
        log.write_rows(9, GAINS[k : k + 40])
    return saved(tmp_path, log)


def test_topics_instances_arrays_and_nested_fields_are_channels(path):
    found = {each.name: each for each in channels(path)}
    assert found["vehicle_angular_velocity.xyz[2]"].unit == "rad/s"
    assert found["vehicle_angular_velocity.xyz[2]"].rate == pytest.approx(250.0)
    assert {"rate_ctrl_status[1].axis[1].i", "rate_ctrl_status[1].other.p"} <= set(found)
    assert not any("padding" in name for name in found)


def test_values_are_those_that_pyulog_reads(path):
    pyulog = pytest.importorskip("pyulog")
    other = {(each.name, each.multi_id): each.data for each in pyulog.ULog(str(path)).data_list}
    rates, gains = other["vehicle_angular_velocity", 0], other["rate_ctrl_status", 1]
    record = read(
        path, inputs="vehicle_angular_velocity.xyz[0]", outputs="vehicle_angular_velocity.xyz[1]"
    )
    np.testing.assert_array_equal(record.inputs[:, 0], rates["xyz[0]"])
    np.testing.assert_array_equal(record.outputs[:, 0], rates["xyz[1]"])
    np.testing.assert_allclose(record.time, rates["timestamp"] * 1e-6, rtol=1e-15)
    record = read(
        path, inputs="rate_ctrl_status[1].axis[1].i", outputs="rate_ctrl_status[1].other.p"
    )
    np.testing.assert_array_equal(record.inputs[:, 0], gains["axis[1].i"])
    np.testing.assert_array_equal(record.outputs[:, 0], gains["other.p"])


def test_dropouts_of_the_logger_are_told(tmp_path):
    log = begun()
    log.write_rows(7, RATES)
    log.dropout(30)
    log.dropout(50)
    with pytest.warns(
        RecordWarning, match="lost data 2 times, 80 ms in all, the longest dropout 50 ms"
    ):
        channels(saved(tmp_path, log))


def test_a_damaged_stretch_is_skipped_and_told_with_its_bytes(tmp_path):
    log = begun()
    log.write_rows(7, RATES[:60])
    begin = len(log.content)
    log.content += b"D" * 70
    log.write_rows(7, RATES[60:])
    with pytest.warns(
        RecordWarning, match=f"1 damaged block .70 bytes. skipped: bytes {begin} .. "
    ):
        record = read(
            saved(tmp_path, log),
            inputs="vehicle_angular_velocity.xyz[0]",
            outputs="vehicle_angular_velocity.xyz[1]",
        )
    np.testing.assert_array_equal(record.inputs[:, 0], XYZ[:, 0])


def test_a_log_cut_off_in_flight_is_read_up_to_there(tmp_path):
    log = begun()
    log.write_rows(7, RATES)
    del log.content[-10:]
    with pytest.warns(RecordWarning, match="the file is cut off: the last 23 bytes"):
        assert channels(saved(tmp_path, log))[1].samples == ROWS - 1


def test_data_appended_after_a_crash_are_read(tmp_path):
    cut = begun()
    cut.write_rows(7, RATES[:50])
    whole = begun(appended=len(cut.content) - 11)
    whole.write_rows(7, RATES[:50])
    del whole.content[-11:]  # The last message never came to its end.
    whole.write_rows(7, RATES[50:])
    assert channels(saved(tmp_path, whole))[1].samples == ROWS - 1


def test_flags_of_a_newer_format_are_refused_with_their_place(tmp_path):
    log = ULog()
    log.content[16 + 3 + 8] = 2
    with pytest.raises(ReadError, match=r"newer reader: .*0x2 \(at byte 16\)"):
        channels(saved(tmp_path, log))


@pytest.mark.parametrize(
    ("definitions", "said"),
    [
        (["t:uint64_t timestamp;u x;"], "'u' is not defined"),
        (["t:uint64_t timestamp;t x;"], "contains itself"),
        (["t:float x;"], "has no timestamp"),
        (["t:uint64_t timestamp;float[99999] x;"], "99999 elements"),
        (["t:uint64_t timestamp;float[40000] x;"], "implausibly long"),
        (
            ["e:float[0] x;", "t:uint64_t timestamp;e[60000] a;e[60000] b;"],
            "implausibly long",
        ),
        (["t uint64_t timestamp"], "not a definition of a format"),
        (["t:uint64_t timestamp;", "t:uint64_t timestamp;float x;"], "defined twice"),
    ],
)
def test_a_senseless_definition_is_told_and_the_rest_is_read(tmp_path, definitions, said):
    log = begun()
    for text in definitions:
        log.define(text)
    log.subscribe(3, "t")
    log.write_rows(7, RATES)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        names = {each.name for each in channels(saved(tmp_path, log))}
    assert any(said in str(each.message) for each in told)
    assert {f"vehicle_angular_velocity.xyz[{i}]" for i in range(3)} <= names


def test_formats_without_end_neither_hang_nor_fill_the_memory(tmp_path):
    log = begun()
    log.write_rows(7, RATES)
    for i in range(400):
        log.define(f"f{i}:uint64_t timestamp;uint8_t x;gain[8000] y;")
        log.subscribe(20 + i, f"f{i}")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert len(channels(saved(tmp_path, log))) == 4
    assert "implausibly long" in str(told[0].message) and len(told) <= 9
