from collections.abc import Callable
from typing import Any

import jax


def apart(function: Callable[..., Any], *args: Any) -> Any:
    """A call that the CPU's compiler does not fuse: what it fuses, it computes for each user anew.

    Without its private mark, a plain call.
    """
    try:
        from jax.experimental.xla_metadata import set_xla_metadata
    except ImportError:
        return function(*args)
    with set_xla_metadata(inlineable="false"):
        return jax.jit(function)(*args)
