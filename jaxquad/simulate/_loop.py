import functools as ft
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ._blocks import scan_in_blocks
from ._ensemble import common_ensemble, start_of
from ._guard import are_sound, guarded
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
    prepared = getattr(controller, "prepared", lambda: controller)
    loop = Loop(plant, prepared(), settings, ensemble)
    carry = (loop.begin(state, like), begin(like))
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
