"""Several window lengths into one response (CIFER's COMPOSITE)."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from ._conditioned import Conditioned


_COHERENCE_WEIGHT = 5.0
_STEPS = 4  # of Gauss-Newton; each gains two digits or more


class Combined(NamedTuple):
    response: Complex[Array, "frequencies outputs inputs"]
    coherence: Float[Array, "frequencies outputs inputs"]
    share: Float[Array, "frequencies outputs inputs groups"]  # of each length in the response


def combine(
    parts: Sequence[Conditioned],
    scales: Float[ArrayLike, " groups"],
    freedom: Float[Array, " groups"],
    resolved: Bool[ArrayLike, "groups frequencies"],
) -> Combined:
    """Weigh spectra of several window lengths by (eps_i / eps_min)^-4 and fit one set to them.

    `scales` turn powers into densities, `freedom` are the independent windows less the inputs
    that share them; `resolved` says where a window holds enough cycles. The cost, to be minimised over G_xx, G_yy, G_xy and so g^2, is

        sum_i W_i {(G_xx - G_xx,i)^2 / G_xx~^2 + (G_yy - ..)^2 + |G_xy - ..|^2 + 5 (g^2 - g_i^2)^2 / g~^4}

    each part relative to the mean under W_i^2. |G_xy~| stands for the textbook's Re G_xy~ and
    Im G_xy~, one of which may be zero. Only weighted means of the spectra enter, and the phase is that of
    the mean. Source: Tischler & Remple eq. 10.4.
    """
    weight = jnp.where(jnp.asarray(resolved)[:, :, None, None], _weights(parts, freedom), 0.0)
    scale = jnp.asarray(scales)[:, None, None, None]
    gain = jnp.stack([part.power[:, None, :] for part in parts]) * scale
    answer = jnp.stack([part.answer for part in parts]) * scale
    cross = jnp.stack([part.response for part in parts]) * gain.astype(parts[0].response.dtype)
    coherence = jnp.stack([part.coherence for part in parts])
    moved = jnp.stack([part.moved[:, None, :] for part in parts])
    pilot = weight**2 / jnp.sum(weight**2, axis=0, keepdims=True)
    xx, yy, seen = (jnp.sum(pilot * each, axis=0) for each in (gain, answer, coherence))
    xy = jnp.abs(jnp.sum(pilot.astype(cross.dtype) * cross, axis=0))
    mean = weight / jnp.sum(weight, axis=0, keepdims=True)
    along = jnp.sum(mean.astype(cross.dtype) * cross, axis=0)
    targets = (
        jnp.sum(mean * gain, axis=0) / xx,
        jnp.sum(mean * answer, axis=0) / yy,
        jnp.abs(along) / xy,
        jnp.sum(mean * coherence, axis=0) / seen,
    )
    a, b, r = _fit_spectra(targets, xy**2 / (xx * yy * seen))
    size = r / a * (xy / xx)
    share = mean * gain / jnp.sum(mean * gain, axis=0, keepdims=True)
    return Combined(
        along / jnp.abs(along).astype(along.dtype) * size.astype(along.dtype),
        jnp.minimum(r**2 / (a * b) * xy**2 / (xx * yy), jnp.sum(mean * moved, axis=0)),
        jnp.moveaxis(share, 0, -1),
    )


def _weights(
    parts: Sequence[Conditioned], freedom: Float[Array, " groups"]
) -> Float[Array, "groups frequencies outputs inputs"]:
    """(eps_i / eps_min)^-4 with eps = sqrt(1 - g^2) / (|g| sqrt(2 n_d))."""
    coherence = jnp.stack([part.coherence for part in parts])
    averages = 2 * freedom[:, None, None, None]
    error = (1 - coherence + 1e-12) / (jnp.maximum(coherence, 1e-12) * averages)
    return (jnp.min(error, axis=0, keepdims=True) / error) ** 2


def _fit_spectra(
    targets: tuple[Float[Array, "..."], ...], level: Float[Array, "..."]
) -> tuple[Float[Array, "..."], ...]:
    """Minimise (a - a0)^2 + (b - b0)^2 + (r - r0)^2 + 5 (level r^2 / (a b) - q0)^2."""
    a0, b0, r0, q0 = targets
    a, b, r = a0, b0, r0
    for _ in range(_STEPS):
        q = level * r**2 / (a * b)
        slopes = (-q / a, -q / b, 2 * q / r)
        # Normal equations of identity plus one rank, by Sherman and Morrison.
        norm = sum(slope**2 for slope in slopes)
        away = (a0 - a) * slopes[0] + (b0 - b) * slopes[1] + (r0 - r) * slopes[2]
        pull = _COHERENCE_WEIGHT * (q0 - q - away) / (1 + _COHERENCE_WEIGHT * norm)
        a, b, r = a0 + pull * slopes[0], b0 + pull * slopes[1], r0 + pull * slopes[2]
    return a, b, r
