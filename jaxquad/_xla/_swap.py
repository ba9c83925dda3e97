"""A row of an array exchanged for another, in place, in every derivative too.

`dynamic_update_slice` and `dynamic_slice` do the same, but the transpose of the latter is a sum of
whole arrays: a queue of many samples then costs its length in every sample of a reverse pass.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float, Int

from ._switch import warn_once


def swap_row(
    rows: Float[Array, "rows ..."], row: Float[Array, "..."], place: Int[Array, ""]
) -> tuple[Float[Array, "rows ..."], Float[Array, "..."]]:
    """The `rows` with `row` at `place`, and the row that was there.

    Linear in `rows` and `row`, and its own transpose.
    """
    changed, old = _exchange(rows, row, place)
    return changed, old


def _exchange(rows: Array, row: Array, place: Array) -> list[Array]:
    return list(_compute(rows, row, place)) if _swap is None else _swap.bind(rows, row, place)


def _compute(rows: Array, row: Array, place: Array) -> tuple[Array, Array]:
    old = jax.lax.dynamic_index_in_dim(rows, place, 0, keepdims=False)
    return jax.lax.dynamic_update_index_in_dim(rows, row, place, 0), old


def _derivative(
    primals: Sequence[Array], tangents: Sequence[Array | ad.Zero]
) -> tuple[Sequence[Array], Sequence[Array | ad.Zero]]:
    rows, row, place = primals
    *moved, _ = tangents
    out = _exchange(rows, row, place)
    if all(isinstance(x, ad.Zero) for x in moved):
        return out, [ad.Zero(jax.typeof(x)) for x in out]
    rows, row = map(ad.instantiate_zeros, moved)
    return out, _exchange(rows, row, place)


def _transpose(
    cotangents: Sequence[Array | ad.Zero], rows: object, row: object, place: Array
) -> list[Array | None]:
    if all(isinstance(x, ad.Zero) for x in cotangents):
        return [None, None, None]
    changed, old = map(ad.instantiate_zeros, cotangents)
    return [*_exchange(changed, old, place), None]


def _batch(values: Sequence[Array], axes: Sequence[int | None]) -> tuple[list[Array], list[int]]:
    rows, row, place = values
    size = next(x.shape[k] for x, k in zip(values, axes, strict=True) if k is not None)
    if axes[2] is not None:  # every one at a place of its own
        found = jax.vmap(_compute, in_axes=axes)(rows, row, place)
        return list(found), [0, 0]
    last = lambda x, k: (
        jnp.broadcast_to(x[..., None], (*x.shape, size)) if k is None else jnp.moveaxis(x, k, -1)
    )
    changed, old = _exchange(last(rows, axes[0]), last(row, axes[1]), place)
    return [changed, old], [changed.ndim - 1, old.ndim - 1]


def _primitive() -> Primitive | None:
    """None where JAX's rules for primitives have moved: the same numbers, in more time."""
    try:
        swap = Primitive("swap_row")
        swap.multiple_results = True
        swap.def_impl(lambda *args: list(jax.jit(_compute)(*args)))
        swap.def_abstract_eval(lambda rows, row, place: [rows, row])
        ad.primitive_jvps[swap] = _derivative
        ad.primitive_transposes[swap] = _transpose
        batching.primitive_batchers[swap] = _batch
        mlir.register_lowering(swap, mlir.lower_fun(_compute, multiple_results=True))
    except AttributeError as error:
        warn_once(f"a long delay costs its length in every sample ({error})")
        return None
    return swap


_swap = _primitive()
