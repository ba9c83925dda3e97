from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ._protocols import Controller, Plant
from ._scenario import Scenario
from ._settings import Settings


def common_ensemble(
    plant: Plant, controller: Controller, scenario: Scenario, settings: Settings
) -> tuple[int, ...]:
    """The trailing shape that all parts of a loop ask for together. Raises ValueError for none."""
    axes = scenario.reference.shape[1]
    line = settings.line
    shapes = {
        "plant": jax.eval_shape(lambda: plant.measure(plant.init())).shape[1:],
        "controller": _of_controller(controller, axes),
        "scenario": scenario.ensemble,
        "delay": () if line is None else line.samples.shape,
    }
    try:
        return np.broadcast_shapes(*shapes.values())
    except ValueError:
        text = ", ".join(f"{name} {shape}" for name, shape in shapes.items() if shape)
        raise ValueError(
            f"the parts of the loop are for different ensembles, {text}: make them one shape"
        ) from None


def _of_controller(controller: Controller, axes: int) -> tuple[int, ...]:
    told = getattr(controller, "ensemble", None)
    if told is not None:
        return told
    gains = [x for x in jax.tree.leaves(controller) if eqx.is_array(x) and x.ndim > 1]
    shapes = {x.shape[1:] for x in gains if x.shape[0] == axes}
    return () if not shapes or _serves_one(controller, axes) else np.broadcast_shapes(*shapes)


def _serves_one(controller: Controller, axes: int) -> bool:
    """Whether gains of two dimensions couple the axes of one loop, instead of an ensemble's."""
    like = jnp.zeros(axes)
    run: Any = lambda: controller.step(controller.init(like), like, like)[1]
    try:
        return jax.eval_shape(run).shape == (axes,)
    except (ValueError, TypeError):
        return False


def start_of(
    plant: Plant, scenario: Scenario, ensemble: tuple[int, ...]
) -> tuple[PyTree, Float[Array, " axes *ensemble"]]:
    """The plant at rest with as many axes as the scenario, and zeros shaped as its angles."""
    axes = scenario.reference.shape[1]
    state = plant.init(ensemble=ensemble)
    angle = jax.eval_shape(plant.measure, state)
    if angle.shape[0] == 1 < axes:  # one set of parameters for all axes
        state = plant.init(jnp.zeros(axes, angle.dtype), ensemble=ensemble)
        angle = jax.eval_shape(plant.measure, state)
    if angle.shape == (axes, *ensemble):
        return state, jnp.zeros(angle.shape, angle.dtype)
    raise ValueError(
        f"the scenario is for {axes} axes, but the plant's angles have the shape {angle.shape} in "
        f"an ensemble of {ensemble}: give a scenario with axes={angle.shape[0]}"
    )
