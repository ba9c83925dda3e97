"""Whether loops become kernels, and what was compiled plain instead."""

import os
import warnings
from typing import get_args, Literal

import jax


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
