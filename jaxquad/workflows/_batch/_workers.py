"""Local processes, or the workers of a Dask cluster: one that dies takes no other job with it."""

import atexit
import contextlib
import gc
import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterable, Iterator
from itertools import islice
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from ._jobs import Content, failure, Job, perform, store_result, stored_result, Work


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
        self.due = math.inf  # by time.monotonic
        self.process = _SPAWN.Process(target=_serve, args=(work, theirs), daemon=True)
        with _environment(_NARROW):
            self.process.start()
        theirs.close()  # or the end of the process would not show on ours

    def give(self, job: Job, timeout: float | None) -> None:
        """Hand out the next job, to be done within so many s."""
        self.job = job
        self.due = math.inf if timeout is None else time.monotonic() + timeout
        with contextlib.suppress(OSError):  # A process that died shows when its answer is due.
            self.connection.send(job)

    def answer(self) -> Content:
        """What became of the job; the death of the process is an answer."""
        try:
            return self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            code = self.process.exitcode or 0
            how = f"killed by signal {-code}" if code < 0 else f"ended with code {code}"
            return failure(
                f"its process was {how} (too little memory?); the next run tries the log again"
            )

    def overdue(self) -> bool:
        return time.monotonic() >= self.due and not self.connection.poll()

    def give_up(self, timeout: float) -> Content:
        """Stop a job that takes too long; its failure is kept, or it would take as long again."""
        assert self.job is not None
        self.stop()
        found = stored_result(self.job)  # It may have come to its end just now.
        if found is None:
            found = failure(f"it took longer than {timeout:g} s: raise the timeout (--timeout)")
            found |= {"seconds": float(timeout), "timeout": float(timeout)}
            with contextlib.suppress(OSError):
                store_result(self.job, found)
        return found

    def stop(self) -> None:
        self.connection.close()
        if self.process.is_alive():
            _kill(self.process)  # Nothing is lost: results appear whole or not at all.
        self.process.join()


def perform_locally(
    jobs: Iterator[Job], work: Work, workers: int, timeout: float | None = None
) -> Iterator[tuple[Job, Content]]:
    """Yield the jobs with their results, as these come in; `jobs` is read as they are needed.

    A job that takes longer than `timeout` s has failed, and its process is killed.
    """
    busy: dict[Connection, _Worker] = {}
    try:
        for job in jobs:
            _start(busy, _Worker(work), job, timeout)
            if len(busy) == workers:
                break
        while busy:
            ready = wait(list(busy), _seconds_left(busy.values()))
            late = [each for each, worker in busy.items() if worker.overdue()]
            for each in [*ready, *late]:
                worker = busy.pop(each)  # pyright: ignore[reportArgumentType]
                done = worker.job
                content = worker.give_up(timeout or 0) if each in late else worker.answer()
                assert done is not None
                _next(busy, worker, jobs, work, timeout)
                yield done, content
    finally:
        for worker in busy.values():
            worker.stop()


def _seconds_left(workers: Iterable[_Worker]) -> float | None:
    """Seconds until the first of them is late; None without a limit."""
    due = min(worker.due for worker in workers)
    return None if due == math.inf else max(0.0, due - time.monotonic())


def _next(
    busy: dict[Connection, _Worker],
    worker: _Worker,
    jobs: Iterator[Job],
    work: Work,
    timeout: float | None,
) -> None:
    job = next(jobs, None)
    if worker.process.exitcode is not None and job is not None:
        worker.stop()
        worker = _Worker(work)
    if job is None:
        worker.stop()
    else:
        _start(busy, worker, job, timeout)


def _start(
    busy: dict[Connection, _Worker], worker: _Worker, job: Job, timeout: float | None
) -> None:
    worker.give(job, timeout)
    busy[worker.connection] = worker


def _serve(work: Work, connection: Connection) -> None:
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)  # What it starts ends with it, see _kill.
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    atexit.register(gc.freeze)  # Python's last look for garbage takes half a second
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
    _kill(None)


def _kill(process: BaseProcess | None) -> None:
    """A process (None: this one) with the readers that it has started."""
    if hasattr(os, "killpg"):
        with contextlib.suppress(OSError):  # It has no group of its own yet.
            os.killpg((process and process.pid) or os.getpid(), signal.SIGKILL)
    if process is None:
        os._exit(1)
    process.kill()


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


PATIENCE = 30.0  # s, for the scheduler to answer
_AHEAD = 2  # jobs per thread of the cluster that are handed out at a time


def perform_on_cluster(
    scheduler: str, jobs: Iterator[Job], work: Work
) -> Iterator[tuple[Job, Content]]:
    """Yield the jobs with their results, as these come in.

    A job whose worker is lost moves to another one; a worker that finds a result on the disk does
    not make it again. Raises ValueError without dask.distributed, and where no scheduler answers.
    """
    distributed = _distributed()
    try:
        client = distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"no Dask scheduler at {scheduler}: {error}") from error
    with client:
        threads = sum(dict(client.nthreads()).values()) or 1  # pyright: ignore
        under_way = {}
        waiting = distributed.as_completed(loop=client.loop)

        def submit(job: Job) -> None:
            future = client.submit(perform, work, job, key=f"jaxquad-{job.key}", pure=False)
            under_way[future.key] = job
            waiting.add(future)

        for job in islice(jobs, _AHEAD * threads):
            submit(job)
        for future in waiting:
            content = _answer(future)
            done = under_way.pop(future.key)
            for job in islice(jobs, 1):
                submit(job)
            yield done, content


def _answer(future) -> Content:
    error = future.exception()
    if error is None:
        return future.result()
    return failure(
        f"the cluster gave up on this log ({type(error).__name__}: {' '.join(str(error).split())})"
    )


def _distributed():
    try:
        import distributed
    except ImportError as error:
        raise ValueError(
            "a scheduler needs dask.distributed: pip install 'jaxquad[cluster]'"
        ) from error
    return distributed
