"""Whether kernels can be trusted: with the installed JAX on a CPU, and on this GPU.

They rely on internals of XLA. The tests ran on the versions that are listed here; with any other, a
child process tries values, a gradient and what is too large for a kernel. XLA's failures can end a
process, so it has to be another one. Its answer is kept in the user's cache folder.
"""

import functools as ft
import json
import os
import platform
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib.version
import numpy as np
import platformdirs
from jaxtyping import Array, PyTree

from . import _nvrtc
from ._switch import device_kernels, plain_loops, Scan, Step, TESTED, warn_once


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
    program = "from jaxquad._xla._trial import try_kernels; try_kernels()"
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
    from ._cuda_text import PRELUDE

    _nvrtc.ptx_of(PRELUDE, _nvrtc.architecture())  # raises what is wrong with NVRTC
    x = jnp.linspace(0.2, 0.8, 2 * _MEMBERS, dtype=jnp.float32).reshape(2, _MEMBERS)
    gain, push = jnp.array([0.9, 0.4], jnp.float32), jnp.linspace(0.0, 0.5, _SAMPLES)
    args = x, gain, push.astype(jnp.float32)[:, None]
    with device_kernels(mode):  # the value, what was stored, three gradients
        pairs = zip(
            *(jax.tree.leaves(_measure(f)(*args)) for f in (_by_kernel, _plain_scan)), strict=True
        )
    differ = 0.0
    for one, other in pairs:
        one, other = np.asarray(one), np.asarray(other)
        if not np.isfinite(one).all():
            return np.inf
        differ = max(differ, float(np.max(np.abs(one - other)) / np.max(np.abs(other))))
    return differ


def _plain_scan(step: Step, carry: PyTree, signals: PyTree) -> tuple[PyTree, PyTree]:
    return jax.lax.scan(step, carry, signals)


def _by_kernel(step: Step, carry: PyTree, signals: PyTree) -> tuple[PyTree, PyTree]:
    from ._device_loop import scan_in_kernel

    result = scan_in_kernel(step, carry, signals, _MEMBERS, _plain_scan)
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
