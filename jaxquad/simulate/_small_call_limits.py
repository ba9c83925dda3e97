"""What a kernel can hold, read from the StableHLO that XLA is about to compile."""

from collections.abc import Iterator
from typing import Any

from jax.extend.mlir import ir
from jax.extend.mlir.dialects import stablehlo


# XLA hands these to libraries or callbacks, which a kernel cannot call (some end the process) ...
_FOREIGN = {"custom_call", "sort", "scatter", "fft", "cholesky", "triangular_solve", "convolution"}
_FOREIGN |= {"rng_bit_generator", "infeed", "outfeed", "send", "recv", "top_k", "composite"}
# ... and sums and products from so many numbers on. Wide arithmetic fits, but one thread without
# XLA's fusion is then the slower way.
_COUNTED = {"reduce", "reduce_window", "dot_general", "dot", "add", "subtract", "multiply"}
_LARGE = 4096


def fits_a_kernel(call: Any, module: Any) -> bool:
    """Whether all that `call` leads to fits, and all that it is given is used.

    XLA ends the process over an argument that is not used.
    """
    functions = {_text(f, "sym_name"): f.operation for f in module.body.operations}
    called = functions[_text(call, "callee")]
    arguments = called.regions[0].blocks[0].arguments
    return all(_is_used(argument, functions) for argument in arguments) and _is_plain(
        called, functions, set()
    )


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
    return kind not in _FOREIGN


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


def _is_used(value: Any, functions: dict[str, Any]) -> bool:
    """Whether something is computed from a value; handing it on is not enough."""
    for use in value.uses:
        op, place = use.owner.operation, use.operand_number
        if op.name == "func.call":
            inner = [functions[_text(op, "callee")].regions[0].blocks[0].arguments[place]]
        elif op.name == "stablehlo.while":
            inner = [region.blocks[0].arguments[place] for region in op.regions]
        elif op.name in ("stablehlo.return", "func.return"):
            inner = []
        else:
            return True
        if any(_is_used(x, functions) for x in inner):
            return True
    return False
