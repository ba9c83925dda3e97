"""What a kernel can hold, read from the StableHLO that XLA is about to compile."""

import functools as ft
import math
from collections.abc import Iterator
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
            least = min(range(len(found)), key=lambda k: _size_small_call_uses(found[k].type))
            found[least] = _unless_impossible(found[least], _sum_of_firsts(arguments))
            func.ReturnOp(found)
    except Exception:
        symbols.erase(whole)  # Half a function would spoil the whole program.
        raise
    return ir.FlatSymbolRefAttr.get(ir.StringAttr(name).value)


def _size_small_call_uses(kind: Any) -> int:
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


# What a kernel is known to hold. XLA hands other operations (sorts, scatters, custom calls, ...) to
# libraries or callbacks, which a kernel cannot call: some raise, and some end the process.
_HELD = set(
    """
    abs add and atan2 bitcast_convert cbrt ceil clamp compare convert cosine divide exponential
    exponential_minus_one floor is_finite log log_plus_one logistic maximum minimum multiply negate
    not or power reduce_precision remainder round_nearest_afz round_nearest_even rsqrt select
    shift_left shift_right_arithmetic shift_right_logical sign sine sqrt subtract tan tanh xor
    acos acosh asin asinh atan atanh cosh erf erfc erf_inv lgamma next_after sinh square
    broadcast broadcast_in_dim concatenate constant dynamic_slice dynamic_update_slice gather iota
    pad reshape reverse slice transpose
    case if optimization_barrier reduce reduce_window return while dot dot_general
    """.split()
)
# Sums and products of so many numbers: wide arithmetic fits, but one thread without XLA's fusion is
# then the slower way.
_COUNTED = {"reduce", "reduce_window", "dot_general", "dot", "add", "subtract", "multiply"}
_LARGE = 4096


def fits_a_kernel(call: Any, module: Any) -> bool:
    """Whether all that `call` takes, leads to and returns fits."""
    functions = {_text(f, "sym_name"): f.operation for f in module.body.operations}
    called = functions[_text(call, "callee")]
    ends = (*call.operands, *call.results)
    return all(_holds_numbers(x.type) for x in ends) and _is_plain(called, functions, set())


def _holds_numbers(kind: Any) -> bool:
    """Whether these are real numbers, integers or booleans, at least one of them."""
    array = ir.RankedTensorType(kind)
    real = isinstance(array.element_type, ir.FloatType | ir.IntegerType)
    return real and array.has_static_shape and _size(kind) > 0


def _text(op: Any, attribute: str) -> str:
    return str(op.attributes[attribute]).strip('@"')


def _is_plain(function: Any, functions: dict[str, Any], seen: set[str]) -> bool:
    for op in _operations(function):
        if op.name == "func.call":
            name = _text(op, "callee")
            if name not in seen:
                seen.add(name)
                if not _is_plain(functions[name], functions, seen):
                    return False
        elif not _fits(op):
            return False
    return True


def _operations(parent: Any) -> Iterator[Any]:
    for region in parent.regions:
        for block in region:
            for op in block:
                yield op.operation
                yield from _operations(op.operation)


def _fits(op: Any) -> bool:
    kind = op.name.split(".")[-1]
    if kind in _COUNTED:
        sizes = (_size(operand.type) for operand in op.operands)
        return all(size < _LARGE for size in sizes) and (kind[:3] != "dot" or _is_thin(op))
    return kind in _HELD


def _size(kind: Any) -> int:
    size = 1
    for length in ir.RankedTensorType(kind).shape:
        size *= length
    return size


def _is_thin(dot: Any) -> bool:
    """Whether a product has a vector on one side: XLA writes a plain loop for it."""
    dims = stablehlo.DotDimensionNumbers(dot.attributes["dot_dimension_numbers"])
    shared = (
        {*dims.lhs_batching_dimensions, *dims.lhs_contracting_dimensions},
        {*dims.rhs_batching_dimensions, *dims.rhs_contracting_dimensions},
    )
    wide = []
    for operand, taken in zip(dot.operands, shared, strict=True):
        shape = ir.RankedTensorType(operand.type).shape
        wide.append(any(n > 1 for k, n in enumerate(shape) if k not in taken))
    return not all(wide)
