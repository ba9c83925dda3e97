"""Responses, coherence and errors from windowed transforms of one or several window lengths."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ._error_covariance import window_products
from ._estimators import adjoint, diagonal, Grid, Levels, Pairs, power_of, Responses
from ._fourier_sums import coefficients, Layout
from ._noise import noise_root, padded, Resolved, Slopes, without_leakage


_TINY = 1e-300
_COHERENCE_WEIGHT = 5.0
_STEPS = 5  # of Gauss-Newton; each gains two digits or more
_DEPENDENT = 1e-4  # share of an input's power below which it cannot be separated from the others
_CYCLES = 2.0  # in a window, below which leakage outweighs what more averages gain

Shares = Float[np.ndarray, "frequencies outputs inputs groups"]
Products = Complex[np.ndarray, "groups frequencies channels channels"]
Counts = Float[np.ndarray, " groups"]
_Powers = Float[np.ndarray, "*groups frequencies inputs"]
_Pairs = Float[np.ndarray, "*groups frequencies outputs inputs"]


class Segments(NamedTuple):
    """Transforms of windows for each length, in absolute phase, by the channels of `Record.names`.

    The starts in `groups` are of the records one after the other, with gaps wider than any window.
    """

    transforms: tuple[Complex[np.ndarray, "frequencies windows channels"], ...]
    slopes: tuple[Slopes, ...]  # empty where they are not needed, or nothing follows from them
    groups: Layout


class Channels(NamedTuple):
    """How many channels are inputs, outputs and instruments; without instruments, inputs serve."""

    inputs: int
    outputs: int
    instruments: int

    def split(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Instruments, inputs and outputs along the last axis."""
        n, m = self.inputs, self.inputs + self.outputs
        x = rows[..., :n]
        return (rows[..., m : m + n] if self.instruments else x), x, rows[..., n:m]


class Conditioned(NamedTuple):
    """Responses of each window length, and the spectra of each pair without the other inputs."""

    response: Complex[np.ndarray, "*groups frequencies outputs inputs"]
    solver: Complex[np.ndarray, "*groups frequencies inputs inputs"]  # (Z* X)^-1
    power: _Powers  # of an input that no other input explains
    alone: _Powers  # share of the input's power that no other input explains
    output_power: _Pairs  # less the other inputs'
    coherence: _Pairs  # partial
    instrument_share: _Powers  # of an input's power
    multiple: Float[np.ndarray, "*groups frequencies outputs"]  # coherence with all inputs


def condition(products: Products, channels: Channels, counts: Counts) -> Conditioned:
    """`(Z* X)^-1 Z* Y` from the sums of `conj(a) b` (Bendat & Piersol, ch. 7; Tischler & Remple,
    ch. 9)."""

    def inverse(matrix: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """That of matrices in any units, which `rows` and `columns` are."""
        if matrix.shape[-1] == 1:
            return 1 / matrix
        units = columns[..., :, None] * rows[..., None, :]
        scaled = matrix / np.swapaxes(units, 2, 3)
        try:
            return np.linalg.inv(scaled) / units
        except np.linalg.LinAlgError:  # One of many is singular to the last digit: make it huge.
            return np.linalg.inv(scaled + 1e-15 * np.eye(matrix.shape[-1])) / units

    z, x, y = channels.split(np.arange(products.shape[-1]))
    power = diagonal(products)
    size = np.sqrt(np.maximum(power, _TINY))
    from_z = products[:, :, z]
    solver = inverse(from_z[..., x], size[..., z], size[..., x])
    response = np.swapaxes(solver @ from_z[..., y], 2, 3)
    # What the instruments move of the inputs, and the diagonal of its inverse.
    if channels.instruments:
        inverted = solver @ from_z[..., z] @ adjoint(solver)
        least = np.maximum(diagonal(inverted), _TINY)
        moving = inverse(inverted, np.sqrt(least), np.sqrt(least))
    else:  # Rounding may make what is singular negative.
        least, moving = np.maximum(np.abs(diagonal(solver)), _TINY), from_z[..., x]
    explained = np.sum(np.conj(response) * (response @ np.swapaxes(moving, 2, 3)), axis=3).real
    total = power[..., y]
    through = power_of(response) / least[:, :, None]
    rest = np.maximum(total - explained, 0.0)
    answer = rest[..., None] + through
    count = counts[:, None, None]
    return Conditioned(
        response,
        solver,
        1 / (least * count),
        1 / (least * np.maximum(diagonal(moving), _TINY)),
        answer / count[..., None],
        through / np.maximum(answer, _TINY),
        np.minimum(diagonal(moving) / np.maximum(power[..., x], _TINY), 1.0),
        np.clip(1 - rest / np.maximum(total, _TINY), 0.0, 1.0),
    )


class Combined(NamedTuple):
    response: Responses
    coherence: Pairs
    share: Shares  # of each length in the response


def combine(parts: Conditioned, scales: Counts, freedom: Counts, resolved: Resolved) -> Combined:
    """Weight spectra of several window lengths by W_i = (eps_i / eps_min)^-4 and fit one set to
    them.

    The cost (Tischler & Remple eq. 10.4), each part relative to its mean under W_i^2 (G_xx~ ...),
    is

        sum_i W_i {(G_xx - G_xx,i)^2 + (G_yy - G_yy,i)^2 + |G_xy - G_xy,i|^2 + 5 (g^2 - g_i^2)^2}

    with |G_xy~| for Re G_xy~ and Im G_xy~, one of which may be zero. The phase is that of the mean.
    """
    averages = 2 * freedom[:, None, None, None]
    error = (1 - parts.coherence + 1e-12) / (np.maximum(parts.coherence, 1e-12) * averages)
    weight = (np.min(error, axis=0, keepdims=True) / error) ** 2
    weight = np.where(resolved[:, :, None, None], weight, 0.0)
    scale = scales[:, None, None, None]
    gain, answer = parts.power[:, :, None, :] * scale, parts.output_power * scale
    cross = parts.response * gain
    pilot, mean = (w / np.sum(w, axis=0, keepdims=True) for w in (weight**2, weight))
    xx, yy, gg = (np.sum(pilot * part, axis=0) for part in (gain, answer, parts.coherence))
    xy = np.abs(np.sum(pilot * cross, axis=0))
    along = np.sum(mean * cross, axis=0)
    size = np.abs(along)
    targets = np.stack([
        np.sum(mean * gain, axis=0) / xx,
        np.sum(mean * answer, axis=0) / yy,
        size / xy,
        np.sum(mean * parts.coherence, axis=0) / gg,
    ])  # fmt: skip
    level = xy**2 / (xx * yy)
    # Minimise (a - a0)^2 + (b - b0)^2 + (r - r0)^2 + 5 (level r^2 / (a b) - q0)^2.
    u, level_q = targets[:3], level / gg
    for _ in range(_STEPS):
        q = level_q * u[2] ** 2 / (u[0] * u[1])
        slopes = np.stack([-q / u[0], -q / u[1], 2 * q / u[2]])
        # Normal equations of identity plus one rank, by Sherman and Morrison.
        norm, away = np.sum(slopes**2, axis=0), np.sum((targets[:3] - u) * slopes, axis=0)
        correction = _COHERENCE_WEIGHT * (targets[3] - q - away) / (1 + _COHERENCE_WEIGHT * norm)
        u = targets[:3] + correction[None] * slopes
    a, b, r = u
    moved = np.sum(mean * parts.instrument_share[:, :, None, :], axis=0)
    share = mean * gain / np.sum(mean * gain, axis=0, keepdims=True)
    return Combined(
        along * (r / a * xy / xx / size),
        np.minimum(r**2 / (a * b) * level, moved),
        np.moveaxis(share, 0, -1),
    )


class Averaged(NamedTuple):
    response: Responses
    coherence: Pairs
    random_error: Pairs
    direct_coherence: Pairs
    multiple_coherence: Levels
    alone: Float[np.ndarray, "frequencies inputs"]  # share of an input's power, nan without any
    effect: Complex[np.ndarray, "frequencies inputs windows"]
    share: Shares
    noise: Complex[np.ndarray, "frequencies outputs roots"]
    freedom: Float[np.ndarray, "frequencies outputs groups"]  # complex, of each length's noise
    # What leakage adds to the response, relative, and the standard error of that.
    leakage: Callable[[], Float[np.ndarray, "2 frequencies outputs inputs"]]


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def average(
    segments: Segments,
    sums: Products,
    channels: Channels,
    omega: Grid,
    dt: float,
    shape: str,
    independent: Counts,
) -> Averaged:
    """One response from all window lengths, with the effect of noise in each window."""
    lengths, starts = zip(*segments.groups, strict=True)
    transforms, many = segments.transforms, tuple(map(len, starts))
    overlap, counts = window_products(segments.groups, shape), np.array(many, float)
    averages = np.maximum(independent - channels.inputs + 1, 0.5)
    level, cosine = coefficients(shape)
    scales = 2 * dt / ((level**2 + cosine**2 / 2) * np.array(lengths))  # to one-sided densities
    resolving = np.array([np.inf, *lengths[1:]])  # the longest window is used everywhere
    resolved = (omega * dt)[None, :] * resolving[:, None] >= 2 * np.pi * _CYCLES
    parts = condition(sums, channels, counts)
    if len(many) > 1:
        combined = combine(parts, scales, averages, resolved)
    else:
        response, coherence = parts.response[0], parts.coherence[0]
        lesser = np.minimum(coherence, parts.instrument_share[0][:, None, :])
        combined = Combined(response, lesser, np.ones((*response.shape, 1)))
    alone = np.einsum("fig,gfi->fi", np.mean(combined.share, axis=1), parts.alone)
    inseparable = ~(alone >= _DEPENDENT)
    lost = np.any(inseparable, axis=1)
    if np.any(lost):  # finite placeholders, which are marked as nan below
        gone = lost[:, None, None]
        solver, multiple = np.where(gone, 0.0, parts.solver), parts.multiple
        multiple = np.where(lost[:, None], 0.0, multiple)
        parts = parts._replace(solver=solver, multiple=multiple)
        equal = (resolved / np.sum(resolved, axis=0)).T[:, None, None]
        combined = Combined(
            np.where(gone, 1e-300, combined.response),
            np.where(gone, 0.0, combined.coherence),
            np.where(gone[..., None], equal, combined.share),
        )
    instruments = [adjoint(channels.split(part)[0]) for part in transforms]
    effect = np.concatenate(list(map(np.matmul, parts.solver, instruments)), axis=2)
    # Variance of the responses under noise of unit power: pair of lengths by pair, since their
    # shares differ between outputs.
    first, gain = np.cumsum((0, *many[:-1])), np.zeros(combined.share.shape[:3])
    rows = effect.reshape(-1, len(overlap))
    rows = np.concatenate([np.real(rows), np.imag(rows)])
    for g, (start, end) in enumerate(zip(first, (*first[1:], len(overlap)), strict=True)):
        products = (rows[:, start:end] @ overlap[start:end, start:]) * rows[:, start:]
        both = np.add.reduceat(products, first[g:] - start, axis=1)
        pairs = np.sum(both.reshape(2, *effect.shape[:2], -1), axis=0)
        pairs[..., 1:] *= 2.0  # each pair of lengths once
        gain += combined.share[..., g] * np.einsum("fih,foih->foi", pairs, combined.share[..., g:])
    windows = [channels.split(part)[1:] for part in transforms]
    rest = without_leakage(windows, combined.response, segments.slopes, overlap, resolved)
    weights = np.mean(combined.share, axis=2)
    trust = np.where(lost, 1e-9, 1.0)[:, None, None]
    outputs = np.moveaxis(channels.split(diagonal(sums))[2], 0, 2)
    noise = noise_root(omega, rest, outputs, weights * trust)
    power = np.sum(power_of(noise), axis=2)
    error = np.sqrt(power[:, :, None] * gain / 2) / np.abs(combined.response)
    response, coherence, direct = combined.response, combined.coherence, combined.coherence
    if channels.instruments:  # partial coherence of inputs and outputs, without the instruments
        plain = condition(sums, channels._replace(instruments=0), counts).coherence
        direct = np.einsum("foig,gfoi->foi", combined.share, plain)
    if np.any(lost):
        none = (response, np.nan), (coherence, 0.0), (error, np.inf)
        mask = inseparable[:, None, :]
        response, coherence, error = (np.where(mask, blank, field) for field, blank in none)

    def leakage() -> Float[np.ndarray, "2 frequencies outputs inputs"]:
        biases = [fit.bias(*combined.response.shape[1:]) for fit in rest.fits]
        bias, square = (padded(part, omega.size) for part in zip(*biases, strict=True))
        added = np.abs(np.sum(bias * combined.share, axis=3))
        spread = np.sum(combined.share * np.sqrt(square), axis=3)
        doubt = np.sqrt(power / 2)[:, :, None] * spread
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([added, doubt]) / np.abs(combined.response)

    return Averaged(
        response,
        coherence,
        error,
        direct,
        np.einsum("fog,gfo->fo", weights, parts.multiple),
        alone,
        effect,
        combined.share,
        noise,
        rest.freedom,
        leakage,
    )
