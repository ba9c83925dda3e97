"""Damaged files of every kind: reading them raises ReadError or nothing, soon and in small memory.

The same at length: `python tests/benchmarks/fuzz_readers.py`.
"""

import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hostile_files import damaged, sound_files
from hypothesis import given, HealthCheck, settings, strategies as st

from jaxquad.records import channels, ReadError


KINDS = (
    "npz", "npy", "csv", "mat", "mat plain", "dataflash", "dataflash text", "ulog",
    "betaflight", "betaflight table", "crazyflie", "hdf5", "parquet", "mcap", "db3",
)  # fmt: skip
PACKAGES = {"hdf5": "h5py", "parquet": "pyarrow", "mcap": "rosbags", "db3": "rosbags"}
OWN = tuple(kind for kind in KINDS if kind not in PACKAGES)
CASES = {kind: 180 for kind in KINDS} | {kind: 6 for kind in PACKAGES}  # a process each
NET = "cannot be read as "  # where a library raised whatever it raises


def outcome(path: Path) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            channels(path)
        except ReadError as error:
            assert str(error).startswith(str(path))
            return str(error)
    return "read"


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damage_of_any_kind_raises_read_error_or_nothing(tmp_path, kind):
    pytest.importorskip(PACKAGES.get(kind, "numpy"))
    name, content = sound_files([kind])[kind]
    counts = Counter()
    for number in range(CASES[kind]):
        (tmp_path / name).write_bytes(damaged(content, np.random.default_rng([7, number])))
        said = outcome(tmp_path / name)
        counts["read" if said == "read" else "net" if NET in said else "refused"] += 1
    assert counts["read"] < CASES[kind]
    # Our own readers know what is wrong by themselves.
    assert not counts["net"] or kind not in OWN


@pytest.mark.parametrize("kind", OWN)
def test_a_file_cut_anywhere_raises_read_error_or_nothing(tmp_path, kind):
    name, content = sound_files([kind])[kind]
    for size in np.linspace(0, len(content) - 1, 25).astype(int):
        (tmp_path / name).write_bytes(content[:size])
        assert NET not in outcome(tmp_path / name)


HEADS = (b"", b"\xa3\x95\x80", b"ULog\x01\x12\x35", b"\x93NUMPY\x01\0", b"PK\x03\x04", b"FMT, ",
         b"MATLAB 5.0".ljust(124) + b"\0\1IM", b"t,u\n", b"loopIteration,time\n",
         b"H Product:Blackbox", b"\xbc\x02")  # fmt: skip
SUFFIXES = (".npz", ".npy", ".mat", ".bin", ".log", ".ulg", ".csv", ".txt", ".bbl", "")


@pytest.mark.slow
@settings(
    max_examples=200,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(head=st.sampled_from(HEADS), body=st.binary(max_size=600), suffix=st.sampled_from(SUFFIXES))
def test_bytes_of_any_kind_raise_read_error_or_nothing(tmp_path, head, body, suffix):
    path = tmp_path / f"log{suffix}"
    path.write_bytes(head + body)
    outcome(path)
