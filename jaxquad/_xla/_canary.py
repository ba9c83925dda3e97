"""Whether kernels can be trusted with the installed JAX.

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
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib.version
import numpy as np
import platformdirs
from jaxtyping import Array

from ._switch import plain_loops, warn_once


TESTED = ("0.10.2", "0.12.0.1")  # versions of jaxlib
_CHILD = "JAXQUAD_KERNEL_CANARY"  # set in the child, which has nobody to ask
_SECONDS = 300.0


@ft.cache
def why_not_trusted() -> str | None:
    """What speaks against kernels with this version of jaxlib; None if nothing does."""
    version = jaxlib.version.__version__
    if version in TESTED or _CHILD in os.environ:
        return None
    path = _answer_path()
    answer = _stored(path)
    if answer is None:
        answer = _ask_child()
        _store(path, answer)
    if answer:
        warn_once(f"jaxlib {version} did not pass the trial of one-kernel loops ({answer})")
    return answer or None


def _answer_path() -> Path | None:
    if os.environ.get("JAXQUAD_CACHE") == "off":
        return None
    versions = f"jax-{jax.__version__}-jaxlib-{jaxlib.version.__version__}"
    folder = Path(platformdirs.user_cache_dir("jaxquad"))
    return folder / f"kernel-{versions}-{platform.machine()}.json"


def _stored(path: Path | None) -> str | None:
    """The answer of another time: empty if kernels passed; None if there is none."""
    if path is None or not path.is_file():
        return None
    try:
        answer = json.loads(path.read_text())["why_not"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        warn_once(f"{path} cannot be read ({error}); the trial is run again")
        return None
    return answer if isinstance(answer, str) else None


def _store(path: Path | None, answer: str) -> None:
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"why_not": answer}))
    except OSError as error:
        warn_once(f"the result of the trial cannot be stored in {path} ({error})")


def _ask_child() -> str:
    """Empty if kernels passed, else what went wrong."""
    program = "from jaxquad._xla._canary import try_kernels; try_kernels()"
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
        last, seen = as_one_kernel(loop, x, inputs)
        return jnp.sum(last**2) + jnp.mean(seen)

    start, inputs = jnp.linspace(-1.0, 1.0, 300).reshape(3, 100), jnp.linspace(0.0, 9.0, 500)
    large = jnp.linspace(-1.0, 1.0, 99_999).reshape(3, -1)
    for function, args in (
        (lambda *given: as_one_kernel(loop, *given), (start, inputs)),
        (total, (start[:, 0], inputs)),
        (jax.grad(total, argnums=(0, 1)), (start, inputs)),
        (total, (large, inputs[:5])),
        (jax.grad(total), (large, inputs[:5])),
    ):
        found = jax.jit(function)(*args)
        with plain_loops(True):
            expected = jax.jit(function)(*args)
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)
    lowered = jax.jit(jax.grad(total)).lower(start, inputs).as_text()
    assert lowered.count("xla_cpu_small_call") == 2, "loops are not marked as kernels"
