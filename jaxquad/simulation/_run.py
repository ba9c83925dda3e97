import functools as ft
import math
import sys
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxquad._xla import as_one_kernel
from jaxquad.loops import Loop

from ._delay import Queue
from ._guard import are_sound, guarded
from ._members import common_ensemble, members_of_run, start_of
from ._sample import Carry, LoopStep, SampleResult, step_of
from ._scenario import Scenario


_SHORT = 128  # samples that need no blocks


def scan_in_blocks(
    step: Callable[..., tuple[PyTree, PyTree]],
    carry: PyTree,
    xs: PyTree,
    count: int,
    queue: Queue | None = None,
) -> tuple[PyTree, PyTree]:
    """`jax.lax.scan` whose reverse keeps the carry of blocks only, and of the one it is in.

    Twice the square root of `count` carries instead of all, for one forward pass more. With a
    `queue`, of which only blocks are kept, `step(carry, x, oldest)` returns (carry, (newest, y)).
    """
    size = _block_size(count)
    length = -(-count // size) * size
    if length > count:
        step, xs = _until(count, step), (jnp.arange(length), jax.tree.map(_lengthened(length), xs))
    # Within a scan nothing can be merged with the forward pass, so no barriers are needed.
    step = jax.checkpoint(step, prevent_cse=False)
    if queue is not None:
        step, carry, xs = _with_queue(step), (queue, carry), (jnp.arange(length), xs)

    @ft.partial(jax.checkpoint, prevent_cse=False)
    def block(carry: PyTree, xs: PyTree) -> tuple[PyTree, PyTree]:
        return jax.lax.scan(step, carry, xs)

    if length == size:
        carry, out = block(carry, xs)
    else:
        apart = lambda x: x.reshape(length // size, size, *x.shape[1:])
        carry, out = jax.lax.scan(block, carry, jax.tree.map(apart, xs))
        out = jax.tree.map(lambda x: x.reshape(length, *x.shape[2:])[:count], out)
    return (carry if queue is None else carry[1]), out


def _with_queue(step: Callable[..., tuple[PyTree, PyTree]]) -> Callable[..., tuple[PyTree, PyTree]]:
    """The queue changes outside of what reverse mode computes again: that would have to keep it."""

    def queued(both: tuple[Queue, PyTree], xs: tuple[Array, PyTree]) -> tuple[PyTree, PyTree]:
        (queue, carry), (index, now) = both, xs
        queue, oldest = queue.exchange(index)
        carry, (newest, out) = step(carry, now, oldest)
        return (queue._replace(newest=newest), carry), out

    return queued


def _until(count: int, step: Callable[..., tuple[PyTree, PyTree]]) -> Any:
    """The step, which leaves the carry as it is after `count` samples.

    A last block of another length would be compiled as a second loop.
    """

    def masked(carry: PyTree, xs: tuple[Array, PyTree], *oldest: Array) -> tuple[PyTree, PyTree]:
        index, now = xs
        after, out = step(carry, now, *oldest)
        return jax.tree.map(lambda new, old: jnp.where(index < count, new, old), after, carry), out

    return masked


def _lengthened(length: int) -> Callable[[Array], Array]:
    """With the last sample repeated."""
    return lambda x: jnp.concatenate([x, jnp.repeat(x[-1:], length - x.shape[0], axis=0)])


def _block_size(count: int) -> int:
    """Near the square root of `count`, and a divisor if there is one."""
    if count <= _SHORT:
        return count
    root = math.isqrt(count)
    near = sorted(range(root // 2, 2 * root + 1), key=lambda size: abs(size - root))
    return next((size for size in near if count % size == 0), root)


CHUNK = 128  # members: some hundred arrays of them fit a core's second cache
_VECTOR = 16  # members that are computed at once


def run_ensemble(
    step: Callable[[PyTree, PyTree, PyTree], tuple[PyTree, PyTree]],
    carry: PyTree,
    parts: PyTree,
    signals: PyTree,
    *,
    own: PyTree,
    chunk: int | None = None,
) -> tuple[PyTree, PyTree]:
    """`jax.lax.scan` of an ensemble of loops: the last carry, and what each sample left.

    `step(carry, parts, now)` returns the next carry and what is stored of a sample, for any number
    of members. `parts` do not change with time; `signals` are [samples, ...], of which `now` is one
    sample. Members are on the last axis: of all that a step returns and of the carry it starts
    from, and of what `own` is True for, which is a tree like (parts, signals), or the top of one.

    On a CPU each `chunk` of members, 128 if None, is one compiled kernel, if it is plain
    arithmetic; other devices take all members at once. Reverse mode keeps blocks of samples of one
    chunk at a time. To be called under `jax.jit`, with `compiler_options()` if that is the
    outermost one.
    """

    def loop(given: PyTree) -> tuple[PyTree, PyTree]:
        carry, (parts, signals) = given
        count = jax.tree.leaves(signals)[0].shape[0]
        return scan_in_blocks(lambda carry, now: step(carry, parts, now), carry, signals, count)

    theirs = (True, own)
    return in_chunks(lambda x: as_one_kernel(loop, x), (carry, (parts, signals)), theirs, chunk)


def in_chunks(
    function: Callable[[PyTree], PyTree], given: PyTree, own: PyTree, chunk: int | None = None
) -> PyTree:
    """`function(given)` for `chunk` members after the others, where there are more than these.

    None: 128 on a CPU, all of them elsewhere. `own` tells which arrays of `given` have the members
    on the last axis. Of a result without them the first chunk's is taken.
    """
    theirs, common = eqx.partition(given, own)
    members = jax.tree.leaves(theirs)[0].shape[-1]
    most = chunk or most_at_once()
    if members <= most:
        return function(given)
    number = -(-members // most)
    size = _size(-(-members // number), given)
    split = jax.tree.map(lambda x: _split(x, -(-members // size), size), theirs)
    # Within a map nothing can be merged with the forward pass, so no barriers are needed.
    run = jax.checkpoint(lambda x: function(eqx.combine(x, common)), prevent_cse=False)
    out = jax.lax.map(run, split)
    have = lambda x: x.ndim > 1 and x.shape[-1] == size
    return jax.tree.map(lambda x: _joined(x, members) if have(x) else x[0], out)


def most_at_once() -> int:
    """Members of a chunk."""
    return CHUNK if jax.default_backend() == "cpu" else sys.maxsize


def _size(least: int, given: PyTree) -> int:
    """Whole vectors, and no other axis' length, so that members can be told from it."""
    others = {n for x in jax.tree.leaves(given) for n in jnp.shape(x)}
    size = -(-least // _VECTOR) * _VECTOR
    while size in others:
        size += _VECTOR
    return size


def _split(x: Array, number: int, size: int) -> Array:
    """[number, ..., size], the last member repeated where there are too few."""
    missing = number * size - x.shape[-1]
    x = jnp.concatenate([x, jnp.repeat(x[..., -1:], missing, axis=-1)], axis=-1)
    return jnp.moveaxis(x.reshape(*x.shape[:-1], number, size), -2, 0)


def _joined(x: Array, members: int) -> Array:
    x = jnp.moveaxis(x, 0, -2)
    return x.reshape(*x.shape[:-2], -1)[..., :members]


Collect = Callable[[PyTree, SampleResult], tuple[PyTree, PyTree]]


def scan_loop(
    loop: Loop,
    scenario: Scenario,
    collect: Collect,
    begin: Callable[[Float[Array, " axes *ensemble"]], PyTree],
) -> tuple[PyTree, PyTree, Bool[Array, "*ensemble"]]:
    """Run a loop over a scenario: what was accumulated, what was stored, and who still runs.

    `collect(accumulated, now)` returns what is accumulated and what is stored of a sample;
    `begin(like)` is what it starts from, with `like` zeros `[axes, *ensemble]`. To be jitted by the
    caller, after `check_run`.
    """
    ensemble = common_ensemble(loop, scenario)
    state, like = start_of(loop.plant, scenario, ensemble)
    carry = (step_of(loop, ensemble).begin(state, like), begin(like))
    given = ((loop, scenario), carry, collect)
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
    own = members_of_run(parts)
    last = lambda x: eqx.is_array(x) and x.shape[-1:] == ensemble
    return None if own is None else (own, *jax.tree.map(last, others))


def _run(given: PyTree) -> tuple[PyTree, PyTree, Bool[Array, "*ensemble"]]:
    (loop, scenario), carry, collect = given
    step = step_of(loop, carry[0].running.shape)
    arrays, rest = eqx.partition((step, carry, scenario, collect), eqx.is_array)
    carried, stored = as_one_kernel(ft.partial(_scan, rest), arrays)
    return carried[1], stored, carried[0].running


def _scan(rest: PyTree, arrays: PyTree) -> tuple[PyTree, PyTree]:
    loop, carry, scenario, collect = eqx.combine(arrays, rest)
    parts, static = eqx.partition(loop, eqx.is_array)
    # Not a nan in sight; and an argument that is not used at all would end the kernel's compiler.
    sound = are_sound(arrays, loop.ensemble)
    queue = carry[0].queue
    start = carry[0]._replace(running=carry[0].running & sound, queue=None)
    at_rest = jax.lax.stop_gradient(start)

    def sample(inner: Carry, parts: LoopStep, now: PyTree) -> tuple[Carry, SampleResult]:
        return eqx.combine(parts, static).sample(inner, *now)

    def step(carry: PyTree, now: PyTree, *oldest: Array) -> tuple[PyTree, PyTree]:
        inner, result = guarded(sample, loop.ensemble, at_rest, carry[0], parts, (*now, *oldest))
        accumulated, output = collect(carry[1], result)
        if oldest:
            output = inner.queue.newest, output
        return (inner._replace(queue=None), accumulated), output

    count = scenario.reference.shape[0]
    return scan_in_blocks(step, (start, carry[1]), (jnp.arange(count), scenario), count, queue)
