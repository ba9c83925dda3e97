"""What the package asks of the compilers, or gets without them; compiled programs on the disk."""

import atexit
import contextlib
import functools as ft
import hashlib
import os
import platform
import shutil
import tempfile
import time
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, Literal, NamedTuple

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache
from jaxtyping import PyTree


# The compilers' functions without compilers: all names that the package takes from `jaxquad._xla`.
PLAIN = SimpleNamespace(
    reason="",  # why there are no compilers
    as_one_kernel=lambda function, *args: function(*args),
    scan_on_device=lambda step, carry, signals, members, scan: None,
    why_no_device_kernels=lambda: PLAIN.reason,
    why_plain=lambda: PLAIN.reason,
    or_plain=lambda name, kind, run: run(),
    set_kernel=lambda kernel: _require_switch(kernel),
    switches=tuple,
    left_plain=tuple,
    compiler_options=dict,
    brief_options=dict,
    hasty_options=dict,
    no_fuse=lambda function, *args: function(*args),
    evaluate_once=lambda function, *, least: function,
)


def _require_switch(kernel: str) -> None:
    if kernel not in ("auto", "off"):
        raise ValueError(f'kernel is "{kernel}", but it must be "auto" or "off"')


@ft.cache
def compilers() -> ModuleType | SimpleNamespace:
    """`jaxquad._xla`; without it, or with a JAX that lacks what it needs, plain scans."""
    try:
        import jaxquad._xla as xla
    except (ImportError, AttributeError) as error:  # JAX's interfaces to its compiler may move.
        PLAIN.reason = f"this JAX ({jax.__version__}) lacks what kernels are made with ({error})"
        warnings.warn(f"loops take longer than they could: {PLAIN.reason}", stacklevel=2)
        return PLAIN
    return xla


class Engine(NamedTuple):
    """What loops are compiled with. It changes how long they take, and no result."""

    platform: str
    one_kernel: bool  # whether a loop of plain arithmetic becomes one kernel
    vector_bits: int | None  # of a jit with `compiler_options()`; None for the compiler's choice
    why_not: str | None  # why no loop becomes a kernel
    left_plain: tuple[str, ...]  # what did not become a kernel in this process, and why


def engine(kernel: Literal["auto", "off"] | None = None) -> Engine:
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
        compilers().set_kernel(kernel)
    reason = compilers().why_plain()
    bits = compiler_options().get("xla_cpu_prefer_vector_width")
    return Engine(jax.default_backend(), reason is None, bits, reason, compilers().left_plain())


def compiler_options() -> dict[str, Any]:
    """What to give `jax.jit(..., compiler_options=...)` around a loop; empty where nothing helps.

    On a CPU, 512-bit vectors; warns, once, if this XLA does not know the option.
    """
    return compilers().compiler_options()


def brief_options() -> dict[str, Any]:
    """`compiler_options()` for programs that take longer to compile than they run."""
    return compilers().brief_options()


def hasty_options() -> dict[str, Any]:
    """For programs without loops over time that run a few times: hardly any optimisation."""
    return compilers().hasty_options()


def no_fuse(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    """`function(*args)` as a call that the CPU's compiler does not fuse with what is around it."""
    return compilers().no_fuse(function, *args)


FEW = 32  # elements, from which on a call costs less than recomputing them five times


def evaluate_once(function: Callable[..., PyTree], *, least: int = 1024) -> Callable[..., PyTree]:
    """The same function, in which expensive operations on large arrays are not recomputed.

    A response with its slopes by five parameters, for many members at many frequencies, takes less
    than half the time with it. Arrays are large from `least` elements on. What is called by
    `no_fuse` stays a call where its result is of 1024 elements or more.

    Complex quotients become products with one reciprocal, which loses them where a denominator's
    square overflows or underflows (1e-154 to 1e154): the result is then not finite. On other
    devices than the CPU, the function itself.
    """
    return compilers().evaluate_once(function, least=least)


# Compiled programs on the disk, for the next process.
#
# JAX writes its entries in place, so that a process that is killed, or two that write the same one,
# leave damaged entries behind, which JAX never replaces; and its own limit of size stops all
# writing after one such accident. So each process has a folder of its own, which begins with hard
# links to what is there. New entries are linked into the shared folder whole, JAX's own with a
# checksum before their name. A damaged entry is removed, and made again.

_VARIABLE = "JAXQUAD_CACHE"  # "off", or a folder
_ENTRIES = "*-cache"  # as JAX names them
_MOST_BYTES, _MOST_ENTRIES = 256 * 2**20, 4000
_ABANDONED = 86_400.0  # s after which the folder of a process that was killed goes without locks
_STARTING = 60.0  # s in which a process locks its folder
_LEAST = 0.0  # s of compile time from which a program is kept: reading one takes 1 ms
_OWN = "process-"  # begins the name of a process's own folder
_TRACED = "traced-"  # begins entries that hold a checksum themselves
_descriptors: list[int] = []  # of this process's own folder, which is locked until it ends


class ProgramWarning(UserWarning):
    """A kept program was damaged."""


def warn_of_damage() -> None:
    text = "a kept program was damaged: it is removed and compiled again"
    warnings.warn(text, ProgramWarning, stacklevel=2)


def enable_compile_cache() -> Path | None:
    """Keep compiled programs on the disk, so that the next process need not compile them again.

    They lie in the user's cache folder, at most 256 MB, and the least recently used go first. The
    command line does this by itself; importing jaxquad never does. The environment's
    `JAXQUAD_CACHE` is another folder, or `off`. A folder that JAX was given already
    (`JAX_COMPILATION_CACHE_DIR`) stays, with its own settings.

    **Returns:** the folder; None if it is switched off or cannot be written.
    """
    if os.environ.get(_VARIABLE) == "off":
        return None
    jax_folder = _jax_folder()
    if jax_folder is not None:
        return jax_folder.parent if _is_own(jax_folder) else jax_folder
    folder = os.environ.get(_VARIABLE)
    default = Path(platformdirs.user_cache_dir("jaxquad")) / f"programs-{_processor()}"
    shared = Path(folder).absolute() if folder else default
    try:
        shared.mkdir(parents=True, exist_ok=True)
        _prune(shared)
        mine = Path(tempfile.mkdtemp(prefix=_OWN, dir=shared))
        if (place := _locked(mine)) is not None:
            _descriptors.append(place)
        for path in shared.glob(_ENTRIES):
            _link_entry(path, mine)
    except OSError as error:
        warnings.warn(
            f"compiled programs are not kept: {error}. Name another folder by {_VARIABLE}, or "
            f"switch it off ({_VARIABLE}=off)",
            stacklevel=2,
        )
        return None
    jax.config.update("jax_compilation_cache_dir", str(mine))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _LEAST)
    # Else the name of this process's folder is part of what programs are found by.
    jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
    compilation_cache.reset_cache()  # An earlier compilation has fixed that there is none.
    atexit.register(shutil.rmtree, mine, ignore_errors=True)
    atexit.register(share_programs)
    return shared


def _locked(folder: Path) -> int | None:
    """The folder, open and locked until its process ends; None where another process has it."""
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    place = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(place)
        return None
    return place


def _link_entry(path: Path, mine: Path) -> None:
    """Put an entry of the shared folder into a process's own; what is damaged is removed."""
    checksum, _, name = path.name.rpartition(".")
    try:
        sound = path.is_file() and (
            name.startswith(_TRACED) or checksum == f"{zlib.crc32(path.read_bytes()):08x}"
        )
        if sound:
            os.link(path, mine / name)
            return
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    except FileNotFoundError:  # another process has just removed it
        return
    except FileExistsError:  # two processes have compiled it
        path.unlink(missing_ok=True)
        return
    warn_of_damage()


def _jax_folder() -> Path | None:
    # `jax.config.values` copies all settings, and every run of a program asks.
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    return Path(folder) if folder else None


def own_folder() -> Path | None:
    """This process's folder of programs; None without `enable_compile_cache`."""
    folder = _jax_folder()
    return folder if folder is not None and _is_own(folder) else None


def _is_own(folder: Path) -> bool:
    return folder.name.startswith(_OWN)


def _processor() -> str:
    """What tells processors apart that do not run each other's programs."""
    try:
        with open("/proc/cpuinfo") as file:
            flags = next((line for line in file if line.startswith(("flags", "Features"))), "")
    except OSError:
        flags = platform.processor()
    return hashlib.sha256(f"{platform.machine()} {flags}".encode()).hexdigest()[:12]


def _prune(shared: Path) -> None:
    """Remove the least recently used entries beyond the limits, and folders of killed processes."""
    entries = [(path, path.stat()) for path in shared.glob(_ENTRIES)]
    entries.sort(key=lambda entry: -max(entry[1].st_atime, entry[1].st_mtime))
    size = 0
    for k, (path, stat) in enumerate(entries):
        size += stat.st_size
        if size > _MOST_BYTES or k >= _MOST_ENTRIES:
            path.unlink(missing_ok=True)
    for folder in shared.glob(f"{_OWN}*"):  # their links keep the space of entries
        with contextlib.suppress(OSError):  # it is gone
            age = time.time() - folder.stat().st_mtime
            place = _locked(folder) if age > _STARTING else None
            if place is not None or age > _ABANDONED:
                shutil.rmtree(folder, ignore_errors=True)
            if place is not None:
                os.close(place)


def share_programs() -> None:
    """Give other processes what this one has compiled; at its end this happens by itself.

    It does nothing without `enable_compile_cache`.
    """
    mine = own_folder()
    if mine is None:
        return
    for path in mine.glob(_ENTRIES):
        if path.stat().st_nlink > 1:
            continue
        with contextlib.suppress(OSError):  # it is there already, or the disk is full
            is_traced = path.name.startswith(_TRACED)
            checksum = "" if is_traced else f"{zlib.crc32(path.read_bytes()):08x}."
            os.link(path, mine.parent / f"{checksum}{path.name}")
