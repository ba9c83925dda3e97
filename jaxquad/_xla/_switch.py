"""Whether loops become kernels, what was compiled plain instead, and the options of XLA."""

import functools as ft
import os
import warnings
from collections.abc import Callable
from typing import Any, get_args, Literal

import jax
import jaxlib.version
from jaxtyping import PyTree


TESTED = ("0.10.2", "0.12.0.1")  # versions of jaxlib
MOST_CELLS = 512  # of one array: a kernel of a GPU keeps them in registers
Result = tuple[PyTree, PyTree]
Step = Callable[[PyTree, PyTree], Result]
Scan = Callable[[Step, PyTree, PyTree], Result]
Kernel = Literal["auto", "off"]
_VARIABLE = "JAXQUAD_KERNEL"

# Part of what JAX tells compiled programs apart by: a change compiles them anew.
plain_loops = jax.make_user_context(False)
# "auto" makes kernels of a GPU where there is one, "forced" everywhere: for tests without one.
device_kernels = jax.make_user_context("auto")

_said: dict[str, None] = {}


def set_kernel(kernel: str) -> None:
    """Raises ValueError for another word."""
    plain_loops.set_global(_checked(kernel, "kernel") == "off")


def is_off() -> bool:
    """Whether kernels are switched off, by a program or by the environment."""
    return plain_loops.value or _checked(os.environ.get(_VARIABLE, "auto"), _VARIABLE) == "off"


def _checked(word: str, name: str) -> str:
    if word not in get_args(Kernel):
        raise ValueError(f'{name} is "{word}", but it must be "auto" or "off"')
    return word


def note(what: str) -> None:
    """Keep for `engine()` what was compiled plain by design, because a kernel cannot hold it."""
    _said.setdefault(what)


def warn_once(what: str) -> None:
    """Keep for `engine()`, and warn of, what should have become a kernel and did not."""
    if what not in _said:
        _said[what] = None
        warnings.warn(f"loops take longer than they could: {what}", stacklevel=3)


def left_plain() -> tuple[str, ...]:
    """All that was kept since the start of the process, each once."""
    return tuple(_said)


def switches() -> tuple:
    """What tells programs apart that are compiled with kernels or without."""
    return plain_loops.value, device_kernels.value


def compiler_options() -> dict[str, Any]:
    """512-bit vectors on a CPU."""
    return dict(_vector_options()) if jax.default_backend() == "cpu" else {}


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
def _vector_options() -> tuple[tuple[str, int], ...]:
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
