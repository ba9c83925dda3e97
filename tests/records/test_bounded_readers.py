"""What a small file may cost, names that no file has, and names that two arrays have."""

import struct
import time
import tracemalloc
import zipfile
import zlib
from typing import Any

import numpy as np
import pytest

from jaxquad.records import channels, propose, read, ReadError, RecordWarning


TIME = np.arange(16) / 100.0


def element(kind, body):
    return struct.pack("<II", kind, len(body)) + body + bytes(-len(body) % 8)


def mat_of_zeros(path, variables, size):
    """Variables of doubles that are stored as int8: compressed a thousandfold, then widened."""
    content = b"MATLAB 5.0".ljust(124) + b"\0\1IM"
    for k in range(variables):
        shape, name = struct.pack("<ii", size, 1), f"v{k}".encode()
        matrix = element(6, struct.pack("<II", 6, 0)) + element(5, shape) + element(1, name)
        body = zlib.compress(element(14, matrix + element(1, bytes(size))), 6)
        content += struct.pack("<II", 15, len(body)) + body
    path.write_bytes(content)
    return len(content)


@pytest.mark.slow
def test_mat_is_bounded_over_all_variables_and_after_widening(tmp_path):
    path = tmp_path / "log.mat"
    stored = mat_of_zeros(path, 44, 8_000_000)  # 2.8 GB of doubles
    assert stored < 400_000
    tracemalloc.start()
    with pytest.raises(ReadError, match="the file declares .* bytes of numbers in 3.*damaged"):
        channels(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6


def test_memory_is_bounded_by_what_a_record_can_use(tmp_path):
    np.save(tmp_path / "long.npy", np.zeros(20_000_001, np.int8))
    with pytest.raises(ReadError, match=r"long.npy: 'data' has 20000001 samples, .* cut the file"):
        channels(tmp_path / "long.npy")


def test_a_line_without_end_is_no_row_of_a_table(tmp_path):
    (tmp_path / "log.csv").write_text(f"time,q\n0,1\n1,{'1' * 6_000_000}\n")
    with pytest.raises(ReadError, match="line 3 has 6000003 bytes: the file is not a table"):
        channels(tmp_path / "log.csv")


def test_a_link_of_hdf5_to_another_file_is_said(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["t"] = file["group/u"] = np.arange(10.0)
        file["group/q"] = h5py.ExternalLink("other.h5", "/q")
        file["again"] = h5py.SoftLink("/t")
    with pytest.warns(RecordWarning, match=r"'group.q' lies in another file and was left out"):
        assert {x.name for x in channels(tmp_path / "log.h5")} == {"group.u"}


def test_mat_of_many_sound_variables_is_not_refused(tmp_path):
    mat_of_zeros(tmp_path / "log.mat", 100, 10_000)  # 8 MB
    assert len(channels(tmp_path / "log.mat")) == 100


def seconds_of(action):
    begin = time.process_time()
    action()
    return time.process_time() - begin


@pytest.mark.slow
def test_npz_takes_a_time_in_proportion_to_its_members(tmp_path):
    taken = []
    for count in (250, 2000):
        path = tmp_path / f"{count}.npz"
        arrays: Any = {f"c{k}": TIME for k in range(count)}
        np.savez(path, t=TIME, **arrays)
        taken.append(min(seconds_of(lambda path=path: channels(path)) for _ in range(2)))
    assert taken[1] < 16 * taken[0] + 0.1  # 8 times as many


@pytest.mark.slow
def test_hdf5_of_many_small_sets_is_read(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for k in range(3000):
            file[f"c{k}"] = TIME
        file["t"] = TIME
    assert len(channels(tmp_path / "log.h5")) == 3000


@pytest.mark.parametrize("action", [channels, propose, lambda p: read(p, inputs="u", outputs="y")])
@pytest.mark.parametrize(
    "name", ["a\0b.npz", "a" * 5000, "a/" * 2500, "loop.npz", "loop.npz/log.npz", "loop/"]
)
def test_a_name_that_no_file_has_is_a_read_error(tmp_path, name, action):
    (tmp_path / "loop.npz").symlink_to(tmp_path / "loop.npz")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(ReadError) as caught:
        action(tmp_path / name)
    assert "\0" not in str(caught.value) and len(str(caught.value)) < 3000


def test_two_arrays_of_one_name_are_said(tmp_path):
    np.save(tmp_path / "u.npy", TIME)
    np.save(tmp_path / "v.npy", 2 * TIME)
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as archive:
        archive.write(tmp_path / "u.npy", "t.npy")
        archive.write(tmp_path / "u.npy", "u.npy")
        with pytest.warns(UserWarning, match="Duplicate name"):
            archive.write(tmp_path / "v.npy", "u.npy")
    with pytest.warns(RecordWarning, match="two arrays are called 'u': the later one is used"):
        assert channels(tmp_path / "log.npz")[0].maximum == 0.3


def test_hdf5_sets_of_one_name_are_said(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["t"], file["a.b"], file["a/b"] = TIME, TIME, TIME
    with pytest.warns(RecordWarning, match="two datasets are called 'a.b'"):
        channels(tmp_path / "log.h5")


def test_parquet_columns_of_one_name_are_refused(tmp_path):
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    table = arrow.Table.from_arrays([arrow.array(TIME)] * 3, names=["t", "u", "u"])
    parquet.write_table(table, tmp_path / "log.parquet")
    with pytest.raises(ReadError, match="two columns are called 'u'"):
        channels(tmp_path / "log.parquet")


def test_a_second_array_of_time_stamps_is_said_unless_it_is_the_same(tmp_path, recwarn):
    np.savez(tmp_path / "log.npz", t=TIME, time=2 * TIME, timestamp=TIME, u=TIME)
    with pytest.warns(RecordWarning, match="taken from 't'; 'time', of the same length, is not"):
        channels(tmp_path / "log.npz")
    recwarn.clear()
    assert channels(tmp_path / "log.npz", time="time")[0].rate == pytest.approx(50)
    np.savez(tmp_path / "log.npz", t=TIME, time=TIME, u=TIME)
    assert channels(tmp_path / "log.npz")[0].rate == pytest.approx(100)
    assert not recwarn.list
