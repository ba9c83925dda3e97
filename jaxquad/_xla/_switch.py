"""Whether loops become kernels, whether these can be trusted, and the options of XLA."""

import functools as ft
import json
import os
import platform
import subprocess
import sys
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, get_args, Literal

import jax
import jax.numpy as jnp
import jaxlib.version
import numpy as np
import platformdirs
from jaxtyping import Array, PyTree

from . import _cuda


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
    if jax.default_backend() != "cpu":
        return {}
    return compiler_options() | {k: v for k, v in _BRIEF.items() if not _is_chosen(k) and _takes(k)}


def hasty_options() -> dict[str, Any]:
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


# Whether kernels can be trusted: with the installed JAX on a CPU, and on this GPU.
#
# They rely on internals of XLA. The tests ran on the versions that are listed here; with any other,
# a child process tries values, a gradient and what is too large for a kernel. XLA's failures can
# end a process, so it has to be another one. Its answer is kept in the user's cache folder.

_CHILD = "JAXQUAD_KERNEL_CANARY"  # set in the child, which has nobody to ask
_SECONDS = 300.0


@ft.cache
def why_not_trusted() -> str | None:
    """What speaks against kernels with this version of jaxlib; None if nothing does."""
    version = jaxlib.version.__version__
    if version in TESTED or _CHILD in os.environ:
        return None
    path, answer = _answer_path(), None  # empty if kernels passed; None if there is none
    if path is not None and path.is_file():
        try:
            answer = json.loads(path.read_text())["why_not"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            warn_once(f"{path} cannot be read ({error}); the trial is run again")
    if not isinstance(answer, str):
        answer = _ask_child()
        try:
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(json.dumps({"why_not": answer}))
        except OSError as error:
            warn_once(f"the result of the trial cannot be stored in {path} ({error})")
    if answer:
        warn_once(f"jaxlib {version} did not pass the trial of one-kernel loops ({answer})")
    return answer or None


def _answer_path() -> Path | None:
    if os.environ.get("JAXQUAD_CACHE") == "off":
        return None
    versions = f"jax-{jax.__version__}-jaxlib-{jaxlib.version.__version__}"
    folder = Path(platformdirs.user_cache_dir("jaxquad"))
    return folder / f"kernel-{versions}-{platform.machine()}.json"


def _ask_child() -> str:
    """Empty if kernels passed, else what went wrong."""
    program = "from jaxquad._xla._switch import try_kernels; try_kernels()"
    around = os.environ | {_CHILD: "1", "JAX_PLATFORMS": "cpu", "JAXQUAD_KERNEL": "auto"}
    around["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    try:
        ran = subprocess.run(
            [sys.executable, "-W", "error::UserWarning", "-c", program],
            env=around, capture_output=True, text=True, timeout=_SECONDS,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError) as error:
        return str(error)
    if ran.returncode == 0:
        return ""
    said = ran.stderr.strip().splitlines()
    return f"status {ran.returncode}: {said[-1] if said else 'no message'}"


def try_kernels() -> None:
    """Raise AssertionError unless kernels compute what plain loops do."""
    from ._kernel import as_one_kernel

    def loop(x: Array, inputs: Array) -> tuple[Array, Array]:
        def step(x: Array, u: Array) -> tuple[Array, Array]:
            y = jnp.tanh(jnp.roll(x, 1, axis=0) * 0.9 + jnp.sin(u) / (2 + x * x))
            return y, x * y

        return jax.lax.scan(step, x, inputs)

    def total(x: Array, inputs: Array) -> Array:
        last, stored = as_one_kernel(loop, x, inputs)
        return jnp.sum(last**2) + jnp.mean(stored)

    start, inputs = jnp.linspace(-1.0, 1.0, 300).reshape(3, 100), jnp.linspace(0.0, 9.0, 500)
    large = jnp.linspace(-1.0, 1.0, 99_999).reshape(3, -1)
    for function, args in (
        (lambda x, u: as_one_kernel(loop, x, u), (start, inputs)),
        (total, (start[:, 0], inputs)),
        (jax.grad(total, argnums=(0, 1)), (start, inputs)),
        (total, (large, inputs[:5])),
        (jax.grad(total), (large, inputs[:5])),
    ):
        result = jax.jit(function)(*args)
        with plain_loops(True):
            expected = jax.jit(function)(*args)
        for one, other in zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)
    lowered = jax.jit(jax.grad(total)).lower(start, inputs).as_text()
    assert lowered.count("xla_cpu_small_call") == 2, "loops are not marked as kernels"


_MEMBERS, _SAMPLES = 600, 7
_DELAY = 76  # samples: so long that blocks ask for more than the 48 kB that they have unasked
_CLOSE = 1e-3  # relative: the devices' functions differ in their last bits


@ft.cache
def why_no_trust_in_gpu() -> str | None:
    """What speaks against the kernels of this GPU, by a small loop; None if nothing does."""
    try:
        # In a thread of its own: it may be asked for while another program is traced here.
        with ThreadPoolExecutor(1) as thread:
            differ = thread.submit(_largest_difference, device_kernels.value).result()
    except Exception as error:  # A compiler that refuses a kernel may raise anything.
        first = (str(error).strip().splitlines() or [""])[0][:200]
        return f"the trial of a GPU's kernels failed ({type(error).__name__}: {first})"
    if differ < _CLOSE:
        return None
    return f"a kernel of this GPU differs from a plain loop by {differ:.1g}, relative"


def _largest_difference(mode: str) -> float:
    """Of values and derivatives, relative to the largest number of each array."""
    from ._cuda import PRELUDE

    _cuda.ptx_of(PRELUDE, _cuda.architecture())  # raises what is wrong with NVRTC
    x = jnp.linspace(0.2, 0.8, 2 * _MEMBERS, dtype=jnp.float32).reshape(2, _MEMBERS)
    gain, push = jnp.array([0.9, 0.4], jnp.float32), jnp.linspace(0.0, 0.5, _SAMPLES)
    args = x, gain, push.astype(jnp.float32)[:, None]
    with device_kernels(mode):  # the value, what was stored, three gradients
        pairs = zip(
            *(jax.tree.leaves(_measure(f)(*args)) for f in (_by_kernel, jax.lax.scan)), strict=True
        )
    differ = 0.0
    for one, other in pairs:
        one, other = np.asarray(one), np.asarray(other)
        if not np.isfinite(one).all():
            return np.inf
        differ = max(differ, float(np.max(np.abs(one - other)) / np.max(np.abs(other))))
    return differ


def _by_kernel(step: Step, carry: PyTree, signals: PyTree) -> tuple[PyTree, PyTree]:
    from ._device_loop import scan_in_kernel

    result = scan_in_kernel(step, carry, signals, _MEMBERS, jax.lax.scan)
    if result is None:
        raise ValueError("the step of the trial does not fit a kernel")
    return result


def _measure(scan: Scan):
    def total(x: Array, gain: Array, push: Array) -> tuple[Array, Array]:
        def step(carry: tuple[Array, Array], now: Array) -> tuple[tuple[Array, Array], Array]:
            x, late = carry
            turned = jnp.stack([jnp.sin(x[1]), x[0] / (1 + late[3] * x[1])])
            after = gain[:, None] * turned + jnp.maximum(now[:, None], 0.1 * x)
            late = jnp.concatenate([x[:1], late[:-1]])
            return (jnp.where(after > 1.2, 1.2, after), late), jnp.sqrt(jnp.abs(after[0]) + 0.1)

        (last, _), stored = scan(step, (x, jnp.broadcast_to(x[:1], (_DELAY, _MEMBERS))), push)
        return jnp.sum(last * last) + jnp.sum(stored), stored

    return jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True))
