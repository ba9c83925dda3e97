"""One thread for the many small matrices of an estimate: more would only wait for each other."""

import contextlib
import ctypes
from collections.abc import Iterator
from typing import Any

import numpy as np


_PREFIXES, _SUFFIXES = ("scipy_openblas", "openblas"), ("64_", "")  # of NumPy's own, of a system's


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Within it, NumPy's OpenBLAS has one thread, in the whole process; another BLAS is left alone.

    The environment's OPENBLAS_NUM_THREADS counts before NumPy is imported alone.
    """
    number = _functions()
    before = number[0]() if number else 1
    if before <= 1:
        yield
        return
    number[1](1)
    try:
        yield
    finally:
        number[1](before)


def _functions() -> tuple[Any, ...]:
    """What asks for the number of threads and what sets it; nothing where they are not found."""
    try:
        library = ctypes.CDLL(np.linalg._umath_linalg.__file__)  # pyright: ignore
    except (AttributeError, OSError, TypeError):
        return ()
    for prefix in _PREFIXES:
        for suffix in _SUFFIXES:
            names = (f"{prefix}_{verb}_num_threads{suffix}" for verb in ("get", "set"))
            found = tuple(getattr(library, name, None) for name in names)
            if all(found):
                return found
    return ()
