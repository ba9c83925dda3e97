"""Sine, cosine and arctangent that CPUs compute eight at a time; libraries take one number."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float


Numbers = Array | np.ndarray  # constants of a traced function are NumPy's

# sin x = x + x^3 (c0 + c1 x^2 + ...) on -pi/2 to pi/2, minimax in the relative error: 3e-19, and
# 6e-9 in single precision. pi as a sum of terms of so few bits that whole multiples are exact.
_DOUBLE = (
    -0.166666666666666656,
    8.33333333333319405e-3,
    -1.9841269841209131e-4,
    2.75573192111224691e-6,
    -2.50521068714565771e-8,
    1.60589396382709149e-10,
    -7.64298972232153102e-13,
    2.72115623198655615e-15,
)
_PI_DOUBLE = tuple(
    map(float.fromhex, ("0x1.921fb544p+1", "0x1.0b4611a6p-33", "0x1.3198a2e037073p-68"))
)
_SINGLE = (
    -0.166666595440576413,
    8.33306607232267338e-3,
    -1.98095894606002282e-4,
    2.60574945504259035e-6,
)
_PI_SINGLE = tuple(map(float.fromhex, ("0x1.92p+1", "0x1.fb4p-11", "0x1.4442d18469899p-23")))
_PER_PI = 0.3183098861837907


@jax.custom_jvp
def sincos(
    x: Float[Numbers, "*shape"],
) -> tuple[Float[Numbers, "*shape"], Float[Numbers, "*shape"]]:
    """Sine and cosine of angles in rad, by short polynomials that a CPU computes 8 at a time.

    For loops of many small steps, where the library functions cost several times as much. Within
    1.4 units of rounding of 1, up to 1e9 rad (1e6 in single precision, where large angles need
    fused products and sums, as optimised code has them); nan beyond. Differentiable to any order.
    """
    x = checkpoint_name(x, "sincos")  # by which a kernel of a GPU knows it
    x = jnp.where(jnp.abs(x) <= (1e6 if x.dtype == jnp.float32 else 1e9), x, jnp.nan)
    near, below = jnp.round(x * _PER_PI), jnp.floor(x * _PER_PI)
    return _sign(near) * _near(x, near), -_sign(below) * _near(x, below + 0.5)


@sincos.defjvp
def _sincos_jvp(primals, tangents):
    (x,), (dx,) = primals, tangents
    sine, cosine = sincos(x)
    return (sine, cosine), (cosine * dx, -sine * dx)


def _near(x: Float[Numbers, "*shape"], turns: Float[Numbers, "*shape"]) -> Float[Numbers, "*shape"]:
    """The sine of x - turns pi, which is a quarter turn at most."""
    single = x.dtype == jnp.float32
    terms, coefficients = (_PI_SINGLE, _SINGLE) if single else (_PI_DOUBLE, _DOUBLE)
    for term in terms:
        x = x - turns * term
    square = x * x
    series = coefficients[-1] * square
    for coefficient in coefficients[-2::-1]:
        series = (series + coefficient) * square
    return x + x * series


def _sign(turns: Float[Numbers, "*shape"]) -> Float[Numbers, "*shape"]:
    """1 for even numbers, -1 for odd ones."""
    half = 0.5 * turns
    return 1 - 4 * (half - jnp.floor(half))


# arctan x = x + x^3 P(x^2) / Q(x^2) to tan(pi / 8); Moshier, Methods and Programs for Mathematical
# Functions (Cephes): 2e-16.
_ABOVE = (
    -0.8750608600031904122785,
    -16.15753718733365076637,
    -75.00855792314704667340,
    -122.8866684490136173410,
    -64.85021904942025371773,
)
_BELOW = (
    1.0,
    24.85846490142306297962,
    165.0270098316988542046,
    432.8810604912902668951,
    485.3903996359136964868,
    194.5506571482613964425,
)
_EIGHTH = 0.4142135623730951  # tan(pi / 8)


def arctan2(y: Float[Numbers, "*shape"], x: Float[Numbers, "*shape"]) -> Float[Numbers, "*shape"]:
    """The angle of (x, y) in rad, within 4e-16 of `jnp.arctan2` in double precision.

    0 at the origin and nan where both are infinite; the sign of a zero does not count.
    """
    high, wide = jnp.abs(y), jnp.abs(x)
    small, large = jnp.minimum(high, wide), jnp.maximum(high, wide)
    steep = small > _EIGHTH * large
    above = jnp.where(steep, small - large, small)
    below = jnp.where(steep, small + large, jnp.where(large == 0, 1.0, large))
    tangent = above / below
    square = tangent * tangent
    series = square * _polynomial(_ABOVE, square) / _polynomial(_BELOW, square)
    angle = tangent + tangent * series
    angle = jnp.where(steep, angle + np.pi / 4, angle)
    angle = jnp.where(high > wide, np.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, np.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)


def _polynomial(coefficients: tuple[float, ...], x: Float[Numbers, "*s"]) -> Float[Numbers, "*s"]:
    value = jnp.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        value = value * x + coefficient
    return value
