"""The workers of a Dask cluster that runs already and sees the same files under the same paths."""

from collections.abc import Iterator
from itertools import islice

from ._jobs import Content, failure, Job, perform, Work


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
