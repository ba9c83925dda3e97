"""A kernel's arithmetic in parts, each a function of its own that computes nothing twice.

XLA merges elementwise operations into loops of one result each, and computes again in every loop
what several of them need: three times over in a controlled vehicle, more in its derivatives. It
merges nothing across the calls of functions, so what is needed twice becomes a part's result.
"""

from jax.extend.mlir import ir
from jax.extend.mlir.dialects import func, stablehlo

from ._kernel_limits import ATTRIBUTE, kind_of, Op, size_of, text


MOVES = set("broadcast_in_dim convert iota reshape slice".split())  # nothing to save in these
_SLOW = set(
    """
    atan2 cbrt cosine divide exponential exponential_minus_one log log_plus_one logistic power
    remainder rsqrt sine sqrt tan tanh
    """.split()
)
ELEMENTWISE = (
    MOVES
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
            moves = kind_of(self.ops[k]) in MOVES
            uses[k] = sum(uses[j] if self._moves(j) else 1 for j in users if j >= 0)
            if moves and outside:
                self.light[k] = False
            kept[k] = not moves and outside
        self._keep_expensive(kept, uses)
        return kept

    def _keep_expensive(self, kept: list[bool], uses: list[int]) -> None:
        price = [0] * len(self.ops)  # of what a loop computes up to here
        for k, op in enumerate(self.ops):
            if not self.light[k] or self.fixed[k]:
                continue
            sources = [self.source.get(value, -1) for value in op.operands]
            price[k] = sum(price[j] for j in sources if j >= 0 and not kept[j])
            if not self._moves(k):
                price[k] += _PRICE if kind_of(op) in _SLOW else 1
                kept[k] |= price[k] * (uses[k] - 1) >= _DEAR

    def _moves(self, k: int) -> bool:
        return self.light[k] and kind_of(self.ops[k]) in MOVES

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
                found = [values[self.ops[k].results[0]] for k in members]
                func.ReturnOp([*found, stablehlo.ConstantOp(_zero()).result])
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


def _zero() -> ir.Attribute:
    single = ir.F32Type.get()
    return ir.DenseElementsAttr.get_splat(
        ir.RankedTensorType.get((), single), ir.FloatAttr.get(single, 0.0)
    )


def operations(block: ir.Block) -> list[Op]:
    return [op.operation for op in block.operations]


def _operands(op: Op) -> list[ir.Value]:
    """Also those that an operation's regions take from around them."""
    found = list(op.operands)
    for region in op.regions:
        for block in region:
            for inner in operations(block):
                found.extend(_operands(inner))
    return found


_SHORT = 32  # numbers that are computed again as fast as they are read
_LONG = 2**15  # numbers that XLA divides among threads (256 KiB), which a kernel does not have
_FEW = 10  # operations of a function, such as `jnp.clip`, that can be within a part


def in_parts(name: str, module: ir.Module, symbols: ir.SymbolTable) -> str:
    """The name of a copy of a function, its loops included, that is made of parts."""
    made: list[Op] = []
    try:
        return _Copies(module, symbols, made).copy(name)
    except Exception:
        for function in reversed(made):  # Half a function would spoil the whole program.
            symbols.erase(function)
        raise


class _Copies:
    def __init__(self, module: ir.Module, symbols: ir.SymbolTable, made: list[Op]):
        self.module, self.symbols, self.made = module, symbols, made
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
        self.made.append(function)
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
            found = self.functions.get(name)  # None: a copy
            ops = [] if found is None else operations(found.regions[0].blocks[0])
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
