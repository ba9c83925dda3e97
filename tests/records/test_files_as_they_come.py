"""Logs as other programs save them: each gives the record, or one error with the remedy."""

import math
import re

import numpy as np
import pytest
from log_writers import DataFlash
from scipy.io import savemat

from jaxquad.records import channels, read, ReadError, RecordError, RecordWarning


TIME = 5.0 + np.arange(400) / 100.0
U, Y = np.sin(3 * TIME), np.cos(3 * TIME)


def assert_holds(path, *, inputs="u", outputs="y", stamps=TIME, **options):
    record = read(path, inputs=inputs, outputs=outputs, **options)
    np.testing.assert_allclose(record.time, stamps, atol=1e-6)
    np.testing.assert_array_equal(record.inputs[:, 0], U)
    np.testing.assert_array_equal(record.outputs[:, 0], Y)


def written(path, header, *columns):
    rows = zip(*([repr(x) for x in np.asarray(c).tolist()] for c in columns), strict=True)
    path.write_text("\n".join([*([header] if header else []), *map(",".join, rows)]) + "\n")
    return path


def named(path, **options):
    return {each.name: each for each in channels(path, **options)}


def test_a_matrix_with_a_channel_in_each_row_is_turned(tmp_path):
    path = tmp_path / "log.mat"
    savemat(path, {"t": TIME, "data": np.stack([U, Y]), "square": np.eye(4)})
    assert_holds(path, inputs="data[0]", outputs="data[1]")
    # As long as the time is, whatever the number of rows.
    np.savez(tmp_path / "log.npz", t=TIME, data=np.tile([U, Y], (10, 1)))
    assert_holds(tmp_path / "log.npz", inputs="data[18]", outputs="data[19]")


def test_to_file_of_simulink_keeps_its_time_in_the_first_row(tmp_path):
    path = tmp_path / "log.mat"
    savemat(path, {"ans": np.stack([TIME, U, Y])})
    with pytest.warns(RecordWarning, match=r"taken from 'ans\[0\]', which rises.*\(dt=\)"):
        assert_holds(path, inputs="ans[1]", outputs="ans[2]")
    with pytest.warns(RecordWarning, match="taken from"):
        assert set(named(path)) == {"ans[1]", "ans[2]"}
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "new.mat", "w") as file:
        file["ans"] = np.stack([TIME, U, Y]).T  # MATLAB's axes are reversed in HDF5
        file["ans"].attrs["MATLAB_class"] = np.bytes_("double")
    with pytest.warns(RecordWarning, match="taken from"):
        assert_holds(tmp_path / "new.mat", inputs="ans[1]", outputs="ans[2]")


def test_a_structure_with_time_of_simulink_gives_its_time_to_all_signals(tmp_path):
    signals = np.zeros((1, 2), dtype=[("values", object), ("label", object)])
    signals["values"][0] = [U[:, None], Y[:, None]]
    path = tmp_path / "log.mat"
    savemat(path, {"simout": {"time": TIME[:, None], "signals": signals}})
    assert_holds(path, inputs="simout.signals[0].values", outputs="simout.signals[1].values")


def test_rows_without_a_time_need_their_interval_and_count_from_0(tmp_path):
    path = written(tmp_path / "log.csv", "u,y", U, Y)
    with pytest.raises(ReadError, match=r"no time base for 'u'.*equally spaced rows in s \(dt=\)"):
        read(path, inputs="u", outputs="y")
    assert_holds(path, stamps=TIME - TIME[0], dt=0.01)
    assert named(path, dt=0.01)["u"].rate == pytest.approx(100)
    with pytest.raises(RecordError, match="dt is -1: give the sampling interval in s, above 0"):
        read(path, inputs="u", outputs="y", dt=-1)
    with pytest.raises(RecordError, match="dt is 0.01 s, and a time base is named as well"):
        read(path, inputs="u", outputs="y", dt=0.01, time="u")


def test_a_file_without_names_is_a_matrix(tmp_path):
    path = written(tmp_path / "log.csv", "", TIME, U, Y)
    said = "no line of channel names: its columns are called data\\[0\\] .. data\\[2\\]"
    with (
        pytest.warns(RecordWarning, match=said),
        pytest.warns(RecordWarning, match=r"taken from 'data\[0\]'"),
    ):
        assert_holds(path, inputs="data[1]", outputs="data[2]")
    path = written(tmp_path / "log.txt", "# flight 7", U, Y)
    with pytest.warns(RecordWarning, match=said.replace("2", "1")):
        assert_holds(path, inputs="data[0]", outputs="data[1]", stamps=TIME - TIME[0], dt=0.01)
    with (
        pytest.warns(RecordWarning, match="no line"),
        pytest.raises(ReadError, match=r"no time base for 'data'.*\(dt=\)"),
    ):
        read(path, inputs="data[0]", outputs="data[1]")


@pytest.mark.parametrize(
    "names",
    [
        ("sec", "nanosec"),
        ("header.stamp.secs", "header.stamp.nsecs"),
        ("/imu/header/stamp/sec", "/imu/header/stamp/nanosec"),
    ],
)
def test_seconds_and_nanoseconds_are_one_clock(tmp_path, names):
    stamps = np.round(1.7e18 + TIME * 1e9).astype(np.int64)
    struct = "/imu/" if names[0].startswith("/") else ""
    header = ",".join([*names, f"{struct}u", f"{struct}y"])
    path = written(tmp_path / "log.csv", header, stamps // 10**9, stamps % 10**9, U, Y)
    assert_holds(path, inputs=f"{struct}u", outputs=f"{struct}y", stamps=1.7e9 + TIME)
    assert set(named(path)) == {f"{struct}u", f"{struct}y"}


def test_other_names_of_seconds_and_nanoseconds_can_be_given(tmp_path):
    whole, rest = np.divmod(np.round(TIME * 1e9).astype(np.int64), 10**9)
    path = written(tmp_path / "log.csv", "a,b,u,y", whole, rest, U, Y)
    assert_holds(path, time="a+b")
    with pytest.raises(ReadError, match=r"time base 'c': there is no channel 'c'"):
        read(path, inputs="u", outputs="y", time="a+c")


def test_each_topic_of_a_bag_in_a_mat_file_has_its_clock(tmp_path):
    """As bags of mavros are exported: a struct for each topic, with its time or its header."""
    slow = TIME[::2]
    stamps = {"secs": np.floor(slow), "nsecs": np.round(1e9 * (slow % 1))}
    imu = {"time": TIME, "angular_velocity": {"x": np.cos(3 * TIME)}}
    rc = {"header": {"stamp": stamps}, "channels": np.sin(3 * slow)}
    path = tmp_path / "bag.mat"
    savemat(path, {"imu": imu, "rc": rc})
    assert {n: round(c.rate, 6) for n, c in named(path).items()} == {
        "imu.angular_velocity.x": 100.0, "rc.channels": 50.0
    }  # fmt: skip
    record = read(path, inputs="rc.channels", outputs="imu.angular_velocity.x")
    assert record.sample_rate == pytest.approx(50.0)
    np.testing.assert_allclose(record.inputs[:, 0], np.sin(3 * record.time), atol=1e-3)
    np.testing.assert_allclose(record.outputs[:, 0], np.cos(3 * record.time), atol=1e-3)


@pytest.mark.parametrize(
    "header", ["imu_time,imu_x,rc_time,rc_u", "/imu/time,/imu/x,/rc/time,/rc/u"]
)
def test_each_topic_of_a_table_has_its_clock(tmp_path, header):
    """The topic with fewer messages leaves the rest of its columns blank."""
    slow = TIME[::2]
    rows = [f"{t!r},{math.cos(3 * t)!r}" for t in TIME.tolist()]
    tail = [f"{t!r},{math.sin(3 * t)!r}" for t in slow.tolist()] + [","] * slow.size
    path = tmp_path / "bag.csv"
    path.write_text("\n".join([header, *map(",".join, zip(rows, tail, strict=True))]))
    _, x, _, u = header.split(",")
    with pytest.warns(RecordWarning, match="has 200 values in 400 rows"):
        record = read(path, inputs=u, outputs=x, start=5.5, stop=8.5)
    assert record.sample_rate == pytest.approx(50.0)
    np.testing.assert_allclose(record.inputs[:, 0], np.sin(3 * record.time), atol=1e-3)
    np.testing.assert_allclose(record.outputs[:, 0], np.cos(3 * record.time), atol=1e-3)


def test_a_table_with_one_message_in_each_row_has_blanks_elsewhere(tmp_path):
    """As PlotJuggler writes it: one time, and a blank where a topic has no message."""
    slow = TIME[::2] + 0.003
    rows = [(t, f"{t!r},{math.cos(3 * t)!r},") for t in TIME.tolist()]
    rows += [(t, f"{t!r},,{math.sin(3 * t)!r}") for t in slow.tolist()]
    path = tmp_path / "bag.csv"
    path.write_text("\n".join(["__time,/imu/x,/rc/u", *(text for _, text in sorted(rows))]))
    with pytest.warns(RecordWarning, match="'/rc/u', for instance, has 200 values in 600 rows"):
        record = read(path, inputs="/rc/u", outputs="/imu/x", start=5.5, stop=8.5)
    np.testing.assert_allclose(record.inputs[:, 0], np.sin(3 * record.time), atol=1e-3)
    np.testing.assert_allclose(record.outputs[:, 0], np.cos(3 * record.time), atol=1e-3)


def test_few_blank_cells_are_missing_values_and_refused(tmp_path):
    path = written(tmp_path / "log.csv", "t,u,y", TIME, U, Y)
    lines = path.read_text().split("\n")
    lines[30] = re.sub(",[^,]*,", ",,", lines[30])
    path.write_text("\n".join(lines))
    with pytest.raises(ReadError, match=r"line 31, column 2 \('u'\): the cell is blank. Fill it"):
        read(path, inputs="u", outputs="y")


def test_a_channel_between_the_stamps_of_another_clock_is_refused(tmp_path):
    rows = [f"{t!r},,1.5" if k % 2 else f"{t!r},{t!r}," for k, t in enumerate(TIME.tolist())]
    path = tmp_path / "bag.csv"
    path.write_text("\n".join(["time,clock,u", *rows]))
    with (
        pytest.warns(RecordWarning, match="200 values in 400"),
        pytest.raises(ReadError, match="in 200 of the 200 rows.*'u' has a value.*'clock' is blank"),
    ):
        read(path, inputs="u", outputs="u", time="clock")


@pytest.mark.parametrize(("size", "scale"), [(57.2958, 1.0), (5729.58, 0.01), (None, 1.0)])
def test_rates_of_old_ardupilot_logs_are_in_degrees(tmp_path, size, scale):
    """Those logs have no FMTU that says so; the gyro of IMU, in rad/s, shows it."""
    log = DataFlash()
    log.define("IMU", "Qfff", "TimeUS,GyrX,GyrY,GyrZ")
    log.define("RATE", "Qff", "TimeUS,RDes,R")
    for k, gyro in enumerate(0.3 * np.sin(3 * TIME)):
        if size:
            log.write("IMU", 10_000 * k, gyro, 0.0, 0.0)
        log.write("RATE", 10_000 * k, 0.0, gyro * (size or 57.2958))
    path = tmp_path / "old.bin"
    path.write_bytes(log.content)
    with pytest.warns(RecordWarning, match="does not say the unit of RATE: taken as deg/s"):
        rate = named(path)["RATE.R"]
    assert rate.unit == "deg/s"
    assert rate.maximum == pytest.approx(0.3 * (size or 57.2958) * scale, rel=1e-3)


def with_header(path, header):
    columns = [1e3 * TIME, np.sin(TIME), np.cos(TIME), 2 + np.sin(3 * TIME)]
    np.savetxt(path, np.stack(columns, axis=1), delimiter=",", header=header, comments="")
    return path


def test_units_in_the_header_of_a_table_are_those_of_its_columns(tmp_path):
    path = with_header(tmp_path / "flight.csv", "t [ms],q [deg/s],phi (rad),x[1]")
    assert [(c.name, c.unit) for c in channels(path)] == [
        ("q", "deg/s"), ("phi", "rad"), ("x[1]", "")
    ]  # fmt: skip
    record = read(path, inputs="q", outputs=["phi", "x[1]"])
    assert record.sample_rate == pytest.approx(100.0)
    assert "inputs: q [deg/s]" in str(record) and "outputs: phi [rad], x[1]" in str(record)
    titled = read(path, inputs="q [deg/s]", outputs="phi (rad)", time="t [ms]")
    np.testing.assert_array_equal(titled.inputs, record.inputs)
    assert "inputs: q [deg/s]\n" in str(titled)


def test_a_header_without_a_known_unit_or_with_one_name_twice_stays_as_it_is(tmp_path):
    path = with_header(tmp_path / "flight.csv", "time (ms),u (left),q [deg/s],q [rad/s]")
    names = [each.name for each in channels(path)]
    assert names == ["u (left)", "q [deg/s]", "q [rad/s]"]


@pytest.mark.parametrize(
    "option, said",
    [
        ({"time_unit": "us"}, "time_unit is 'us', but the header says that 't' is in ms"),
        ({"units": {"q": "rad/s"}}, "the unit of 'q' is given as rad/s, but the log says deg/s"),
    ],
)
def test_an_option_that_contradicts_the_header_is_refused(tmp_path, option, said):
    path = with_header(tmp_path / "flight.csv", "t [ms],q [deg/s],phi (rad),x[1]")
    with pytest.raises(ValueError, match=said):
        read(path, inputs="q", outputs="phi", **option)
    same = read(path, inputs="q", outputs="phi", time_unit="ms", units={"q": "deg/s"})
    assert same.unit("q") == "deg/s"


def test_a_factor_may_convert_a_channel_whose_unit_is_then_not_that_of_the_header(tmp_path):
    path = with_header(tmp_path / "flight.csv", "t [ms],q [deg/s],phi (rad),x[1]")
    turned = read(path, inputs={"q": {"q": np.pi / 180}}, outputs="phi", units={"q": "rad/s"})
    assert turned.unit("q") == "rad/s"
    plain = read(path, inputs={"q": {"q": np.pi / 180}}, outputs="phi")
    assert plain.unit("q") == ""
