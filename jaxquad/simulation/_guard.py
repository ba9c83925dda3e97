"""What keeps an unstable loop finite, in its values and in its derivatives.

A member whose angle leaves the bound, or whose numbers grow beyond all measure, is held where it
was from then on.
"""

import functools as ft
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, PyTree

from jaxquad._compile import KEPT


# In SI units no angle, rate, voltage or squared rotor speed comes near it.
VAST = 1e9


def within(x: Float[Array, " axes *ensemble"], bound: float) -> Float[Array, " axes *ensemble"]:
    """`x` kept within +-`bound`, and without a nan."""
    return jnp.clip(jnp.where(jnp.isnan(x), bound, x), -bound, bound)


def are_tame(tree: PyTree, ensemble: tuple[int, ...]) -> Bool[Array, "*ensemble"]:
    """Whether every float of a member is finite and not vast."""
    return _members(tree, ensemble, lambda x: jnp.abs(x) <= VAST)


def are_numbers(tree: PyTree, ensemble: tuple[int, ...]) -> Bool[Array, "*ensemble"]:
    """Whether no float of a member is nan (inf may be a bound or a spread that is not known)."""
    return _members(tree, ensemble, lambda x: ~jnp.isnan(x))


def are_sound(tree: PyTree) -> Bool[Array, ""]:
    """Whether the first number of every array is one."""
    firsts = [jnp.ravel(x)[:1] for x in jax.tree.leaves(tree)]
    checks = [jnp.all(x == x) for x in firsts]
    return ft.reduce(jnp.logical_and, checks, jnp.ones((), bool))


def choose(
    fresh: Bool[Array, "*ensemble"], new: PyTree, old: PyTree, ensemble: tuple[int, ...]
) -> PyTree:
    """Per member the `new` numbers or the `old`; what all members share is always new.

    So is a single integer, such as a count of samples, in a single loop, too: what happens at some
    samples only (`jax.lax.cond`) then stays so for all that are batched by `jax.vmap`.
    """

    def leaf(new: Array, old: Array) -> Array:
        count = new.ndim == 0 and jnp.issubdtype(new.dtype, jnp.integer)
        if count or not _is_per_member(new, ensemble):
            return new
        return jnp.where(fresh.reshape((1,) * (new.ndim - fresh.ndim) + ensemble), new, old)

    return jax.tree.map(leaf, new, old)


@ft.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def guarded(
    sample: Callable[..., PyTree], ensemble: tuple[int, ...], rest: PyTree, *args: PyTree
) -> PyTree:
    """`sample(*args)`, whose derivatives are those of the members that run after it.

    The first of `args` is the carry, which tells who runs; `rest` is one that is safe to step from.
    Reverse mode multiplies by a derivative even where its result is thrown away, and 0 * inf is
    nan. So the sample of a member that is held is differentiated at `rest`, and the result is 0.
    """
    return sample(*args)


@guarded.defjvp
def _guarded_jvp(sample, ensemble, primals, tangents):
    rest, carry, *others = primals
    following, result = sample(carry, *others)
    runs = _keep(following.running)
    out = following._replace(running=runs), jax.tree.map(_keep, result)
    carry = choose(runs, carry, rest, ensemble)
    moved = jax.jvp(sample, (carry, *others), tangents[1:])[1]
    still = jax.tree.map(lambda t: t if _is_void(t) else jnp.zeros_like(t), moved)
    return out, choose(runs, moved, still, ensemble)


def _keep(x: Array) -> Array:
    """For reverse mode: who runs, and what was measured."""
    return checkpoint_name(x, KEPT)


def _is_void(tangent: Array) -> bool:
    """Of an integer, which has no tangent."""
    return tangent.dtype == jax.dtypes.float0


def _members(tree: PyTree, ensemble: tuple[int, ...], valid) -> Bool[Array, "*ensemble"]:
    checks = [jnp.ones(ensemble, bool)]
    for x in jax.tree.leaves(tree):
        if jnp.issubdtype(x.dtype, jnp.floating) and _is_per_member(x, ensemble):
            checks.append(jnp.all(valid(x), axis=tuple(range(x.ndim - len(ensemble)))))
    return ft.reduce(jnp.logical_and, checks)


def _is_per_member(x: Array, ensemble: tuple[int, ...]) -> bool:
    shared = x.ndim - len(ensemble)
    return shared >= 0 and x.shape[shared:] == ensemble and not _is_void(x)
