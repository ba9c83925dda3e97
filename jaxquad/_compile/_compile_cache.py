"""Compiled programs on the disk, for the next process.

JAX writes its entries in place, so that a process that is killed, or two that write the same one,
leave damaged entries behind; and its own limit of size stops all writing after one such accident.
So each process has a folder of its own, which begins with hard links to what is there. New entries
are linked into the shared folder whole.
"""

import atexit
import contextlib
import hashlib
import os
import platform
import shutil
import tempfile
import time
import warnings
from pathlib import Path

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache


_VARIABLE = "JAXQUAD_CACHE"  # "off", or a folder
_ENTRIES = "*-cache"  # as JAX names them
_MOST_BYTES, _MOST_ENTRIES = 256 * 2**20, 4000
_ABANDONED = 86_400.0  # s after which the folder of a process that was killed goes
_LEAST = 0.0  # s of compile time from which a program is kept: reading one takes 1 ms
_OWN = "process-"  # begins the name of a process's own folder


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
        for path in shared.glob(_ENTRIES):
            with contextlib.suppress(FileNotFoundError):  # Another process has just removed it.
                os.link(path, mine / path.name)
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
    for folder in shared.glob(f"{_OWN}*"):
        if folder.stat().st_mtime < time.time() - _ABANDONED:
            shutil.rmtree(folder, ignore_errors=True)


def share_programs() -> None:
    """Give other processes what this one has compiled; at its end this happens by itself.

    It does nothing without `enable_compile_cache`.
    """
    mine = own_folder()
    if mine is None:
        return
    for path in mine.glob(_ENTRIES):
        with contextlib.suppress(OSError):  # It is there already, or the disk is full.
            os.link(path, mine.parent / path.name)
