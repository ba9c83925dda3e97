"""The compilers' functions without compilers: plain scans and JAX's own options.

These are all the names that the package takes from `jaxquad._xla`.
"""

from collections.abc import Callable
from typing import Any

from jaxtyping import PyTree


reason = ""  # why there are no compilers


def as_one_kernel(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    return function(*args)


def scan_on_device(
    step: Callable, carry: PyTree, signals: PyTree, members: int, scan: Callable
) -> None:
    return None


def why_no_device_kernels() -> str | None:
    return reason


def why_plain() -> str | None:
    return reason


def or_plain(name: str, kind: Callable[[], object], run: Callable[[], PyTree]) -> PyTree:
    return run()


def set_kernel(kernel: str) -> None:
    if kernel not in ("auto", "off"):
        raise ValueError(f'kernel is "{kernel}", but it must be "auto" or "off"')


def switches() -> tuple:
    return ()


def left_plain() -> tuple[str, ...]:
    return ()


def compiler_options() -> dict[str, Any]:
    return {}


brief_options = hasty_options = compiler_options


def no_fuse(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    return function(*args)


def evaluate_once(function: Callable[..., PyTree], *, least: int) -> Callable[..., PyTree]:
    return function
