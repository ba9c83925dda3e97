"""What a kernel can hold, and how it is written, in the StableHLO that XLA is about to compile."""

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
    inputs = [x.type for x in call.operands]
    single = ir.RankedTensorType.get((), ir.F32Type.get())
    functions = []
    try:
        kernel, name = _new_function("kernel", inputs, [*kinds, single], call, module, symbols)
        functions.append(kernel)
        with call.location, ir.InsertionPoint(kernel.add_entry_block()):
            arguments = list(kernel.arguments)
            called = func.CallOp(
                kinds, ir.FlatSymbolRefAttr(call.attributes["callee"]), arguments
            ).results
            func.ReturnOp([*called, _sum_of_firsts(arguments)])
        wrapper, outer = _new_function("in_kernel", inputs, kinds, call, module, symbols)
        functions.append(wrapper)
        with call.location, ir.InsertionPoint(wrapper.add_entry_block()):
            hidden = stablehlo.OptimizationBarrierOp(list(wrapper.arguments)).results
            inner = func.CallOp([*kinds, single], ir.FlatSymbolRefAttr.get(name), list(hidden))
            inner.operation.attributes[ATTRIBUTE] = attributes
            func.ReturnOp(list(inner.results)[:-1])
    except Exception:
        for function in reversed(functions):  # Half a function would spoil the whole program.
            symbols.erase(function)
        raise
    call.attributes["callee"] = ir.FlatSymbolRefAttr.get(outer)


def _new_function(
    name: str, inputs: list[ir.Type], kinds: list[ir.Type], call: Op, module: ir.Module,
    symbols: ir.SymbolTable,
) -> tuple[func.FuncOp, str]:  # fmt: skip
    with call.location, ir.InsertionPoint(module.body):
        function = func.FuncOp(name, ir.FunctionType.get(inputs, kinds), visibility="private")
    return function, ir.StringAttr(symbols.insert(function)).value


def _sum_of_firsts(values: list[ir.Value]) -> ir.Value:
    """The sum of the first number of each array, in single precision."""
    single, total = ir.RankedTensorType.get((), ir.F32Type.get()), None
    for value in values:
        kind = ir.RankedTensorType(value.type)
        rank, scalar = len(kind.shape), ir.RankedTensorType.get((), kind.element_type)
        corner = stablehlo.SliceOp(value, [0] * rank, [1] * rank, [1] * rank).result
        number = stablehlo.ReshapeOp(scalar, corner).result
        first = stablehlo.ConvertOp(single, number).result
        total = first if total is None else stablehlo.AddOp(total, first).result
    assert total is not None
    return total


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
        array = ir.RankedTensorType(value.type)
        real = isinstance(array.element_type, ir.FloatType | ir.IntegerType)
        if not (real and array.has_static_shape and size_of(value.type) > 0):
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


def text(op: Op, attribute: str) -> str:
    return str(op.attributes[attribute]).strip('@"')


_Counts = tuple[int, int]  # all operations, and those on many numbers


def _count(name: str, functions: Mapping[str, Op], counted: dict[str, _Counts]) -> tuple[int, int]:
    """Operations of a function and of all that it calls, once for every call: XLA inlines them."""
    if name in counted:
        return counted[name]
    count = wide = 0
    for op in operations_in(functions[name]):
        if op.name == "func.call":
            more, wider = _count(text(op, "callee"), functions, counted)
            count, wide = count + more, wide + wider
        elif not _fits(op):
            raise _DoesNotFit(f"{op.name} of {', '.join(str(x.type) for x in op.operands)}")
        else:
            count += 1
            wide += kind_of(op) != "while" and any(size_of(x.type) >= _WIDE for x in op.results)
    counted[name] = count, wide
    return counted[name]


def calls_within(name: str, what: str, module: ir.Module) -> list[Op]:
    """In a function and all it calls: the calls of functions whose name begins with `what`; those
    that are given nothing are done before the program runs."""
    functions = {text(f, "sym_name"): f.operation for f in module.body.operations}
    calls_found, open_ = [], [name]
    for name in open_:
        calls = [op for op in operations_in(functions[name]) if op.name == "func.call"]
        for op in calls:
            callee = text(op, "callee")
            if callee.startswith(what) and len(op.operands):
                calls_found.append(op)
            elif callee not in open_:
                open_.append(callee)
    return calls_found


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


# A kernel's arithmetic in parts, each a function of its own that computes nothing twice.
#
# XLA merges elementwise operations into loops of one result each, and computes again in every loop
# what several of them need: three times over in a controlled vehicle, more in its derivatives. It
# merges nothing across the calls of functions, so what is needed twice becomes a part's result.

FREE = set("broadcast_in_dim convert iota reshape slice".split())  # nothing to save in these
_SLOW = set(
    """
    atan2 cbrt cosine divide exponential exponential_minus_one log log_plus_one logistic power
    remainder rsqrt sine sqrt tan tanh
    """.split()
)
ELEMENTWISE = (
    FREE
    | _SLOW
    | set(
        """
    abs add and ceil clamp compare constant floor is_finite maximum minimum multiply negate not or
    round_nearest_afz round_nearest_even select sign subtract xor
    """.split()
    )
)
_PRICE = 8  # additions, of a slow operation
_DEAR = 5  # additions, what it costs to write a result down and to read it


class Division:
    """Of one block of operations: what is kept, and the step of its computation that yields it."""

    def __init__(self, block: ir.Block, copies: "_Copies"):
        self.copies = copies
        *self.ops, self.end = operations(block)
        self.source: dict[ir.Value, int] = {
            value: k for k, op in enumerate(self.ops) for value in op.results
        }
        self.light = [copies.is_in_a_part(op) for op in self.ops]
        self.fixed = [kind_of(op) == "constant" for op in self.ops]
        self.kept = self._select_kept()

    def _select_kept(self) -> list[bool]:
        """Light operations whose result is dear and used twice, or used by what is in no part."""
        place = {op: k for k, op in enumerate(self.ops)}
        uses, kept = [0] * len(self.ops), [False] * len(self.ops)
        for k in reversed(range(len(self.ops))):
            if not self.light[k] or self.fixed[k]:
                continue
            users = [place.get(use.owner.operation, -1) for use in self.ops[k].results[0].uses]
            outside = any(j < 0 or not self.light[j] for j in users)
            moves = kind_of(self.ops[k]) in FREE
            uses[k] = sum(uses[j] if self._moves(j) else 1 for j in users if j >= 0)
            if moves and outside:
                self.light[k] = False
            kept[k] = not moves and outside
        price = [0] * len(self.ops)  # of what a loop computes up to here
        for k, op in enumerate(self.ops):
            if not self.light[k] or self.fixed[k]:
                continue
            sources = [self.source.get(value, -1) for value in op.operands]
            price[k] = sum(price[j] for j in sources if j >= 0 and not kept[j])
            if not self._moves(k):
                price[k] += _PRICE if kind_of(op) in _SLOW else 1
                kept[k] |= price[k] * (uses[k] - 1) >= _DEAR
        return kept

    def _moves(self, k: int) -> bool:
        return self.light[k] and kind_of(self.ops[k]) in FREE

    def apply(self) -> None:
        if sum(self.kept) < 2:
            return
        for others, members in self._steps():
            for k in others:
                self.ops[k].move_before(self.end)
            if members:
                self._emit(members)
        for k in reversed(range(len(self.ops))):
            if self.light[k] and not self.fixed[k]:
                self.ops[k].erase()

    def _steps(self) -> list[tuple[list[int], list[int]]]:
        """Step by step, what is in no part and then what a part computes from all before it."""
        steps: list[tuple[list[int], list[int]]] = [([], [])]
        after = [0] * len(self.ops)
        for k, op in enumerate(self.ops):
            read = [self.source[v] for v in _operands(op) if v in self.source]
            step = max((after[j] for j in read), default=0)
            after[k] = step + self.kept[k]
            while len(steps) <= step:
                steps.append(([], []))
            if self.kept[k]:
                steps[step][1].append(k)
            elif not self.light[k] or self.fixed[k]:
                steps[step][0].append(k)
        return steps

    def _emit(self, members: list[int]) -> None:
        inputs, within = self._needs(members)
        kinds = [self.ops[k].results[0].type for k in members]
        # XLA divides among threads what is a function's only result; a kernel has one thread.
        kinds += [ir.RankedTensorType.get((), ir.F32Type.get())]
        shape = ir.FunctionType.get([x.type for x in inputs], kinds)
        with self.ops[members[0]].location:
            with ir.InsertionPoint(self.copies.module.body):
                part = func.FuncOp("part", shape, visibility="private")
            name = self.copies.insert(part)
            with ir.InsertionPoint(part.add_entry_block()):
                values = dict(zip(inputs, part.arguments, strict=True))
                for k in within:
                    op = self.ops[k].clone()
                    for i, operand in enumerate(self.ops[k].operands):
                        op.operands[i] = values[operand]
                    values[self.ops[k].results[0]] = op.results[0]
                results = [values[self.ops[k].results[0]] for k in members]
                single = ir.F32Type.get()
                scalar = ir.RankedTensorType.get((), single)
                zero = ir.DenseElementsAttr.get_splat(scalar, ir.FloatAttr.get(single, 0.0))
                func.ReturnOp([*results, stablehlo.ConstantOp(zero).result])
            with ir.InsertionPoint(self.end):
                call = func.CallOp(kinds, ir.FlatSymbolRefAttr.get(name), inputs)
        call.operation.attributes[ATTRIBUTE] = ir.DictAttr.get(
            {"inlineable": ir.StringAttr.get("false")}
        )
        for k, result in zip(members, list(call.results)[:-1], strict=True):
            self.ops[k].results[0].replace_all_uses_with(result)

    def _needs(self, members: list[int]) -> tuple[list[ir.Value], list[int]]:
        """What a part is given, and the operations in it."""
        inputs, within, open_ = {}, set(members), list(members)
        while open_:
            for value in self.ops[open_.pop()].operands:
                k = self.source.get(value)
                if k is None or not self.light[k] or self.kept[k]:
                    inputs[value] = None
                elif k not in within:
                    within.add(k)
                    open_.append(k)
        return list(inputs), sorted(within)


def operations(block: ir.Block) -> list[Op]:
    return [op.operation for op in block.operations]


def _operands(op: Op) -> list[ir.Value]:
    """Also those that an operation's regions take from around them."""
    values = list(op.operands)
    for region in op.regions:
        for block in region:
            for inner in operations(block):
                values.extend(_operands(inner))
    return values


_SHORT = 32  # numbers that are computed again as fast as they are read
_LONG = 2**15  # numbers that XLA divides among threads (256 KiB), which a kernel does not have
_FEW = 10  # operations of a function, such as `jnp.clip`, that can be within a part


def in_parts(name: str, module: ir.Module, symbols: ir.SymbolTable) -> str:
    """The name of a copy of a function, its loops included, that is made of parts."""
    functions: list[Op] = []
    try:
        return _Copies(module, symbols, functions).copy(name)
    except Exception:
        for function in reversed(functions):  # Half a function would spoil the whole program.
            symbols.erase(function)
        raise


class _Copies:
    def __init__(self, module: ir.Module, symbols: ir.SymbolTable, functions: list[Op]):
        self.module, self.symbols, self.inserted = module, symbols, functions
        self.functions = {text(f, "sym_name"): f.operation for f in module.body.operations}
        self.named: dict[str, str] = {}
        self.small: dict[str, bool] = {}

    def copy(self, name: str) -> str:
        if name not in self.named:
            with ir.InsertionPoint(self.module.body):
                function = self.functions[name].clone()
            self.named[name] = self.insert(function)
            self._divide(function.operation)
        return self.named[name]

    def insert(self, function: Op) -> str:
        name = ir.StringAttr(self.symbols.insert(function)).value
        self.inserted.append(function)
        return name

    def _divide(self, op: Op) -> None:
        for place, region in enumerate(op.regions):
            for block in region:
                for inner in operations(block):
                    if inner.name == "func.call" and not self.is_small(text(inner, "callee")):
                        name = self.copy(text(inner, "callee"))
                        inner.attributes["callee"] = ir.FlatSymbolRefAttr.get(name)
                    elif kind_of(inner) in ("while", "case", "if"):
                        self._divide(inner)
                if kind_of(op) != "while" or place == 1:  # the first region is the condition
                    Division(block, self).apply()

    def is_small(self, name: str) -> bool:
        """Whether a function is a few elementwise operations."""
        if name not in self.small:
            function = self.functions.get(name)  # None: a copy
            ops = [] if function is None else operations(function.regions[0].blocks[0])
            self.small[name] = 0 < len(ops) <= _FEW and all(map(self._is_light, ops[:-1]))
        return self.small[name]

    def _is_light(self, op: Op) -> bool:
        called = op.name == "func.call" and ATTRIBUTE not in op.attributes
        light = self.is_small(text(op, "callee")) if called else kind_of(op) in ELEMENTWISE
        return light and len(op.results) == 1

    def is_in_a_part(self, op: Op) -> bool:
        return self._is_light(op) and (
            kind_of(op) == "constant" or _SHORT <= size_of(op.results[0].type) < _LONG
        )
