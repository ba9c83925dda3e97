"""Several window lengths into one response (CIFER's COMPOSITE)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from ._conditioned import Conditioned


_COHERENCE_WEIGHT = 5.0
_STEPS = 5  # of Gauss-Newton; each gains two digits or more

Pairs = Float[Array, "frequencies outputs inputs"]


class Combined(NamedTuple):
    response: Complex[Array, "frequencies outputs inputs"]
    coherence: Pairs
    share: Float[Array, "frequencies outputs inputs groups"]  # of each length in the response


def alone(part: Conditioned) -> Combined:
    """One window length by itself."""
    response, coherence = part.response[0], part.coherence[0]
    lesser = jnp.minimum(coherence, part.moved[0][:, None, :])
    return Combined(response, lesser, jnp.ones((*response.shape, 1)))


def combine(
    parts: Conditioned,
    scales: Float[ArrayLike, " groups"],
    freedom: Float[Array, " groups"],
    resolved: Bool[ArrayLike, "groups frequencies"],
) -> Combined:
    """Weigh spectra of several window lengths by (eps_i / eps_min)^-4 and fit one set to them.

    `scales` turn powers into densities, `freedom` are the independent windows less the inputs
    that share them; `resolved` says where a window holds enough cycles. The cost is

        sum_i W_i {(G_xx - G_xx,i)^2 + (G_yy - G_yy,i)^2 + |G_xy - G_xy,i|^2 + 5 (g^2 - g_i^2)^2}

    each part relative to its mean under W_i^2 (G_xx~ and so on). |G_xy~| stands for the textbook's
    Re G_xy~ and Im G_xy~, one of which may be zero. Only weighted means of the spectra enter, and
    the phase is that of the mean. Source: Tischler & Remple eq. 10.4.
    """
    known = jnp.asarray(resolved)[:, :, None, None]
    weight = jnp.where(known, _weights(parts.coherence, freedom), 0.0)
    scale = jnp.asarray(scales)[:, None, None, None]
    gain, answer = parts.power[:, :, None, :] * scale, parts.answer * scale
    cross = parts.response * gain.astype(parts.response.dtype)
    pilot, mean = (w / jnp.sum(w, axis=0, keepdims=True) for w in (weight**2, weight))
    xx, yy, seen = (jnp.sum(pilot * each, axis=0) for each in (gain, answer, parts.coherence))
    xy = jnp.abs(jnp.sum(pilot.astype(cross.dtype) * cross, axis=0))
    along = jnp.sum(mean.astype(cross.dtype) * cross, axis=0)
    size = jnp.abs(along)
    targets = jnp.stack([
        jnp.sum(mean * gain, axis=0) / xx,
        jnp.sum(mean * answer, axis=0) / yy,
        size / xy,
        jnp.sum(mean * parts.coherence, axis=0) / seen,
    ])  # fmt: skip
    whole = xy**2 / (xx * yy)
    a, b, r = _fit_spectra(targets, whole / seen)
    moved = jnp.sum(mean * parts.moved[:, :, None, :], axis=0)
    share = mean * gain / jnp.sum(mean * gain, axis=0, keepdims=True)
    return Combined(
        along * (r / a * xy / xx / size).astype(along.dtype),
        jnp.minimum(r**2 / (a * b) * whole, moved),
        jnp.moveaxis(share, 0, -1),
    )


def _weights(
    coherence: Float[Array, "groups frequencies outputs inputs"], freedom: Float[Array, " groups"]
) -> Float[Array, "groups frequencies outputs inputs"]:
    """(eps_i / eps_min)^-4 with eps = sqrt(1 - g^2) / (|g| sqrt(2 n_d))."""
    averages = 2 * freedom[:, None, None, None]
    error = (1 - coherence + 1e-12) / (jnp.maximum(coherence, 1e-12) * averages)
    return (jnp.min(error, axis=0, keepdims=True) / error) ** 2


def _fit_spectra(
    targets: Float[Array, "4 frequencies outputs inputs"], level: Pairs
) -> Float[Array, "3 frequencies outputs inputs"]:
    """Minimise (a - a0)^2 + (b - b0)^2 + (r - r0)^2 + 5 (level r^2 / (a b) - q0)^2."""
    start, q0 = targets[:3], targets[3]

    def step(_, u):
        q = level * u[2] ** 2 / (u[0] * u[1])
        slopes = jnp.stack([-q / u[0], -q / u[1], 2 * q / u[2]])
        # Normal equations of identity plus one rank, by Sherman and Morrison.
        norm, away = jnp.sum(slopes**2, axis=0), jnp.sum((start - u) * slopes, axis=0)
        pull = _COHERENCE_WEIGHT * (q0 - q - away) / (1 + _COHERENCE_WEIGHT * norm)
        return start + pull[None] * slopes

    return jax.lax.fori_loop(0, _STEPS, step, start)
