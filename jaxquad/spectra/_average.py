"""Responses, coherence and errors from windowed transforms of one or several window lengths."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from ._combine import combine, Combined
from ._conditioned import condition, Conditioned
from ._noise import noise_root


_ALIKE = 1e-4  # share of an input's power below which it cannot be told from the others


class Channels(NamedTuple):
    """How many channels are inputs, outputs and instruments; without instruments, inputs serve."""

    inputs: int
    outputs: int
    instruments: int


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
    split = [_split(part, channels) for part in transforms]
    parts = [condition(z, x, y) for z, x, y in split]
    combined = _combined(parts, scales, averages, resolved)
    alone = jnp.einsum(
        "fig,gfi->fi", jnp.mean(combined.share, axis=1), jnp.stack([part.alone for part in parts])
    )
    lost = ~(alone >= _ALIKE)
    parts, combined = _without(lost, parts, combined)
    gain, traces = _unit_noise(parts, combined.share, [x for _, x, _ in split], overlap)
    residuals = [y - x @ jnp.swapaxes(combined.response, 1, 2) for _, x, y in split]
    weights = jnp.mean(combined.share, axis=2)
    trust = jnp.where(jnp.any(lost, axis=1), 1e-9, 1.0)[:, None, None]
    noise = noise_root(
        jnp.asarray(omega), residuals, [y for *_, y in split], traces,
        left, weights * trust,
    )  # fmt: skip
    power = jnp.sum(jnp.abs(noise) ** 2, axis=2)
    error = jnp.sqrt(power[:, :, None] * gain / 2) / jnp.abs(combined.response)
    gone = lost[:, None, :]
    return Averaged(
        jnp.where(gone, jnp.nan, combined.response),
        jnp.where(gone, 0.0, combined.coherence),
        jnp.where(gone, jnp.inf, error),
        _direct(split, combined, channels),
        jnp.einsum("fog,gfo->fo", weights, jnp.stack([part.multiple for part in parts])),
        1 - jnp.nan_to_num(alone),
        jnp.concatenate([part.effect for part in parts], axis=2),
        combined.share,
        noise,
        _excitation(transforms[0], channels),
    )


def _without(
    lost: Bool[Array, "frequencies inputs"], parts: list[Conditioned], combined: Combined
) -> tuple[list[Conditioned], Combined]:
    """Finite numbers where inputs cannot be told apart, which are marked as lost elsewhere."""
    every = jnp.any(lost, axis=1)[:, None, None]
    clean = [
        part._replace(
            effect=jnp.where(every, 0.0, part.effect),
            multiple=jnp.where(every[:, :, 0], 0.0, part.multiple),
        )
        for part in parts
    ]
    share = jnp.where(every[..., None], 1 / len(parts), combined.share)
    response = jnp.where(every, 1e-300, combined.response)
    coherence = jnp.where(every, 0.0, combined.coherence)
    return clean, Combined(response, coherence, share)


def _split(transforms: Complex[Array, "windows frequencies channels"], channels: Channels):
    """Instruments, inputs and outputs, frequency first."""
    rows = jnp.swapaxes(transforms, 0, 1)
    n, m = channels.inputs, channels.inputs + channels.outputs
    x = rows[:, :, :n]
    return (rows[:, :, m : m + n] if channels.instruments else x), x, rows[:, :, n:m]


def _combined(parts: list[Conditioned], scales, freedom, resolved) -> Combined:
    if len(parts) > 1:
        return combine(parts, scales, freedom, resolved)
    [part] = parts
    coherence = jnp.minimum(part.coherence, part.moved[:, None, :])
    return Combined(part.response, coherence, jnp.ones((*part.response.shape, 1)))


def _unit_noise(
    parts: list[Conditioned],
    share: Float[Array, "frequencies outputs inputs groups"],
    inputs: list[Complex[Array, "frequencies _ inputs"]],
    overlap: Float[ArrayLike, "windows windows"],
) -> tuple[Float[Array, "frequencies outputs inputs"], list[Float[Array, "frequencies outputs"]]]:
    """Variance of the responses under noise of unit power, and the residual energy it leaves."""
    overlap = jnp.asarray(overlap)
    ends = np.cumsum([0, *(part.effect.shape[2] for part in parts)])
    places = [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    kind = share.astype(parts[0].effect.dtype)
    spread = [
        part.effect @ overlap[mine].astype(kind.dtype)
        for part, mine in zip(parts, places, strict=True)
    ]
    pairs = [
        jnp.stack(
            [each[:, :, mine] @ jnp.conj(jnp.swapaxes(part.effect, 1, 2)) for each in spread], -1
        )
        for part, mine in zip(parts, places, strict=True)
    ]
    covariance = jnp.einsum("foig,fojh,fijgh->foij", kind, kind, jnp.stack(pairs, -1))
    traces = []
    for x, mine in zip(inputs, places, strict=True):
        first = jnp.stack([jnp.einsum("fsi,fis->fi", x, each[:, :, mine]) for each in spread], -1)
        once = jnp.real(jnp.einsum("foig,fig->fo", kind, first))
        power = jnp.einsum("fsi,fsj->fij", x, jnp.conj(x))
        twice = jnp.real(jnp.einsum("fij,foij->fo", power, covariance))
        traces.append(jnp.trace(overlap[mine, mine]) - 2 * once + twice)
    return jnp.real(jnp.diagonal(covariance, axis1=2, axis2=3)), traces


def _direct(split, combined: Combined, channels: Channels):
    """Partial coherence of inputs and outputs, whatever the instruments say of it."""
    if not channels.instruments:
        return combined.coherence
    each = jnp.stack([condition(x, x, y).coherence for _, x, y in split])
    return jnp.einsum("foig,gfoi->foi", combined.share, each)


def _excitation(transforms: Complex[Array, "windows frequencies channels"], channels: Channels):
    first, last = channels.inputs, channels.inputs + channels.outputs
    moving = jnp.concatenate([transforms[:, :, :first], transforms[:, :, last:]], axis=2)
    return jnp.mean(jnp.abs(moving) ** 2, axis=0).T
