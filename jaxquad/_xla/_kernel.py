"""A whole time loop as one compiled kernel on a CPU, and expensive operations computed once.

XLA's CPU runtime dispatches every small operation of a loop by itself, which costs more than the
arithmetic of one vehicle does. A call with two attributes becomes one kernel instead. They are
internal to XLA, so they are used only where the installed version is known to take them, and what
goes in is bounded; all else is compiled as any other program.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Jaxpr, JaxprEqn, Literal, Primitive
from jax.extend.mlir import ir
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from . import _switch
from ._stablehlo import (
    ATTRIBUTE,
    calls_within,
    hold_in_kernel,
    in_parts,
    Op,
    operations_in,
    text,
    why_not,
)
from ._switch import device_kernels, is_off, MOST_CELLS, note, plain_loops, Result, Scan, Step


def as_one_kernel(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    """`function(*args)`, compiled as one kernel if it can be; the arguments are arrays.

    So are its derivatives: what is differentiated is marked where it enters and where it leaves,
    and each mark is the transpose of the other.
    """
    if why_no_kernels() is not None:
        return function(*args)

    def jaxquad_kernel(*args: PyTree) -> PyTree:
        return function(*args)

    entered = jax.tree.map(_marked(enter), args)
    return jax.tree.map(_marked(leave), jax.jit(jaxquad_kernel)(*entered))


def why_no_kernels() -> str | None:
    """Why loops are compiled plain here; None if they become kernels."""
    if is_off():
        return "switched off"
    if jax.default_backend() != "cpu":
        return f"the platform is {jax.default_backend()}, and kernels are for CPUs"
    if device_kernels.value != "auto":
        return "kernels of a GPU are being tried"
    return _switch.why_not_trusted()


def why_plain() -> str | None:
    """Why loops are compiled plain here; None if they become kernels, of a CPU or of a GPU."""
    reason = why_no_kernels()
    return None if why_no_device_kernels() is None else reason


_failed: set[object] = set()


def or_plain(name: str, kind: Callable[[], object], run: Callable[[], PyTree]) -> PyTree:
    """`run()`; with plain loops, and a warning, where it does not compile with kernels.

    The next one of its `kind` is run with plain loops at once.
    """
    if _failed and why_plain() is None and kind() in _failed:
        with plain_loops(True):
            return run()
    try:
        return run()
    except eqx.EquinoxRuntimeError:  # raised by what runs: it did compile
        raise
    except jax.errors.JaxRuntimeError as error:
        if why_plain() is not None:
            raise
        with plain_loops(True):
            result = run()  # If the kernel is not at fault, this raises too.
        _failed.add(kind())
        reason = str(error).strip().splitlines()[0][:200]
        _switch.warn_once(f"{name} did not compile as one kernel ({reason})")
        return result


def _marked(mark: Primitive) -> Callable[[Array], Array]:
    return lambda x: mark.bind(x) if jnp.issubdtype(x.dtype, jnp.floating) else x


def why_no_device_kernels() -> str | None:
    """Why loops of ensembles are compiled plain on this platform; None if they become kernels."""
    if is_off():
        return "switched off"
    if device_kernels.value != "auto":
        return None
    if jax.default_backend() != "gpu":
        return f"the platform is {jax.default_backend()}, and these kernels are for GPUs"
    reason = _switch.why_no_trust_in_gpu()
    if reason is not None:
        _switch.warn_once(reason)
    return reason


def scan_on_device(
    step: Step, carry: PyTree, signals: PyTree, members: int, scan: Scan
) -> Result | None:
    """`scan(step, carry, signals)` as one kernel of an accelerator; None where that cannot be.

    An axis as long as the ensemble is the members' axis. No mistake is possible where there are
    more members than an array in a kernel has numbers, and smaller ensembles gain little.
    """
    fewest = MOST_CELLS if device_kernels.value == "auto" else 1
    if members <= fewest or why_no_device_kernels() is not None:
        return None
    from ._device_loop import scan_in_kernel

    return scan_in_kernel(step, carry, signals, members, scan)


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
    program = ctx.module_context
    try:
        call = _owner(x)
        if _is_plain_call(call) and _is_for_one_cpu(program):
            for kernel in (call, *_forward_passes(call, program)):
                _make_kernel(kernel, program)
    except Exception as error:  # The compiler's interfaces have changed: do without the kernel.
        _switch.warn_once(
            f"JAX {jax.__version__} cannot mark a kernel ({type(error).__name__}: {error})"
        )
    return [x]


def _owner(x: ir.Value) -> Op | ir.Block:
    return getattr(x.owner, "operation", x.owner)


def _forward_passes(call: Op, program: mlir.ModuleContext) -> Iterator[Op]:
    """The calls whose results a call takes. What is in a function takes them as its arguments; its
    forward pass is in one written before."""
    owners = [_owner(operand) for operand in call.operands]
    yield from filter(_is_plain_call, owners)
    alone = isinstance(program.axis_context, mlir.ShardingContext)  # then all functions are for one
    if alone and any(isinstance(owner, ir.Block) for owner in owners):
        before = [op for f in program.module.body.operations for op in operations_in(f)]
        yield from filter(_is_plain_call, before)


def _make_kernel(call: Op, program: mlir.ModuleContext) -> None:
    if not _is_plain_call(call):
        return
    reason = why_not(call, program.module)
    if reason is not None:
        note(f"a kernel does not hold {reason}")
        call.attributes[ATTRIBUTE] = _attributes(_SEEN)
        return
    name = in_parts(text(call, "callee"), program.module, program.symbol_table)
    call.attributes["callee"] = ir.FlatSymbolRefAttr.get(name)
    parts = calls_within(name, "jaxquad_block", program.module)
    if len(parts) > 1:  # a block computed again, and reversed
        call.attributes[ATTRIBUTE] = _attributes(_SEEN)
    else:
        parts = [call]
    for part in parts:
        hold_in_kernel(part, program.module, program.symbol_table, _attributes(_TAGS))


def _attributes(texts: dict[str, str]) -> ir.Attribute:
    named: dict[str, ir.Attribute] = {name: ir.StringAttr.get(x) for name, x in texts.items()}
    return ir.DictAttr.get(named)


def _is_plain_call(op: Op | ir.Block) -> TypeGuard[ir.Operation]:
    """Whether this is a call to make a kernel of; one that is given nothing is a constant."""
    if not isinstance(op, ir.Operation) or op.name != "func.call" or ATTRIBUTE in op.attributes:
        return False
    return text(op, "callee").startswith("jaxquad_kernel") and len(op.operands) > 0


def _is_for_one_cpu(program: mlir.ModuleContext) -> bool:
    """Whether XLA has nothing to split among devices: a kernel cannot be split."""
    where = program.axis_context
    if isinstance(where, mlir.SPMDAxisContext):
        alone = where.manual_axes == frozenset(where.mesh.axis_names)
    else:
        alone = isinstance(where, mlir.ShardingContext) and where.num_devices == 1
    return alone and tuple(program.platforms) == ("cpu",)


mlir.register_lowering(enter, lambda ctx, x: [x])
mlir.register_lowering(leave, _tag, cacheable=False)


# Expensive operations computed once: what a CPU's compiler fuses, it computes for each user anew.
#
# Derivatives share exponentials and quotients with the response. Fused into ten outputs, each of
# them computes them again.

Value = Any  # an array, or the number of a literal


def no_fuse(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    def run(*args: PyTree) -> PyTree:
        with set_xla_metadata(inlineable="true"):  # `jnp.where` and its like are calls themselves
            return function(*args)

    with set_xla_metadata(inlineable="false"):
        return jax.jit(run)(*args)


_COSTLY = {"exp", "log", "sin", "cos", "tan", "div", "atan2", "sqrt", "rsqrt", "pow", "tanh"}
_INLINED = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr"}
_LARGE = 1024  # elements, from which on no call costs more than recomputing


def evaluate_once(function: Callable[..., PyTree], *, least: int) -> Callable[..., PyTree]:
    if jax.default_backend() != "cpu":
        return function

    def run(*args: PyTree) -> PyTree:
        leaves, structure = jax.tree.flatten(args)
        flat = lambda *xs: function(*jax.tree.unflatten(structure, xs))
        closed, shape = jax.make_jaxpr(flat, return_shape=True)(*leaves)
        values = _Evaluation(least).evaluate(closed.jaxpr, closed.consts, leaves)
        return jax.tree.unflatten(jax.tree.structure(shape), values)

    return run


class _Evaluation:
    """Evaluates jaxprs, and remembers what it has computed: slopes by different parameters were
    traced apart, and what they share has to be found again."""

    def __init__(self, least: int):
        self.least, self.computed = least, dict[tuple, tuple[Sequence[Value], list[Value]]]()

    def evaluate(self, jaxpr: Jaxpr, consts: Sequence[Value], args: Sequence[Value]) -> list[Value]:
        values = dict(zip(jaxpr.constvars, consts, strict=True))
        values.update(zip(jaxpr.invars, args, strict=True))
        read = lambda var: var.val if isinstance(var, Literal) else values[var]
        for equation in jaxpr.eqns:
            results = self._apply(equation, [read(var) for var in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(var) for var in jaxpr.outvars]

    def _apply(self, equation: JaxprEqn, args: list[Value]) -> list[Value]:
        name, params = equation.primitive.name, equation.params
        sizes = [getattr(var.aval, "size", 0) for var in equation.outvars]
        if name in _INLINED:
            inner = params[_INLINED[name]]
            is_marked = (equation.ctx.xla_metadata or {}).get("inlineable") == "false"
            if is_marked and max(sizes) >= _LARGE:  # by `no_fuse`, and longer than a call
                return self._remembered(("call", id(inner)), args, lambda: _bind(equation, args))
            return self.evaluate(inner.jaxpr, inner.consts, args)
        if equation.primitive.multiple_results:
            return _bind(equation, args)

        def compute() -> list[Value]:
            if sizes[0] < self.least:
                return _bind(equation, args)
            if name == "div" and jnp.iscomplexobj(args[1]):
                return [args[0] * self._reciprocal(args[1])]
            if name == "integer_pow" and params["y"] < 0 and jnp.iscomplexobj(args[0]):
                return [jax.lax.integer_pow(self._reciprocal(args[0]), -params["y"])]
            if name in _COSTLY:
                return [no_fuse(lambda *xs: _bind(equation, xs)[0], *args)]
            return _bind(equation, args)

        return self._remembered((name, str(params)), args, compute)

    def _remembered(
        self, what: tuple, args: Sequence[Value], compute: Callable[[], list[Value]]
    ) -> list[Value]:
        key = (*what, *map(_key_of, args))
        if key not in self.computed:
            self.computed[key] = args, compute()  # holding the arguments keeps their ids their own
        return self.computed[key][1]

    def _reciprocal(self, value: Value) -> Value:
        def reciprocal(value: Value) -> Value:
            squared = jnp.real(value) ** 2 + jnp.imag(value) ** 2
            return jax.lax.complex(jnp.real(value) / squared, -jnp.imag(value) / squared)

        return self._remembered(("reciprocal",), [value], lambda: [no_fuse(reciprocal, value)])[0]


def _key_of(arg: Value) -> Value:
    # Literals are new objects at every place where they stand.
    is_number = isinstance(arg, np.ndarray | np.generic) and arg.ndim == 0
    return (str(arg.dtype), repr(arg.item())) if is_number else id(arg)


def _bind(equation: JaxprEqn, args: Sequence[Value]) -> list[Value]:
    params = equation.primitive.get_bind_params(equation.params)
    with equation.ctx.manager:  # without it `no_fuse` would be lost
        results = equation.primitive.bind(*args, **params)
    return list(results) if equation.primitive.multiple_results else [results]
