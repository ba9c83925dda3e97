"""Which arrays of a loop have one value for each member of its ensemble."""

import itertools as it
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad.loops import Controller, Loop, Plant

from ._sample import step_of
from ._scenario import Scenario


def common_ensemble(loop: Loop, scenario: Scenario) -> tuple[int, ...]:
    """The trailing shape that all parts of a loop ask for together. Raises ValueError for none."""
    axes = scenario.reference.shape[1]
    shapes = {
        "plant": jax.eval_shape(lambda: loop.plant.measure(loop.plant.init())).shape[1:],
        "controller": _of_controller(loop.controller, axes),
        "scenario": scenario.ensemble,
        "delay": loop.delay.shape,
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


_MOST = 5  # groups of arrays that are tried together
_OTHER = 7919  # a number of members that no other axis has


def count_members(run: tuple[Loop, Scenario]) -> int:
    """How many a loop and its scenario have on the last axis of the ensemble."""
    return (1, *common_ensemble(*run))[-1]


def members_of_run(run: tuple[Loop, Scenario]) -> PyTree | None:
    """`per_member` of a loop and its scenario.

    None, too, for a controller that holds its number of members fixed.
    """
    return per_member(_one_sample, run, count_members(run))


def _one_sample(parts: PyTree) -> Array:
    """Who runs after the first sample: a number for each member, by all that is in the loop."""
    loop, scenario = parts
    ensemble = common_ensemble(loop, scenario)
    state, like = start_of(loop.plant, scenario, ensemble)
    step = step_of(loop, ensemble)
    carry = step.begin(state, like)
    return step.sample(carry, jnp.zeros((), int), jax.tree.map(lambda x: x[0], scenario))[0].running


def per_member(run: Callable[[PyTree], Array], tree: PyTree, members: int) -> PyTree | None:
    """True for each leaf whose last axis counts the members, False for the others and for no array.

    `run(tree)` has the members on its last axis. Another axis may be as long, such as the knots of
    a table or the axes of a vehicle; so what counts as the members' is the least that has to be
    resized for another number of members to run. `None` if nothing does.
    """
    paths, structure = jax.tree_util.tree_flatten_with_path(tree)
    leaves = [leaf for _, leaf in paths]
    runs = lambda chosen: _runs_with_others(run, leaves, structure, chosen)
    long = {k for k, x in enumerate(leaves) if eqx.is_array(x) and x.shape[-1:] == (members,)}
    groups = _alike(long, paths)
    chosen = next((x for x in _choices(groups) if runs(x)), None)
    if chosen is None:
        return None
    for part in [*groups, *({k} for k in sorted(chosen))]:
        if chosen & part and chosen - part and runs(chosen - part):
            chosen = chosen - part
    return jax.tree.unflatten(structure, [k in chosen for k in range(len(leaves))])


def _alike(chosen: set[int], paths: list[Any]) -> list[set[int]]:
    """Leaves of one module and one rank together, as the two columns of a table are."""
    groups: dict[Any, set[int]] = {}
    for k in sorted(chosen):
        path, leaf = paths[k]
        groups.setdefault((path[:-1], leaf.ndim), set()).add(k)
    return list(groups.values())


def _choices(groups: list[set[int]]) -> Iterator[set[int]]:
    """What may be the members': first all, as it is but for few members, then ever more groups."""
    yield set().union(*groups)
    for count in range(1, min(len(groups), _MOST)):
        yield from (set().union(*some) for some in it.combinations(groups, count))


def _runs_with_others(run: Any, leaves: list[Any], structure: Any, chosen: set[int]) -> bool:
    """Whether `run` has as many members as the `chosen` leaves, however many those have."""

    def changed(k: int, x: Any) -> Any:
        if not eqx.is_array(x):
            return x
        shape = (*x.shape[:-1], _OTHER) if k in chosen else x.shape
        return jax.ShapeDtypeStruct(shape, x.dtype)

    others = jax.tree.unflatten(structure, [changed(k, x) for k, x in enumerate(leaves)])
    try:
        out = eqx.filter_eval_shape(run, others)
    except Exception:  # Arrays that do not fit raise whatever the user's own code makes of them.
        return False
    return out.shape[-1:] == (_OTHER,)
