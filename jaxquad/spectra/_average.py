"""Responses, coherence and errors from windowed transforms of one or several window lengths."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from ._leakage import find_bias, power_of, Slopes, without_leakage
from ._noise import noise_root


_TINY = 1e-300
_ROUNDING = 1e-15
_COHERENCE_WEIGHT = 5.0
_STEPS = 5  # of Gauss-Newton; each gains two digits or more
_DEPENDENT = 1e-4  # share of an input's power below which it cannot be separated from the others

Pairs = Float[np.ndarray, "frequencies outputs inputs"]
Responses = Complex[np.ndarray, "frequencies outputs inputs"]
Products = Complex[np.ndarray, "groups frequencies channels channels"]
Matrices = Complex[np.ndarray, "groups frequencies n n"]
Counts = Float[np.ndarray, " groups"]
Resolved = Bool[np.ndarray, "groups frequencies"]
_Powers = Float[np.ndarray, "*groups frequencies inputs"]
_Pairs = Float[np.ndarray, "*groups frequencies outputs inputs"]


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
    """`(Z* X)^-1 Z* Y` from the sums of `conj(a) b` over so many windows of each length.

    With two inputs and instruments z = x, this is the closed form of the textbook.
    Source: Bendat & Piersol, ch. 7; Tischler & Remple, ch. 9.
    """
    z, x, y = channels.split(np.arange(products.shape[-1]))
    power = _diagonal(products)
    size = np.sqrt(np.maximum(power, _TINY))
    from_z = products[:, :, z]
    solver = _inverse(from_z[..., x], size[..., z], size[..., x])
    response = np.swapaxes(solver @ from_z[..., y], 2, 3)
    # What the instruments move of the inputs, and the diagonal of its inverse.
    if channels.instruments:
        inverted = solver @ from_z[..., z] @ np.conj(np.swapaxes(solver, 2, 3))
        least = np.maximum(_diagonal(inverted), _TINY)
        moving = _inverse(inverted, np.sqrt(least), np.sqrt(least))
    else:  # Rounding may make what is singular negative.
        least, moving = np.maximum(np.abs(_diagonal(solver)), _TINY), from_z[..., x]
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
        1 / (least * np.maximum(_diagonal(moving), _TINY)),
        answer / count[..., None],
        through / np.maximum(answer, _TINY),
        np.minimum(_diagonal(moving) / np.maximum(power[..., x], _TINY), 1.0),
        np.clip(1 - rest / np.maximum(total, _TINY), 0.0, 1.0),
    )


def _inverse(
    matrix: Matrices,
    rows: Float[np.ndarray, "groups frequencies n"],
    columns: Float[np.ndarray, "groups frequencies n"],
) -> Matrices:
    """That of matrices in any units, which `rows` and `columns` are."""
    if matrix.shape[-1] == 1:
        return 1 / matrix
    units = columns[..., :, None] * rows[..., None, :]
    scaled = matrix / np.swapaxes(units, 2, 3)
    try:
        return np.linalg.inv(scaled) / units
    except np.linalg.LinAlgError:  # One of many is singular to the last digit: make it huge.
        return np.linalg.inv(scaled + _ROUNDING * np.eye(matrix.shape[-1])) / units


def _diagonal(
    matrix: Complex[np.ndarray, "*batch rows rows"],
) -> Float[np.ndarray, "*batch rows"]:
    return np.real(np.diagonal(matrix, axis1=-2, axis2=-1))


class Combined(NamedTuple):
    response: Responses
    coherence: Pairs
    share: Float[np.ndarray, "frequencies outputs inputs groups"]  # of each length in the response


def single_length(part: Conditioned) -> Combined:
    """The response of one window length, without a combination."""
    response, coherence = part.response[0], part.coherence[0]
    lesser = np.minimum(coherence, part.instrument_share[0][:, None, :])
    return Combined(response, lesser, np.ones((*response.shape, 1)))


def combine(parts: Conditioned, scales: Counts, freedom: Counts, resolved: Resolved) -> Combined:
    """Weight spectra of several window lengths by (eps_i / eps_min)^-4 and fit one set to them.

    `scales` turn powers into densities, `freedom` are the independent windows less the inputs
    that share them, and eps = sqrt(1 - g^2) / (|g| sqrt(2 freedom)); `resolved` says where a window
    holds enough cycles. The cost is

        sum_i W_i {(G_xx - G_xx,i)^2 + (G_yy - G_yy,i)^2 + |G_xy - G_xy,i|^2 + 5 (g^2 - g_i^2)^2}

    each part relative to its mean under W_i^2 (G_xx~ and so on). |G_xy~| stands for the textbook's
    Re G_xy~ and Im G_xy~, one of which may be zero. Only weighted means of the spectra enter, and
    the phase is that of the mean. Source: Tischler & Remple eq. 10.4.
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
    a, b, r = _fit_spectra(targets, level / gg)
    moved = np.sum(mean * parts.instrument_share[:, :, None, :], axis=0)
    share = mean * gain / np.sum(mean * gain, axis=0, keepdims=True)
    return Combined(
        along * (r / a * xy / xx / size),
        np.minimum(r**2 / (a * b) * level, moved),
        np.moveaxis(share, 0, -1),
    )


def _fit_spectra(
    targets: Float[np.ndarray, "4 frequencies outputs inputs"], level: Pairs
) -> Float[np.ndarray, "3 frequencies outputs inputs"]:
    """Minimise (a - a0)^2 + (b - b0)^2 + (r - r0)^2 + 5 (level r^2 / (a b) - q0)^2."""
    start, q0 = targets[:3], targets[3]
    u = start
    for _ in range(_STEPS):
        q = level * u[2] ** 2 / (u[0] * u[1])
        slopes = np.stack([-q / u[0], -q / u[1], 2 * q / u[2]])
        # Normal equations of identity plus one rank, by Sherman and Morrison.
        norm, away = np.sum(slopes**2, axis=0), np.sum((start - u) * slopes, axis=0)
        correction = _COHERENCE_WEIGHT * (q0 - q - away) / (1 + _COHERENCE_WEIGHT * norm)
        u = start + correction[None] * slopes
    return u


# What leakage adds to the response, relative, and the standard error of that.
Leakage = Float[np.ndarray, "2 frequencies outputs inputs"]


class Averaged(NamedTuple):
    response: Responses
    coherence: Pairs
    random_error: Pairs
    direct_coherence: Pairs
    multiple_coherence: Float[np.ndarray, "frequencies outputs"]
    alone: Float[np.ndarray, "frequencies inputs"]  # share of an input's power, nan without any
    effect: Complex[np.ndarray, "frequencies inputs windows"]
    share: Float[np.ndarray, "frequencies outputs inputs groups"]
    noise: Complex[np.ndarray, "frequencies outputs roots"]
    freedom: Float[np.ndarray, "frequencies outputs groups"]  # complex, of each length's noise
    leakage: Callable[[], Leakage]  # computed where it is asked for


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def average(
    transforms: tuple[Complex[np.ndarray, "frequencies _ channels"], ...],
    sums: Products,
    slopes: tuple[Slopes, ...],
    channels: Channels,
    omega: Float[np.ndarray, " frequencies"],
    overlap: Float[np.ndarray, "windows windows"],
    scales: Counts,
    resolved: Resolved,
    averages: Counts,
) -> Averaged:
    """One response from all window lengths, with the effect of noise in each window.

    `sums` are those of the products of `transforms` over windows, `averages` the independent
    windows of each length less the inputs, and `slopes` the transforms behind the derivatives of
    the windows.
    """
    many = tuple(part.shape[1] for part in transforms)
    counts = np.array(many, float)
    parts = condition(sums, channels, counts)
    combined = combine(parts, scales, averages, resolved) if len(many) > 1 else single_length(parts)
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
    instruments = [np.conj(np.swapaxes(channels.split(part)[0], 1, 2)) for part in transforms]
    pairs = zip(parts.solver, instruments, strict=True)
    effect = np.concatenate([solver @ part for solver, part in pairs], axis=2)
    gain = _unit_noise(effect, combined.share, overlap, many)
    windows = [channels.split(part)[1:] for part in transforms]
    rest = without_leakage(windows, combined.response, slopes, overlap, resolved)
    weights = np.mean(combined.share, axis=2)
    trust = np.where(lost, 1e-9, 1.0)[:, None, None]
    outputs = np.moveaxis(channels.split(_diagonal(sums))[2], 0, 2)
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

    def leakage() -> Leakage:
        bias, square = find_bias(rest.fits, *combined.response.shape[1:])
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


def _unit_noise(
    effect: Complex[np.ndarray, "frequencies inputs windows"],
    share: Float[np.ndarray, "frequencies outputs inputs groups"],
    overlap: Float[np.ndarray, "windows windows"],
    counts: Sequence[int],
) -> Pairs:
    """Variance of the responses under noise of unit power.

    Sums over windows are taken pair of groups by pair, since the shares differ between outputs.
    """
    first = np.cumsum((0, *counts[:-1]))
    ends, rows = (*first[1:], len(overlap)), effect.reshape(-1, len(overlap))
    parts, total = np.concatenate([np.real(rows), np.imag(rows)]), np.zeros(share.shape[:3])
    for g, (start, end) in enumerate(zip(first, ends, strict=True)):
        products = (parts[:, start:end] @ overlap[start:end, start:]) * parts[:, start:]
        both = np.add.reduceat(products, first[g:] - start, axis=1)
        pairs = np.sum(both.reshape(2, *effect.shape[:2], -1), axis=0)
        pairs[..., 1:] *= 2.0  # each pair of lengths once
        total += share[..., g] * np.einsum("fih,foih->foi", pairs, share[..., g:])
    return total
