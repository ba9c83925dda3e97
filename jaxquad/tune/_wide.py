import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxquad.control import LADRC, PID


_PER_MEMBER = ("b0", "kp", "ki", "kd", "feedforward")  # what an inertia told may change


def wide(law: Any, axes: int, members: int) -> Any:
    """The gains of a LADRC or PID in one shape, so that all of a kind share a compile."""
    if not isinstance(law, LADRC | PID):
        return law
    gains = {name: x for name, x in vars(law).items() if isinstance(x, Array)}
    full = {name: _shaped(x, name, axes, members) for name, x in gains.items()}
    return dataclasses.replace(law, **full)


def _shaped(gain: Array, name: str, axes: int, members: int) -> Array:
    shape = (axes, members) if name in _PER_MEMBER or gain.ndim > 1 else (axes,)
    given = np.asarray(gain)
    aligned = given.reshape(given.shape + (1,) * (len(shape) - given.ndim)) if given.ndim else given
    return jnp.asarray(np.broadcast_to(aligned, shape))
