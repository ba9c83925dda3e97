"""Files that are whole or not there, JSON, stages that are told; threads and cores."""

import contextlib
import functools as ft
import logging
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import threadpoolctl


STAGES = logging.getLogger("jaxquad.stages")


def announce(stage: str) -> None:
    """Log what begins now, at level INFO; the command line shows it on stderr."""
    STAGES.info(stage)


def write_file(path: str | Path, content: str | bytes) -> Path:
    """Write a file whole or not at all; it is on the disk when this returns.

    **Arguments:**

    - `path`: its folders are made as needed.
    - `content`: a text is encoded as UTF-8, as `readable` makes it.

    **Returns:** the path.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with draft.open("wb") as file:
            file.write(readable(content).encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except BaseException as error:
        draft.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno:  # a full disk names no file
            error.filename = str(path)
        raise
    if os.name != "nt":  # a new name is on the disk only once its folder is
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    return path


@contextlib.contextmanager
def staged_files(folder: Path) -> Iterator[Path]:
    """A folder of drafts whose files move to `folder` at the end of the `with`: all, or none."""
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        draft = Path(tempfile.mkdtemp(prefix=".", suffix=".part", dir=folder))
        try:
            yield draft
            for path in sorted(draft.iterdir()):
                path.replace(folder / path.name)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
    except BaseException as error:
        for path in new:
            with contextlib.suppress(OSError):  # it holds something else
                path.rmdir()
        if isinstance(error, OSError) and error.errno:
            error.filename = str(folder)
        raise


def readable(text: str) -> str:
    """A text without what UTF-8 cannot hold: bytes in the name of a file, half a pair in JSON."""
    if text.isascii():
        return text
    try:
        return text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    except UnicodeEncodeError:
        return "".join("\ufffd" if "\ud800" <= x <= "\udfff" else x for x in text)


def plain_content(value: object) -> Any:
    """JSON's own types, with null for what is not finite, and texts as `readable` makes them."""
    if isinstance(value, float):  # first what there is most of
        return float(value) if math.isfinite(value) else None
    if isinstance(value, str):
        return readable(value)
    if value is None or isinstance(value, int):
        return value
    if isinstance(value, Mapping):
        return {readable(str(key)): plain_content(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_content(item) for item in value]
    if hasattr(value, "__array__"):  # of NumPy or JAX
        return plain_content(np.asarray(value).tolist())
    return value


Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """`function` of each, on all cores, while the next ones are drawn from an iterator.

    One after the other where JAX is set differently for the caller's thread alone.
    """
    with ThreadPoolExecutor(max(available_cores(), 2)) as pool:
        if pool.submit(thread_settings).result() != thread_settings():
            return [function(x) for x in items]
        return list(pool.map(function, items))


def available_cores() -> int:
    """That this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS, Windows
        return os.cpu_count() or 1


def thread_settings() -> tuple[object, ...]:
    """Of JAX, those that change numbers or raise, and that a `with` can set for one thread."""
    import jax  # Batches and usage errors ask for cores without it.
    import jax.numpy as jnp

    config = jax.config  # makes its attributes while it is imported, which no type checker sees
    return (
        jnp.result_type(float),
        config.jax_default_device,  # pyright: ignore[reportAttributeAccessIssue]
        config.jax_default_matmul_precision,  # pyright: ignore[reportAttributeAccessIssue]
        config.jax_debug_nans,  # pyright: ignore[reportAttributeAccessIssue]
        config.jax_numpy_rank_promotion,  # pyright: ignore[reportAttributeAccessIssue]
        config.jax_numpy_dtype_promotion,  # pyright: ignore[reportAttributeAccessIssue]
    )


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Within it, NumPy's and SciPy's BLAS has one thread, in the whole process.

    The environment's OPENBLAS_NUM_THREADS and its kin count only before NumPy is imported.
    """
    with _libraries().limit(limits=1, user_api="blas"):
        yield


@ft.cache  # to look for them takes as long as a small fit
def _libraries() -> threadpoolctl.ThreadpoolController:
    import scipy.linalg.lapack  # SciPy has a BLAS of its own, and only loaded ones are limited

    del scipy
    return threadpoolctl.ThreadpoolController()
