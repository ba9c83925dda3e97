"""Threads and cores: which compute only what a caller would compute in their place."""

import contextlib
import functools as ft
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import threadpoolctl


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
