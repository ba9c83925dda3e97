"""An estimate gives NumPy's small matrices one thread, and puts back what was there."""

import subprocess
import sys

import pytest

from jaxquad._core._threads import _functions, one_blas_thread


SCRIPT = """
from jaxquad.spectra._one_blas_thread import _functions, one_blas_thread
get, put = _functions()
put(2)
try:
    with one_blas_thread():
        print(get())
        raise KeyError
except KeyError:
    print(get())
"""


def test_within_there_is_one_thread_and_after_an_error_too_as_many_as_before():
    if not _functions():
        pytest.skip("NumPy has another BLAS than OpenBLAS")
    told = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True)
    assert told.stdout.split() == ["1", "2"], told.stderr


def test_without_openblas_nothing_happens(monkeypatch):
    monkeypatch.setattr("jaxquad._core._threads._functions", lambda: ())
    with one_blas_thread():
        pass
