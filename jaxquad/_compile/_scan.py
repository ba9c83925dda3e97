"""Scans over the members of an ensemble: the one entry to kernels, and what needs no compiler.

Long scans run in blocks and large ensembles in chunks, which keeps gradients and caches small.
"""

import math
import sys
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ._door import compilers


# What reverse mode keeps of a sample, by `checkpoint_name`. Otherwise it would compute each sample
# twice, for these numbers and for the derivatives.
KEPT = "kept_of_sample"
_POLICY = jax.checkpoint_policies.save_only_these_names(KEPT)
_SHORT = 128  # samples that need no blocks
_LONG = 8  # samples of a queue, from which on no block is longer than it
SINGLE, _SOME = 8, 64  # members up to which a loop is compiled as a single one, and briefly
Step = Callable[..., tuple[PyTree, PyTree]]
Queue = Float[Array, "waiting inputs *ensemble"]  # on their way to the plant, the oldest first


def scan_members(
    step: Step, carry: PyTree, parts: PyTree, signals: PyTree, *, members: int | None = None,
    queue: Queue | None = None,
) -> tuple[PyTree, PyTree]:  # fmt: skip
    """`jax.lax.scan` of `step(carry, parts, now)`: the last carry, and what each sample stored.

    A CPU runs it as one kernel, and an NVIDIA GPU the loop of an ensemble, where the compilers can
    make them; else it is a plain scan of the same numbers. All arguments but `step` are arrays.

    **Arguments:**

    - `parts`: what does not change with time.
    - `signals`: [samples, ...], of which `now` is one sample.
    - `members`: on the last axis of the carry; None for a single loop, or for more axes.
    - `queue`: then `step(carry, parts, now, oldest)` returns (carry, (newest, stored)), and what is
        newest in a sample is the oldest `len(queue)` samples later.
    """
    few = members is not None and are_few(members)

    def blocks(
        carry: PyTree, parts: PyTree, signals: PyTree, queue: Queue | None
    ) -> tuple[PyTree, PyTree]:
        advance = lambda carry, *now: step(carry, parts, *now)
        return scan_in_blocks(advance, carry, signals, queue, few)

    def with_rows(both: tuple[tuple[Array, ...], PyTree], now: PyTree) -> tuple[PyTree, PyTree]:
        """Hands the queue on row by row: a GPU's kernel has no place that is known only later."""
        (oldest, *rows), carry = both
        carry, (newest, out) = step(carry, parts, now, oldest)
        return ((*rows, newest), carry), out

    if members is not None and compilers().why_no_device_kernels() is None:
        advance, begun = lambda carry, now: step(carry, parts, now), carry
        if queue is not None:
            advance, begun = with_rows, (tuple(queue), carry)
        result = compilers().scan_on_device(advance, begun, signals, members, scan_in_blocks)
        if result is not None:
            return result if queue is None else (result[0][1], result[1])
    return compilers().as_one_kernel(blocks, carry, parts, signals, queue)


def are_few(members: int) -> bool:
    """Whether a loop of so many takes longer to compile than to run, and is no single loop."""
    return SINGLE < members <= _SOME


def scan_in_blocks(
    step: Step, carry: PyTree, xs: PyTree, queue: Queue | None = None, few: bool = False
) -> tuple[PyTree, PyTree]:
    """`jax.lax.scan` whose reverse keeps the carry of blocks only, and of the one it is in.

    Twice the square root of the samples' number of carries instead of all, for one forward pass
    more. With a `queue`, `step(carry, x, oldest)` returns (carry, (newest, y)). The reverse of
    `few` members is kernels that two cores compile at once.
    """
    count = len(jax.tree.leaves(xs)[0])
    waits = 0 if queue is None else len(queue)
    size, most = count, count if waits < _LONG else min(count, waits)
    if count > min(most, _SHORT):  # near the square root of `count`, and a divisor if there is one
        root = min(math.isqrt(count), most)
        near = range(root // 2, min(2 * root, most) + 1)
        divisors = [size for size in near if count % size == 0]
        size = min(divisors, key=lambda size: abs(size - root), default=root)
    length = -(-count // size) * size

    def until_count(carry: PyTree, xs: tuple[Array, PyTree], *oldest: Array) -> PyTree:
        """Leaves the carry as it is after `count`: a last block of another length would be
        compiled as a second loop."""
        index, now = xs
        after, out = step(carry, now, *oldest)
        return jax.tree.map(lambda new, old: jnp.where(index < count, new, old), after, carry), out

    longer = lambda x: jnp.concatenate([x, jnp.repeat(x[-1:], length - count, axis=0)])
    sample = step
    if length > count:
        sample, xs = until_count, (jnp.arange(length), jax.tree.map(longer, xs))
    # Within a scan nothing can be merged with the forward pass, so no barriers are needed.
    sample = jax.checkpoint(sample, prevent_cse=False, policy=_POLICY)

    def by_sample(both: tuple[Queue, PyTree], now: PyTree) -> tuple[PyTree, PyTree]:
        """Moves a short queue by one place, outside of what reverse mode computes again."""
        queue, carry = both
        carry, (newest, out) = sample(carry, now, queue[0])
        return (jnp.concatenate([queue[1:], newest[None]]), carry), out

    def jaxquad_block(carry: PyTree, xs: PyTree, arriving: Queue | None) -> tuple[PyTree, PyTree]:
        if arriving is not None:
            return jax.lax.scan(lambda carry, now: sample(carry, *now), carry, (xs, arriving))
        return jax.lax.scan(sample if queue is None else by_sample, carry, xs)

    # A function of this name becomes kernels of its own where it is computed again and reversed:
    # two cores compile these two at once, and the time of both grows faster than their operations.
    block = jax.checkpoint(jax.jit(jaxquad_block) if few else jaxquad_block, prevent_cse=False)

    def by_block(both: tuple[Queue, PyTree], xs: PyTree) -> tuple[PyTree, PyTree]:
        """What arrives in a block was sent before it: reverse mode sums no queue in its samples."""
        queue, carry = both
        parts = (size, waits - size) if waits > size else (size,)
        arriving, *later = jax.lax.split(queue, parts)  # slices have sums as their reverse
        carry, (sent, out) = block(carry, xs, arriving)
        return (jnp.concatenate([*later, sent]), carry), out

    run = lambda carry, xs: block(carry, xs, None) if waits < _LONG else by_block(carry, xs)
    carry = carry if queue is None else (queue, carry)
    if length == size:
        carry, out = run(carry, xs)
    else:
        in_rows = lambda x: x.reshape(length // size, size, *x.shape[1:])
        carry, out = jax.lax.scan(run, carry, jax.tree.map(in_rows, xs))
        out = jax.tree.map(lambda x: x.reshape(length, *x.shape[2:])[:count], out)
    return (carry if queue is None else carry[1]), out


_CHUNK = 128  # members: some hundred arrays of them fit a core's second cache
_VECTOR = 16  # members that are computed at once
_WIDEST = 4095  # numbers of an array in a kernel


def run_ensemble(
    step: Callable[[PyTree, PyTree, PyTree], tuple[PyTree, PyTree]], carry: PyTree, parts: PyTree,
    signals: PyTree, *, of_members: PyTree, chunk: int | None = None,
) -> tuple[PyTree, PyTree]:  # fmt: skip
    """`jax.lax.scan` of an ensemble of loops: the last carry, and what each sample left.

    On a CPU each chunk of members is one compiled kernel, if it is plain arithmetic. Other devices
    take all members at once, and an NVIDIA GPU runs the whole loop as one kernel. Reverse mode
    keeps blocks of samples of one chunk at a time. To be called under `jax.jit`, with
    `compiler_options()` if that is the outermost one.

    **Arguments:**

    - `step`: `step(carry, parts, now)` returns the next carry and what is stored of a sample, for
        any number of members, which are on the last axis of all that it returns.
    - `carry`: before the first sample, with the members on the last axis.
    - `parts`: what does not change with time.
    - `signals`: [samples, ...], of which `now` is one sample.
    - `of_members`: True for the arrays of (parts, signals) that have the members on their last
        axis; a tree like these, or the top of one.
    - `chunk`: members at a time; None is 128 on a CPU, or as many as a kernel holds.

    **Raises:** ValueError for a result that does not have the members on its last axis.
    """

    def scan(args: PyTree) -> tuple[PyTree, PyTree]:
        carry, (parts, signals) = args
        members = jax.tree.leaves(carry)[0].shape[-1]
        return scan_members(step, carry, parts, signals, members=members)

    chunk = chunk or most_at_once(carry, jax.tree.leaves(carry)[0].shape[-1])
    return in_chunks(scan, (carry, (parts, signals)), (True, of_members), chunk)


def in_chunks(
    function: Callable[[PyTree], PyTree], args: PyTree, of_members: PyTree, chunk: int | None = None
) -> PyTree:
    """`function(args)` for `chunk` members after the others, where there are more than these.

    None: 128 on a CPU, all of them elsewhere. `of_members` tells which arrays of `args` have the
    members on the last axis; all results must have them there, or a ValueError is raised.
    """
    theirs, common = eqx.partition(args, of_members)
    members = jax.tree.leaves(theirs)[0].shape[-1]
    number = -(-members // (chunk or most_at_once()))
    size = -(-members // (number * _VECTOR)) * _VECTOR  # equal chunks, whole vectors long
    if members <= size:
        return function(args)
    firsts = np.minimum(np.arange(0, members, size), members - size)  # the last two may overlap

    def in_rows(x: Array) -> Array:
        """[chunks, ..., size]."""
        rows = x[..., : size * (len(firsts) - 1)].reshape(*x.shape[:-1], len(firsts) - 1, size)
        return jnp.moveaxis(jnp.concatenate([rows, x[..., None, -size:]], axis=-2), -2, 0)

    # Within a scan nothing can be merged with the forward pass, so no barriers are needed.
    run = jax.checkpoint(lambda x: function(eqx.combine(x, common)), prevent_cse=False)

    def room(x: jax.ShapeDtypeStruct) -> Array:
        """For the results of all members: joined at the end, they would be written twice."""
        if len(x.shape) < 1 or x.shape[-1] != size:
            raise ValueError(
                f"a result has the shape {x.shape}, but the {size} members of a chunk belong on "
                "its last axis: return what each member gives, and nothing that they share"
            )
        return jnp.zeros((*x.shape[:-1], members), x.dtype)

    def put(joined: PyTree, now: tuple[Array, PyTree]) -> tuple[PyTree, None]:
        first, few = now
        place = lambda old, x: jax.lax.dynamic_update_slice_in_dim(old, x, first, old.ndim - 1)
        return jax.tree.map(place, joined, run(few)), None

    few = jax.tree.map(in_rows, theirs)
    shapes = jax.eval_shape(run, jax.tree.map(lambda x: x[0], few))
    return jax.lax.scan(put, jax.tree.map(room, shapes), (jnp.asarray(firsts), few))[0]


def most_at_once(carry: PyTree = None, members: int = 1) -> int:
    """Members of a chunk: as many as a kernel holds of the widest array in the `carry` of all."""
    if jax.default_backend() != "cpu":
        return sys.maxsize
    theirs = [x.size for x in jax.tree.leaves(carry) if x.shape[-1:] == (members,)]
    fitting = _WIDEST * members // max(theirs, default=members) // _VECTOR * _VECTOR
    return min(_CHUNK, fitting) or _CHUNK
