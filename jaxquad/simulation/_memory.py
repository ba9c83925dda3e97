"""What an ensemble needs, held against what there is, before an allocation fails."""

from pathlib import Path
from typing import Any

import jax
from jaxtyping import PyTree


_GB = 1e9


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
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree) if hasattr(x, "dtype"))


def free_memory(device: Any) -> float | None:
    """In bytes; of the host for a CPU."""
    if device.platform != "cpu":
        known = device.memory_stats() or {}
        limit = known.get("bytes_limit")
        return None if limit is None else limit - known.get("bytes_in_use", 0)
    found = [x for x in (_available(), _container_limit()) if x is not None]
    return min(found, default=None)


def _available() -> float | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024.0 * int(x.split()[1]) for x in lines if x.startswith("MemAvailable"))
    except (OSError, StopIteration, ValueError):
        return None


def _container_limit() -> float | None:
    """All that the container may use, of which the page cache is a part that can be freed."""
    try:
        return float(Path("/sys/fs/cgroup/memory.max").read_text())
    except (OSError, ValueError):  # "max" where there is no limit
        return None
