"""Whether an ensemble's time loop becomes one kernel of a GPU. Loads nothing else before."""

from collections.abc import Callable

import jax
from jaxtyping import PyTree

from ._lanes import MOST_CELLS
from ._switch import device_kernels, is_off, warn_once


Result = tuple[PyTree, PyTree]
Step = Callable[[PyTree, PyTree], Result]
Scan = Callable[[Step, PyTree, PyTree], Result]


def why_no_device_kernels() -> str | None:
    """Why loops of ensembles are compiled plain on this platform; None if they become kernels."""
    if is_off():
        return "switched off"
    if device_kernels.value != "auto":
        return None
    if jax.default_backend() != "gpu":
        return f"the platform is {jax.default_backend()}, and these kernels are for GPUs"
    return _why_not_trusted()


def _why_not_trusted() -> str | None:
    try:
        from ._device_trial import why_not_trusted
    except (ImportError, AttributeError) as error:  # JAX's rules for primitives may move.
        reason = f"JAX {jax.__version__} lacks what kernels of a GPU are made with ({error})"
    else:
        reason = why_not_trusted()
    if reason is not None:
        warn_once(reason)
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
