from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class LockInSolution(NamedTuple):
    inertia: Float[Array, " axes *ensemble"]  # kg m^2
    variance: Float[Array, " axes *ensemble"]  # (kg m^2)^2
    stiffness: Float[Array, " axes *ensemble"]  # N m/rad
    informed: Float[Array, " axes *ensemble"]  # 1 where enough tones stand out


class _Tones(NamedTuple):
    """What each tone says: [tones, axes, *ensemble]."""

    ratio: Array  # real part of torque / acceleration, kg m^2
    weight: Array  # 1 / variance of it, 0 where the tone does not stand out


def solve(
    acceleration: Float[Array, " parts tones places axes *ensemble"],
    torque: Float[Array, " parts tones places axes *ensemble"],
    square: Float[Array, " tones *ones"],
    *,
    contrast: float,
    stiff: bool,
) -> LockInSolution:
    """Inertia from what torque and acceleration have in common with each tone.

    The parts are a tone's cosine and sine; the places a frequency below it, its own, one above.
    At a tone torque / acceleration = J - k / w^2 + j (damping, lag), with w^2 the `square`: the
    real part counts. Beside it there is no tone: what the ratio leaves of the torque there is the
    disturbance. Its power, of four degrees of freedom, gives the variance. A tone stands out when
    its acceleration has `contrast` times the power of its neighbours'.
    """
    tones = _ratios(acceleration, torque, contrast)
    return _stiff(tones, square) if stiff else _free(tones)


def _ratios(acceleration, torque, contrast):
    a, u = acceleration[:, :, 1], torque[:, :, 1]
    power = jnp.sum(a**2, axis=0)
    beside = jnp.sum(acceleration[:, :, ::2] ** 2, axis=(0, 2)) / 2
    out = power > contrast * beside
    inverse = jnp.where(out, 1 / jnp.where(out, power, 1), 0)
    real = jnp.sum(a * u, axis=0) * inverse
    imaginary = (a[0] * u[1] - a[1] * u[0]) * inverse
    x, y = acceleration[:, :, ::2]
    left = torque[:, :, ::2] - jnp.stack(
        [real[:, None] * x - imaginary[:, None] * y, real[:, None] * y + imaginary[:, None] * x]
    )
    noise = jnp.sum(left**2, axis=(0, 2)) / 4
    rounding = 1e-12 * jnp.sum(u**2, axis=0)  # keeps the weights of a perfect record finite
    return _Tones(real, jnp.where(out, power / jnp.where(out, noise + rounding, 1), 0))


def _free(tones):
    total = jnp.sum(tones.weight, axis=0)
    some = total > 0
    inverse = jnp.where(some, 1 / jnp.where(some, total, 1), 0)
    inertia = jnp.sum(tones.weight * tones.ratio, axis=0) * inverse
    return LockInSolution(inertia, inverse, jnp.zeros_like(inertia), some.astype(inertia.dtype))


def _stiff(tones, square):
    """Weighted least squares of the ratios on 1 and -1/w^2."""
    mean = _free(tones)
    away = -1 / square - jnp.sum(tones.weight / -square, axis=0)[None] * mean.variance[None]
    spread = jnp.sum(tones.weight * away**2, axis=0)
    some = spread * mean.variance > 1e-9 / jnp.max(square) ** 2
    inverse = jnp.where(some, 1 / jnp.where(some, spread, 1), 0)
    stiffness = jnp.sum(tones.weight * away * tones.ratio, axis=0) * inverse
    centre = jnp.sum(tones.weight / -square, axis=0) * mean.variance
    return LockInSolution(
        mean.inertia - centre * stiffness,
        mean.variance + centre**2 * inverse,
        stiffness,
        some.astype(stiffness.dtype),
    )
