from collections.abc import Callable, Iterator
from typing import TypeGuard

import jax
from jax.extend.core import Primitive
from jax.extend.mlir import ir
from jax.interpreters import ad, batching, mlir

from ._kernel_limits import (
    ATTRIBUTE,
    calls_within,
    hold_in_kernel,
    Op,
    operations_in,
    text,
    why_not,
)
from ._kernel_parts import in_parts
from ._switch import note, warn_once


_TAGS = {"inlineable": "false", "xla_cpu_small_call": "true"}
_SEEN = {"jaxquad_kernel": "false"}  # tells XLA nothing, and this module not to look again


def _identity(name: str) -> Primitive:
    mark = Primitive(name)
    mark.def_impl(lambda x: x)
    mark.def_abstract_eval(lambda x: x)
    batching.defvectorized(mark)
    return mark


def _transposed(mark: Primitive) -> Callable[..., tuple]:
    return lambda ct, _: (ct if isinstance(ct, ad.Zero) else mark.bind(ct),)


# Where a differentiated array enters a kernel, and where it leaves it.
enter, leave = _identity("enter_kernel"), _identity("leave_kernel")
ad.deflinear2(enter, _transposed(leave))
ad.deflinear2(leave, _transposed(enter))


def _tag(ctx: mlir.LoweringRuleContext, x: ir.Value) -> list[ir.Value]:
    """Turn the call that `x` comes from, by now differentiated and batched, into a kernel."""
    whole = ctx.module_context
    try:
        call = _owner(x)
        if _is_plain_call(call) and _is_for_one_cpu(whole):
            for found in (call, *_forward_passes(call, whole)):
                _make_kernel(found, whole)
    except Exception as error:  # The compiler's interfaces have changed: do without the kernel.
        warn_once(f"JAX {jax.__version__} cannot mark a kernel ({type(error).__name__}: {error})")
    return [x]


def _owner(x: ir.Value) -> Op | ir.Block:
    return getattr(x.owner, "operation", x.owner)


def _forward_passes(call: Op, whole: mlir.ModuleContext) -> Iterator[Op]:
    """The calls whose results a call takes, without their marks where nothing else was asked of.

    What is in a function takes them as its arguments; its forward pass is in one written before.
    """
    owners = [_owner(operand) for operand in call.operands]
    yield from filter(_is_plain_call, owners)
    alone = isinstance(whole.axis_context, mlir.ShardingContext)  # then all functions are for one
    if alone and any(isinstance(owner, ir.Block) for owner in owners):
        before = [op for f in whole.module.body.operations for op in operations_in(f)]
        yield from filter(_is_plain_call, before)


def _make_kernel(call: Op, whole: mlir.ModuleContext) -> None:
    if not _is_plain_call(call):
        return
    reason = why_not(call, whole.module)
    if reason is not None:
        note(f"a kernel does not hold {reason}")
        call.attributes[ATTRIBUTE] = _attributes(_SEEN)
        return
    name = in_parts(text(call, "callee"), whole.module, whole.symbol_table)
    call.attributes["callee"] = ir.FlatSymbolRefAttr.get(name)
    parts = calls_within(name, "jaxquad_block", whole.module)
    if len(parts) > 1:  # a block computed again, and reversed
        call.attributes[ATTRIBUTE] = _attributes(_SEEN)
    else:
        parts = [call]
    for part in parts:
        hold_in_kernel(part, whole.module, whole.symbol_table, _attributes(_TAGS))


def _attributes(texts: dict[str, str]) -> ir.Attribute:
    named: dict[str, ir.Attribute] = {name: ir.StringAttr.get(x) for name, x in texts.items()}
    return ir.DictAttr.get(named)


def _is_plain_call(op: Op | ir.Block) -> TypeGuard[ir.Operation]:
    """Whether this is a call to make a kernel of; one that is given nothing is a constant."""
    if not isinstance(op, ir.Operation) or op.name != "func.call" or ATTRIBUTE in op.attributes:
        return False
    return text(op, "callee").startswith("jaxquad_kernel") and len(op.operands) > 0


def _is_for_one_cpu(whole: mlir.ModuleContext) -> bool:
    """Whether XLA has nothing to split among devices: a kernel cannot be split."""
    where = whole.axis_context
    if isinstance(where, mlir.SPMDAxisContext):
        alone = where.manual_axes == frozenset(where.mesh.axis_names)
    else:
        alone = isinstance(where, mlir.ShardingContext) and where.num_devices == 1
    return alone and tuple(whole.platforms) == ("cpu",)


mlir.register_lowering(enter, lambda ctx, x: [x])
mlir.register_lowering(leave, _tag, cacheable=False)
