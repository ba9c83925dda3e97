import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


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
    x: Float[Array, "*shape"],
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Sine and cosine of angles in rad, by short polynomials that a CPU computes 8 at a time.

    For loops of many small steps, where the library functions cost several times as much. Within
    1.4 units of rounding of 1, up to 1e9 rad (1e6 in single precision, where large angles need
    fused products and sums, as optimised code has them); nan beyond. Differentiable to any order.
    """
    x = jnp.where(jnp.abs(x) <= (1e6 if x.dtype == jnp.float32 else 1e9), x, jnp.nan)
    near, below = jnp.round(x * _PER_PI), jnp.floor(x * _PER_PI)
    return _sign(near) * _near(x, near), -_sign(below) * _near(x, below + 0.5)


@sincos.defjvp
def _sincos_jvp(primals, tangents):
    (x,), (dx,) = primals, tangents
    sine, cosine = sincos(x)
    return (sine, cosine), (cosine * dx, -sine * dx)


def _near(x: Float[Array, "*shape"], turns: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
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


def _sign(turns: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """1 for even numbers, -1 for odd ones."""
    half = 0.5 * turns
    return 1 - 4 * (half - jnp.floor(half))


def euler_rates_matrix(euler: Float[Array, " 3 *ensemble"]) -> Float[Array, " 3 3 *ensemble"]:
    """The W of `rate = W @ euler_rates`, for ZYX Euler angles in rad.

    Source: Eq. (1), where the matrix itself is not printed. W is no rotation: its determinant is
    cos(pitch), so it has no inverse at a pitch of 90 degrees.
    """
    (s_phi, s_theta, _), (c_phi, c_theta, _) = jnp.sin(euler), jnp.cos(euler)
    zero, one = jnp.zeros_like(s_phi), jnp.ones_like(s_phi)
    return jnp.stack(
        [
            jnp.stack([one, zero, -s_theta]),
            jnp.stack([zero, c_phi, s_phi * c_theta]),
            jnp.stack([zero, -s_phi, c_phi * c_theta]),
        ]
    )


def euler_rates(
    euler: Float[Array, " 3 *ensemble"], rate: Float[Array, " 3 *ensemble"]
) -> Float[Array, " 3 *ensemble"]:
    """Derivatives of the Euler angles, rad/s, at a body `rate` in rad/s: Eq. (1), solved."""
    phi, theta, _ = euler
    p, q, r = rate
    (s_phi, c_phi), (s_theta, c_theta) = sincos(phi), sincos(theta)
    heading = (s_phi * q + c_phi * r) / c_theta
    return jnp.stack([p + s_theta * heading, c_phi * q - s_phi * r, heading])


def euler_acceleration(
    euler: Float[Array, " 3 *ensemble"],
    rate: Float[Array, " 3 *ensemble"],
    rate_derivative: Float[Array, " 3 *ensemble"],
) -> Float[Array, " 3 *ensemble"]:
    """Second derivatives of the Euler angles, rad/s^2.

    Source: Eq. (8), corrected: its right side is `rate_derivative`, and the left side follows as
    inv(W) (rate_derivative - dW/dt euler_rates), which is the time derivative of inv(W) rate.
    """
    tangent = (euler_rates(euler, rate), rate_derivative)
    return jax.jvp(euler_rates, (euler, rate), tangent)[1]


def quaternion_from_euler(euler: Float[Array, " 3 *ensemble"]) -> Float[Array, " 4 *ensemble"]:
    """Unit quaternion, scalar first, that turns body into earth vectors; angles ZYX in rad."""
    (s_phi, s_theta, s_psi), (c_phi, c_theta, c_psi) = jnp.sin(euler / 2), jnp.cos(euler / 2)
    return jnp.stack(
        [
            c_phi * c_theta * c_psi + s_phi * s_theta * s_psi,
            s_phi * c_theta * c_psi - c_phi * s_theta * s_psi,
            c_phi * s_theta * c_psi + s_phi * c_theta * s_psi,
            c_phi * c_theta * s_psi - s_phi * s_theta * c_psi,
        ]
    )


def euler_from_quaternion(
    quaternion: Float[Array, " 4 *ensemble"],
) -> Float[Array, " 3 *ensemble"]:
    """ZYX Euler angles in rad of a unit `quaternion`, with a finite gradient at every attitude."""
    w, x, y, z = quaternion
    limit = 1 - jnp.finfo(quaternion.dtype).eps  # arcsin has an infinite slope at 1
    return jnp.stack(
        [
            jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            jnp.arcsin(jnp.clip(2 * (w * y - z * x), -limit, limit)),
            jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ]
    )


def quaternion_derivative(
    quaternion: Float[Array, " 4 *ensemble"], rate: Float[Array, " 3 *ensemble"]
) -> Float[Array, " 4 *ensemble"]:
    """Time derivative, 1/s, of a body-to-earth `quaternion` at a body `rate` in rad/s."""
    scalar, vector = quaternion[:1], quaternion[1:]
    along = -jnp.sum(vector * rate, axis=0, keepdims=True)
    across = scalar * rate + jnp.cross(vector, rate, axis=0)
    return jnp.concatenate([along, across]) / 2


def rotation_matrix(quaternion: Float[Array, " 4 *ensemble"]) -> Float[Array, " 3 3 *ensemble"]:
    """The matrix that turns body into earth vectors, from a unit `quaternion`."""
    w, x, y, z = quaternion
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )
