"""One thread for the many small matrices of an estimate: more would only wait for each other."""

import contextlib
from collections.abc import Iterator

import threadpoolctl


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Within it, NumPy's and SciPy's BLAS has one thread, in the whole process.

    The environment's OPENBLAS_NUM_THREADS and its kin count only before NumPy is imported.
    """
    with threadpoolctl.threadpool_limits(limits=1, user_api="blas"):
        yield
