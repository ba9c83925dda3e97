"""Local processes, one job at a time each; one that dies takes no other job with it."""

import contextlib
import multiprocessing
import os
import threading
from collections.abc import Iterator
from multiprocessing.connection import Connection, wait
from typing import Any

from ._perform import Content, failed, perform, Work
from ._store import Job


_SPAWN = multiprocessing.get_context("spawn")  # JAX has threads, which do not survive a fork
_NARROW = {  # Each process has one core: more threads would only wait for each other.
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "MPLBACKEND": "Agg",
}


class _Worker:
    def __init__(self, work: Work):
        self.connection, theirs = _SPAWN.Pipe()
        self.job: Job | None = None
        self.process = _SPAWN.Process(target=_serve, args=(work, theirs), daemon=True)
        with _environment(_NARROW):
            self.process.start()
        theirs.close()  # or the end of the process would not show on ours

    def give(self, job: Job | None) -> bool:
        """Hand out the next job, None for the end; whether there was one."""
        self.job = job
        with contextlib.suppress(OSError):  # A process that died shows when its answer is due.
            self.connection.send(job)
        return job is not None

    def answer(self) -> Content:
        """What became of the job; the death of the process is an answer."""
        try:
            return self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            code = self.process.exitcode or 0
            how = f"killed by signal {-code}" if code < 0 else f"ended with code {code}"
            return failed(f"its process was {how}: out of memory? It is tried again next time")

    def stop(self) -> None:
        self.connection.close()
        if self.process.is_alive():
            self.process.kill()  # Nothing is lost: results appear whole or not at all.
        self.process.join()


def performed(jobs: Iterator[Job], work: Work, workers: int) -> Iterator[tuple[Job, Content]]:
    """The jobs with their results, as these come in; `jobs` is read only as they are needed."""
    busy: dict[Connection, _Worker] = {}
    try:
        for job in jobs:
            _start(busy, _Worker(work), job)
            if len(busy) == workers:
                break
        while busy:
            for ready in wait(list(busy)):
                worker = busy.pop(ready)  # pyright: ignore[reportArgumentType]
                done, content = worker.job, worker.answer()
                assert done is not None
                _next(busy, worker, jobs, work)
                yield done, content
    finally:
        for worker in busy.values():
            worker.stop()


def _next(busy: dict[Any, _Worker], worker: _Worker, jobs: Iterator[Job], work: Work) -> None:
    job = next(jobs, None)
    if worker.process.exitcode is not None and job is not None:
        worker.stop()
        worker = _Worker(work)
    if job is None:
        worker.stop()
    else:
        _start(busy, worker, job)


def _start(busy: dict[Any, _Worker], worker: _Worker, job: Job) -> None:
    worker.give(job)
    busy[worker.connection] = worker


def _serve(work: Work, connection: Connection) -> None:
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    while True:
        try:
            job = connection.recv()
            connection.send(perform(work, job))
        except (EOFError, OSError, KeyboardInterrupt):
            return


def _end_with_the_parent() -> None:
    """At once: a batch that is started again must not find the job under way."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


@contextlib.contextmanager
def _environment(added: dict[str, str]) -> Iterator[None]:
    """For a process that starts within; what the user set stays."""
    missing = {name: text for name, text in added.items() if name not in os.environ}
    os.environ.update(missing)
    try:
        yield
    finally:
        for name in missing:
            os.environ.pop(name, None)
