"""The time loop of an ensemble as one kernel on an accelerator, with its derivatives.

XLA launches some kernels for every sample there, and the launches take longer than the arithmetic.
Forward and reverse mode are one kernel each (`_loop`). Forward-mode derivatives, second
ones and batches of ensembles run as plain scans.
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun, Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from ._cuda import CannotCompile
from ._lanes import NotInLanes, NUMBERS, numbers
from ._loop import (
    Flat,
    held_bytes,
    is_float,
    Loop,
    reverse_in_lanes,
    segments_of,
    Shaped,
    size,
    split,
    step_in_lanes,
    without_invariants,
)
from ._passes import BLOCK, holds_cotangents, kept_avals, memory_type, run_forward, run_reverse
from ._switch import note, Result, Scan, Step, warn_once


def scan_in_kernel(
    step: Step, carry: PyTree, signals: PyTree, members: int, scan: Scan
) -> Result | None:
    """`scan(step, carry, signals)`; None, and a note for `engine()`, where no kernel holds it."""
    jaxpr, consts, result = _trace(step, carry, signals)
    jaxpr, consts = without_invariants(jaxpr, consts, members)
    first, now = jax.tree.leaves(carry), jax.tree.leaves(signals)
    carried, doubles = _bytes_of(first, members)
    fixed, fixed_doubles = _bytes_of(consts, members)
    # The carry and its cotangents, what is fixed and the cotangents of that.
    shared = held_bytes(2 * carried + 2 * fixed, doubles + 2 * fixed_doubles, BLOCK)
    segments = segments_of(len(now[0]) if now else 0, carried, members, BLOCK, shared)
    loop = Loop(jaxpr, len(consts), len(first), members, segments)
    reason = _why_not(loop)
    if reason is not None:
        note(f"a kernel of a GPU does not hold {reason}")
        return None
    results = _loop.bind(*consts, *first, *now, loop=loop, scan=scan, keep=False)
    return jax.tree.unflatten(result, results)


def _bytes_of(arrays: Sequence[Array], members: int) -> tuple[int, int]:
    """Of a member's numbers, and of those with eight bytes."""
    sizes = [(numbers(x.shape, members), memory_type(x.dtype).itemsize) for x in arrays]
    return sum(n * size for n, size in sizes), sum(n * size for n, size in sizes if size == 8)


def _trace(step: Step, carry: PyTree, signals: PyTree) -> tuple[ClosedJaxpr, list[Array], PyTree]:
    """The step as a jaxpr of (consts, carry, now), what it takes from around it, and its result."""
    now = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), signals)
    closed, result = jax.make_jaxpr(step, return_shape=True)(carry, now)
    consts = [x for x in closed.consts if isinstance(x, jax.Array)]

    def opened(*args: Array) -> list[Array]:
        fresh = iter(args)
        values = [next(fresh) if isinstance(x, jax.Array) else x for x in closed.consts]
        return jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, values))(*fresh)

    shaped = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in (*consts, *closed.in_avals)]
    return jax.make_jaxpr(opened)(*shaped), consts, jax.tree.structure(result)


_MOST_HELD = 128  # numbers between two samples: a thread has 255 registers
_MOST_ARRAYS = 200  # a kernel has 4 kB of parameters, and the reverse one twice this and some more


def _why_not(loop: Loop) -> str | None:
    carry, after = loop.avals[1], loop.results[0]
    if not loop.avals[2]:
        return "a loop without signals"
    if any((a.shape, a.dtype) != (b.shape, b.dtype) for a, b in zip(carry, after, strict=True)):
        return "a carry that changes its shape"
    carried = sum(size(loop, x) for x in carry)
    if carried > _MOST_HELD:
        return f"a carry of {carried} numbers for each member"
    if len(loop.inputs) + len(loop.out) > _MOST_ARRAYS:
        return f"a step of more than {_MOST_ARRAYS} arrays"
    for x in (*loop.inputs, *loop.out):
        if x.dtype not in NUMBERS:
            return f"values of {x.dtype}"
    return _fits(ft.partial(step_in_lanes, loop))


def _fits(write: Callable[[], object]) -> str | None:
    try:
        write()
    except NotInLanes as reason:
        return str(reason)
    except Exception as error:  # JAX's operations have changed: do without the kernel.
        warn_once(f"JAX {jax.__version__} cannot write a kernel ({type(error).__name__}: {error})")
        return f"a step that fails with {type(error).__name__}"
    return None


def _run_plain(loop: Loop, scan: Scan, *args: Array) -> Flat:
    consts, carry, signals = split(args, loop.consts, loop.carry)
    step = jaxpr_as_fun(loop.step)

    def sample(carry: Flat, now: Flat) -> tuple[Flat, Flat]:
        carry, stored = split(step(*consts, *carry, *now), loop.carry)
        return carry, stored

    carry, stored = scan(sample, carry, signals)
    return [*carry, *stored]


def _plain(*args: Array, loop: Loop, scan: Scan, keep: bool) -> Flat:
    # What is kept is for kernels.
    kept = [jnp.zeros(x.shape, x.dtype) for x in kept_avals(loop)] if keep else []
    return [*_run_plain(loop, scan, *args), *kept]


def _of_wanted(
    loop: Loop, scan: Scan, args: Sequence[Array], which: tuple[bool, ...]
) -> tuple[Callable[..., Flat], Flat]:
    """The float results as a function of the arguments in `which`, and these."""

    def function(*some: Array) -> Flat:
        fresh = iter(some)
        values = [next(fresh) if w else x for w, x in zip(which, args, strict=True)]
        return [x for x in _run_plain(loop, scan, *values) if is_float(x.dtype)]

    return function, [x for w, x in zip(which, args, strict=True) if w]


def _plain_tangents(*args: Array, loop: Loop, scan: Scan, which: tuple[bool, ...]) -> Flat:
    """Of (arguments, kept, tangents)."""
    primals, _, tangents = split(args, len(which), len(kept_avals(loop)))
    function, some = _of_wanted(loop, scan, primals, which)
    return jax.jvp(function, some, tangents)[1]


def _plain_cotangents(*args: Array, loop: Loop, scan: Scan, which: tuple[bool, ...]) -> Flat:
    """Of (arguments, kept, cotangents)."""
    primals, _, cotangents = split(args, len(which), len(kept_avals(loop)))
    function, some = _of_wanted(loop, scan, primals, which)
    return list(jax.vjp(function, *some)[1](cotangents))


def _primitive(name: str, kernel: Callable[..., Flat], plain: Callable[..., Flat]) -> Primitive:
    """Runs `kernel`, and differentiates and batches `plain`."""

    def run(*args: Array, **params: Any) -> Flat:
        try:
            return kernel(*args, **params)
        except CannotCompile as reason:
            warn_once(f"NVRTC made no kernel of a loop ({reason})")
            return plain(*args, **params)

    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(lambda *args, **params: jax.jit(ft.partial(run, **params))(*args))
    mlir.register_lowering(primitive, mlir.lower_fun(run, multiple_results=True))

    def derivative(primals: Sequence, tangents: Sequence, **params: Any) -> tuple[Flat, Flat]:
        moved = tuple(ad.instantiate_zeros(x) for x in tangents)
        return jax.jvp(ft.partial(plain, **params), tuple(primals), moved)

    def batch(args: Sequence, axes: Sequence, **params: Any) -> tuple[Flat, list[int]]:
        out = jax.vmap(ft.partial(plain, **params), in_axes=tuple(axes))(*args)
        return out, [0] * len(out)

    ad.primitive_jvps[primitive] = derivative
    batching.primitive_batchers[primitive] = batch
    return primitive


_loop = _primitive(
    "ensemble_loop", lambda *args, loop, scan, keep: run_forward(loop, *args, keep=keep), _plain
)
_tangent = _primitive("ensemble_loop_tangent", _plain_tangents, _plain_tangents)
_cotangent = _primitive(
    "ensemble_loop_cotangent",
    lambda *args, loop, scan, which: run_reverse(loop, *args, which=which),
    _plain_cotangents,
)


def _shaped(loop: Loop, still: Sequence[Shaped], timed: Sequence[Shaped]) -> list[ShapedArray]:
    """As the whole loop has them."""
    shapes = [x.shape for x in still] + [(loop.count, *x.shape) for x in timed]
    kinds = [x.dtype for x in (*still, *timed)]
    return [ShapedArray(shape, kind) for shape, kind in zip(shapes, kinds, strict=True)]


@_loop.def_abstract_eval
def _(*_: Any, loop: Loop, scan: Scan, keep: bool) -> list[ShapedArray]:
    return _shaped(loop, *loop.results) + _shaped(loop, kept_avals(loop) if keep else (), ())


@_tangent.def_abstract_eval
def _(*_: Any, loop: Loop, scan: Scan, which: tuple[bool, ...]) -> list[ShapedArray]:
    return [x for x in _shaped(loop, *loop.results) if is_float(x.dtype)]


@_cotangent.def_abstract_eval
def _(*_: Any, loop: Loop, scan: Scan, which: tuple[bool, ...]) -> list[ShapedArray]:
    consts, carry, signals = loop.avals
    arguments = _shaped(loop, [*consts, *carry], signals)
    return [x for x, wanted in zip(arguments, which, strict=True) if wanted]


def _loop_derivative(
    primals: Sequence[Array], tangents: Sequence, *, loop: Loop, scan: Scan, keep: bool
) -> tuple[Flat, list]:
    which = tuple(not isinstance(x, ad.Zero) for x in tangents)
    out = _loop.bind(*primals, loop=loop, scan=scan, keep=keep or any(which))
    results, kept = split(out, len(loop.out))
    moved = [x for x in tangents if not isinstance(x, ad.Zero)]
    if any(which):
        moved = _tangent.bind(*primals, *kept, *moved, loop=loop, scan=scan, which=which)
    in_order = iter(moved)
    still = lambda x: ad.Zero(jax.typeof(x).to_tangent_aval())
    out_tangents = [next(in_order, still(x)) if is_float(x.dtype) else still(x) for x in results]
    kept = kept if keep else []
    # What is made of the kept carries is differentiated by the arguments, which lead to them.
    return [*results, *kept], [*out_tangents, *map(still, kept)]


def _transpose(
    cotangents: Sequence, *args: Any, loop: Loop, scan: Scan, which: tuple[bool, ...]
) -> list:
    primals, _ = split(args, len(which) + len(kept_avals(loop)))
    if all(isinstance(x, ad.Zero) for x in cotangents):
        return [None] * len(args)
    are_given = [not isinstance(x, ad.Zero) for x in cotangents]
    filled = [ad.instantiate_zeros(x) for x in cotangents]
    reason = _fits(ft.partial(reverse_in_lanes, loop, which))
    if reason is None and not holds_cotangents(loop, are_given):
        reason = "a cotangent of what all members share"
    if reason is None:
        transposed = _cotangent.bind(*primals, *filled, loop=loop, scan=scan, which=which)
    else:
        note(f"the reverse kernel of a GPU does not hold {reason}")
        transposed = _plain_cotangents(*primals, *filled, loop=loop, scan=scan, which=which)
    return [*(None for _ in primals), *transposed]


ad.primitive_jvps[_loop] = _loop_derivative
ad.primitive_transposes[_tangent] = _transpose
