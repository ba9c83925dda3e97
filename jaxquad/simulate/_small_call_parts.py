"""A kernel's arithmetic in parts, each a function of its own that computes nothing twice.

XLA merges elementwise operations into loops of one result each, and computes again in every loop
what several of them need: three times over in a controlled vehicle, more in its derivatives. It
merges nothing across the calls of functions, so what is needed twice becomes a part's result.
"""

from typing import Any

from jax.extend.mlir import ir

from ._small_call_division import ATTRIBUTE, Division, ELEMENTWISE, kind, operations, size, text


_SHORT = 32  # numbers that are computed again as fast as they are read
_FEW = 10  # operations of a function, such as `jnp.clip`, that can be within a part


def in_parts(name: str, module: Any, symbols: Any) -> str:
    """The name of a copy of a function, its loops included, that is made of parts.

    Of the function itself if the compiler's interfaces have changed.
    """
    made: list[Any] = []
    try:
        return _Copies(module, symbols, made).copy(name)
    except Exception:
        for function in reversed(made):  # Half a function would spoil the whole program.
            symbols.erase(function)
        return name


class _Copies:
    def __init__(self, module: Any, symbols: Any, made: list[Any]):
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

    def insert(self, function: Any) -> str:
        name = ir.StringAttr(self.symbols.insert(function)).value
        self.made.append(function)
        return name

    def _divide(self, op: Any) -> None:
        for place, region in enumerate(op.regions):
            for block in region:
                for inner in operations(block):
                    if inner.name == "func.call" and not self.is_small(text(inner, "callee")):
                        name = self.copy(text(inner, "callee"))
                        inner.attributes["callee"] = ir.FlatSymbolRefAttr.get(name)
                    elif kind(inner) in ("while", "case", "if"):
                        self._divide(inner)
                if kind(op) != "while" or place == 1:  # the first region is the condition
                    Division(block, self).apply()

    def is_small(self, name: str) -> bool:
        """Whether a function is a few elementwise operations."""
        if name not in self.small:
            found = self.functions.get(name)  # None: a copy
            ops = [] if found is None else operations(found.regions[0].blocks[0])
            self.small[name] = 0 < len(ops) <= _FEW and all(map(self._is_light, ops[:-1]))
        return self.small[name]

    def _is_light(self, op: Any) -> bool:
        called = op.name == "func.call" and ATTRIBUTE not in op.attributes
        light = self.is_small(text(op, "callee")) if called else kind(op) in ELEMENTWISE
        return light and len(op.results) == 1

    def is_in_a_part(self, op: Any) -> bool:
        return self._is_light(op) and (kind(op) == "constant" or size(op.results[0]) >= _SHORT)
