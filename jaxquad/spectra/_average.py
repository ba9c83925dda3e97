"""Responses, coherence and errors from windowed transforms of one or several window lengths."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from ._combine import alone, combine, Combined
from ._conditioned import Channels, condition, Conditioned
from ._noise import noise_root


_ALIKE = 1e-4  # share of an input's power below which it cannot be told from the others


class Averaged(NamedTuple):
    response: Complex[Array, "frequencies outputs inputs"]
    coherence: Float[Array, "frequencies outputs inputs"]
    random_error: Float[Array, "frequencies outputs inputs"]
    direct_coherence: Float[Array, "frequencies outputs inputs"]
    multiple_coherence: Float[Array, "frequencies outputs"]
    input_coherence: Float[Array, "frequencies inputs"]
    effect: Complex[Array, "frequencies inputs windows"]
    share: Float[Array, "frequencies outputs inputs groups"]
    noise: Complex[Array, "frequencies outputs roots"]
    excitation: Float[Array, "channels frequencies"]  # power of inputs and of instruments


@eqx.filter_jit
def average(
    transforms: tuple[Complex[Array, "_ frequencies channels"], ...],
    channels: Channels,
    omega: Float[ArrayLike, " frequencies"],
    overlap: Float[ArrayLike, "windows windows"],
    scales: Float[ArrayLike, " groups"],
    resolved: Bool[ArrayLike, "groups frequencies"],
    freedom: Float[ArrayLike, "groups 2"],
) -> Averaged:
    """One response from all window lengths, with the effect of noise in each window.

    `freedom` holds, for each length, the independent windows less the inputs, and the degrees of
    freedom of the residuals.
    """
    averages, left = jnp.asarray(freedom).T
    many = tuple(len(part) for part in transforms)
    flat = jnp.swapaxes(jnp.concatenate(transforms), 0, 1)
    rows = jnp.split(flat, np.cumsum(many)[:-1], axis=1)
    products = jnp.stack([jnp.conj(jnp.swapaxes(row, 1, 2)) @ row for row in rows])
    counts = jnp.asarray(many, float)
    parts = _conditioned(products, channels, counts)
    combined = combine(parts, scales, averages, resolved) if len(many) > 1 else alone(parts)
    apart = jnp.einsum("fig,gfi->fi", jnp.mean(combined.share, axis=1), parts.alone)
    lost = ~(apart >= _ALIKE)
    parts, combined = _without(jnp.any(lost, axis=1), parts, combined)
    z, inputs, outputs = channels.split(flat)
    split = jnp.split(jnp.conj(jnp.swapaxes(z, 1, 2)), np.cumsum(many)[:-1], axis=2)
    effect = jnp.concatenate([s @ c for s, c in zip(parts.solver, split, strict=True)], axis=2)
    gain, trace = _unit_noise(effect, combined.share, inputs, jnp.asarray(overlap), many)
    weights = jnp.mean(combined.share, axis=2)
    trust = jnp.where(jnp.any(lost, axis=1), 1e-9, 1.0)[:, None, None]
    residuals = outputs - inputs @ jnp.swapaxes(combined.response, 1, 2)
    member = jnp.asarray(np.repeat(np.eye(len(many)), many, axis=0))
    noise = noise_root(jnp.asarray(omega), residuals, outputs, member, trace, left, weights * trust)
    power = jnp.sum(jnp.abs(noise) ** 2, axis=2)
    error = jnp.sqrt(power[:, :, None] * gain / 2) / jnp.abs(combined.response)
    gone = lost[:, None, :]
    return Averaged(
        jnp.where(gone, jnp.nan, combined.response),
        jnp.where(gone, 0.0, combined.coherence),
        jnp.where(gone, jnp.inf, error),
        _direct(products, counts, combined, channels),
        jnp.einsum("fog,gfo->fo", weights, parts.multiple),
        1 - jnp.nan_to_num(apart),
        effect,
        combined.share,
        noise,
        _excitation(products[0] / counts[0].astype(products.dtype), channels),
    )


def _conditioned(products, channels: Channels, counts: Float[Array, " groups"]) -> Conditioned:
    return jax.vmap(lambda p, count: condition(p, channels, count))(products, counts)


def _without(
    lost: Bool[Array, " frequencies"], parts: Conditioned, combined: Combined
) -> tuple[Conditioned, Combined]:
    """Finite numbers where inputs cannot be told apart, which are marked as lost elsewhere."""
    gone = lost[:, None, None]
    clean = parts._replace(
        solver=jnp.where(gone[None], 0.0, parts.solver),
        multiple=jnp.where(lost[None, :, None], 0.0, parts.multiple),
    )
    share = jnp.where(gone[..., None], 1 / combined.share.shape[-1], combined.share)
    response = jnp.where(gone, 1e-300, combined.response)
    return clean, Combined(response, jnp.where(gone, 0.0, combined.coherence), share)


def _unit_noise(
    effect: Complex[Array, "frequencies inputs windows"],
    share: Float[Array, "frequencies outputs inputs groups"],
    x: Complex[Array, "frequencies windows inputs"],
    overlap: Float[Array, "windows windows"],
    counts: tuple[int, ...],
) -> tuple[Float[Array, "frequencies outputs inputs"], Float[Array, "frequencies outputs groups"]]:
    """Variance of the responses under noise of unit power, and the residual energy it leaves.

    Sums over windows are taken group by group, since each output has shares of its own.
    """
    ends, count = np.cumsum(counts)[:-1], effect.shape[1]
    rows = zip(jnp.split(effect, ends, axis=2), jnp.split(overlap, ends), strict=True)
    spread = jnp.concatenate([_times_real(e, o) for e, o in rows], axis=1)
    columns = jnp.concatenate([jnp.conj(jnp.swapaxes(effect, 1, 2)), x], axis=2)
    kept = zip(jnp.split(spread, ends, axis=2), jnp.split(columns, ends, axis=1), strict=True)
    sums = jnp.stack([s @ c for s, c in kept], axis=-1)
    sums = sums.reshape(len(effect), len(counts), count, 2 * count, len(counts))
    part, pairs, crossed = share.astype(effect.dtype), sums[:, :, :, :count], sums[:, :, :, count:]
    covariance = jnp.einsum("foig,fgijh,fojh->foij", part, pairs, part)
    once = jnp.einsum("foig,fgiih->foh", part, crossed)
    moments = [jnp.swapaxes(c, 1, 2) @ jnp.conj(c) for c in jnp.split(x, ends, axis=1)]
    twice = jnp.einsum("hfij,foij->foh", jnp.stack(moments), covariance)
    whole = jnp.stack([jnp.sum(part) for part in jnp.split(jnp.diagonal(overlap), ends)])
    variance = jnp.real(jnp.diagonal(covariance, axis1=2, axis2=3))
    return variance, whole[None, None, :] - jnp.real(2 * once - twice)


def _times_real(
    a: Complex[Array, "frequencies inputs _"], b: Float[Array, "_ windows"]
) -> Complex[Array, "frequencies inputs windows"]:
    rows = a.reshape(-1, a.shape[2])
    both = jnp.concatenate([rows.real, rows.imag]) @ b
    real, imag = jnp.split(both, 2)
    return jax.lax.complex(real, imag).reshape(*a.shape[:2], b.shape[1])


def _direct(products, counts, combined: Combined, channels: Channels):
    """Partial coherence of inputs and outputs, whatever the instruments say of it."""
    if not channels.instruments:
        return combined.coherence
    plain = channels._replace(instruments=0)
    each = _conditioned(products, plain, counts).coherence
    return jnp.einsum("foig,gfoi->foi", combined.share, each)


def _excitation(
    products: Complex[Array, "frequencies channels channels"], channels: Channels
) -> Float[Array, "moving frequencies"]:
    power = jnp.real(jnp.diagonal(products, axis1=1, axis2=2)).T
    first, last = channels.inputs, channels.inputs + channels.outputs
    return jnp.concatenate([power[:first], power[last:]])
