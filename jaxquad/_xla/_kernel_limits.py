"""What a kernel can hold, read from the StableHLO that XLA is about to compile."""

from collections.abc import Iterator, Mapping

from jax.extend.mlir import ir
from jax.extend.mlir.dialects import func, stablehlo


Op = ir.Operation | ir.OpView
ATTRIBUTE = "mhlo.frontend_attributes"


def hold_in_kernel(
    call: Op, module: ir.Module, symbols: ir.SymbolTable, attributes: ir.Attribute
) -> None:
    """Turn a plain call into one of a function that calls a kernel which does the same.

    The kernel is given its operands behind a barrier, for XLA would put constants in the arguments'
    place, and it returns the sum of one number of each argument as a last result, for an argument
    that is not read ends the process. With two results its last operation is no arithmetic either:
    XLA would divide that among threads, which a kernel does not have.
    """
    kinds = [x.type for x in call.results]
    given = [x.type for x in call.operands]
    single = ir.RankedTensorType.get((), ir.F32Type.get())
    made = []
    try:
        kernel, name = _new_function("kernel", given, [*kinds, single], call, module, symbols)
        made.append(kernel)
        with call.location, ir.InsertionPoint(kernel.add_entry_block()):
            arguments = list(kernel.arguments)
            found = func.CallOp(
                kinds, ir.FlatSymbolRefAttr(call.attributes["callee"]), arguments
            ).results
            func.ReturnOp([*found, _sum_of_firsts(arguments)])
        whole, outer = _new_function("in_kernel", given, kinds, call, module, symbols)
        made.append(whole)
        with call.location, ir.InsertionPoint(whole.add_entry_block()):
            hidden = stablehlo.OptimizationBarrierOp(list(whole.arguments)).results
            inner = func.CallOp([*kinds, single], ir.FlatSymbolRefAttr.get(name), list(hidden))
            inner.operation.attributes[ATTRIBUTE] = attributes
            func.ReturnOp(list(inner.results)[:-1])
    except Exception:
        for function in reversed(made):  # Half a function would spoil the whole program.
            symbols.erase(function)
        raise
    call.attributes["callee"] = ir.FlatSymbolRefAttr.get(outer)


def _new_function(
    name: str,
    given: list[ir.Type],
    kinds: list[ir.Type],
    call: Op,
    module: ir.Module,
    symbols: ir.SymbolTable,
) -> tuple[func.FuncOp, str]:
    with call.location, ir.InsertionPoint(module.body):
        function = func.FuncOp(name, ir.FunctionType.get(given, kinds), visibility="private")
    return function, ir.StringAttr(symbols.insert(function)).value


def _like(kind: ir.Type, shape: tuple[int, ...]) -> ir.Type:
    return ir.RankedTensorType.get(shape, ir.RankedTensorType(kind).element_type)


def _sum_of_firsts(values: list[ir.Value]) -> ir.Value:
    total, *others = map(_first, values)
    for other in others:
        total = stablehlo.AddOp(total, other).result
    return total


def _first(value: ir.Value) -> ir.Value:
    """The first number of an array, in single precision."""
    rank = len(ir.RankedTensorType(value.type).shape)
    corner = stablehlo.SliceOp(value, [0] * rank, [1] * rank, [1] * rank).result
    scalar = stablehlo.ReshapeOp(_like(value.type, ()), corner).result
    return stablehlo.ConvertOp(ir.RankedTensorType.get((), ir.F32Type.get()), scalar).result


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
# These move the numbers of whole signals, or write zeros for a loop to fill: no arithmetic, so of
# any size.
_MOVES = set(
    """
    broadcast broadcast_in_dim case concatenate constant convert dynamic_slice dynamic_update_slice
    if iota optimization_barrier pad reshape return reverse slice transpose while
    """.split()
)
_BRANCHES = {"case", "if"}
_NARROW = 128  # numbers that XLA never divides among threads
# The most numbers of any other operation: XLA hands longer sums to a library, which a kernel cannot
# call, and all wider arithmetic takes three times as long to compile as in a plain loop.
WIDEST = 4096
# Operations of one kernel: the time to compile them grows faster than their number. With 6800, most
# of them wide, it can be four times that of a plain loop; narrow ones compile faster than plain.
_MOST_OPERATIONS, _MOST_WIDE = 12_000, 6_000
_WIDE = 32  # numbers


def why_not(call: Op, module: ir.Module) -> str | None:
    """What `call` takes, leads to or returns that a kernel cannot hold; None if all of it fits."""
    functions = {text(f, "sym_name"): f.operation for f in module.body.operations}
    for value in (*call.operands, *call.results):
        if not _holds_numbers(value.type):
            return f"values of {value.type}"
    try:
        count, wide = _count(text(call, "callee"), functions, {})
    except _DoesNotFit as reason:
        return str(reason)
    if count > _MOST_OPERATIONS or wide > _MOST_WIDE:
        return f"{count} operations, {wide} of them on {_WIDE} numbers or more"
    return None


class _DoesNotFit(Exception):
    pass


def _holds_numbers(kind: ir.Type) -> bool:
    """Whether these are real numbers, integers or booleans, at least one of them."""
    array = ir.RankedTensorType(kind)
    real = isinstance(array.element_type, ir.FloatType | ir.IntegerType)
    return real and array.has_static_shape and size_of(kind) > 0


def text(op: Op, attribute: str) -> str:
    return str(op.attributes[attribute]).strip('@"')


_Counts = tuple[int, int]  # all operations, and those on many numbers


def _count(name: str, functions: Mapping[str, Op], known: dict[str, _Counts]) -> tuple[int, int]:
    """Operations of a function and of all that it calls, once for every call: XLA inlines them."""
    if name in known:
        return known[name]
    count = wide = 0
    for op in operations_in(functions[name]):
        if op.name == "func.call":
            more, wider = _count(text(op, "callee"), functions, known)
            count, wide = count + more, wide + wider
        elif not _fits(op):
            raise _DoesNotFit(f"{op.name} of {', '.join(str(x.type) for x in op.operands)}")
        else:
            count += 1
            wide += kind_of(op) != "while" and any(size_of(x.type) >= _WIDE for x in op.results)
    known[name] = count, wide
    return known[name]


def calls_within(name: str, what: str, module: ir.Module) -> list[Op]:
    """In a function and all it calls: the calls of functions whose name begins with `what`.

    Without those that are given nothing, which are done before the program runs.
    """
    functions = {text(f, "sym_name"): f.operation for f in module.body.operations}
    found, open_ = [], [name]
    for name in open_:
        calls = [op for op in operations_in(functions[name]) if op.name == "func.call"]
        for op in calls:
            callee = text(op, "callee")
            if callee.startswith(what) and len(op.operands):
                found.append(op)
            elif callee not in open_:
                open_.append(callee)
    return found


def operations_in(parent: Op) -> Iterator[Op]:
    for region in parent.regions:
        for block in region:
            for op in block:
                yield op.operation
                yield from operations_in(op.operation)


def _fits(op: Op) -> bool:
    kind = kind_of(op)
    if kind not in _HELD or (kind[:3] == "dot" and not _is_thin(op)):
        return False
    if kind in _BRANCHES and len(op.results) == 1 and size_of(op.results[0].type) >= _NARROW:
        return False  # A branch's only result is divided among threads.
    if kind in _MOVES:
        return True
    return all(size_of(value.type) < WIDEST for value in (*op.operands, *op.results))


def size_of(kind: ir.Type) -> int:
    size = 1
    for length in ir.RankedTensorType(kind).shape:
        size *= length
    return size


def kind_of(op: Op) -> str:
    return op.name.split(".")[-1]


def _is_thin(dot: Op) -> bool:
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
