import io
import zipfile
from pathlib import Path
from typing import IO

import numpy as np

from .._errors import printable, ReadError
from .._log import add_columns, check_size, Log, Table


_MAGIC = b"\x93NUMPY"


def sniff(head: bytes, path: Path) -> bool:
    return head.startswith((_MAGIC, b"PK\x03\x04"))


def load(path: Path) -> Log:
    """The arrays of a .npz archive, or the one of a .npy file, which is called `data`."""
    with path.open("rb") as stream:
        magic = stream.read(len(_MAGIC))
        stream.seek(0)
        if magic == _MAGIC:
            array = _read_array("data", stream, path.stat().st_size)
            return Log({"": Table(_named("data", array))})
        if not magic.startswith(b"PK"):
            raise ReadError("not a NumPy array, nor an archive of arrays", offset=0)
        size = path.stat().st_size
        try:
            archive = zipfile.ZipFile(stream)
        # On damaged archives zipfile raises almost anything, here and below.
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise ReadError(f"the archive is cut off or damaged ({reason})", offset=size) from error
        arrays: dict[str, np.ndarray] = {}
        remarks: list[str] = []
        with archive:
            members = [member for member in archive.infolist() if not member.filename.endswith("/")]
            check_size("the archive", sum(member.file_size for member in members), size)
            for member in members:
                name = member.filename.removesuffix(".npy")
                try:
                    with archive.open(member) as file:
                        if file.read(len(_MAGIC)) != _MAGIC:
                            continue
                        file.seek(0)
                        columns = _named(name, _read_array(name, file, member.file_size))
                except ReadError:
                    raise
                except Exception as error:
                    reason = f"{type(error).__name__}: {printable(str(error))}"
                    raise ReadError(
                        f"the array {printable(name)!r} is cut off or damaged ({reason})",
                        offset=member.header_offset,
                    ) from error
                add_columns(arrays, columns, remarks)
    return Log({"": Table(arrays)}, tuple(remarks))


def _named(name: str, array: np.ndarray) -> dict[str, np.ndarray]:
    """A structured array is a table, and its fields are the channels."""
    fields = array.dtype.names or ()
    return {field: array[field] for field in fields} if fields else {name: array}


def _read_array(name: str, stream: io.BufferedIOBase | IO[bytes], size: int) -> np.ndarray:
    """The array of a .npy stream of `size` bytes, which holds at least what its header declares."""
    read = np.lib.format.read_array_header_1_0, np.lib.format.read_array_header_2_0
    try:
        version = np.lib.format.read_magic(stream)
        header = read[version[0] > 1](stream) if version in ((1, 0), (2, 0), (3, 0)) else None
    # The header is a piece of Python: what is wrong with it shows as almost anything.
    except Exception as error:
        raise ReadError(
            f"the header of the array {name!r} is cut off or damaged ({type(error).__name__})"
        ) from error
    if header is None:
        raise ReadError(f"the array {name!r} has npy version {version}: only 1 to 3 are read")
    shape, fortran, dtype = header
    if dtype.hasobject:
        raise ReadError(
            f"the array {name!r} is pickled, and reading it could run code: save it as numbers"
        )
    declared = dtype.itemsize * int(np.prod([int(n) for n in shape], dtype=object))
    if min(shape, default=0) < 0 or declared > size:
        raise ReadError(
            f"the array {name!r} declares the shape {shape} of {dtype} ({declared:.6g} bytes), but "
            f"has {size} bytes: it is cut off or damaged"
        )
    content = stream.read(declared)
    if len(content) < declared:
        raise ReadError(f"the array {name!r} has {len(content)} of {declared} bytes: it is cut off")
    stream.read(1)  # The end of an archive's member is where its checksum is looked at.
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")
