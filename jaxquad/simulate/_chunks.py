"""An ensemble computed a few members after the others, so that they stay in a CPU's cache."""

import sys
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ._blocks import scan_in_blocks
from ._small_call import as_one_kernel


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
