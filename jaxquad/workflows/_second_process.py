"""A second process for scripts, and what it imports before it is asked for anything."""

import contextlib
from collections.abc import Iterator

from jaxquad._core import allowed_second_process, prepare_second_process, start_second_process


@contextlib.contextmanager
def second_process() -> Iterator[None]:
    """Share the work within with a second process, as the command line does.

    It takes a part of each joint estimate and of each report's figures; results are the same. A
    script that writes one report takes a seventh less time, and 340 MB more. The process imports
    while this one goes on, so begin early, behind `jq.enable_compile_cache()`, and end the block
    when the last report is written. There is none on one core, or with
    `JAXQUAD_SECOND_PROCESS=off` in the environment. A script of many logs has `jaxquad batch`,
    which uses all cores.
    """
    from jaxquad._compile import own_folder

    with allowed_second_process():
        start_second_process()
        prepare_second_process(_prepare_with_cache if own_folder() else _prepare)
        prepare_second_process(import_figures, last=True)
        yield


def _prepare() -> None:
    from jaxquad._core import enable_x64

    enable_x64()
    import_estimates()


def _prepare_with_cache() -> None:
    from jaxquad._compile import enable_compile_cache

    enable_compile_cache()
    _prepare()


def import_estimates() -> None:
    """Import what estimates and fits need."""
    import scipy.linalg.lapack
    import scipy.special

    from ._identify import identify

    del identify, scipy


def import_figures() -> None:
    """Import what reports need, with matplotlib."""
    from jaxquad.report import write_report

    del write_report
