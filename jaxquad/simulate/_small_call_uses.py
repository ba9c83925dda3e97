"""Every argument of a kernel must be used in it, and none may be a constant.

XLA looks for the memory of each argument of a kernel among what the kernel's operations read. It
ends the process over an argument that is not there: a constant, or one whose last use XLA has
simplified away (`x == x` of an integer, a `where` of a condition that is a constant).
"""

import functools as ft
import math
from typing import Any

from jax.extend.mlir import ir
from jax.extend.mlir.dialects import func, stablehlo


def shield(call: Any) -> None:
    """Hide from XLA which operands are constants: it would put them in the arguments' place."""
    with ir.InsertionPoint(call):
        shielded = stablehlo.OptimizationBarrierOp(list(call.operands)).results
    for k, operand in enumerate(shielded):
        call.operands[k] = operand


def using_all(call: Any, module: Any, symbols: Any) -> ir.Attribute:
    """The name of a new function that does what `call` does, and reads all that it is given.

    The sum of one number of each argument takes the place of a result where it is both above 1
    and below 0: never, but XLA does not know that.
    """
    results = [x.type for x in call.results]
    kind = ir.FunctionType.get([x.type for x in call.operands], results)
    with call.location, ir.InsertionPoint(module.body):
        whole = func.FuncOp("kernel", kind, visibility="private")
    name = symbols.insert(whole)
    try:
        with call.location, ir.InsertionPoint(whole.add_entry_block()):
            arguments = list(whole.arguments)
            found = list(func.CallOp(results, call.attributes["callee"], arguments).results)
            least = min(range(len(found)), key=lambda k: _size(found[k].type))
            found[least] = _unless_impossible(found[least], _sum_of_firsts(arguments))
            func.ReturnOp(found)
    except Exception:
        symbols.erase(whole)  # Half a function would spoil the whole program.
        raise
    return ir.FlatSymbolRefAttr.get(ir.StringAttr(name).value)


def _size(kind: Any) -> int:
    return math.prod(ir.RankedTensorType(kind).shape)


def _like(kind: Any, shape: tuple[int, ...]) -> Any:
    return ir.RankedTensorType.get(shape, ir.RankedTensorType(kind).element_type)


def _sum_of_firsts(values: list[Any]) -> Any:
    return ft.reduce(lambda x, y: stablehlo.AddOp(x, y).result, map(_first, values))


def _first(value: Any) -> Any:
    """The first number of an array, in single precision."""
    rank = len(ir.RankedTensorType(value.type).shape)
    corner = stablehlo.SliceOp(value, [0] * rank, [1] * rank, [1] * rank).result
    scalar = stablehlo.ReshapeOp(_like(value.type, ()), corner).result
    return stablehlo.ConvertOp(ir.RankedTensorType.get((), ir.F32Type.get()), scalar).result


def _unless_impossible(value: Any, total: Any) -> Any:
    kind = ir.RankedTensorType(value.type)
    above, below = (_compare(total, bound, way) for bound, way in ((1.0, "GT"), (0.0, "LT")))
    other = stablehlo.ConvertOp(_like(kind, ()), total).result
    wide = stablehlo.BroadcastInDimOp(kind, other, []).result
    return stablehlo.SelectOp(stablehlo.AndOp(above, below).result, wide, value).result


def _compare(x: Any, bound: float, way: str) -> Any:
    single = ir.F32Type.get()
    number = ir.DenseElementsAttr.get_splat(
        ir.RankedTensorType.get((), single), ir.FloatAttr.get(single, bound)
    )
    direction = stablehlo.ComparisonDirectionAttr.get(way)
    return stablehlo.CompareOp(x, stablehlo.ConstantOp(number).result, direction).result
