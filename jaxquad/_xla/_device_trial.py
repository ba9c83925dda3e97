"""Whether a GPU's kernels can be trusted: a small loop, by them and plain, once per process."""

import functools as ft
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ._accelerator import Scan, Step
from ._cuda_text import PRELUDE
from ._device_loop import scan_in_kernel
from ._nvrtc import architecture, ptx_of
from ._switch import device_kernels


_MEMBERS, _SAMPLES = 600, 7
_DELAY = 76  # samples: so long that blocks ask for more than the 48 kB that they have unasked
_CLOSE = 1e-3  # relative: the devices' functions differ in their last bits


@ft.cache
def why_not_trusted() -> str | None:
    """What speaks against the kernels of this GPU; None if nothing does."""
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
    ptx_of(PRELUDE, architecture())  # raises what is wrong with NVRTC
    with device_kernels(mode):
        return max(map(_difference, *_results()))


def _difference(one: np.ndarray, other: np.ndarray) -> float:
    if not np.isfinite(one).all():
        return np.inf
    return float(np.max(np.abs(one - other)) / np.max(np.abs(other)))


def _results() -> list[list[np.ndarray]]:
    """By the kernels and plain: the value, what was stored, three gradients."""
    x = jnp.linspace(0.2, 0.8, 2 * _MEMBERS, dtype=jnp.float32).reshape(2, _MEMBERS)
    gain, push = jnp.array([0.9, 0.4], jnp.float32), jnp.linspace(0.0, 0.5, _SAMPLES)
    args = x, gain, push.astype(jnp.float32)[:, None]
    found = (_measure(scan)(*args) for scan in (_by_kernel, _plain))
    return [[np.asarray(x) for x in jax.tree.leaves(result)] for result in found]


def _plain(step: Step, carry: PyTree, signals: PyTree) -> tuple[PyTree, PyTree]:
    return jax.lax.scan(step, carry, signals)


def _by_kernel(step: Step, carry: PyTree, signals: PyTree) -> tuple[PyTree, PyTree]:
    found = scan_in_kernel(step, carry, signals, _MEMBERS, _plain)
    if found is None:
        raise ValueError("the step of the trial does not fit a kernel")
    return found


def _measure(scan: Scan):
    def total(x: Array, gain: Array, push: Array) -> tuple[Array, Array]:
        def step(carry: tuple[Array, Array], now: Array) -> tuple[tuple[Array, Array], Array]:
            x, late = carry
            turned = jnp.stack([jnp.sin(x[1]), x[0] / (1 + late[3] * x[1])])
            after = gain[:, None] * turned + jnp.maximum(now[:, None], 0.1 * x)
            late = jnp.concatenate([x[:1], late[:-1]])
            return (jnp.where(after > 1.2, 1.2, after), late), jnp.sqrt(jnp.abs(after[0]) + 0.1)

        (last, _), seen = scan(step, (x, jnp.broadcast_to(x[:1], (_DELAY, _MEMBERS))), push)
        return jnp.sum(last * last) + jnp.sum(seen), seen

    return jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True))
