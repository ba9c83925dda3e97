import functools as ft
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ._blocks import scan_in_blocks
from ._chunks import in_chunks, most_at_once
from ._ensemble import common_ensemble, start_of
from ._guard import are_sound, guarded
from ._members import members_of_loop
from ._protocols import Controller, Plant
from ._sample import Carry, Loop, SampleResult
from ._scenario import Scenario
from ._settings import Settings
from ._small_call import as_one_kernel


Collect = Callable[[PyTree, SampleResult], tuple[PyTree, PyTree]]


def scan_loop(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    settings: Settings,
    collect: Collect,
    begin: Callable[[Float[Array, " axes *ensemble"]], PyTree],
) -> tuple[PyTree, PyTree, Bool[Array, "*ensemble"]]:
    """Run a loop over a scenario: what was accumulated, what was stored, and who still runs.

    `collect(accumulated, now)` returns what is accumulated and what is stored of a sample;
    `begin(like)` is what it starts from, with `like` zeros `[axes, *ensemble]`. To be jitted by the
    caller, after `check_loop`.
    """
    ensemble = common_ensemble(plant, controller, scenario, settings)
    state, like = start_of(plant, scenario, ensemble)
    carry = (_loop(plant, controller, settings, ensemble).begin(state, like), begin(like))
    given = ((plant, controller, scenario, settings), carry, collect)
    own = _of_members(given, ensemble)
    if own is None:
        return _run(given)
    arrays, rest = eqx.partition(given, eqx.is_array)
    try:
        return in_chunks(lambda arrays: _run(eqx.combine(arrays, rest)), arrays, own)
    except (TypeError, ValueError):  # `collect` has the members of all chunks where none can see.
        return _run(given)


def _of_members(given: PyTree, ensemble: tuple[int, ...]) -> PyTree | None:
    """Which arrays have the members on the last axis, where these are so many that it matters."""
    if len(ensemble) != 1 or ensemble[0] <= most_at_once():
        return None
    parts, *others = given
    own = members_of_loop(parts)
    last = lambda x: eqx.is_array(x) and x.shape[-1:] == ensemble
    return None if own is None else (own, *jax.tree.map(last, others))


def _loop(
    plant: Plant, controller: Controller, settings: Settings, ensemble: tuple[int, ...]
) -> Loop:
    prepared = getattr(controller, "prepared", lambda: controller)
    return Loop(plant, prepared(), settings, ensemble)


def _run(given: PyTree) -> tuple[PyTree, PyTree, Bool[Array, "*ensemble"]]:
    (plant, controller, scenario, settings), carry, collect = given
    loop = _loop(plant, controller, settings, carry[0].running.shape)
    arrays, rest = eqx.partition((loop, carry, scenario, collect), eqx.is_array)
    carried, stored = as_one_kernel(ft.partial(_scan, rest), arrays)
    return carried[1], stored, carried[0].running


def _scan(rest: PyTree, arrays: PyTree) -> tuple[PyTree, PyTree]:
    loop, carry, scenario, collect = eqx.combine(arrays, rest)
    parts, static = eqx.partition(loop, eqx.is_array)
    # Not a nan in sight; and an argument that is not used at all would end the kernel's compiler.
    sound = are_sound(arrays, loop.ensemble)
    carry = (carry[0]._replace(running=carry[0].running & sound), carry[1])
    at_rest = jax.lax.stop_gradient(carry[0])

    def sample(inner: Carry, parts: Loop, now: PyTree) -> tuple[Carry, SampleResult]:
        return eqx.combine(parts, static).sample(inner, *now)

    def step(carry: PyTree, now: PyTree) -> tuple[PyTree, PyTree]:
        inner, result = guarded(sample, loop.ensemble, at_rest, carry[0], parts, now)
        accumulated, output = collect(carry[1], result)
        return (inner, accumulated), output

    count = scenario.reference.shape[0]
    return scan_in_blocks(step, carry, (jnp.arange(count), scenario), count)
