"""Responses, coherence and errors from windowed transforms of one or several window lengths."""

import functools as ft
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from jaxquad.models import invert

from ._leakage import power_of, Rest, Slopes, without_leakage


_TINY = 1e-300


class Channels(NamedTuple):
    """How many channels are inputs, outputs and instruments; without instruments, inputs serve."""

    inputs: int
    outputs: int
    instruments: int

    def split(self, rows: Array) -> tuple[Array, Array, Array]:
        """Instruments, inputs and outputs along the last axis."""
        n, m = self.inputs, self.inputs + self.outputs
        x = rows[..., :n]
        return (rows[..., m : m + n] if self.instruments else x), x, rows[..., n:m]


class Conditioned(NamedTuple):
    """Responses of one window length, and the spectra of each pair without the other inputs."""

    response: Complex[Array, "*groups frequencies outputs inputs"]
    solver: Complex[Array, "*groups frequencies inputs inputs"]  # (Z* X)^-1
    power: Float[Array, "*groups frequencies inputs"]  # of an input that no other input explains
    own_share: Float[Array, "*groups frequencies inputs"]  # share of the input's power
    output_power: Float[Array, "*groups frequencies outputs inputs"]  # less the other inputs'
    coherence: Float[Array, "*groups frequencies outputs inputs"]  # partial
    instrument_share: Float[Array, "*groups frequencies inputs"]  # of an input's power
    multiple: Float[Array, "*groups frequencies outputs"]  # coherence of the output with all inputs


def condition(
    products: Complex[Array, "frequencies channels channels"],
    channels: Channels,
    count: Float[Array, ""],
) -> Conditioned:
    """`(Z* X)^-1 Z* Y` from the sums of `conj(a) b` over `count` windows.

    With two inputs and instruments z = x, this is the closed form of the textbook.
    Source: Bendat & Piersol, ch. 7; Tischler & Remple, ch. 9.
    """
    z, x, y = channels.split(jnp.arange(products.shape[1]))
    from_z = products[:, z]
    solver = _inverse(from_z[:, :, x])
    response = jnp.swapaxes(solver @ from_z[:, :, y], 1, 2)
    # The inverse power of what the instruments move of the inputs.
    inverted = solver @ from_z[:, :, z] @ jnp.conj(jnp.swapaxes(solver, 1, 2))
    moving = _inverse(inverted)
    power = 1 / jnp.maximum(_diagonal(inverted), _TINY)
    explained = jnp.real(jnp.sum(jnp.conj(response) * (response @ jnp.swapaxes(moving, 1, 2)), 2))
    whole = _diagonal(products)
    total = whole[:, y]
    own = power_of(response) * power[:, None, :]
    rest = jnp.maximum(total - explained, 0.0)
    answer = rest[:, :, None] + own
    return Conditioned(
        response,
        solver,
        power / count,
        power / jnp.maximum(_diagonal(moving), _TINY),
        answer / count,
        own / jnp.maximum(answer, _TINY),
        jnp.minimum(_diagonal(moving) / jnp.maximum(whole[:, x], _TINY), 1.0),
        jnp.clip(1 - rest / jnp.maximum(total, _TINY), 0.0, 1.0),
    )


def _inverse(
    matrix: Complex[Array, "frequencies inputs inputs"],
) -> Complex[Array, "frequencies inputs inputs"]:
    # One input needs no factorisation, which would double the time to compile.
    return 1 / matrix if matrix.shape[1] == 1 else invert(matrix)


def _diagonal(
    matrix: Complex[Array, "frequencies rows rows"],
) -> Float[Array, "frequencies rows"]:
    return jnp.real(jnp.diagonal(matrix, axis1=1, axis2=2))


BANDWIDTH = 0.2  # of the noise's smoothing, in ln(omega)
_FLOOR = 1e-26  # of the output's power: below it lies rounding

Residuals = Complex[Array, "frequencies windows outputs"]


def noise_root(
    omega: Float[Array, " frequencies"],
    residuals: Residuals,
    outputs: Residuals,
    member: Float[Array, "windows groups"],
    trace: Float[Array, "frequencies outputs groups"],
    freedom: Float[Array, "frequencies outputs groups"],
    weights: Float[Array, "frequencies outputs groups"],
) -> Complex[Array, "frequencies outputs outputs"]:
    """Hermitian root of the covariance of the noise, from the residuals, smooth along frequency.

    `member` says which window is of which length. For each length, `trace` is the energy that unit
    noise would leave in the residuals, `freedom` its complex degrees of freedom, and `weights` how
    much it counts.
    """
    place = jnp.log(omega)
    energy, floor = (jnp.swapaxes(power_of(x), 1, 2) @ member for x in (residuals, outputs))
    # The logarithm of a chi-squared variable is biased by digamma(f) - ln(f).
    low = -1 / (2 * freedom) - 1 / (12 * freedom**2)
    levels = jnp.log(jnp.maximum(energy, _FLOOR * floor + 1e-280) / trace) - low
    weight = jnp.sum(weights * freedom, axis=2)
    level = jnp.sum(weights * levels, axis=2)
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
    kernel = weight[None, :] * jnp.exp(-0.5 * (offset / BANDWIDTH) ** 2)
    m0, m1, m2 = (jnp.sum(kernel * offset**k, axis=1) for k in (0, 1, 2))
    l0, l1 = (jnp.sum(kernel * offset**k * level[None, :], axis=1) for k in (0, 1))
    # A single frequency has no slope: the small term keeps the line flat there.
    spread = m2 + 1e-9 * m0
    return (spread * l0 - m1 * l1) / (spread * m0 - m1**2)


def _coherency(
    place: Float[Array, " frequencies"], unit: Residuals
) -> Complex[Array, "frequencies outputs outputs"]:
    """Correlation between the outputs' noise, of unit diagonal and positive semidefinite."""
    total = jnp.swapaxes(unit, 1, 2) @ jnp.conj(unit)
    kernel = jnp.exp(-0.5 * ((place[None, :] - place[:, None]) / BANDWIDTH) ** 2)
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


_COHERENCE_WEIGHT = 5.0
_STEPS = 5  # of Gauss-Newton; each gains two digits or more

Pairs = Float[Array, "frequencies outputs inputs"]


class Combined(NamedTuple):
    response: Complex[Array, "frequencies outputs inputs"]
    coherence: Pairs
    share: Float[Array, "frequencies outputs inputs groups"]  # of each length in the response


def single_length(part: Conditioned) -> Combined:
    """The response of one window length, without a combination."""
    response, coherence = part.response[0], part.coherence[0]
    lesser = jnp.minimum(coherence, part.instrument_share[0][:, None, :])
    return Combined(response, lesser, jnp.ones((*response.shape, 1)))


def combine(
    parts: Conditioned,
    scales: Float[ArrayLike, " groups"],
    freedom: Float[Array, " groups"],
    resolved: Bool[ArrayLike, "groups frequencies"],
) -> Combined:
    """Weight spectra of several window lengths by (eps_i / eps_min)^-4 and fit one set to them.

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
    gain, answer = parts.power[:, :, None, :] * scale, parts.output_power * scale
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
    moved = jnp.sum(mean * parts.instrument_share[:, :, None, :], axis=0)
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
        correction = _COHERENCE_WEIGHT * (q0 - q - away) / (1 + _COHERENCE_WEIGHT * norm)
        return start + correction[None] * slopes

    return jax.lax.fori_loop(0, _STEPS, step, start)


_DEPENDENT = 1e-4  # share of an input's power below which it cannot be separated from the others


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
    freedom: Float[
        Array, "frequencies outputs groups"
    ]  # complex, of the noise of each window length
    leakage: Float[Array, "2 frequencies outputs inputs"]  # relative bias, and its error


@ft.partial(jax.jit, static_argnames="channels")
def average(
    transforms: tuple[Complex[Array, "_ frequencies channels"], ...],
    slopes: tuple[Slopes, ...],
    channels: Channels,
    omega: Float[ArrayLike, " frequencies"],
    overlap: Float[ArrayLike, "windows windows"],
    scales: Float[ArrayLike, " groups"],
    resolved: Bool[ArrayLike, "groups frequencies"],
    averages: Float[ArrayLike, " groups"],
) -> Averaged:
    """One response from all window lengths, with the effect of noise in each window.

    `averages` are the independent windows of each length less the inputs, and `slopes` the
    transforms behind the derivatives of the windows.
    """
    averages = jnp.asarray(averages)
    many = tuple(len(part) for part in transforms)
    flat = jnp.swapaxes(jnp.concatenate(transforms), 0, 1)
    rows = jnp.split(flat, np.cumsum(many)[:-1], axis=1)
    products = jnp.stack([jnp.conj(jnp.swapaxes(row, 1, 2)) @ row for row in rows])
    counts = jnp.asarray(many, float)
    parts = _conditioned(products, channels, counts)
    combined = combine(parts, scales, averages, resolved) if len(many) > 1 else single_length(parts)
    own_share = jnp.einsum("fig,gfi->fi", jnp.mean(combined.share, axis=1), parts.own_share)
    lost = ~(own_share >= _DEPENDENT)
    parts, combined = _with_placeholders(jnp.any(lost, axis=1), parts, combined)
    z, inputs, outputs = channels.split(flat)
    split = jnp.split(jnp.conj(jnp.swapaxes(z, 1, 2)), np.cumsum(many)[:-1], axis=2)
    effect = jnp.concatenate([s @ c for s, c in zip(parts.solver, split, strict=True)], axis=2)
    gain = _unit_noise(effect, combined.share, jnp.asarray(overlap), many)
    weights = jnp.mean(combined.share, axis=2)
    trust = jnp.where(jnp.any(lost, axis=1), 1e-9, 1.0)[:, None, None]
    residuals = outputs - inputs @ jnp.swapaxes(combined.response, 1, 2)
    rest = without_leakage(residuals, inputs, slopes, jnp.asarray(overlap), many)
    member = jnp.asarray(np.repeat(np.eye(len(many)), many, axis=0))
    noise = noise_root(
        jnp.asarray(omega), rest.residuals, outputs, member, rest.trace, rest.freedom,
        weights * trust,
    )  # fmt: skip
    power = jnp.sum(power_of(noise), axis=2)
    error = jnp.sqrt(power[:, :, None] * gain / 2) / jnp.abs(combined.response)
    gone = lost[:, None, :]
    return Averaged(
        jnp.where(gone, jnp.nan, combined.response),
        jnp.where(gone, 0.0, combined.coherence),
        jnp.where(gone, jnp.inf, error),
        _direct(products, counts, combined, channels),
        jnp.einsum("fog,gfo->fo", weights, parts.multiple),
        1 - jnp.nan_to_num(own_share),
        effect,
        combined.share,
        noise,
        _excitation(products[0] / counts[0].astype(products.dtype), channels),
        rest.freedom,
        _leakage(rest, combined, power),
    )


def _leakage(
    rest: Rest, combined: Combined, power: Float[Array, "frequencies outputs"]
) -> Float[Array, "2 frequencies outputs inputs"]:
    """What leakage adds to the response, relative, and the standard error of that."""
    bias = jnp.abs(jnp.sum(rest.bias * combined.share.astype(rest.bias.dtype), axis=3))
    spread = jnp.sum(combined.share * jnp.sqrt(rest.doubt), axis=3)
    error = jnp.sqrt(power / 2)[:, :, None] * spread
    return jnp.stack([bias, error]) / jnp.abs(combined.response)[None]


def _conditioned(products, channels: Channels, counts: Float[Array, " groups"]) -> Conditioned:
    return jax.vmap(lambda p, count: condition(p, channels, count))(products, counts)


def _with_placeholders(
    lost: Bool[Array, " frequencies"], parts: Conditioned, combined: Combined
) -> tuple[Conditioned, Combined]:
    """Finite placeholders where inputs cannot be separated; `average` marks them as nan."""
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
    overlap: Float[Array, "windows windows"],
    counts: tuple[int, ...],
) -> Float[Array, "frequencies outputs inputs"]:
    """Variance of the responses under noise of unit power.

    Sums over windows are taken group by group, since the shares differ between outputs.
    """
    ends = np.cumsum(counts)[:-1]
    rows = zip(jnp.split(effect, ends, axis=2), jnp.split(overlap, ends), strict=True)
    spread = jnp.stack([_times_real(e, o) for e, o in rows], axis=-1)
    own = jnp.split(spread * jnp.conj(effect)[..., None], ends, axis=2)
    pairs = jnp.real(jnp.stack([jnp.sum(part, axis=2) for part in own], axis=-1))
    return jnp.einsum("foig,figh,foih->foi", share, pairs, share)


def _times_real(
    a: Complex[Array, "frequencies inputs _"], b: Float[Array, "_ windows"]
) -> Complex[Array, "frequencies inputs windows"]:
    rows = a.reshape(-1, a.shape[2])
    both = jnp.concatenate([rows.real, rows.imag]) @ b
    real, imag = jnp.split(both, 2)
    return jax.lax.complex(real, imag).reshape(*a.shape[:2], b.shape[1])


def _direct(products, counts, combined: Combined, channels: Channels):
    """Partial coherence of inputs and outputs, without the instruments."""
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
