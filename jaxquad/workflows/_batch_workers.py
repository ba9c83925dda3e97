"""The logs of a batch, by local processes or a Dask cluster: one that dies costs no other log.

A result is on the disk whole or not there.
"""

import atexit
import contextlib
import gc
import json
import math
import multiprocessing
import os
import re
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple

from jaxquad._core import is_ours, write_file

from ._result_file import read_json
from ._settings import IdentifySettings


class Job(NamedTuple):
    """One log to identify."""

    log: str  # path
    key: str  # of content and settings
    settings: IdentifySettings
    out: str  # folder of the batch

    @property
    def stored(self) -> Path:
        """Where its result is stored."""
        return Path(self.out) / "results" / f"{self.key}.json"


Content = dict[str, Any]  # what JSON can hold; "status" at least
Work = Callable[[Job], Mapping[str, object]]
_ONE_AT_A_TIME = threading.Lock()  # matplotlib and warnings belong to the process, not to a thread


def identify_log(job: Job) -> Content:
    """Identify one log; its report and figures go to `logs/` in the folder of the batch."""
    import matplotlib

    from jaxquad._compile import enable_compile_cache, share_programs
    from jaxquad._core import enable_x64

    from ._identify import identify  # here: a process with other work starts in half the time

    name = re.sub(r"[^\w.-]", "_", Path(job.log).stem)[:60]
    folder = Path(job.out) / "logs" / f"{name}-{job.key[:12]}"
    folder.mkdir(parents=True, exist_ok=True)
    with _ONE_AT_A_TIME, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        matplotlib.use("Agg")
        enable_x64()
        enable_compile_cache()
        result = identify(job.log, job.settings)
        result.write(folder)
    share_programs()  # Not only at the end: workers are killed.
    texts = [str(result)] if result.proposal is None else [str(result.proposal), str(result)]
    write_file(folder / "printed.txt", "\n\n".join(texts))
    ours = [str(warning.message) for warning in caught if is_ours(warning.category)]
    warned = list(dict.fromkeys(" ".join(text.split()) for text in ours))
    if warned:
        write_file(folder / "warnings.txt", "\n".join(warned))
    fit, rows = result.fit, []
    if fit.verdict.fitted:
        numbers = zip(fit.names, fit.values, fit.standard_errors, fit.determined, strict=True)
        # A table has no place for a mark: what is not determined has no number in it.
        rows += [(name, *(pair if sure else (None, None))) for name, *pair, sure in numbers]
    rows += [(x.name, x.value, x.standard_error) for x in result.combinations]
    plain = lambda x: None if x is None else float(x)
    return {
        "status": "identified" if fit.identifiable else "not identifiable",
        "error": "" if fit.identifiable else fit.verdict.summary,
        "parameters": [
            {"name": name, "value": plain(value), "standard_error": plain(error)}
            for name, value, error in rows
        ],
        "remarks": [*warned, *fit.remarks],
        "report": (folder / "report.html").relative_to(job.out).as_posix(),
    }


def perform(work: Work, job: Job) -> Content:
    """Do one job and store its result; an error is a result, too."""
    earlier = stored_result(job)  # by a process whose answer was lost
    if earlier is not None:
        return earlier
    start = time.monotonic()
    seconds = lambda: {"seconds": round(time.monotonic() - start, 3)}
    try:
        content = dict(work(job)) | seconds()
        store_result(job, content)
    except Exception as error:
        text = " ".join(str(error).split())
        if not (isinstance(error, ValueError | OSError) and text):
            text = f"{type(error).__name__}: {text}"
        content = failure(text) | seconds()
        # The log cannot be used, which stays so; after other errors the next run tries again.
        if isinstance(error, ValueError):
            with contextlib.suppress(OSError):
                store_result(job, content)
    return content


def failure(error: str) -> Content:
    """The result of a log that could not be used."""
    return {"status": "failed", "error": error}


def stored_result(job: Job) -> Content | None:
    """The result of an earlier run, or None; one that cannot be read counts as none."""
    try:
        content = read_json(job.stored)
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) and content.get("key") == job.key else None


def store_result(job: Job, content: Mapping[str, object]) -> None:
    text = json.dumps(dict(content) | {"key": job.key}, indent=1, allow_nan=False)
    write_file(job.stored, text)


@contextlib.contextmanager
def locked(out: Path) -> Iterator[None]:
    """One batch at a time in a folder; a killed one leaves no lock, and its drafts are removed."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / ".lock").open("w") as file:
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except ImportError:  # Windows: two batches in one folder do the same work twice, no harm.
            pass
        except OSError as error:
            raise ValueError(
                f"{out}: another batch is running in this folder: wait for it, or choose another "
                "one (--out)"
            ) from error
        for draft in (*out.glob("*.part"), *out.glob("results/*.part")):
            draft.unlink(missing_ok=True)
        yield


_SPAWN = multiprocessing.get_context("spawn")  # JAX has threads, which do not survive a fork
_NARROW = {  # Each process has one core: more threads would only wait for each other.
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "MPLBACKEND": "Agg",
}


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """A process that starts within it never gets the interrupt that ends this one."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # which would let interrupts in
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Worker:
    def __init__(self, work: Work, timeout: float | None):
        self.timeout, self.due = math.inf if timeout is None else timeout, math.inf
        self.connection, theirs = _SPAWN.Pipe()
        self.process = _SPAWN.Process(target=_serve, args=(work, theirs), daemon=True)
        missing = {name: text for name, text in _NARROW.items() if name not in os.environ}
        os.environ.update(missing)  # what the user set stays
        try:
            with _without_interrupts():
                self.process.start()
        finally:
            for name in missing:
                os.environ.pop(name, None)
        theirs.close()  # or the end of the process would not show on ours

    def give(self, job: Job) -> None:
        self.job, self.due = job, time.monotonic() + self.timeout
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

    def give_up(self) -> Content:
        """Stop a job that takes too long; its failure is kept, or it would take as long again."""
        self.stop()
        content = stored_result(self.job)  # It may have come to its end just now.
        if content is None:
            limit = float(self.timeout)
            content = failure(f"it took longer than {limit:g} s: raise the timeout (--timeout)")
            content |= {"seconds": limit, "timeout": limit}
            with contextlib.suppress(OSError):
                store_result(self.job, content)
        return content

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

    def start(worker: _Worker, job: Job) -> None:
        worker.give(job)
        busy[worker.connection] = worker

    try:
        for job in islice(jobs, workers):
            start(_Worker(work, timeout), job)
        while busy:
            due = min(worker.due for worker in busy.values())
            left = None if due == math.inf else max(0.0, due - time.monotonic())
            ready = wait(list(busy), left)
            now = time.monotonic()
            late = [x for x, worker in busy.items() if now >= worker.due and not x.poll()]
            for connection in [*ready, *late]:
                worker = busy.pop(connection)  # pyright: ignore[reportArgumentType]
                done = worker.job
                content = worker.give_up() if connection in late else worker.answer()
                job, ended = next(jobs, None), worker.process.exitcode is not None
                if job is None or ended:
                    worker.stop()
                if job is not None:
                    start(_Worker(work, timeout) if ended else worker, job)
                yield done, content
    finally:
        for worker in busy.values():
            worker.stop()


def _serve(work: Work, connection: Connection) -> None:
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)  # What it starts ends with it, see _kill.

    def end_with_the_parent() -> None:
        """At once: a batch that is started again must not find the job under way."""
        parent = multiprocessing.parent_process()
        assert parent is not None
        wait([parent.sentinel])
        _kill(None)

    threading.Thread(target=end_with_the_parent, daemon=True).start()
    atexit.register(gc.freeze)  # Python's last look for garbage takes half a second
    while True:
        try:
            job = connection.recv()
            connection.send(perform(work, job))
        except (EOFError, OSError, KeyboardInterrupt):
            return


def _kill(process: BaseProcess | None) -> None:
    """A process (None: this one) with the readers that it has started."""
    if hasattr(os, "killpg"):
        with contextlib.suppress(OSError):  # It has no group of its own yet.
            os.killpg((process and process.pid) or os.getpid(), signal.SIGKILL)
    if process is None:
        os._exit(1)
    process.kill()


PATIENCE = 30.0  # s, for the scheduler to answer
_AHEAD = 2  # jobs per thread of the cluster that are handed out at a time


def perform_on_cluster(
    scheduler: str, jobs: Iterator[Job], work: Work
) -> Iterator[tuple[Job, Content]]:
    """As `perform_locally`. A job whose worker is lost moves to another one; a worker that finds a
    result on the disk does not make it again."""
    try:
        import distributed
    except ImportError as error:
        text = "a scheduler needs dask.distributed: pip install 'jaxquad[cluster]'"
        raise ValueError(text) from error
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
            error = future.exception()
            if error is None:
                content = future.result()
            else:
                text = f"{type(error).__name__}: {' '.join(str(error).split())}"
                content = failure(f"the cluster gave up on this log ({text})")
            done = under_way.pop(future.key)
            for job in islice(jobs, 1):
                submit(job)
            yield done, content
