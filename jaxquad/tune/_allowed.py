"""What a controller refuses of its own gains, which a traced one cannot."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxquad.control import LADRC

from ._parameters import Coordinates


_ALONE = 1 - 1e-9  # the radius at which an observer forgets


def refusal(coordinates: Coordinates, z: np.ndarray) -> str:
    """Why the controller at `z` cannot be built or must not be flown; empty if it can."""
    controller = _built(coordinates, z)
    for part in _modules(controller):
        try:
            dataclasses.replace(part)
        except ValueError as error:
            return str(error)
        if isinstance(part, LADRC) and _observer_radius(part) >= _ALONE:
            return (
                f"the observer alone is unstable at wo = {part.wo} rad/s and an observer_factor of "
                f"{part.observer_factor}: it would run away while the command saturates"
            )
    return ""


@eqx.filter_jit
def _built(coordinates: Coordinates, z: Any) -> Any:
    return coordinates.controller_at(z)


def _modules(tree: Any) -> Iterator[eqx.Module]:
    if isinstance(tree, eqx.Module):
        yield tree
        for field in dataclasses.fields(tree):
            yield from _modules(getattr(tree, field.name))


def _observer_radius(ladrc: LADRC) -> float:
    """Of the observer's error from sample to sample, the worst axis: (I - l C) Ad."""
    factor = np.asarray(ladrc.observer_factor)
    if np.all(factor == 1):
        return 0.0
    size = ladrc.order + 1
    correction = np.asarray(ladrc.gains.correction).reshape(size, -1)
    undriven = ladrc.observer.predict(list(jnp.eye(size)), jnp.zeros(size), ladrc.dt)
    predict = np.stack([np.asarray(row) for row in undriven])
    radii = []
    for gains in correction.T:
        left = np.eye(size) - np.outer(gains, np.eye(size)[0])
        radii.append(np.max(np.abs(np.linalg.eigvals(left @ predict))))
    return float(max(radii))
