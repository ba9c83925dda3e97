"""What an ensemble needs, held against what there is, before an allocation fails."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Int, PyTree


_GB = 1e9
_SIZED = (jax.Array, np.ndarray, jax.ShapeDtypeStruct)


def require_memory(what: str, needed: float | int, remedy: str) -> None:
    """Raises ValueError where `needed` bytes are more than the default device has left.

    Where a machine does not tell what that is, nothing is refused.
    """
    chosen = getattr(jax.config, "jax_default_device", None)
    free = free_memory(chosen if isinstance(chosen, jax.Device) else jax.local_devices()[0])
    if free is not None and needed > free:
        raise ValueError(
            f"{what} needs about {needed / _GB:.3g} GB, but {free / _GB:.3g} GB are free: {remedy}"
        )


def size_of(tree: PyTree) -> int:
    """The bytes of its arrays."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree) if isinstance(x, _SIZED))


def free_memory(device: Any) -> float | None:
    """Of a `jax.Device` in bytes; of the host for a CPU, and of what a container may use of it."""
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        limit = stats.get("bytes_limit")
        return None if limit is None else limit - stats.get("bytes_in_use", 0)
    free: list[float] = []
    with contextlib.suppress(OSError, StopIteration, ValueError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        free.append(next(1024.0 * int(x.split()[1]) for x in lines if x.startswith("MemAvailable")))
    # Of all that the container may use ("max" without a limit) the page cache can be freed.
    with contextlib.suppress(OSError, ValueError):
        free.append(float(Path("/sys/fs/cgroup/memory.max").read_text()))
    return min(free, default=None)


def in_slices(
    function: Callable[[Int[Array, " at_once"]], PyTree], members: int, *, at_once: int
) -> PyTree:
    """`function(indices)` of a few members at a time, its results joined on the last axis.

    For ensembles that do not fit the memory together: what is drawn in the function, such as the
    noise of each member, exists for one slice only. Every call is given equally many indices, so
    that it compiles once; where they run out, the last is repeated, and what that gives is dropped.

        fly = lambda few: jq.evaluate(few.loop(ladrc), few.flight(scenario))
        found = jq.simulation.in_slices(lambda k: fly(members.take(k)), members.size, at_once=4096)

    A loop in Python whose results wait in the host's memory. It saves none under `jax.grad`: for
    the gradient of a mean, sum those of its slices.

    **Arguments:**

    - `function`: of indices; all its results have the members last, as `Metrics` have.
    - `members`: how many there are.
    - `at_once`: how many indices a call gets.

    **Raises:** ValueError for counts below 1 and for results of other shapes.
    """
    if members < 1 or at_once < 1:
        raise ValueError(f"{members} members, {at_once} at once: give 1 or more of both")
    at_once = min(members, at_once)

    def part_of(x: ArrayLike, left: int) -> np.ndarray:
        values = np.asarray(x)
        if values.shape[-1:] != (at_once,):
            raise ValueError(
                f"a result has the shape {values.shape}, but the {at_once} members of a slice "
                "belong on its last axis: return what each member gives, and nothing that they "
                "share"
            )
        return values[..., :left]

    parts = []
    for first in range(0, members, at_once):
        indices = np.minimum(np.arange(first, first + at_once), members - 1)
        part = function(jnp.asarray(indices))
        parts.append(jax.tree.map(lambda x, left=members - first: part_of(x, left), part))
    return jax.tree.map(lambda *xs: jnp.asarray(np.concatenate(xs, axis=-1)), *parts)
