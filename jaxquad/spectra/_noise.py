"""The outputs' noise, from what the responses leave unexplained in the windows."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float


_BANDWIDTH = 0.2  # of the noise's smoothing, in ln(omega)
_FLOOR = 1e-26  # of the output's power: below it lies rounding

Residuals = Complex[Array, "frequencies windows outputs"]


def noise_root(
    omega: Float[Array, " frequencies"],
    residuals: Residuals,
    outputs: Residuals,
    member: Float[Array, "windows groups"],
    trace: Float[Array, "frequencies outputs groups"],
    freedom: Float[Array, " groups"],
    weights: Float[Array, "frequencies outputs groups"],
) -> Complex[Array, "frequencies outputs outputs"]:
    """Hermitian root of the covariance of noise that would leave these residuals.

    `member` says which window is of which length. Each length has the energy `trace` that unit
    noise would leave in its residuals, and the complex degrees of `freedom` of that energy;
    `weights` say how much it counts. Smooth along frequency.
    """
    place = jnp.log(omega)
    energy, floor = (jnp.swapaxes(jnp.abs(x) ** 2, 1, 2) @ member for x in (residuals, outputs))
    # The logarithm of a chi-squared variable is low on average: digamma(f) - ln(f).
    low = -1 / (2 * freedom) - 1 / (12 * freedom**2)
    levels = jnp.log(jnp.maximum(energy, _FLOOR * floor + 1e-280) / trace) - low[None, None, :]
    weight, level = weights @ freedom, jnp.sum(weights * levels, axis=2)
    lines = jax.vmap(_local_line, in_axes=(None, 1, 1), out_axes=1)
    root = jnp.exp(lines(place, level, weight) / 2)
    if root.shape[1] == 1:
        return jax.lax.complex(root, jnp.zeros_like(root))[:, :, None]
    scale = jnp.sqrt(jnp.mean(weights, axis=1, keepdims=True) / (energy + 1e-280))
    unit = residuals * jnp.swapaxes(scale @ member.T, 1, 2).astype(residuals.dtype)
    return _hermitian_root(_coherency(place, unit), root)


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


def _coherency(
    place: Float[Array, " frequencies"], unit: Residuals
) -> Complex[Array, "frequencies outputs outputs"]:
    """Correlation between the outputs' noise, of unit diagonal and positive semidefinite."""
    total = jnp.swapaxes(unit, 1, 2) @ jnp.conj(unit)
    kernel = jnp.exp(-0.5 * ((place[None, :] - place[:, None]) / _BANDWIDTH) ** 2)
    flat = total.reshape(place.size, -1)
    smooth = jax.lax.complex(kernel @ flat.real, kernel @ flat.imag).reshape(total.shape)
    deviation = jnp.sqrt(jnp.real(jnp.diagonal(smooth, axis1=1, axis2=2))).astype(smooth.dtype)
    return smooth / (deviation[:, :, None] * deviation[:, None, :])


def _hermitian_root(
    coherency: Complex[Array, "frequencies outputs outputs"],
    root: Float[Array, "frequencies outputs"],
) -> Complex[Array, "frequencies outputs outputs"]:
    # Not Cholesky's: along frequency the root must change as slowly as the matrix does.
    scaled = coherency * (root[:, :, None] * root[:, None, :]).astype(coherency.dtype)
    values, vectors = jnp.linalg.eigh(scaled)
    stretch = jnp.sqrt(jnp.maximum(values, 0.0)).astype(vectors.dtype)
    return (vectors * stretch[:, None, :]) @ jnp.conj(jnp.swapaxes(vectors, 1, 2))
