from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from jaxquad.records import channels, read, ReadError, RecordError, RecordWarning


TIME = 5.0 + np.arange(400) / 100.0
U = np.sin(3 * TIME)
Y = np.stack([np.cos(3 * TIME), np.sin(5 * TIME)], axis=1)
ANTX = "antx_pitch/antx_log3_prbs.npz"


def npz(folder, **arrays):
    path = folder / "log.npz"
    np.savez(path, **arrays)
    return path


def text(folder, content):
    path = folder / "log.csv"
    path.write_text(content, encoding="utf-8")
    return path


def table(folder, *, separator=",", above="", header="t,u,y"):
    rows = zip(TIME, U, Y[:, 0], strict=True)
    lines = [separator.join(repr(float(cell)) for cell in row) for row in rows]
    return text(folder, "\n".join([above + header.replace(",", separator), *lines]) + "\n")


def test_npz_on_one_uniform_base_is_passed_on_bit_by_bit(tmp_path):
    path = npz(tmp_path, t=TIME, u=U.astype(np.float32), y=Y)
    record = read(path, inputs=["u"], outputs=["y[0]", "y[1]"])
    np.testing.assert_array_equal(record.time, TIME)
    np.testing.assert_array_equal(record.inputs[:, 0], U.astype(np.float32))
    np.testing.assert_array_equal(record.outputs, Y)
    assert record.output_names == ("y[0]", "y[1]") and record.source == str(path)


@pytest.mark.parametrize("separator", [",", ";", "\t", " ", ", "])
def test_csv_gives_back_what_was_written(tmp_path, separator):
    record = read(table(tmp_path, separator=separator), inputs="u", outputs="y")
    np.testing.assert_array_equal(record.time, TIME)
    np.testing.assert_array_equal(record.inputs[:, 0], U)
    np.testing.assert_array_equal(record.outputs[:, 0], Y[:, 0])


def test_csv_takes_comments_a_byte_order_mark_and_a_commented_header(tmp_path):
    above = "\ufeff# flight 7\n\n"
    assert read(table(tmp_path, above=above), inputs="u", outputs="y").samples == 400
    assert read(table(tmp_path, above=above + "# "), inputs="u", outputs="y").samples == 400


def test_mat_gives_vectors_matrices_and_fields_of_a_struct(tmp_path):
    path = tmp_path / "log.mat"
    savemat(path, {"t": TIME, "u": U[:, None], "y": Y, "s": {"q": U * 2, "note": "calm"}})
    record = read(path, inputs="u", outputs=["y[1]", "s.q"])
    np.testing.assert_array_equal(record.time, TIME)
    np.testing.assert_array_equal(record.outputs, np.stack([Y[:, 1], 2 * U], axis=1))


def test_a_struct_brings_its_own_time(tmp_path):
    path = tmp_path / "log.mat"
    savemat(path, {"t": np.arange(7.0), "s": {"t": TIME, "u": U, "y": Y}})
    record = read(path, inputs="s.u", outputs="s.y[0]")
    np.testing.assert_array_equal(record.time, TIME)


def test_start_and_stop_are_in_the_time_of_the_file(tmp_path):
    record = read(npz(tmp_path, t=TIME, u=U, y=Y), inputs="u", outputs="y[0]", start=6, stop=8)
    np.testing.assert_array_equal(record.time, TIME[100:301])
    np.testing.assert_array_equal(record.inputs[:, 0], U[100:301])


def test_mixes_are_weighted_sums_under_a_new_name(tmp_path):
    motor = np.stack([U, Y[:, 0], Y[:, 1], U**2], axis=1)
    weights = {f"motor[{i}]": weight for i, weight in enumerate((-1, 1, 1, -1))}
    path = npz(tmp_path, t=TIME, motor=motor, y=Y)
    record = read(path, inputs={"roll": weights}, outputs={"rate": {"y[0]": 2.0}})
    np.testing.assert_allclose(record.channel("roll"), motor @ [-1, 1, 1, -1], atol=1e-15)
    np.testing.assert_array_equal(record.channel("rate"), 2 * Y[:, 0])


def test_channels_with_bases_of_their_own_meet_on_the_slowest(tmp_path):
    slow = 5.003 + np.arange(200) / 50.0
    path = npz(tmp_path, t_u=TIME, u=U, t_y=slow, y=np.cos(3 * slow))
    record = read(path, inputs="u", outputs="y", start=5.5, stop=8.5)
    assert record.sample_rate == pytest.approx(50.0, rel=1e-12) and record.time[0] == 5.5
    np.testing.assert_allclose(record.channel("u"), np.sin(3 * record.time), atol=1e-3)
    np.testing.assert_allclose(record.channel("y"), np.cos(3 * record.time), atol=1e-3)


@pytest.mark.parametrize(("unit", "scale"), [("s", 1), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_time_units_become_seconds(tmp_path, unit, scale):
    stamps = np.round(TIME * scale).astype(np.int64) if scale > 1 else TIME
    path = npz(tmp_path, clock=stamps, u=U, y=Y)
    record = read(path, inputs="u", outputs="y[0]", time="clock", time_unit=unit)
    np.testing.assert_allclose(record.time, TIME, rtol=1e-15)


def test_time_that_cannot_be_seconds_is_refused(tmp_path):
    path = npz(tmp_path, t=(TIME * 1e6).astype(np.int64), u=U, y=Y)
    with pytest.raises(
        ReadError, match="steps by 10000, which is probably not in seconds.*time_unit="
    ):
        read(path, inputs="u", outputs="y[0]")


def test_a_log_that_really_is_slow_can_be_read(tmp_path):
    path = npz(tmp_path, t=TIME * 1000, u=U, y=Y)
    record = read(path, inputs="u", outputs="y[0]", time_unit="s")
    assert record.dt == pytest.approx(10.0)


def test_a_look_lists_what_can_be_read(tmp_path):
    stray = np.arange(9.0)
    first, *_, last = channels(npz(tmp_path, t=TIME, u=U, y=Y, stray=stray))
    assert (first.name, first.samples, first.start) == ("u", 400, 5.0)
    assert first.rate == pytest.approx(100.0) and first.maximum == U.max()
    assert "u: 400 samples, 100 Hz, t = 5 .. 8.99 s" in str(first)
    assert last.name == "stray" and np.isnan(last.rate) and last.maximum == 8.0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (dict(outputs="Y[1]"), r"no channel 'Y\[1\]'. Did you mean 'y\[1\]'.*u, y\[0\], y\[1\]"),
        (dict(outputs="t"), "no channel 't'"),
        (dict(outputs="stray"), "channel 'stray' has 9 samples, but its time base 't' has 400"),
        (
            dict(time="clock"),
            "time base 'clock': .*no channel 'clock'.*channels are: t, u, y, stray",
        ),
        (dict(time="y"), r"time base 'y' has shape \(400, 2\)"),
        (dict(inputs="y[0]"), r"'y\[0\]' occurs 2 times"),
        (dict(inputs=["u", "u"]), "'u' occurs 2 times"),
        (dict(inputs=[]), "inputs has no channel"),
        (dict(start=4.0), "4 .. 8.99 s is out of range; the record covers 5 .. 8.99 s"),
        (dict(sample_rate=0.0), "sample rate is 0.0 Hz"),
        (dict(sample_rate=100.0, stop=9.5), "5 .. 9.5 s is out of range"),
    ],
)
def test_read_refuses(tmp_path, options, said):
    path = npz(tmp_path, t=TIME, u=U, y=Y, stray=np.arange(9.0))
    with pytest.raises(RecordError, match=said):
        read(path, **dict(inputs="u", outputs="y[0]") | options)


def test_a_file_without_time_is_refused_with_what_it_has(tmp_path):
    with pytest.raises(
        ReadError, match="no time base for 'u': .*among the arrays u, y. Name .*time="
    ):
        read(npz(tmp_path, u=U, y=Y), inputs="u", outputs="y[0]")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "the file is empty"),
        ("# nothing but words\n", "holds no table"),
        ("t,u,y\n", r"only a header \(t, u, y\)"),
        ("t,u,y\n0,1,2\n# gust\n1,,3\n", r"line 4, column 2 \('u'\): the cell is blank"),
        ("t,u,y\n0,1,2\n1,2,off\n", r"line 3, column 3 \('y'\): 'off' is not a number"),
        ("t;u;y\n0;1;2,5\n", r"line 2, column 3 \('y'\): '2,5' is not a number.*with a point"),
        ("t,u,y\n0,1,2\n1,2\n", "line 3 has 2 cells for 3 columns"),
        ("t,u,u\n0,1,2\n", "names 'u' twice"),
        ("t,u,y\n0,1,2\n", "has 1 samples: at least 16"),
    ],
)
def test_csv_refuses(tmp_path, content, said):
    with pytest.raises(RecordError, match=said):
        read(text(tmp_path, content), inputs="u", outputs="y")


def test_csv_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(bytes(range(256)))
    with pytest.raises(ReadError, match="not text: it holds a zero byte .at byte 0"):
        channels(path)


def test_a_missing_file_and_an_unknown_kind_are_refused(tmp_path):
    with pytest.raises(ReadError, match="there is no such file"):
        channels(tmp_path / "log.npz")
    (tmp_path / "log.xyz").write_bytes(b"what is this?")
    with pytest.raises(ReadError, match=r"neither the first bytes nor the ending '.xyz' .*.npz"):
        channels(tmp_path / "log.xyz")


@pytest.mark.parametrize("kept", [3, 40, 1000, 4000])
@pytest.mark.parametrize("suffix", [".npz", ".mat"])
def test_a_truncated_file_is_refused(tmp_path, suffix, kept):
    path = tmp_path / f"log{suffix}"
    arrays = {"t": TIME, "u": U, "y": Y}
    np.savez(path, **arrays) if suffix == ".npz" else savemat(path, arrays)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ReadError, match="cut off"):
        channels(path)


def test_a_corrupted_archive_is_refused(tmp_path):
    path = npz(tmp_path, t=TIME, u=U, y=Y)
    content = bytearray(path.read_bytes())
    content[2000] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(ReadError, match="cut off or damaged.*CRC"):
        channels(path)


def test_a_pickled_array_is_refused_by_name(tmp_path):
    path = npz(tmp_path, t=TIME, note=np.array([{"pilot": "A"}], dtype=object))
    with pytest.raises(ReadError, match="array 'note' is pickled"):
        channels(path)


def test_a_mat_file_of_version_7_3_needs_more_than_its_head(tmp_path):
    path = tmp_path / "log.mat"
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    path.write_bytes(head + bytes(512))
    with pytest.raises(
        ReadError, match="an HDF5 or MATLAB v7.3 file: the file is cut off or damaged"
    ):
        channels(path)


def test_nan_in_a_chosen_channel_is_refused_and_in_another_is_not(tmp_path):
    spoilt = U.copy()
    spoilt[7] = np.nan
    path = npz(tmp_path, t=TIME, u=spoilt, y=Y)
    with pytest.raises(RecordError, match="channel 'u' holds 1 NaN"):
        read(path, inputs="u", outputs="y[0]")
    assert read(path, inputs="y[0]", outputs="y[1]").samples == 400


def test_antx_prbs_comes_to_one_grid(data):
    options: dict[str, Any] = dict(
        inputs=["M"], outputs=["q"], references=["x0"], start=50, stop=76
    )
    record = read(data / ANTX, sample_rate=250, **options)
    assert (record.samples, record.time[0], record.time[-1]) == (6501, 50.0, 76.0)
    assert record.names == ("M", "q", "x0")
    with np.load(data / ANTX) as log:
        linear = np.interp(record.time, log["t_q"], log["q"])
    # A line between samples errs by the curvature of q.
    assert np.std(record.channel("q") - linear) < 0.02 * np.std(linear)
    assert read(data / ANTX, **options).sample_rate == pytest.approx(250.0, rel=1e-12)


def test_antx_sweep_tells_of_its_gaps(data):
    with pytest.warns(RecordWarning, match=r"'M' 1, longest 35\.91 ms at t = 115\.158 s; 'q' 1"):
        path = data / "antx_pitch/antx_log2_sweep.npz"
        read(path, inputs="M", outputs="q", references="x0", sample_rate=100, start=94.7)


def test_crazyflie_motors_mix_to_a_roll_command(data):
    motors = [f"motor_u16[{i}]" for i in range(4)]
    roll = dict(zip(motors, (-1, -1, 1, 1), strict=True))
    path = data / "crazyflie_rollpitch/log15.npz"
    with pytest.warns(RecordWarning, match="6, longest 7 ms at t = 80.8742 s"):
        record = read(path, inputs={"roll": roll}, outputs="gyro_dps[0]", start=55, stop=90)
    assert record.sample_rate == pytest.approx(1010.0, rel=1e-12)
    with np.load(path) as log:
        linear = np.interp(record.time, log["t"], log["motor_u16"] @ np.array([-1.0, -1, 1, 1]))
    # The command is noise up to half its rate, which a line between samples smooths.
    assert np.corrcoef(record.channel("roll"), linear)[0, 1] > 0.99


def test_crazypad_is_uniform_and_untouched(data):
    path = data / "crazypad_hover/E8_log00.npz"
    record = read(path, inputs="cmd[0]", outputs="rate[0]")
    assert record.sample_rate == pytest.approx(101.15, abs=0.01)
    with np.load(path) as log:
        np.testing.assert_array_equal(record.inputs[:, 0], log["cmd"][:, 0])


def test_betaflight_jitter_comes_to_a_uniform_grid(data):
    path = data / "betaflight_ar8/LOG00037.npz"
    record = read(path, inputs="pid_sum[0]", outputs="gyro_dps[0]", references="setpoint_dps[0]")
    assert record.sample_rate == pytest.approx(985.0, rel=1e-9)
    assert record.duration == pytest.approx(17.02, abs=0.01)


def test_units_are_given_by_name_and_refused_for_channels_that_are_not_read(tmp_path):
    path = tmp_path / "units.npz"
    time = np.arange(50) / 100
    np.savez(path, t=time, M=np.sin(time), q=np.cos(time))
    record = read(path, inputs="M", outputs="q", units={"q": "rad/s"})
    assert record.unit("q") == "rad/s" and record.unit("M") == ""
    with pytest.raises(RecordError, match="a unit is given for 'p'.*The channels are: M, q"):
        read(path, inputs="M", outputs="q", units={"p": "rad/s"})


@pytest.mark.parametrize(
    ("weights", "said"),
    [
        ({"m1": 1.0}, "no channel 'm1'"),
        ({}, "the sum 'roll' is empty"),
        ({"u": np.nan, "u^2": 1.0}, "weight of 'u' in the sum 'roll' is nan"),
    ],
)
def test_a_sum_is_refused_that_says_nothing(weights, said, tmp_path):
    with pytest.raises(RecordError, match=said):
        read(npz(tmp_path, t=TIME, u=U, y=Y), inputs={"roll": weights}, outputs="y[0]")


def test_a_hold_is_kept_as_long_as_a_sample_is_no_shorter(tmp_path):
    time = np.arange(400) * 0.01
    path = tmp_path / "log.npz"
    np.savez(path, time=time, u=np.sin(time), y=np.cos(time))
    take: dict[str, Any] = {"inputs": "u", "outputs": "y"}
    assert read(path, **take).hold is None
    assert read(path, **take, hold="dt").hold == pytest.approx(0.01)
    assert read(path, **take, hold=0).hold == 0.0
    assert read(path, **take, hold=0.01, sample_rate=50).hold == 0.01
    with pytest.warns(RecordWarning, match="resampled to 200 Hz"):
        assert read(path, **take, hold=0.01, sample_rate=200).hold is None
