"""The kinds of file that other libraries define, against what those libraries write."""

import os
import struct
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_files import sound_files
from scipy.io import savemat

from jaxquad.records import channels, formats, read, ReadError, RecordWarning


READERS = "jaxquad.records.formats"
CHILD = Path(formats.__file__).with_name("_by_library.py")
TIME = 5.0 + np.arange(400) / 100.0
U = np.sin(3 * TIME)
Y = np.stack([np.cos(3 * TIME), np.sin(5 * TIME)], axis=1)


def assert_holds(path, *, inputs, outputs, expected=Y[:, 1]):
    record = read(path, inputs=inputs, outputs=outputs)
    np.testing.assert_allclose(record.time, TIME, rtol=1e-15)
    np.testing.assert_array_equal(record.inputs[:, 0], U)
    np.testing.assert_array_equal(record.outputs[:, 0], expected)


@pytest.mark.parametrize("compressed", [True, False])
def test_mat_of_every_class_comes_out_as_scipy_put_it_in(tmp_path, compressed):
    kinds = ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"]
    values = {kind: np.arange(6).reshape(2, 3).astype(kind) for kind in kinds}
    values |= {"text": "calm", "wave": U + 1j, "cell": np.array([U, "x"], dtype=object)}
    savemat(tmp_path / "log.mat", {"t": TIME, **values}, do_compression=compressed)
    found = {each.name: each for each in channels(tmp_path / "log.mat")}
    assert set(found) == {f"{kind}[{i}]" for kind in kinds for i in range(3)}
    assert all(
        (found[f"{kind}[2]"].minimum, found[f"{kind}[2]"].maximum) == (2, 5) for kind in kinds
    )


def test_mat_structs_within_structs_bring_their_channels(tmp_path):
    savemat(tmp_path / "log.mat", {"run": {"t": TIME, "rate": {"u": U, "y": Y}}, "t": TIME})
    assert_holds(tmp_path / "log.mat", inputs="run.rate.u", outputs="run.rate.y[1]")


def test_mat_of_version_4_is_refused_with_the_remedy(tmp_path):
    savemat(tmp_path / "log.mat", {"u": U}, format="4")
    with pytest.raises(ReadError, match="not a MATLAB file of version 5 to 7.3.*-v7"):
        channels(tmp_path / "log.mat")


def test_hdf5_groups_units_and_tables_of_records(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file["run/time"], file["run/u"], file["run/y"] = TIME, U, Y
        file["run/y"].attrs["units"] = "rad/s"
        table = np.zeros(400, dtype=[("t", "f8"), ("q", "f4"), ("note", "S4")])
        table["t"], table["q"] = TIME, U
        file.create_dataset("table", data=table, compression="gzip")
        file["away"] = h5py.ExternalLink("/etc/passwd", "/")
        file["again"] = h5py.SoftLink("/run")
    with pytest.warns(RecordWarning, match="'away' lies in another file and was left out"):
        assert_holds(path, inputs="run.u", outputs="run.y[1]")
        found = {each.name: each for each in channels(path)}
    assert set(found) == {"run.u", "run.y[0]", "run.y[1]", "table.q"}
    assert found["run.y[0]"].unit == "rad/s"


def test_mat_of_version_7_3_has_the_axes_of_matlab(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "log.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in {"t": TIME[None], "u": U[None], "s/y": Y.T}.items():
            file[name] = values
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["note"] = np.frombuffer(b"calm", np.uint8).astype("u2")[None]
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    assert_holds(path, inputs="u", outputs="s.y[1]")
    assert len(channels(path)) == 3


def test_hdf5_that_declares_more_than_it_can_hold_is_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "bomb.h5", "w") as file:
        file.create_dataset("u", shape=(10**12,), dtype="f8", chunks=(1000,))
    with pytest.raises(
        ReadError, match="the file declares 8e.12 bytes of numbers in .* bytes of file"
    ):
        channels(tmp_path / "bomb.h5")


def test_hdf5_that_never_comes_to_an_end_is_given_up(tmp_path, monkeypatch):
    pytest.importorskip("h5py")
    monkeypatch.setattr(f"{READERS}.PATIENCE", 0.01)
    (tmp_path / "log.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(ReadError, match="an HDF5 .* file: reading did not end within"):
        channels(tmp_path / "log.h5")


def test_hdf5_that_crashes_the_library_is_an_error_here(tmp_path, monkeypatch):
    pytest.importorskip("h5py")
    crash = subprocess.CompletedProcess([], -11, b"", b"Segmentation fault")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: crash)
    (tmp_path / "log.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(
        ReadError,
        match=r"the library that decodes it crashed \(exit status -11, Segmentation fault",
    ):
        channels(tmp_path / "log.h5")


@pytest.mark.parametrize("kind", ["hdf5", "parquet", "mcap"])
def test_a_missing_package_is_named_with_the_remedy(tmp_path, monkeypatch, kind):
    pytest.importorskip({"hdf5": "h5py", "parquet": "pyarrow", "mcap": "rosbags"}[kind])
    name, content = sound_files([kind])[kind]
    (tmp_path / name).write_bytes(content)
    # Without site packages, whatever is installed is missing; numpy has to stay.
    script = tmp_path / "child.py"
    script.write_text(
        "import sys, runpy\n"
        "for name in ('h5py', 'pyarrow', 'rosbags'): sys.modules[name] = None\n"
        f"runpy.run_path({str(CHILD)!r}, run_name='__main__')\n"
    )
    monkeypatch.setattr(f"{READERS}._CHILD", script)
    with pytest.raises(
        ReadError, match=r'needs a further library .*: pip install "jaxquad\[logs\]"'
    ):
        channels(tmp_path / name)


@pytest.mark.slow
def test_a_chunk_that_unfolds_to_gigabytes_is_stopped(tmp_path):
    pytest.importorskip("rosbags")
    name, content = sound_files(["mcap"])["mcap"]
    zstd = pytest.importorskip("backports.zstd")
    compressor = zstd.ZstdCompressor()
    bomb = b"".join(compressor.compress(bytes(2**24)) for _ in range(200)) + compressor.flush()
    assert len(bomb) < 2**20
    chunk = struct.pack("<QQQI", 0, 2**62, 2**32 - 1, 0) + struct.pack("<I", 4) + b"zstd"
    chunk += struct.pack("<Q", len(bomb)) + bomb
    record = b"\x06" + struct.pack("<Q", len(chunk)) + chunk
    head = content.index(b"ros2") + 4
    head += 4 + struct.unpack_from("<I", content, head)[0]
    footer = b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0) + content[:8]
    (tmp_path / name).write_bytes(content[:head] + record + footer)
    with pytest.raises(ReadError, match="a ROS 2 bag: the file is cut off or damaged .MemoryError"):
        channels(tmp_path / name)


@pytest.mark.slow
def test_parquet_gives_numbers_stamps_in_seconds_and_nan_for_what_is_missing(tmp_path):
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    stamps = arrow.array(np.round(TIME * 1e6).astype("i8"), arrow.timestamp("us"))
    field = arrow.field("y", arrow.float64(), metadata={"unit": "rad/s"})
    schema = arrow.schema(
        [("time", stamps.type), ("u", arrow.float64()), field, ("k", "i4"), ("s", "string")]
    )
    columns = [stamps, U, Y[:, 1], [None, *range(1, 400)], ["x"] * 400]
    parquet.write_table(arrow.table(columns, schema=schema), tmp_path / "log.parquet")
    assert_holds(tmp_path / "log.parquet", inputs="u", outputs="y")
    found = {each.name: each for each in channels(tmp_path / "log.parquet")}
    assert set(found) == {"u", "y", "k"} and found["y"].unit == "rad/s"
    assert (found["k"].minimum, found["k"].samples) == (1, 400)


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_bags_give_numbers_by_topic_on_the_clock_of_their_headers(tmp_path, kind):
    pytest.importorskip("rosbags")
    name, content = sound_files([kind])[kind]
    (tmp_path / name).write_bytes(content)
    record = read(tmp_path / name, inputs="/rate.vector.x", outputs="/rate.vector.y")
    assert record.sample_rate == pytest.approx(100.0) and record.time[0] == 0
    np.testing.assert_array_equal(record.inputs, -record.outputs)
    np.testing.assert_array_equal(record.inputs[:, 0], np.sin(3.0 + np.arange(40) / 100))


def test_npy_tables_may_have_their_time_in_a_column(tmp_path):
    np.save(tmp_path / "log.npy", np.column_stack([TIME, U, Y]))
    record = read(tmp_path / "log.npy", inputs="data[1]", outputs="data[3]", time="data[0]")
    np.testing.assert_array_equal(record.time, TIME)
    np.testing.assert_array_equal(record.outputs[:, 0], Y[:, 1])
    table = np.zeros(400, dtype=[("t", "f8"), ("u", "f8"), ("y", "f8")])
    table["t"], table["u"], table["y"] = TIME, U, Y[:, 1]
    np.save(tmp_path / "log.npy", table)
    assert_holds(tmp_path / "log.npy", inputs="u", outputs="y")


def test_npy_that_declares_more_than_it_holds_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "log.npy"
    np.save(path, U)
    path.write_bytes(path.read_bytes().replace(b"(400,)", b"(9" + b"9" * 3 + b",)"))
    with pytest.raises(ReadError, match=r"'data' declares the shape \(9999,\) of float64"):
        channels(path)


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_pickles_are_refused_without_being_run(tmp_path, suffix):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "trapped"), "w"))

    path = tmp_path / f"log{suffix}"
    content = np.array([Trap(), 1], dtype=object)
    np.save(path, content) if suffix == ".npy" else np.savez(path, u=content)
    with pytest.raises(ReadError, match="is pickled, and reading it could run code"):
        channels(path)
    assert not (tmp_path / "trapped").exists()


def test_zip_bombs_are_refused_by_what_they_declare(tmp_path):
    path = tmp_path / "log.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("u.npy", bytes(200 * 2**20))
    with pytest.raises(ReadError, match="the archive declares 2.097e.08 bytes of numbers in 2.04"):
        channels(path)


def test_mat_bombs_are_refused_by_what_they_declare(tmp_path):
    path = tmp_path / "log.mat"
    savemat(path, {"t": TIME, "u": np.zeros(12_000_000)}, do_compression=True)
    with pytest.raises(ReadError, match=r"variable declares 9.6e.07 .* \(at byte \d+\)"):
        channels(path)


def test_the_content_decides_before_the_name_does(tmp_path):
    with (tmp_path / "log.mat").open("wb") as file:
        np.savez(file, t=TIME, u=U, y=Y[:, 1])
    assert_holds(tmp_path / "log.mat", inputs="u", outputs="y")
    (tmp_path / "log.npz").write_bytes(sound_files(["ulog"])["ulog"][1])
    with pytest.warns(RecordWarning, match="lost data"):
        assert channels(tmp_path / "log.npz")[0].name.startswith("vehicle_angular_velocity")


def test_names_from_a_file_cannot_steer_a_terminal(tmp_path):
    arrays: dict[str, Any] = {"t": TIME, "u\x1b[2Jx": U}
    np.savez(tmp_path / "log.npz", **arrays)
    assert channels(tmp_path / "log.npz")[0].name == "u\N{REPLACEMENT CHARACTER}[2Jx"


def test_folders_fifos_and_empty_files_are_refused(tmp_path):
    (tmp_path / "empty.bin").touch()
    os.mkfifo(tmp_path / "pipe.bin")
    (tmp_path / "folder").mkdir()
    for name, said in (("empty", "the file is empty"), ("pipe", "not a regular file")):
        with pytest.raises(ReadError, match=said):
            channels(tmp_path / f"{name}.bin")
    with pytest.raises(ReadError, match="folder is a folder, and no bag of ROS 2"):
        channels(tmp_path / "folder")
