"""How loops are compiled where the library owns the outermost jit."""

import functools as ft
import os
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlib.version
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import Primitive
from jax.interpreters import mlir
from jaxtyping import PyTree

from ._accelerator import why_no_device_kernels
from ._canary import TESTED
from ._kept_programs import KeptPrograms, kind_of
from ._kernel import why_no_kernels
from ._prepared import Prepared
from ._switch import Kernel, left_plain, plain_loops, set_kernel, warn_once


class Engine(NamedTuple):
    """What loops are compiled with. It changes how long they take, and no result."""

    platform: str
    one_kernel: bool  # whether a loop of plain arithmetic becomes one kernel
    vector_bits: int | None  # of a jit with `compiler_options()`; None for the compiler's choice
    why_not: str | None  # why no loop becomes a kernel
    left_plain: tuple[str, ...]  # what did not become a kernel in this process, and why


def engine(kernel: Kernel | None = None) -> Engine:
    """Tell what loops are compiled with, and choose it.

    On a CPU a time loop is compiled as one kernel, which makes the gradient of a single flight 25
    times faster (2.4 times with jaxlib 0.12, which runs plain loops better). This relies on
    internals of XLA. It is on for the versions of jaxlib that the tests ran on; with any other, a
    child process tries it once, and its answer is kept in the user's cache folder (not with
    `JAXQUAD_CACHE=off` in the environment). Loops with operations that a kernel cannot hold, or
    with too many or too large ones, are compiled plain. On an NVIDIA GPU the loop of an ensemble of
    more than 512 members is one kernel, made by the NVRTC that `jax[cuda13]` brings.

    Where `jq.simulate`, `jq.evaluate` and the like are called outside of `jax.jit`, a kernel that
    does not compile is compiled plain, with a warning. Within a `jax.jit` of your own that cannot
    be done: if it fails in XLA, call `jq.engine(kernel="off")` and file an issue.

    **Arguments:**

    - `kernel`: `"off"` compiles all loops plain from then on, as `JAXQUAD_KERNEL=off` in the
        environment does; `"auto"` makes kernels of those that can be; `None` leaves it as it is.

    **Returns:**

    An `Engine`: platform, whether loops become kernels and why not, and what was left plain.

    **Raises:**

    - `ValueError`: `kernel`, or `JAXQUAD_KERNEL`, is another word.
    """
    if kernel is not None:
        set_kernel(kernel)
    reason = _why_plain()
    bits = compiler_options().get("xla_cpu_prefer_vector_width")
    return Engine(jax.default_backend(), reason is None, bits, reason, left_plain())


def _why_plain() -> str | None:
    """Why loops are compiled plain here; None if they become kernels, of a CPU or of a GPU."""
    reason = why_no_kernels()
    return None if why_no_device_kernels() is None else reason


class Jit:
    """`eqx.filter_jit` of a function that loops, with the compiler's options for loops.

    JAX takes options of an outermost jit only: within another, such as a user's, this one has none,
    and `compiler_options()` are there to be given to that one. What does not compile with kernels
    is compiled plain, with a warning.
    """

    def __init__(
        self,
        function: Callable[..., PyTree],
        options: Callable[[], dict[str, Any]] | None = None,
    ):
        ft.update_wrapper(self, function)
        self._function = function
        self._options = compiler_options if options is None else options
        self._kept = KeptPrograms(function, self._options)
        self._prepared = Prepared(function, self._options)
        self._name = function.__name__
        self._plain = eqx.filter_jit(function)
        self._failed: set[tuple] = set()
        self._known: set[tuple] = set()

    @ft.cached_property
    def brief(self) -> "Jit":
        """The same function, compiled with `brief_options`."""
        return self if self._options is brief_options else Jit(self._function, brief_options)

    def __call__(self, *args: PyTree) -> PyTree:
        return self.of_flat(args, *jax.tree.flatten(args))

    def of_flat(self, args: tuple, leaves: list, structure: PyTree) -> PyTree:
        """The same for arguments that the caller has taken apart."""
        if not _is_outermost(leaves):
            return self._plain(*args)
        run = lambda: self._run(args, leaves, structure)
        if self._failed and _why_plain() is None and _shapes(args) in self._failed:
            return _without_kernels(run)
        try:
            return run()
        except eqx.EquinoxRuntimeError:  # raised by what runs: it did compile
            raise
        except jax.errors.JaxRuntimeError as error:
            if _why_plain() is not None:
                raise
            result = _without_kernels(run)  # If the kernel is not at fault, this raises too.
            self._failed.add(_shapes(args))
            warn_once(f"{self._name} did not compile as one kernel ({_first_line(error)})")
            return result

    def _run(self, args: PyTree, leaves: list, structure: PyTree) -> PyTree:
        program = self._kept.find(args)
        if program is not None:
            return program(args)
        try:
            return self._prepared(leaves, structure)
        except (jax.errors.JaxRuntimeError, ValueError) as error:
            if _RAISED not in str(error):
                raise
            return self._plain(*args)  # raises it with its own words, as equinox does

    def lower(self, *args: PyTree) -> jax.stages.Lowered:
        """What a call with such arguments, outside of other programs, compiles."""
        return self._prepared.lower(*jax.tree.flatten(args))

    def is_outermost(self, *args: PyTree) -> bool:
        """Whether a call with such arguments is no part of another program."""
        return _is_outermost(jax.tree.leaves(args))

    def is_new(self, *args: PyTree) -> bool:
        """Whether nobody has asked before for arguments that have the same program."""
        kinds = kind_of(args)
        if kinds in self._known:
            return False
        self._known.add(kinds)
        return True

    def begin(self, *args: PyTree) -> None:
        """Trace and lower what the first call with such arguments will compile."""
        if not self._kept.begin(args):
            self.lower(*args)


def compiler_options() -> dict[str, int]:
    """What to give `jax.jit(..., compiler_options=...)` around a loop; empty where nothing helps.

    On a CPU, 512-bit vectors; warns, once, if this XLA does not know the option.
    """
    return dict(_known()) if jax.default_backend() == "cpu" else {}


_WIDEST = {"xla_cpu_prefer_vector_width": 512}  # bits; LLVM takes half of what a CPU can, unasked
# Without XLA's own compiler of fused operations, and with less of LLVM's: that takes half of the
# time, and the derivatives of loops run as fast. LLVM's highest level, 3, unrolls loops over 16 to
# 64 members, which then take up to twice as long to compile and to run. XLA 0.12 has no way around
# that compiler: it takes loops no longer than 0.10 without it, and the first fit of a structure
# 0.9 s of processor more.
_LEVEL = "xla_backend_optimization_level"
_EMITTERS = "xla_cpu_use_fusion_emitters"
_WITHOUT = ("0.12.0.1",)  # of the versions that are not asked, those that do not know this option
_BRIEF = {_EMITTERS: False, _LEVEL: 2}


def brief_options() -> dict[str, Any]:
    """`compiler_options()` for programs that take longer to compile than they run."""
    if jax.default_backend() != "cpu":
        return {}
    return compiler_options() | {k: v for k, v in _BRIEF.items() if not _is_chosen(k) and _takes(k)}


def hasty_options() -> dict[str, Any]:
    """For programs without loops over time that run a few times: hardly any optimisation."""
    level = {_LEVEL: 0}
    return level if _is_chosen(_EMITTERS) or not _takes(_EMITTERS) else level | {_EMITTERS: False}


def _is_chosen(option: str) -> bool:
    """Whether the user has a say in it, by the environment or by JAX's own settings."""
    quickly = jax.config.values["jax_disable_most_optimizations"]
    return option in os.environ.get("XLA_FLAGS", "") or (quickly and "level" in option)


@ft.cache
def _takes(option: str) -> bool:
    if option == _EMITTERS and jaxlib.version.__version__ in _WITHOUT:
        return False
    return _refusal({option: _BRIEF[option]}) is None


@ft.cache
def _known() -> tuple[tuple[str, int], ...]:
    refusal = _refusal(_WIDEST)
    if refusal is None:
        return tuple(_WIDEST.items())
    warnings.warn(
        f"loops run up to a tenth slower: this jaxlib refuses {_WIDEST} ({refusal})", stacklevel=2
    )
    return ()


def _refusal(options: dict[str, Any]) -> Exception | None:
    """What XLA has against the options; the versions of jaxlib that the tests ran on know them."""
    if jaxlib.version.__version__ in TESTED:  # to ask takes 25 ms
        return None
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError as error:
        return error
    return None


_RAISED = "_EquinoxRuntimeError: "  # in the message of what `eqx.error_if` has raised


def _without_kernels(run: Callable[[], PyTree]) -> PyTree:
    with plain_loops(True):
        return run()


def _is_outermost(leaves: list) -> bool:
    # Within another jit even a constant is traced.
    constant = jnp.negative(np.zeros(())) if _probe is None else _probe.bind()
    return not any([isinstance(x, Tracer) for x in (constant, *leaves)])


def _make_probe() -> Primitive | None:
    """A tenth of the price of the cheapest operation of `jax.numpy`; None where it cannot be."""
    probe = Primitive("probe")
    probe.def_impl(lambda: False)
    try:
        probe.def_abstract_eval(lambda: ShapedArray((), np.dtype(bool)))
        lowered = mlir.lower_fun(lambda: np.zeros((), bool), multiple_results=False)
        mlir.register_lowering(probe, lowered)
    except AttributeError:  # a JAX without these rules, in which no loop is a kernel either
        return None
    return probe


_probe = _make_probe()


def _shapes(args: PyTree) -> tuple:
    """What tells compiled programs apart."""
    leaves, structure = jax.tree.flatten(args)
    arrays = [x for x in leaves if eqx.is_array(x)]
    return str(structure), *((x.shape, str(x.dtype)) for x in arrays)


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:200]
