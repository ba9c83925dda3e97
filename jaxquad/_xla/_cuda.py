"""CUDA C for a jaxpr of scalars, with the nan of `jax.lax`, made into a kernel that XLA runs.

NVRTC, which is installed beside JAX for CUDA, compiles it; XLA takes a kernel as PTX, the assembly
language of NVIDIA's virtual machine.
"""

import ctypes
import functools as ft
import importlib.util
import pathlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Primitive, Var
from jaxtyping import Array


Expression = Callable[..., str]  # of the result's type, the equation's parameters, and operands
lax = jax.lax

TYPES = {
    "bool": "bool", "float32": "float", "float64": "double", "int32": "int", "int64": "long long",
    "uint32": "unsigned",
}  # fmt: skip
_FLOATS = ("float", "double")


def _between(sign: str) -> Expression:
    return lambda kind, params, a, b: f"{a} {sign} {b}"


def _function(name: str) -> Expression:
    return lambda kind, params, *args: f"{name}({', '.join(args)})"


def _select(kind: str, params: dict, which: str, first: str, *cases: str) -> str:
    for k, case in enumerate(cases, 1):
        first = f"({which} >= {k} ? {case} : {first})"
    return first


_ROUNDED = {
    lax.RoundingMethod.AWAY_FROM_ZERO: "round", lax.RoundingMethod.TO_NEAREST_EVEN: "rint",
}  # fmt: skip
_SIGNS = {
    "add": "+", "add_any": "+", "sub": "-", "mul": "*", "div": "/", "and": "&", "or": "|",
    "xor": "^", "eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">=",
}  # fmt: skip
_SAME_IN_C = """
    ceil floor exp exp2 expm1 log log1p sqrt cbrt sin cos tan asin acos atan atan2 sinh cosh tanh
    asinh acosh atanh erf erfc
""".split()
_WRITTEN: dict[str, Expression] = {
    "abs": lambda kind, params, x: f"fabs({x})" if kind in _FLOATS else f"{x} < 0 ? -{x} : {x}",
    "clamp": lambda kind, params, low, x, high: f"smaller(larger({x}, {low}), {high})",
    "convert_element_type": lambda kind, params, x: (
        f"{x} != 0" if kind == "bool" else f"({kind}){x}"
    ),
    "integer_pow": lambda kind, params, x: f"integer_power<{params['y']}>({x})",
    "is_finite": lambda kind, params, x: f"{x} - {x} == 0",
    "logistic": lambda kind, params, x: f"1 / (1 + exp(-{x}))",
    "max": _function("larger"),
    "min": _function("smaller"),
    "neg": lambda kind, params, x: f"-{x}",
    "not": lambda kind, params, x: f"!{x}" if kind == "bool" else f"~{x}",
    "quotient_of_choices": lambda kind, params, over, n0, n1, under, d0, d1: (
        f"{over} ? ({under} ? {n1} / {d1} : {n1} / {d0}) : ({under} ? {n0} / {d1} : {n0} / {d0})"
    ),
    "pow": lambda kind, params, x, y: f"pow({x}, ({kind}){y})",
    "rem": lambda kind, params, a, b: f"fmod({a}, {b})" if kind in _FLOATS else f"{a} % {b}",
    "round": lambda kind, params, x: f"{_ROUNDED[params['rounding_method']]}({x})",
    "rsqrt": lambda kind, params, x: f"1 / sqrt({x})",
    "select_n": _select,
    "sign": lambda kind, params, x: f"{x} > 0 ? 1 : {x} < 0 ? -1 : {x}",
    "within": _function("within"),
    "square": lambda kind, params, x: f"{x} * {x}",
}


def _of_one_number(name: str) -> Primitive:
    """An operation of lanes alone, which only CUDA C has a text for."""
    primitive = Primitive(name)
    primitive.def_abstract_eval(lambda x: x)
    return primitive


# In place of what a function does that names its argument so.
FUNCTIONS = {"sincos": (_of_one_number("sine_of"), _of_one_number("cosine_of"))}
EXPRESSIONS: dict[str, Expression] = (
    {name: _between(sign) for name, sign in _SIGNS.items()}
    | {name: _function(name) for name in _SAME_IN_C}
    | {x.name: _function(x.name) for pair in FUNCTIONS.values() for x in pair}
    | _WRITTEN
)

# Sine and cosine of one angle of at most an eighth turn, with fused products and sums, which all of
# NVIDIA's GPUs have: half of the operations of the form of `sincos` that suits vectors of a CPU.
# sin x = x + x^3 (s0 + s1 x^2 + ...) and cos x = 1 - x^2 / 2 + x^4 (c0 + c1 x^2 + ...) to pi / 4:
# minimax, within 4e-18 and 5e-20, in single precision within 4e-9 and 1e-10.
_DOUBLE = {
    "sine": (
        -0.16666666666666632, 0.00833333333332248, -0.00019841269829846725, 2.755731370215645e-06,
        -2.5050759361193126e-08, 1.5896852413321754e-10,
    ),
    "cosine": (
        0.0416666666666666, -0.0013888888888874465, 2.4801587289662216e-05, -2.755731439745978e-07,
        2.0875728697899716e-09, -1.135989972166348e-11,
    ),
}  # fmt: skip
_SINGLE = {
    "sine": (-0.16666655242443085, 0.008332191035151482, -0.00019518604676704854),
    "cosine": (0.04166664555668831, -0.00138873013202101, 2.4430670237052254e-05),
}
# What leaves of a number its whole part in the last bits, and pi / 2 as a sum.
_SHIFT = {"double": 1.5 * 2.0**52, "float": 1.5 * 2.0**23}
_QUARTER = {
    "double": ("0x1.921fb544p+0", "0x1.0b4611a6p-34", "0x1.3198a2e037073p-69"),
    "float": ("0x1.92p+0", "0x1.fb4p-12", "0x1.4442d2p-24"),
}
_PER_QUARTER = 0.6366197723675814  # turns of a quarter in a rad


def _horner(coefficients: Sequence[float], kind: str) -> str:
    *others, text = (f"({kind}){c!r}" for c in coefficients)
    for c in reversed(others):
        text = f"fma({text}, z, {c})"
    return text


def _turn(kind: str, farthest: str, series: dict[str, tuple[float, ...]]) -> str:
    shift, terms = f"({kind}){_SHIFT[kind]!r}", _QUARTER[kind]
    reduced = "".join(f"    x = fma(-turns, ({kind}){term}, x);\n" for term in terms)
    cosine = (1.0, -0.5, *series["cosine"])
    return f"""
__device__ void turn({kind} x, {kind} &sine, {kind} &cosine) {{
    x = fabs(x) <= ({kind}){farthest} ? x : ({kind})NOT_A_NUMBER;
    const {kind} shifted = fma(x, ({kind}){_PER_QUARTER!r}, {shift}), turns = shifted - {shift};
    const int quarters = low_bits(shifted);
{reduced}    const {kind} z = x * x;
    const {kind} s = fma(x * z, {_horner(series["sine"], kind)}, x);
    const {kind} c = {_horner(cosine, kind)};
    sine = flipped(quarters & 1 ? c : s, quarters << 30);
    cosine = flipped(quarters & 1 ? s : c, (quarters + 1) << 30);
}}
"""


SINCOS = (
    """
__device__ int low_bits(float x) { return __float_as_int(x); }
__device__ int low_bits(double x) { return __double2loint(x); }
// The other sign, where the highest bit says so.
__device__ float flipped(float x, int sign) {
    return __int_as_float(__float_as_int(x) ^ (sign & 0x80000000));
}
__device__ double flipped(double x, int sign) {
    return __hiloint2double(__double2hiint(x) ^ (sign & 0x80000000), __double2loint(x));
}
"""
    + _turn("float", "1e6", _SINGLE)
    + _turn("double", "1e9", _DOUBLE)
    + """
template <typename T> __device__ T sine_of(T x) { T s, c; turn(x, s, c); return s; }
template <typename T> __device__ T cosine_of(T x) { T s, c; turn(x, s, c); return c; }
"""
)


Source = Mapping[Var, JaxprEqn]  # of what it is the result


# Of the operations that CUDA C has no sign and no function for.
PRELUDE = (
    """
#define NOT_A_NUMBER __int_as_float(0x7fffffff)
template <int N, typename T> __device__ T integer_power(T x) {
    if constexpr (N < 0) return 1 / integer_power<-N>(x);
    else if constexpr (N == 0) return 1;
    else if constexpr (N % 2) return x * integer_power<N - 1>(x);
    else return integer_power<N / 2>(x * x);
}
// A member that is nan stays nan: the maximum of CUDA would hide it.
template <typename T> __device__ T larger(T a, T b) { return a > b || a != a ? a : b; }
template <typename T> __device__ T smaller(T a, T b) { return a < b || a != a ? a : b; }
// What passes a limit, in reverse; with one instruction less than a compiler finds.
template <typename T> __device__ T within(T low, T x, T high, T then) {
    return x > low && x < high ? then : 0;
}
#if __CUDA_ARCH__ >= 800
template <> __device__ float within(float low, float x, float high, float then) {
    float y;
    asm("{ .reg .pred p; setp.gt.f32 p, %1, %2; setp.lt.and.f32 p, %1, %3, p; "
        "selp.f32 %0, %4, 0f00000000, p; }"
        : "=f"(y) : "f"(x), "f"(low), "f"(high), "f"(then));
    return y;
}
template <> __device__ float larger(float a, float b) {
    float c;
    asm("max.NaN.f32 %0, %1, %2;" : "=f"(c) : "f"(a), "f"(b));
    return c;
}
template <> __device__ float smaller(float a, float b) {
    float c;
    asm("min.NaN.f32 %0, %1, %2;" : "=f"(c) : "f"(a), "f"(b));
    return c;
}
#endif
// Memory on its way to a warp: `rows` of its numbers, each `apart` from the one before.
template <typename T> __device__ void fetch(const T *first, int rows, int apart) {
#ifdef __CUDA_ARCH__
    constexpr int lines = sizeof(T) / 4, bytes = 128;
    for (int k = threadIdx.x % 32; k < rows * lines; k += 32) {
        const char *place = (const char *)(first + k / lines * apart) + k % lines * bytes;
        asm volatile("prefetch.global.L1 [%0];" :: "l"(place));
    }
#endif
}
"""
    + SINCOS
)


def type_of(kind: np.dtype) -> str:
    return TYPES[kind.name]


def number(value: Any, kind: np.dtype) -> str:
    """A constant in C, to the last bit."""
    if kind.kind == "b":
        return "true" if value else "false"
    if kind.kind in "iu":
        return f"({type_of(kind)}){int(value)}LL"
    x = float(value)
    if np.isfinite(x):
        text = x.hex()
    else:
        text = "NOT_A_NUMBER" if np.isnan(x) else "1e308 * 10" if x > 0 else "-1e308 * 10"
    return f"({type_of(kind)})({text})"


def statements(jaxpr: ClosedJaxpr, args: Sequence[str], prefix: str) -> tuple[list[str], list[str]]:
    """The lines that compute a jaxpr of scalars `args`, and what its results are called; what is
    new begins with the `prefix`."""
    body, lines = jaxpr.jaxpr, list[str]()
    names = dict(zip(body.invars, args, strict=True))
    for v, value in zip(body.constvars, jaxpr.consts, strict=True):
        names[v] = number(value, v.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]
    source = {v: equation for equation in body.eqns for v in equation.outvars}
    for equation in _in_order(body.outvars, source):
        (name, operands), [out] = _shortened(equation, source), equation.outvars
        kind = type_of(out.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]
        text = EXPRESSIONS[name](kind, equation.params, *(_name(v, names) for v in operands))
        names[out] = f"{prefix}{len(lines)}"
        lines.append(f"const {kind} {names[out]} = {text};")
    return lines, [_name(v, names) for v in body.outvars]


def _in_order(results: Sequence[Any], source: Source) -> list[JaxprEqn]:
    """Each equation just before the first result that needs it: numbers that are computed late are
    held in registers for a shorter time."""
    ordered: dict[int, JaxprEqn] = {}
    for v in results:
        open_ = [source[v]] if isinstance(v, Var) and v in source else []
        while open_:
            operands = _shortened(open_[-1], source)[1]
            needs = [source[x] for x in operands if isinstance(x, Var) and x in source]
            missing = [x for x in needs if id(x) not in ordered]
            if missing:
                open_.append(missing[0])
            else:
                equation = open_.pop()
                ordered[id(equation)] = equation
    return list(ordered.values())


def _shortened(equation: JaxprEqn, source: Source) -> tuple[str, list]:
    """The name in `EXPRESSIONS`, and operands, of an operation or of a small group of them, as
    derivatives make it."""
    name = equation.primitive.name
    group = _RULES[name](equation.invars, source) if name in _RULES else None
    return group or (name, equation.invars)


def _slope_of_clamp(operands: list, source: Source) -> tuple[str, list] | None:
    """`then` where low < x < high, else 0."""
    which, zero, *then = operands
    one, other = _given_to("and", which, source) or (None, None)
    above, below = _given_to("gt", one, source), _given_to("lt", other, source)
    if not (_is_zero(zero) and above and below and above[0] is below[0] and len(then) == 1):
        return None
    operands = [above[1], above[0], below[1], *then]
    return ("within", operands) if len({v.aval.dtype for v in operands}) == 1 else None


def _slope_of_extreme(operands: list, source: Source) -> tuple[str, list] | None:
    """1, 1/2 where both are as large, or 0: JAX writes it as a quotient of two choices."""
    choices = [_given_to("select_n", v, source) for v in operands]
    numbers = [v for choice in choices for v in choice[1:]]
    if len(numbers) != 4 or not all(isinstance(v, Literal) for v in numbers):
        return None
    return "quotient_of_choices", [v for choice in choices for v in choice]


_RULES = {"select_n": _slope_of_clamp, "div": _slope_of_extreme}


def _is_zero(v: Any) -> bool:
    return isinstance(v, Literal) and not isinstance(v.val, bool) and bool(v.val == 0)


def _given_to(name: str, v: Any, source: Source) -> list:
    """The arguments of the operation of that name that `v` is the result of; none of another."""
    equation = source.get(v) if isinstance(v, Var) else None
    return equation.invars if equation is not None and equation.primitive.name == name else []


def _name(v: Any, names: dict[Var, str]) -> str:
    if isinstance(v, Literal):
        return number(v.val, v.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]
    return names[v]


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
