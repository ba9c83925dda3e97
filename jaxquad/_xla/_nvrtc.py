"""CUDA C made into a kernel that XLA runs: by NVRTC, which is installed beside JAX for CUDA.

XLA takes a kernel as PTX, the assembly language of NVIDIA's virtual machine.
"""

import ctypes
import functools as ft
import importlib.util
import pathlib
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array


_OPTIONS = (
    "--std=c++17",
    # Of float32 alone: the last bit of a quotient and of a root, and what is below 1e-38.
    "--prec-div=false",
    "--prec-sqrt=false",
    "--ftz=true",
)
# The version of PTX that came with an architecture. What is written for it runs on all later GPUs,
# and with drivers that are older than NVRTC, which would refuse the version that NVRTC writes.
_VERSIONS = {"75": "6.3", "80": "7.0"}


class CannotCompile(Exception):
    """Why NVRTC made no kernel."""


def launch(
    text: str, name: str, args: Sequence[Array], outs: Sequence[Any], threads: int, block: int,
    shared: int,
) -> list[Array]:  # fmt: skip
    """What the kernel `name` of a text in CUDA C, of pointers to arguments and then to results,
    writes to `outs`; the threads of a `block` have `shared` bytes together."""
    call = jax.ffi.ffi_call("__gpu$xla.gpu.ptx", tuple(outs))
    one = np.int32(1)
    results = call(
        *args, name=name, kernel_type="ptx", kernel_data=ptx_of(text, architecture()),
        grid_x=np.int32(-(-threads // block)), grid_y=one, grid_z=one, block_x=np.int32(block),
        block_y=one, block_z=one, shared_mem_bytes=np.int32(shared),
    )  # fmt: skip
    return list(results)


def architecture() -> str:
    """Of this machine's GPU, or one that it runs programs of; a late one where there is no GPU."""
    try:
        turing = float(jax.devices("gpu")[0].compute_capability) < 8
    except RuntimeError:  # a program for another machine
        turing = False
    return "75" if turing else "80"


@ft.lru_cache(maxsize=64)
def ptx_of(text: str, architecture: str) -> str:
    """The PTX of a text in CUDA C. Raises `CannotCompile`."""
    nvrtc = _library()
    program = ctypes.c_void_p()
    source = text.encode()
    _require(nvrtc.nvrtcCreateProgram(ctypes.byref(program), source, None, 0, None, None))
    try:
        options = [*_OPTIONS, f"--gpu-architecture=compute_{architecture}"]
        array = (ctypes.c_char_p * len(options))(*(x.encode() for x in options))
        if nvrtc.nvrtcCompileProgram(program, len(options), array):
            log = _read(nvrtc.nvrtcGetProgramLogSize, nvrtc.nvrtcGetProgramLog, program)
            raise CannotCompile(next((x for x in log.splitlines() if "error" in x), log[:200]))
        ptx = _read(nvrtc.nvrtcGetPTXSize, nvrtc.nvrtcGetPTX, program)
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))
    return re.sub(r"(?m)^\.version .*$", f".version {_VERSIONS[architecture]}", ptx)


def _read(size_of: Callable, copy: Callable, program: ctypes.c_void_p) -> str:
    size = ctypes.c_size_t()
    _require(size_of(program, ctypes.byref(size)))
    buffer = ctypes.create_string_buffer(size.value)
    _require(copy(program, buffer))
    return buffer.value.decode()


def _require(status: int) -> None:
    if status:
        raise CannotCompile(f"NVRTC returned the error {status}")


@ft.cache
def _library() -> ctypes.CDLL:
    for place in _places():
        try:
            return ctypes.CDLL(place)
        except OSError:
            continue
    raise CannotCompile('no NVRTC: `pip install "jax[cuda13]"` brings it')


def _places() -> Iterator[str]:
    """Of the packages that JAX for CUDA needs, and of a CUDA toolkit."""
    spec = importlib.util.find_spec("nvidia")
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        yield from sorted(map(str, pathlib.Path(folder).glob("**/libnvrtc.so.*")), reverse=True)
    yield from ("libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so")
    yield "/usr/local/cuda/lib64/libnvrtc.so"
