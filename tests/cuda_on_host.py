"""Kernels in CUDA C compiled for the processor, one member after the other: tests without a GPU."""

import ctypes
import functools as ft
import pathlib
import shutil
import subprocess
import tempfile

import jax
import numpy as np
import pytest

from jaxquad._xla import _cuda, _passes, _switch


_HOST = """
#include <cmath>
#include <cstring>
using namespace std;
#define __global__
#define __device__
#define __launch_bounds__(threads, blocks)
#define __shared__
static struct {{ int x; }} blockIdx, threadIdx;
template <typename A, typename B> A as(B x) {{ A y; memcpy(&y, &x, sizeof x); return y; }}
float __int_as_float(int x) {{ return as<float>(x); }}
int __float_as_int(float x) {{ return as<int>(x); }}
int __double2loint(double x) {{ return int(as<long long>(x)); }}
int __double2hiint(double x) {{ return int(as<long long>(x) >> 32); }}
double __hiloint2double(int high, int low) {{
    return as<double>((long long)high << 32 | (unsigned)low);
}}
template <typename T> T __ldcs(const T *p) {{ return *p; }}
template <typename T> T __shfl_down_sync(unsigned, T x, int) {{ return x; }}
{text}
long long shelf[1 << 15];
extern "C" void all(void **p) {{
    for (int m = 0; m < {blocks} * {block}; ++m) {{
        blockIdx.x = m / {block};
        threadIdx.x = m % {block};
        {name}({arguments});
    }}
}}
"""


def run_on_host(monkeypatch):
    """Kernels of a GPU run here, from now on."""
    if shutil.which("g++") is None:
        pytest.skip("needs g++")
    monkeypatch.setattr(_passes, "launch", _launch)
    monkeypatch.setattr(_passes, "WARP", 1)
    monkeypatch.setattr(_cuda, "ptx_of", lambda text, architecture: "")


def for_cuda(function, *args):
    """What XLA for a GPU gets, with a word in place of what NVRTC makes."""
    with pytest.MonkeyPatch.context() as patch, _switch.device_kernels("forced"):
        patch.setattr(_passes, "launch", _cuda.launch)
        patch.setattr(_cuda, "ptx_of", lambda text, architecture: "made by NVRTC")
        return jax.jit(function).trace(*args).lower(lowering_platforms=("cuda",)).as_text()


def _launch(text, name, args, outs, threads, block, shared):
    def run(*arrays):
        made = [np.full(x.shape, 77, x.dtype) for x in outs]
        arrays = [np.ascontiguousarray(x) for x in arrays]
        pointers = [x.ctypes.data for x in (*arrays, *made)]
        function((ctypes.c_void_p * len(pointers))(*pointers))
        return made

    blocks = -(-threads // block)
    function = _compiled(text, name, len(args) + len(outs), blocks, block)
    return jax.pure_callback(run, outs, *args)


@ft.lru_cache
def _compiled(text, name, count, blocks, block):
    kinds = text[text.index(f"{name}(") + len(name) + 1 :].split(")")[0].split(",")
    pointers = [x.split("__restrict__")[0] for x in kinds]
    assert len(pointers) == count
    arguments = ", ".join(f"({kind})p[{k}]" for k, kind in enumerate(pointers))
    whole = _HOST.format(text=text, name=name, arguments=arguments, blocks=blocks, block=block)
    # Without fused operations: the plain loop has none.
    options = ["-std=c++17", "-O1", "-ffp-contract=off", "-shared", "-fPIC"]
    with tempfile.TemporaryDirectory() as folder:
        source, library = pathlib.Path(folder, "kernel.cpp"), pathlib.Path(folder, "kernel.so")
        source.write_text(whole)
        subprocess.run(["g++", *options, "-o", library, source], check=True)
        return ctypes.CDLL(str(library)).all
