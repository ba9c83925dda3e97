"""The cores that a process may use; without JAX, whose import a usage error does not wait for."""

import os


def available_cores() -> int:
    """That this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS, Windows
        return os.cpu_count() or 1
