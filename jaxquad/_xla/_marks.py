from collections.abc import Callable, Iterator
from typing import Any

from jax.extend.core import Primitive
from jax.extend.mlir import ir
from jax.interpreters import ad, batching, mlir

from ._kernel_limits import hold_in_kernel, why_not
from ._kernel_parts import ATTRIBUTE, in_parts, text


_TAGS = {"inlineable": "false", "xla_cpu_small_call": "true"}


def _identity(name: str) -> Primitive:
    mark = Primitive(name)
    mark.def_impl(lambda x: x)
    mark.def_abstract_eval(lambda x: x)
    batching.defvectorized(mark)
    return mark


def _transposed(mark: Primitive) -> Callable[..., tuple[Any]]:
    return lambda ct, _: (ct if isinstance(ct, ad.Zero) else mark.bind(ct),)


# Where a differentiated array enters a kernel, and where it leaves it.
enter, leave = _identity("enter_kernel"), _identity("leave_kernel")
ad.deflinear2(enter, _transposed(leave))
ad.deflinear2(leave, _transposed(enter))


def _tag(ctx: Any, x: Any) -> list[Any]:
    """Turn the call that `x` comes from, by now differentiated and batched, into a kernel."""
    try:
        call, whole = _owner(x), ctx.module_context
        if _is_plain_call(call) and _is_for_one_cpu(whole):
            for found in (call, *_forward_passes(call)):
                _make_kernel(found, whole)
    except Exception:  # The compiler's interfaces have changed: do without the kernel.
        pass
    return [x]


def _owner(x: Any) -> Any:
    return getattr(x.owner, "operation", x.owner)


def _forward_passes(call: Any) -> Iterator[Any]:
    """The calls whose results a call takes, without their marks where nothing else was asked of."""
    for operand in call.operands:
        owner = _owner(operand)
        if _is_plain_call(owner):
            yield owner


def _make_kernel(call: Any, whole: Any) -> None:
    if _is_plain_call(call) and why_not(call, whole.module) is None:
        name = in_parts(text(call, "callee"), whole.module, whole.symbol_table)
        call.attributes["callee"] = ir.FlatSymbolRefAttr.get(name)
        attributes = ir.DictAttr.get(_tags())
        hold_in_kernel(call, whole.module, whole.symbol_table, attributes)


def _is_plain_call(op: Any) -> bool:
    name = text(op, "callee") if getattr(op, "name", "") == "func.call" else ""
    return name.startswith("jaxquad_kernel") and ATTRIBUTE not in op.attributes


def _is_for_one_cpu(whole: Any) -> bool:
    """Whether XLA has nothing to split among devices: a kernel cannot be split."""
    mesh = getattr(whole.axis_context, "mesh", None)
    if mesh is None:
        alone = whole.axis_context.num_devices == 1
    else:
        alone = whole.axis_context.manual_axes == frozenset(mesh.axis_names)
    return alone and tuple(whole.platforms) == ("cpu",)


def _tags() -> dict[str, ir.Attribute]:
    return {name: ir.StringAttr.get(value) for name, value in _TAGS.items()}


mlir.register_lowering(enter, lambda ctx, x: [x])
mlir.register_lowering(leave, _tag, cacheable=False)
