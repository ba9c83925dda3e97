"""Records from and to pandas and MATLAB's iddata: what goes out comes back, bit by bit."""

from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat, savemat

import jaxquad as jq
from jaxquad.records import ReadError, RecordError


SAMPLES = 200
TIME = 5.0 + np.arange(SAMPLES) / 100.0
U, Y = np.random.default_rng(0).normal(size=(2, SAMPLES, 2))
RECORD = jq.Record(
    TIME, U[:, 0], Y, U[:, 1], input_names="M", output_names=("p", "q"), reference_names="x0",
    input_units="-", output_units=("rad/s", "rad/s"), reference_units="m", hold="dt", source="made",
)  # fmt: skip


def assert_equal_records(found, wanted, *, time=0.0):
    np.testing.assert_allclose(found.time, wanted.time, rtol=0, atol=time)
    for name in wanted.names:
        np.testing.assert_array_equal(found.channel(name), wanted.channel(name))
        assert found.unit(name) == wanted.unit(name)
    assert (found.input_names, found.reference_names) == (
        wanted.input_names,
        wanted.reference_names,
    )
    assert found.hold == pytest.approx(wanted.hold)


@pytest.fixture
def pandas():
    return pytest.importorskip(
        "pandas", reason="pandas is not installed: pip install 'jaxquad[interop]'"
    )


def test_a_record_goes_to_a_table_and_back(pandas):
    frame = RECORD.to_dataframe()
    assert list(frame.columns) == ["M", "p", "q", "x0"] and frame.index.name == "time"
    back = jq.Record.from_dataframe(frame)
    assert_equal_records(back, RECORD)
    assert back.source == "made"
    two = jq.Record.from_dataframe(frame, inputs="M", outputs="q", units={"q": "deg/s"})
    assert (two.names, two.unit("M"), two.unit("q")) == (("M", "q"), "-", "deg/s")


@pytest.mark.parametrize("kind", ["index", "column", "ms", "dates", "zone", "durations"])
def test_time_stamps_are_found_in_a_column_or_the_index(pandas, kind):
    frame = pandas.DataFrame({"M": U[:, 0], "q": Y[:, 1]})
    dates = pandas.to_datetime(np.round(TIME * 1e9).astype(np.int64), unit="ns")
    options: dict[str, Any] = {}
    if kind == "index":
        frame.index = pandas.Index(TIME)
    elif kind == "column":
        frame["time"] = TIME
    elif kind == "ms":
        frame["clock"], options = 1e3 * TIME, {"time": "clock", "time_unit": "ms"}
    elif kind == "dates":
        frame.index = dates
    elif kind == "zone":
        frame["time"] = dates.tz_localize("Europe/Rome")
    else:
        frame.index = dates - dates[0]
    record = jq.Record.from_dataframe(frame, inputs="M", outputs="q", **options)
    np.testing.assert_allclose(record.time - record.time[0], TIME - TIME[0], atol=1e-9)
    np.testing.assert_array_equal(record.channel("q"), Y[:, 1])


def test_missing_values_are_repaired_and_jitter_is_resampled(pandas):
    slow = np.sin(2.0 * TIME)
    late = TIME + 1e-3 * np.random.default_rng(1).uniform(size=SAMPLES)
    frame = pandas.DataFrame({"t": late, "M": np.sin(2.0 * late), "q": slow})
    frame["q"] = frame["q"].astype("Float64")
    frame.loc[50:52, "q"] = pandas.NA
    with pytest.raises(RecordError, match="uniform"):
        jq.Record.from_dataframe(frame, inputs="M", outputs="q", max_gap=0.1)
    record = jq.Record.from_dataframe(frame, inputs="M", outputs="q", sample_rate=50, max_gap=0.1)
    assert record.sample_rate == pytest.approx(50.0)
    inner = slice(5, -5)  # no filter's transient
    np.testing.assert_allclose(record.inputs[inner, 0], np.sin(2.0 * record.time[inner]), atol=2e-2)


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({}, {}, "which columns are inputs"),
        ({}, {"inputs": "M", "outputs": "r"}, "no channel 'r'"),
        ({}, {"inputs": "M", "outputs": "q"}, "no time stamps"),
        ({"q": "text"}, {"inputs": "M", "outputs": "q", "time": "M"}, "not numbers"),
        ({"time": 1e3 * TIME}, {"inputs": "M", "outputs": "q"}, "probably not in seconds"),
        ({"time": TIME}, {"inputs": "M", "outputs": "q", "units": {"p": "V"}}, "no channel 'p'"),
    ],
)
def test_tables_that_do_not_say_enough_are_refused(pandas, change, options, message):
    frame = pandas.DataFrame({"M": U[:, 0], "q": Y[:, 1]}).assign(**change)
    with pytest.raises(RecordError, match=message):
        jq.Record.from_dataframe(frame, **options)


def test_columns_of_one_name_are_refused(pandas):
    frame = pandas.DataFrame(np.column_stack([TIME, U[:, 0], Y]), columns=["t", "M", "q", "q"])
    with pytest.raises(RecordError, match="several columns 'q'"):
        jq.Record.from_dataframe(frame, inputs="M", outputs="q")


def test_a_record_goes_to_the_fields_of_iddata_and_back(tmp_path):
    path = RECORD.to_iddata(tmp_path / "z.mat")
    found = loadmat(path, simplify_cells=True)["z"]
    assert list(found["InputName"]) == ["M", "x0"] and found["InterSample"] == "zoh"
    back = jq.Record.from_iddata(path, references="x0")
    assert_equal_records(back, RECORD, time=1e-12)


def test_the_properties_that_matlab_saves_are_read(tmp_path):
    fields = {
        "y": Y[:, 0], "u": U[:, 0], "Ts": 10.0, "Tstart": [], "TimeUnit": "milliseconds",
        "InputName": np.array(["elevator"], object), "SamplingInstants": [], "InterSample": "bl",
        "Domain": "Time", "Notes": np.empty((0, 0), object),
    }  # fmt: skip
    savemat(tmp_path / "z.mat", {"s": fields, "other": 3.0})
    record = jq.Record.from_iddata(tmp_path / "z.mat")
    assert record.names == ("elevator", "y")
    assert (record.hold, record.time[0]) == (0.0, 0.0)
    assert record.dt == pytest.approx(0.01)
    savemat(tmp_path / "plain.mat", {"y": Y, "u": U, "Ts": 0.01})
    assert jq.Record.from_iddata(tmp_path / "plain.mat").names == ("u1", "u2", "y1", "y2")


@pytest.mark.parametrize(
    ("content", "options", "message"),
    [
        ({"a": {"y": Y, "u": U, "Ts": 1}, "b": {"y": Y, "u": U}}, {}, "a, b; which of them"),
        ({"a": {"y": Y, "u": U}}, {"variable": "z"}, "not 'z'"),
        ({"a": {"y": Y, "u": U}}, {}, "Ts is"),
        ({"a": 3.0}, {}, r"s = get\(z\)"),
        ({"a": {"y": np.array([Y, Y[:9]], object), "u": U, "Ts": 1}}, {}, "getexp"),
        ({"a": {"y": Y, "u": U, "Ts": 0.01}}, {"references": "x0"}, "no input 'x0'; it has u1"),
    ],
)
def test_files_that_are_no_single_iddata_are_refused(tmp_path, content, options, message):
    savemat(tmp_path / "z.mat", content)
    with pytest.raises(RecordError, match=message):
        jq.Record.from_iddata(tmp_path / "z.mat", **options)


def test_a_file_that_is_cut_off_is_refused(tmp_path):
    path = RECORD.to_iddata(tmp_path / "z.mat")
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ReadError, match="cut off|damaged"):
        jq.Record.from_iddata(path)
