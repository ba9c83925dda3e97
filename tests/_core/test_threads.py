"""An estimate gives NumPy's small matrices one thread, and puts back what was there."""

import subprocess
import sys

import pytest
import threadpoolctl

from jaxquad._core import map_in_threads, one_blas_thread


def threads():
    return [x["num_threads"] for x in threadpoolctl.threadpool_info() if x["user_api"] == "blas"]


def test_within_there_is_one_thread_and_after_an_error_too_as_many_as_before():
    if not threads():
        pytest.skip("NumPy's BLAS is not one that threadpoolctl knows")
    with one_blas_thread():  # loads the libraries that it limits
        pass
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = threads()
        with pytest.raises(KeyError), one_blas_thread():
            assert set(threads()) == {1}
            raise KeyError
        assert threads() == before


def test_threads_within_that_ask_for_it_too_leave_what_was_there_before():
    if not threads():
        pytest.skip("NumPy's BLAS is not one that threadpoolctl knows")

    def ask(_):
        with one_blas_thread():
            return set(threads())

    with one_blas_thread():  # loads the libraries that it limits
        pass
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = threads()
        with one_blas_thread():
            assert map_in_threads(ask, iter(range(8))) == 8 * [{1}]
            assert set(threads()) == {1}
        assert threads() == before


def test_a_library_that_an_estimate_loads_only_then_has_one_thread_too():
    code = (
        "import threadpoolctl\nfrom jaxquad._core import one_blas_thread\n"
        "with one_blas_thread():\n    import scipy.linalg.lapack\n"
        "    print(*(x['num_threads'] for x in threadpoolctl.threadpool_info() "
        "if x['user_api'] == 'blas'))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= {"1"}
