"""A loop in a scenario, from the first sample to the last."""

import math
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxquad._compile import in_chunks, most_at_once, scan_members
from jaxquad._core import ensemble_shape, is_concrete, mark_members
from jaxquad.loops import CarriesPayload, Loop, Plant

from ._guard import are_sound, guarded
from ._scenario import Scenario
from ._step import Carry, LoopStep, make_step, require_runnable, SampleResult


def check_run(loop: Loop, scenario: Scenario) -> None:
    """Raises ValueError for a loop that cannot run, and for a scenario that does not fit it."""
    if not isinstance(loop, Loop):
        raise ValueError(f"loop is a {type(loop).__name__}: give jq.Loop(plant, controller, ...)")
    if not isinstance(scenario, Scenario):
        raise ValueError(
            f"scenario is a {type(scenario).__name__}: give jq.scenario(duration=..., ...)"
        )
    require_runnable(loop.controller)
    if scenario.dt is not None and not math.isclose(scenario.dt, loop.dt, rel_tol=1e-6):
        raise ValueError(
            f"the scenario is sampled every {scenario.dt} s, but the loop runs every {loop.dt} s: "
            f"give jq.scenario(..., dt={loop.dt}), or a loop with dt={scenario.dt}"
        )
    if scenario.payload is not None:
        _check_payload(loop.plant, scenario.payload)
    for name, part in scenario.parts.items():
        if is_concrete(part):
            _check_numbers(name, part)


def _check_payload(plant: Plant, payload: Float[Array, "samples axes ..."]) -> None:
    if not isinstance(plant, CarriesPayload):
        raise ValueError(
            f"the scenario has a payload, but {type(plant).__name__} has no "
            "with_added_inertia(inertia) to carry it: add that method, or leave the payload None"
        )
    if is_concrete(payload):  # the plant refuses one that leaves it without inertia
        plant.with_added_inertia(np.min(np.asarray(payload), axis=0))


def _check_numbers(name: str, part: Float[Array, "samples axes ..."]) -> None:
    finite = np.isfinite(np.asarray(part))
    if not finite.all():
        bad = np.flatnonzero(~finite.all(axis=tuple(range(1, part.ndim))))
        raise ValueError(
            f"the scenario's {name} is not finite at sample {bad[0]}: look for the nan or inf in it"
        )


@runtime_checkable
class Accumulator(Protocol):
    """What a run of a loop adds up, and what it stores.

    A frozen module: arrays that differ between members are fields made by `per_member`. All results
    have the members on their last axis.
    """

    def begin(self, like: Float[Array, " axes *ensemble"]) -> PyTree:
        """The total before the first sample; `like` is zeros."""
        ...

    def update(self, total: PyTree, now: SampleResult, /) -> tuple[PyTree, PyTree]:
        """The total after one sample more, and what is stored of it."""
        ...


def scan_loop(
    loop: Loop, scenario: Scenario, accumulator: Accumulator
) -> tuple[PyTree, PyTree, Bool[Array, "*ensemble"]]:
    """Run a loop over a scenario: what was accumulated, what was stored, and who still runs.

    To be jitted by the caller, after `check_run`.
    """
    given, ensemble = (loop, scenario, accumulator), ensemble_shape(loop, scenario)
    most = _most_at_once(given, ensemble)
    if len(ensemble) != 1 or ensemble[0] <= most:
        return _run(given, ensemble)
    arrays, rest = eqx.partition(given, eqx.is_array)

    def run(arrays: PyTree) -> PyTree:
        given = eqx.combine(arrays, rest)
        return _run(given, ensemble_shape(*given[:2]))

    return in_chunks(run, arrays, mark_members(given, ensemble), most)


_Given = tuple[Loop, Scenario, Accumulator]
_FEW = 16  # members that are one chunk


def _most_at_once(given: _Given, ensemble: tuple[int, ...]) -> int:
    if math.prod(ensemble) <= _FEW:
        return _FEW
    carry, total = jax.eval_shape(lambda: _begin(given, ensemble)[1])
    return most_at_once((carry._replace(queue=None), total), ensemble[-1])


def _begin(given: _Given, ensemble: tuple[int, ...]) -> tuple[LoopStep, tuple[Carry, PyTree]]:
    """What runs the loop, and its carry before the first sample."""
    loop, scenario, accumulator = given
    step = make_step(loop, ensemble)
    state, like = _at_rest(loop.plant, scenario, ensemble)
    return step, (step.begin(state, like), accumulator.begin(like))


def _run(
    given: _Given, ensemble: tuple[int, ...]
) -> tuple[PyTree, PyTree, Bool[Array, "*ensemble"]]:
    step, (start, total) = _begin(given, ensemble)
    _, scenario, accumulator = given
    sound = are_sound(eqx.filter((step, start, total, scenario, accumulator), eqx.is_array))
    queue, start = start.queue, start._replace(running=start.running & sound, queue=None)
    arrays, static = eqx.partition((step, accumulator), eqx.is_array)

    def sample(inner: Carry, parts: PyTree, now: PyTree) -> tuple[Carry, SampleResult]:
        step, _ = eqx.combine(parts, static)
        return step.sample(inner, *now)

    def advance(carry: PyTree, parts: PyTree, now: PyTree, *oldest: Array) -> tuple[PyTree, PyTree]:
        parts, at_rest = parts
        inner, result = guarded(sample, ensemble, at_rest, carry[0], parts, (*now, *oldest))
        _, accumulator = eqx.combine(parts, static)
        total, output = accumulator.update(carry[1], result)
        if oldest:
            output = inner.queue.newest, output
        return (inner._replace(queue=None), total), output

    parts = arrays, jax.lax.stop_gradient(start)
    signals = jnp.arange(len(scenario.reference)), scenario
    members = ensemble[0] if len(ensemble) == 1 else None
    carried, stored = scan_members(
        advance, (start, total), parts, signals, members=members, queue=queue
    )
    return carried[1], stored, carried[0].running


def _at_rest(
    plant: Plant, scenario: Scenario, ensemble: tuple[int, ...]
) -> tuple[PyTree, Float[Array, " axes *ensemble"]]:
    """The plant at rest, and zeros shaped as its angles; raise ValueError for other axes."""
    axes = scenario.reference.shape[1]
    state = plant.init(ensemble=ensemble)
    angle = jax.eval_shape(plant.measure, state)
    if angle.shape == (axes, *ensemble):
        return state, jnp.zeros(angle.shape, angle.dtype)
    if angle.shape[0] != axes:
        raise ValueError(
            f"the scenario is for {axes} axes, but the plant has {angle.shape[0]}: give "
            f"jq.scenario(..., axes={angle.shape[0]}), or a plant with a value for each axis"
        )
    raise ValueError(
        f"the plant's angles have the shape {angle.shape}, but {(axes, *ensemble)} is expected: "
        "make fields that differ between members by jq.loops.per_member, and let "
        "init(euler, ensemble=...) give a state as wide as the ensemble"
    )
