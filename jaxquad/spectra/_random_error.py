"""The random error of a response by instrument, from the windows and signals themselves."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ._transform import turn
from ._window import window


_POINTS = 32  # coarse time grid: points to a window
_REACH = 8  # windows' resolutions beyond which two frequencies share no noise
_BANDWIDTH = 0.2  # of the noise's smoothing, in ln(omega)


def window_grid(name: str, length: int, starts: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Times (samples) of a coarse grid, and every window's values there, as (segments, times).

    Scaled so that sums over the grid stand for sums over samples.
    """
    fine = window(name, 1024)
    first = np.asarray(starts)[:, None]
    times = np.arange(min(starts), max(starts) + length, length / _POINTS)
    place = np.floor((times[None, :] - first) * (1024 / length)).astype(int)
    inside = (place >= 0) & (place < 1024)
    values = np.where(inside, fine[np.clip(place, 0, 1023)], 0.0)
    return times, values * np.sqrt(length / _POINTS)


def relative_covariance(
    z: Complex[Array, "segments frequencies"],
    x: Complex[Array, "segments frequencies"],
    y: Complex[Array, "segments frequencies"],
    response: Complex[Array, " frequencies"],
    omega: Float[Array, " frequencies"],
    times: Float[Array, " times"],
    windows: Float[Array, "segments times"],
    resolution: Float[Array, ""],
) -> Complex[Array, "frequencies frequencies"]:
    """Covariance of the relative error of `response = sum(z* y) / sum(z* x)`.

    With `v = y - response x` the error is `sum(z* v) / sum(z* x)`: linear in a noise `v` that is
    independent of the instrument `z`. Its power comes from the residuals, its correlation
    between segments and frequencies from the windows. Transforms have absolute phase; `times` and
    `resolution` (rad/s) have the unit of `omega`.
    """
    power = _noise_power(z, x, y, response, omega, windows)
    cross = jnp.sum(jnp.conj(z) * x, axis=0)
    effect = jnp.einsum("sf,st->ft", jnp.conj(z), windows.astype(z.dtype))
    effect = effect * turn(omega[:, None] * times[None, :])
    gain = jnp.sqrt(power).astype(z.dtype) / (cross * response)
    effect = effect * gain[:, None]
    apart = jnp.abs(omega[:, None] - omega[None, :])
    shared = effect @ jnp.conj(effect.T)
    return jnp.where(apart < _REACH * resolution, shared, jnp.zeros_like(shared))


def _noise_power(
    z: Complex[Array, "segments frequencies"],
    x: Complex[Array, "segments frequencies"],
    y: Complex[Array, "segments frequencies"],
    response: Complex[Array, " frequencies"],
    omega: Float[Array, " frequencies"],
    windows: Float[Array, "segments times"],
) -> Float[Array, " frequencies"]:
    """Power of white noise that would leave these residuals, smooth along frequency."""
    overlap = (windows @ windows.T).astype(z.dtype)
    trace, freedom = jax.vmap(_residual_moments, in_axes=(1, 1, None))(z, x, overlap)
    energy = jnp.sum(jnp.abs(y - response[None, :] * x) ** 2, axis=0)
    floor = 1e-26 * jnp.sum(jnp.abs(y) ** 2, axis=0) + 1e-280
    level = jnp.log(jnp.maximum(energy, floor) / trace)
    # The logarithm of a chi-squared variable is low on average.
    unbiased = level - (jax.scipy.special.digamma(freedom) - jnp.log(freedom))
    return jnp.exp(_local_line(jnp.log(omega), unbiased, freedom))


def _residual_moments(
    z: Complex[Array, " segments"],
    x: Complex[Array, " segments"],
    overlap: Complex[Array, "segments segments"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Expected residual energy for unit noise, and its effective complex degrees of freedom."""
    cross = jnp.vdot(z, x)
    # From both sides, less the projection x z* / cross, which takes the fitted response out.
    left = overlap - jnp.outer(x, jnp.conj(z) @ overlap / cross)
    moment = left - jnp.outer(left @ z / jnp.conj(cross), jnp.conj(x))
    trace = jnp.real(jnp.trace(moment))
    return trace, trace**2 / jnp.sum(jnp.abs(moment) ** 2)


def _local_line(
    place: Float[Array, " frequencies"],
    level: Float[Array, " frequencies"],
    weight: Float[Array, " frequencies"],
) -> Float[Array, " frequencies"]:
    """Weighted local straight lines: a power law passes unchanged."""
    offset = place[None, :] - place[:, None]
    kernel = weight[None, :] * jnp.exp(-0.5 * (offset / _BANDWIDTH) ** 2)
    m0, m1, m2 = (jnp.sum(kernel * offset**k, axis=1) for k in (0, 1, 2))
    l0, l1 = (jnp.sum(kernel * offset**k * level[None, :], axis=1) for k in (0, 1))
    # One lone frequency has no slope: the small term keeps the line flat there.
    spread = m2 + 1e-9 * m0
    return (spread * l0 - m1 * l1) / (spread * m0 - m1**2)
