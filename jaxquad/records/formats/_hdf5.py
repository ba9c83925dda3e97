from pathlib import Path

from .._log import Log
from ._isolated import read_isolated


_MAGIC = b"\x89HDF\r\n\x1a\n"


def sniff(head: bytes, path: Path) -> bool:
    return head.startswith((_MAGIC, b"MATLAB 7.3")) or head[512:520] == _MAGIC


def load(path: Path) -> Log:
    """The numeric datasets as `group.name`; of MATLAB v7.3 with rows and columns as there.

    Datasets whose values lie in other files are left out.
    """
    return read_isolated(path, module="_hdf5_tables", kind="an HDF5 or MATLAB v7.3 file")
