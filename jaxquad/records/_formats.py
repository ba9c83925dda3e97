from collections.abc import Callable
from pathlib import Path

import numpy as np

from ._csv import read_csv
from ._errors import ReadError


def load_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """The numeric arrays of a .csv, .npz or .mat (version 5) file, of one or two dimensions.

    Raises ReadError, and nothing else, where the file is missing, damaged or of another kind.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ReadError(
            f"{path}: files ending in {path.suffix or 'nothing'!r} are not read, only "
            f"{', '.join(_READERS)}: convert it, or give its arrays to jq.Record."
        )
    if not path.is_file():
        raise ReadError(f"{path}: there is no such file in {path.resolve().parent}.")
    if path.stat().st_size == 0:
        raise ReadError(f"{path}: the file is empty.")
    arrays = {name: array for name, array in _guarded(reader, path).items() if _is_data(array)}
    if not arrays:
        raise ReadError(f"{path}: the file holds no numeric array of one or two dimensions.")
    return arrays


def _guarded(reader: Callable[[Path], dict[str, np.ndarray]], path: Path) -> dict[str, np.ndarray]:
    try:
        return reader(path)
    except ReadError:
        raise
    # A damaged file makes zipfile, zlib, numpy and scipy raise almost anything.
    except Exception as error:
        raise ReadError(
            f"{path}: cannot be read as {path.suffix.lower()}, it may be cut off or damaged "
            f"({type(error).__name__}: {error})."
        ) from error


def _is_data(array: np.ndarray) -> bool:
    return array.dtype.kind in "fiub" and array.ndim in (1, 2)


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    # Given a path, numpy leaves a damaged archive open.
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        return {name: _unpickled(path, file, name) for name in file.files}


def _unpickled(path: Path, file: np.lib.npyio.NpzFile, name: str) -> np.ndarray:
    try:
        return file[name]
    except ValueError as error:
        if "pickle" not in str(error):
            raise
        raise ReadError(
            f"{path}: the array {name!r} is pickled, which could run code: save it as numbers."
        ) from error


def _read_mat(path: Path) -> dict[str, np.ndarray]:
    from scipy.io import loadmat

    try:
        variables = loadmat(path, squeeze_me=True)
    except NotImplementedError as error:
        raise ReadError(
            f"{path}: a MATLAB v7.3 file, which is HDF5: save it again with save(..., '-v7')."
        ) from error
    arrays = {}
    for name, value in variables.items():
        if name.startswith("__"):
            continue
        arrays |= _fields(name, value) if _is_struct(value) else {name: np.asarray(value)}
    return arrays


def _is_struct(value: object) -> bool:
    return isinstance(value, np.ndarray | np.void) and value.dtype.names is not None


def _fields(name: str, struct: np.ndarray) -> dict[str, np.ndarray]:
    if struct.ndim:
        return {}
    fields = struct.dtype.names or ()
    return {f"{name}.{field}": np.asarray(struct[field].item()) for field in fields}


_READERS = {".csv": read_csv, ".npz": _read_npz, ".mat": _read_mat}
