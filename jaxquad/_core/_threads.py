"""Threads beside that of a caller, which compute only what they would compute in its place."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar


Given = TypeVar("Given")
Found = TypeVar("Found")


def map_in_threads(function: Callable[[Given], Found], given: Iterable[Given]) -> list[Found]:
    """`function` of each, on all cores, while the next ones are drawn from an iterator.

    One after the other where JAX is set differently for the caller's thread alone.
    """
    settings, items = thread_settings(), []

    def remember() -> Iterable[Given]:
        for each in given:
            items.append(each)
            yield each

    def run(each: Given) -> tuple[Found] | None:
        return (function(each),) if thread_settings() == settings else None

    with ThreadPoolExecutor(max(available_cores(), 2)) as pool:
        found = list(pool.map(run, remember()))
    return [function(x) if y is None else y[0] for x, y in zip(items, found, strict=True)]


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
