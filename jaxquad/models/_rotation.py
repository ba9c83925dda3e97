import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._vector_functions import arctan2, sincos


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


def euler_from_quaternion(quaternion: Float[Array, " 4 *ensemble"]) -> Float[Array, " 3 *ensemble"]:
    """ZYX Euler angles in rad of a unit `quaternion`, with a finite gradient at every attitude."""
    w, x, y, z = quaternion
    limit = 1 - jnp.finfo(quaternion.dtype).eps  # arcsin has an infinite slope at 1
    sine = jnp.clip(2 * (w * y - z * x), -limit, limit)
    ahead = [1 - 2 * (x * x + y * y), jnp.sqrt((1 - sine) * (1 + sine)), 1 - 2 * (y * y + z * z)]
    return _angles(jnp.stack([2 * (w * x + y * z), sine, 2 * (w * z + x * y)]), jnp.stack(ahead))


@jax.custom_jvp
def _angles(y: Float[Array, "*shape"], x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    return jnp.asarray(arctan2(y, x))


@_angles.defjvp
def _angles_jvp(primals, tangents):
    (y, x), (dy, dx) = primals, tangents
    return _angles(y, x), (x * dy - y * dx) / (x * x + y * y)


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
