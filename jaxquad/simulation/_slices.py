import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree


def in_slices(
    function: Callable[[Int[Array, " at_once"]], PyTree], members: int, *, at_once: int
) -> PyTree:
    """`function(indices)` of `at_once` members at a time, its results joined on the last axis.

    For ensembles that do not fit the memory together: what is drawn in the function, such as the
    noise of each member, exists for one slice only. All results have the members last, as
    `jq.simulation.Metrics` have. Every call is given equally many indices, so that it compiles once; where
    they run out, the last is repeated, and what that gives is dropped.

        fly = lambda few: jq.evaluate(few.plant, ladrc, few.flight(happens), delay=few.delay)
        found = jq.simulation.in_slices(lambda k: fly(members.take(k)), members.size, at_once=4096)

    A loop in Python whose results wait in the host's memory. It saves none under `jax.grad`: for
    the gradient of a mean, sum those of its slices. Raises ValueError for counts below 1 and for
    results of other shapes.
    """
    if members < 1 or at_once < 1:
        raise ValueError(f"{members} members, {at_once} at once: give 1 or more of both")
    at_once = min(members, at_once)
    parts = []
    for first in range(0, members, at_once):
        indices = np.minimum(np.arange(first, first + at_once), members - 1)
        part = function(jnp.asarray(indices))
        parts.append(jax.tree.map(ft.partial(_kept, at_once, members - first), part))
    return jax.tree.map(lambda *xs: jnp.asarray(np.concatenate(xs, axis=-1)), *parts)


def _kept(at_once: int, left: int, x: Any) -> np.ndarray:
    values = np.asarray(x)
    if values.shape[-1:] != (at_once,):
        raise ValueError(
            f"a result has the shape {values.shape}, but the {at_once} members of a slice belong "
            "on its last axis: return what each member gives, and nothing that they share"
        )
    return values[..., :left]
