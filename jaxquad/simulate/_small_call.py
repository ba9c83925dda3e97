"""A whole time loop as one compiled kernel on a CPU.

XLA's CPU runtime dispatches every small operation of a loop by itself, which costs more than the
arithmetic of one vehicle does. A call with these two attributes becomes one kernel instead. They
are internal to XLA: on other devices, and for computations that such a kernel cannot hold, they
are not set, and where XLA does not know them they mean nothing.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.extend.mlir import ir
from jax.extend.mlir.dialects import stablehlo
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from ._small_call_limits import fits_a_kernel


_ATTRIBUTE = "mhlo.frontend_attributes"
_TAGS = {"inlineable": "false", "xla_cpu_small_call": "true"}


def as_one_kernel(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    """`function(*args)`, compiled as one kernel if it can be; the arguments are arrays.

    So are its derivatives: what is differentiated is marked where it enters and where it leaves,
    and each mark is the transpose of the other.
    """
    entered = jax.tree.map(_marked(_enter), args)
    return jax.tree.map(_marked(_leave), jax.jit(function)(*entered))


def _marked(mark: Primitive) -> Callable[[Array], Array]:
    return lambda x: mark.bind(x) if jnp.issubdtype(x.dtype, jnp.floating) else x


def _identity(name: str) -> Primitive:
    mark = Primitive(name)
    mark.def_impl(lambda x: x)
    mark.def_abstract_eval(lambda x: x)
    batching.defvectorized(mark)
    return mark


def _transposed(mark: Primitive) -> Callable[..., tuple[Any]]:
    return lambda ct, _: (ct if isinstance(ct, ad.Zero) else mark.bind(ct),)


_enter, _leave = _identity("enter_kernel"), _identity("leave_kernel")
ad.deflinear2(_enter, _transposed(_leave))
ad.deflinear2(_leave, _transposed(_enter))


def _tag(ctx: Any, x: Any) -> list[Any]:
    """Turn the call that `x` comes from, by now differentiated and batched, into a kernel."""
    call = getattr(x.owner, "operation", x.owner)
    on_cpu = tuple(ctx.module_context.platforms) == ("cpu",)
    if on_cpu and getattr(call, "name", "") == "func.call" and _ATTRIBUTE not in call.attributes:
        try:
            if fits_a_kernel(call, ctx.module_context.module):
                _shield(call)
                call.attributes[_ATTRIBUTE] = ir.DictAttr.get(_tags())
        except Exception:  # The compiler's interfaces have changed: do without the kernel.
            pass
    return [x]


def _tags() -> dict[str, ir.Attribute]:
    return {name: ir.StringAttr.get(value) for name, value in _TAGS.items()}


def _shield(call: Any) -> None:
    """Hide from XLA which operands are constants: it would put them in the arguments' place."""
    with ir.InsertionPoint(call):
        shielded = stablehlo.OptimizationBarrierOp(list(call.operands)).results
    for k, operand in enumerate(shielded):
        call.operands[k] = operand


mlir.register_lowering(_enter, lambda ctx, x: [x])
mlir.register_lowering(_leave, _tag, cacheable=False)
