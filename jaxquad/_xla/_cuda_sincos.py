"""Sine and cosine in CUDA C: what a kernel of a GPU computes in place of `sincos`.

Both from one angle of at most an eighth turn, with fused products and sums, which NVIDIA's GPUs
all have: half of the operations of the form that suits vectors of a CPU.
"""

from collections.abc import Sequence


# sin x = x + x^3 (s0 + s1 x^2 + ...) and cos x = 1 - x^2 / 2 + x^4 (c0 + c1 x^2 + ...) to pi / 4:
# minimax, within 4e-18 and 5e-20, in single precision within 4e-9 and 1e-10.
_DOUBLE = {
    "sine": (
        -0.16666666666666632,
        0.00833333333332248,
        -0.00019841269829846725,
        2.755731370215645e-06,
        -2.5050759361193126e-08,
        1.5896852413321754e-10,
    ),
    "cosine": (
        0.0416666666666666,
        -0.0013888888888874465,
        2.4801587289662216e-05,
        -2.755731439745978e-07,
        2.0875728697899716e-09,
        -1.135989972166348e-11,
    ),
}
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


def _written(kind: str, farthest: str, series: dict[str, tuple[float, ...]]) -> str:
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
    + _written("float", "1e6", _SINGLE)
    + _written("double", "1e9", _DOUBLE)
    + """
template <typename T> __device__ T sine_of(T x) { T s, c; turn(x, s, c); return s; }
template <typename T> __device__ T cosine_of(T x) { T s, c; turn(x, s, c); return c; }
"""
)
