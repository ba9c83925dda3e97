"""The outputs' noise, from what the responses leave unexplained in the windows."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float


_BANDWIDTH = 0.2  # of the noise's smoothing, in ln(omega)
_FLOOR = 1e-26  # of the output's power: below it lies rounding

Residuals = Complex[Array, "frequencies _ outputs"]


def noise_root(
    omega: Float[Array, " frequencies"],
    residuals: Sequence[Residuals],
    outputs: Sequence[Residuals],
    traces: Sequence[Float[Array, "frequencies outputs"]],
    freedom: Float[Array, " groups"],
    weights: Float[Array, "frequencies outputs groups"],
) -> Complex[Array, "frequencies outputs outputs"]:
    """Hermitian root of the covariance of noise that would leave these residuals.

    One set of `residuals` for each window length, with the energy `traces` that unit noise would
    leave in them and the complex degrees of `freedom` of that energy; `weights` say how much each
    length counts. Smooth along frequency.
    """
    place = jnp.log(omega)
    kinds = zip(residuals, outputs, traces, list(freedom), strict=True)
    levels = jnp.stack([_level(*kind) for kind in kinds], axis=2)
    weight = jnp.sum(weights * freedom[None, None, :], axis=2)
    level = jnp.sum(weights * levels, axis=2)
    power = jnp.exp(jax.vmap(_local_line, in_axes=(None, 1, 1), out_axes=1)(place, level, weight))
    root = jnp.sqrt(power)
    if power.shape[1] == 1:
        return jax.lax.complex(root, jnp.zeros_like(root))[:, :, None]
    return _hermitian_root(_coherency(place, residuals, weights), root)


def _level(
    residual: Residuals,
    output: Residuals,
    trace: Float[Array, "frequencies outputs"],
    freedom: Float[Array, ""],
) -> Float[Array, "frequencies outputs"]:
    """Logarithm of the noise's power, unbiased."""
    energy = jnp.sum(jnp.abs(residual) ** 2, axis=1)
    floor = _FLOOR * jnp.sum(jnp.abs(output) ** 2, axis=1) + 1e-280
    # The logarithm of a chi-squared variable is low on average.
    low = jax.scipy.special.digamma(freedom) - jnp.log(freedom)
    return jnp.log(jnp.maximum(energy, floor) / trace) - low


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
    place: Float[Array, " frequencies"],
    residuals: Sequence[Residuals],
    weights: Float[Array, "frequencies outputs groups"],
) -> Complex[Array, "frequencies outputs outputs"]:
    """Correlation between the outputs' noise, of unit diagonal and positive semidefinite."""
    total = jnp.zeros((1,), residuals[0].dtype)
    for g, residual in enumerate(residuals):
        size = jnp.sqrt(jnp.sum(jnp.abs(residual) ** 2, axis=1, keepdims=True)) + 1e-280
        scaled = residual / size.astype(residual.dtype)
        counts = jnp.mean(weights[:, :, g], axis=1)[:, None, None].astype(residual.dtype)
        product = jnp.einsum("fso,fsp->fop", scaled, jnp.conj(scaled)) * counts
        total = total + product if g else product
    kernel = jnp.exp(-0.5 * ((place[None, :] - place[:, None]) / _BANDWIDTH) ** 2)
    smooth = jnp.einsum("fg,gop->fop", kernel.astype(total.dtype), total)
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
