"""The outputs' noise along frequency, from the residuals of local fits."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from ._atoms import Reach, reach_of
from ._error_covariance import ErrorCovariance
from ._local_fit import Bins, LocalFit
from ._noise_freedom import BANDWIDTH


_WIDE = 2.0  # bandwidth of the correlations between outputs in open loop, in ln(omega)
_UNLIKELY = 1e-4  # chance at which a residual counts as a misfit, or a line in the noise


class Noise(NamedTuple):
    """Noise covariance of the outputs at rising frequencies, power laws between them."""

    omega: Float[np.ndarray, " frequencies"]  # rad/s
    power: Float[np.ndarray, "frequencies outputs"]
    correlation: Complex[np.ndarray, "frequencies outputs outputs"]
    freedom: Float[np.ndarray, " frequencies"]  # complex degrees of freedom behind a power

    def power_at(self, omega: Float[np.ndarray, " bins"]) -> Float[np.ndarray, "bins outputs"]:
        """Powers at other frequencies; beyond the ends, those at the ends."""
        place, known = np.log(omega), np.log(self.omega)
        columns = [np.interp(place, known, column) for column in np.log(self.power).T]
        return np.exp(np.stack(columns, axis=1))

    def root_at(
        self, omega: Float[np.ndarray, " bins"]
    ) -> Complex[np.ndarray, "bins outputs outputs"]:
        """Roots of the covariances at other frequencies, correlated as at the nearest one."""
        near = np.searchsorted(np.sqrt(self.omega[1:] * self.omega[:-1]), omega)
        scale = np.sqrt(self.power_at(omega) / self.power[near])
        return self.root()[near] * scale[:, :, None]

    def root(self) -> Complex[np.ndarray, "frequencies outputs outputs"]:
        """Roots of the covariances, which change along frequency as slowly as they do."""
        values, vectors = np.linalg.eigh(self.correlation)
        stretched = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        root = stretched @ np.conj(np.swapaxes(vectors, 1, 2))
        return np.sqrt(self.power)[:, :, None] * root


def smooth_noise(
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
    scatter: Complex[np.ndarray, "frequencies outputs outputs"],
    freedom: Float[np.ndarray, " frequencies"],
    *,
    open_loop: bool = False,
) -> Noise:
    """Smooth residual covariances, each of `freedom` complex degrees of freedom, along frequency.

    Powers are smoothed by local lines in log-log, corrected for the bias of the logarithm of a
    chi-squared variable; correlations by positive weights, so that they stay positive semidefinite.
    Residuals larger than chance allows are left out. Outputs in `open_loop` are correlated as in a
    wide band, as far as the narrow ones agree with it.
    """
    from scipy.special import digamma, gammaincinv

    known = freedom > 0
    freedom = np.where(known, freedom, 1.0)
    raw = np.real(np.diagonal(scatter, axis1=1, axis2=2))
    raw = np.where(known[:, None], np.maximum(raw, 1e-300), 1.0)
    bias = (digamma(freedom) - np.log(freedom))[:, None]
    high = np.log(gammaincinv(freedom, 1 - _UNLIKELY) / freedom)[:, None]
    place, level = np.log(omega), np.log(raw) - bias
    weight = np.where(known, freedom, 0.0)[:, None] * np.ones_like(level)
    smooth = _local_lines(place, level, weight)
    for _ in range(3):
        outlier = known[:, None] & (np.log(raw) > smooth + high)
        smooth = _local_lines(place, level, np.where(outlier, 1e-9 * weight, weight))
    if np.any(known):  # Far from all known frequencies the kernel vanishes.
        isolated = np.interp(place, place[known], np.arange(np.sum(known)))
        isolated = np.abs(place - place[known][np.round(isolated).astype(int)]) > 3 * BANDWIDTH
        nearest = [np.interp(place, place[known], column[known]) for column in smooth.T]
        smooth = np.where(isolated[:, None], np.stack(nearest, axis=1), smooth)
    freedom = np.where(known, freedom, 0.0)
    windows = 1 + np.sqrt(np.pi) * BANDWIDTH * omega / half_width
    correlation = _correlation(place, scatter, raw, freedom, BANDWIDTH)
    if open_loop and raw.shape[1] > 1:
        wide = _correlation(place, scatter, raw, freedom * windows, _WIDE)
        correlation = _drawn_together(correlation, wide, freedom * windows)
    return Noise(omega, np.exp(smooth), correlation, freedom * windows)


def _drawn_together(
    narrow: Complex[np.ndarray, "frequencies outputs outputs"],
    wide: Complex[np.ndarray, "frequencies outputs outputs"],
    freedom: Float[np.ndarray, " frequencies"],
) -> Complex[np.ndarray, "frequencies outputs outputs"]:
    """The wide correlations where the narrow ones differ from them by chance.

    Towards the narrow ones as the squared differences grow to twice what chance makes. A complex
    correlation r of n complex degrees of freedom has the variance (1 - |r|^2) / n.
    """
    found = np.sum(freedom[:, None, None] * np.abs(narrow - wide) ** 2)
    chance = np.sum((1 - np.abs(wide) ** 2)[freedom > 0])
    share = np.clip(found / max(float(chance), 1e-300) - 1, 0.0, 1.0)
    return wide + share * (narrow - wide)


def _local_lines(
    place: Float[np.ndarray, " frequencies"],
    level: Float[np.ndarray, "frequencies outputs"],
    weight: Float[np.ndarray, "frequencies outputs"],
) -> Float[np.ndarray, "frequencies outputs"]:
    offset = place[None, :] - place[:, None]
    kernel = np.exp(-0.5 * (offset / BANDWIDTH) ** 2)
    m0, m1, m2 = ((kernel * offset**k) @ weight for k in (0, 1, 2))
    l0, l1 = ((kernel * offset**k) @ (weight * level) for k in (0, 1))
    # A single frequency has no slope: a prior on the slope keeps the line flat there.
    spread = m2 + 1e-3 * BANDWIDTH**2 * m0 + 1e-300
    return (spread * l0 - m1 * l1) / (spread * m0 - m1**2 + 1e-300)


def _correlation(
    place: Float[np.ndarray, " frequencies"],
    scatter: Complex[np.ndarray, "frequencies outputs outputs"],
    power: Float[np.ndarray, "frequencies outputs"],
    weight: Float[np.ndarray, " frequencies"],
    bandwidth: float,
) -> Complex[np.ndarray, "frequencies outputs outputs"]:
    offset = place[None, :] - place[:, None]
    kernel = weight[None, :] * np.exp(-0.5 * (offset / bandwidth) ** 2)
    size = np.sqrt(power)
    normal = np.where(weight[:, None, None] > 0, scatter, 0) / (size[:, :, None] * size[:, None, :])
    mixed = np.einsum("fg,gop->fop", kernel, normal) + 1e-12 * np.eye(power.shape[1])
    size = np.sqrt(np.real(np.diagonal(mixed, axis1=1, axis2=2)))
    return mixed / (size[:, :, None] * size[:, None, :])


class SharedErrors(NamedTuple):
    """Errors of real parameters p that the noise at some bins has moved by Re(drive W).

    W are circular noises of unit power, `roots` to a bin. The drive is that of one noise of unit
    power times its share of the roots: all of a long record at once would fill the memory.
    """

    slopes: Complex[np.ndarray, "frequencies outputs inputs parameters"]
    single: Complex[np.ndarray, "parameters places"]
    lines: Complex[np.ndarray, "places lines roots"]
    line: Int[np.ndarray, " parameters"]  # that each parameter's noise has in `lines`
    places: Int[np.ndarray, " places"]  # bins, rising

    def drive_at(
        self, taken: Int[np.ndarray, " taken"]
    ) -> Complex[np.ndarray, "parameters taken roots"]:
        """The drive by some of the `places`, numbers of which are `taken`."""
        lines = np.swapaxes(self.lines[taken], 0, 1)
        return self.single[:, taken, None] * lines[self.line]

    def power(self) -> Float[np.ndarray, " parameters"]:
        """Sum of |drive|^2 over all places and roots."""
        level = np.sum(np.abs(self.lines) ** 2, axis=2)
        return np.array(
            [np.abs(row) ** 2 @ level[:, k] for row, k in zip(self.single, self.line, strict=True)]
        )


_CHANCE = 1e-5  # of calling a residual a misfit
_FALSE_ALARM = 1e-3  # chance that noise alone leaves any of a record's responses unresolved
_HARMLESS = 1e-4  # share of the moved channel's power
_FAR_OFF = 10.0  # residual power over that of the noise from which a response is unresolved
_UNKNOWN = 1e60  # error of what is not determined: infinity, but products with zero are zero


def error_covariance(
    omega: Float[np.ndarray, " frequencies"],
    fit: LocalFit,
    noise: Noise,
    at: Int[np.ndarray, " frequencies"],
    bins: Bins,
    back: Complex[np.ndarray, "frequencies 1 1"],
    sources: Noise,
    left: Complex[np.ndarray, "frequencies outputs moved"],
    models: SharedErrors | None,
) -> ErrorCovariance:
    """Errors of `fit`, recoloured by `back`; `at` is the place of each frequency in `noise`.

    The atoms are the bins, each with the noise of its own frequency. Where the residual is larger
    than chance allows, the error is as much larger: it must not shrink below a local misfit.
    The noise of the fit is `left` times that of the `sources`, with the factor of the fit's own
    frequency at all its bins. The same noise disturbs the global `models`, whose response is part
    of that of `fit`.
    """
    places = window_places(fit, bins)
    colour = colour_of_noise(sources, left, omega, bins, places)
    inside = np.any(fit.effect != 0, axis=1)
    effect = fit.effect * np.exp(0.5 * np.mean(np.log(colour), axis=2))[:, None, :]
    scale = fit.boost * np.sqrt(_misfit(fit, noise, at, colour, inside, _CHANCE))
    root = left @ sources.root()[at]
    size = np.sqrt(noise.power[at]) * scale / np.maximum(np.linalg.norm(root, axis=2), 1e-300)
    root = root * size[:, :, None]
    known = np.isfinite(fit.response[:, 0, 0])[:, None, None]
    kind, effect = np.where(known, root, np.eye(*root.shape[1:])), np.where(known, effect * back, 0)
    reach, unknown = reach_of(effect, fit.first), ~known[:, 0, 0]
    effect = effect[:, :, : max(np.max(reach.last - reach.first), 1)].copy()
    effect[unknown, :, 0] = _UNKNOWN
    found = ErrorCovariance(np.asarray(omega), effect, kind, first=np.where(unknown, 0, fit.first))
    if models is None:
        return found
    slopes = np.where(known[..., None], models.slopes * back[..., None], 0.0)
    slopes, drive, driven = _on_common_atoms(slopes, models, reach, bins.omega.size)
    return dataclasses.replace(found, sensitivity=slopes, drive=drive, driven=driven)


def colour_of_noise(
    sources: Noise,
    left: Complex[np.ndarray, "frequencies outputs moved"],
    omega: Float[np.ndarray, " frequencies"],
    bins: Bins,
    places: Int[np.ndarray, "frequencies window"],
) -> Float[np.ndarray, "frequencies window outputs"]:
    """Power of `left` times the noise at the bins of each window, to that at its centre."""
    lowest = np.min(places, initial=bins.omega.size - 1)
    inside = bins.omega[lowest : np.max(places, initial=0) + 1]
    if left.shape[1] == left.shape[2] == 1:
        power = sources.power_at(inside)
        return power[places - lowest] / sources.power_at(omega)[:, None, :]
    roots = np.ascontiguousarray(np.swapaxes(sources.root_at(inside), 0, 1))
    colour, moved = np.empty((*places.shape, left.shape[1])), len(roots)
    for f, mine in enumerate(places):
        parts = left[f] @ roots[:, mine - lowest].reshape(moved, -1)  # one product: many are slow
        power = parts.real**2 + parts.imag**2
        colour[f] = np.sum(power.reshape(-1, mine.size, moved), axis=2).T
    centre = np.sum(np.abs(left @ sources.root_at(omega)) ** 2, axis=2)
    return colour / np.maximum(centre, 1e-300)[:, None, :]


def window_places(fit: LocalFit, bins: Bins) -> Int[np.ndarray, "frequencies window"]:
    """The bins of each window, padded."""
    return np.minimum(fit.first[:, None] + np.arange(fit.effect.shape[2]), bins.omega.size - 1)


def coloured_gain(
    fit: LocalFit,
    sources: Noise,
    left: Complex[np.ndarray, "frequencies outputs moved"],
    omega: Float[np.ndarray, " frequencies"],
    bins: Bins,
) -> LocalFit:
    """The fit with the gain of noise that is of unit power at the window's centre only."""
    colour = colour_of_noise(sources, left, omega, bins, window_places(fit, bins))
    gain = np.einsum("fik,fko->foi", np.abs(fit.effect) ** 2, colour)
    return fit._replace(gain=fit.boost[:, :, None] ** 2 * gain)


def partial_coherence(
    fit: LocalFit, noise: Float[np.ndarray, "frequencies outputs"]
) -> Float[np.ndarray, "frequencies outputs inputs"]:
    """Share of each output's power that an input explains beyond the other inputs, 0 to 1."""
    known = np.isfinite(fit.response[:, 0, 0])[:, None, None]
    response = np.where(known, fit.response, 0)
    explained = np.abs(response) ** 2 * power_alone(fit)[:, None, :]
    return explained / (explained + noise[:, :, None])


def power_alone(fit: LocalFit) -> Float[np.ndarray, "frequencies inputs"]:
    """Power of each input that no other input explains; 1 where nothing is determined."""
    known = np.isfinite(fit.response[:, 0, 0])[:, None, None]
    power = np.where(known, fit.power, np.eye(fit.power.shape[1]))
    return 1 / np.real(np.diagonal(np.linalg.inv(power), axis1=1, axis2=2))


def multiple_coherence(
    fit: LocalFit, noise: Float[np.ndarray, "frequencies outputs"]
) -> Float[np.ndarray, "frequencies outputs"]:
    """Share of each output's power that all inputs together explain, 0 to 1."""
    known = np.isfinite(fit.response[:, 0, 0])[:, None, None]
    response, power = np.where(known, fit.response, 0), np.where(known, fit.power, 0)
    explained = np.real(np.einsum("foi,fij,foj->fo", response, power, np.conj(response)))
    return explained / (explained + noise)


def unresolved(
    omega: Float[np.ndarray, " frequencies"],
    fit: LocalFit,
    noise: Noise,
    at: Int[np.ndarray, " frequencies"],
    bins: Bins,
    moved: slice,
) -> Bool[np.ndarray, " frequencies"]:
    """Where `fit` leaves residuals far above the noise, seldom by chance in a whole record.

    Residuals of less than a hundredth of what `moved` in the window do no harm.
    """
    outputs = fit.response.shape[1]
    left = np.broadcast_to(np.eye(outputs, dtype=complex), (omega.size, outputs, outputs))
    colour = colour_of_noise(noise, left, omega, bins, window_places(fit, bins))
    chance = _FALSE_ALARM / (omega.size * outputs)
    ratio = _misfit(fit, noise, at, colour, np.any(fit.effect != 0, axis=1), chance)
    inside = np.any(fit.effect != 0, axis=1)[:, :, None]
    values = np.abs(bins.values[:, moved]) ** 2
    power = np.sum(values[window_places(fit, bins)] * inside, axis=1) / np.sum(inside, axis=1)
    left = np.real(np.diagonal(fit.scatter, axis1=1, axis2=2))
    large = (ratio > _FAR_OFF) & (left > _HARMLESS * power)
    return np.isfinite(fit.response[:, 0, 0]) & np.any(large, axis=1)


def undetermined(fit: LocalFit) -> LocalFit:
    """The same windows without a response."""
    return fit._replace(
        response=fit.response * np.nan,
        effect=fit.effect * np.nan,
        gain=fit.gain * np.nan,
        scatter=fit.scatter * np.nan,
        freedom=0 * fit.freedom,
    )


def _misfit(
    fit: LocalFit,
    noise: Noise,
    at: Int[np.ndarray, " frequencies"],
    colour: Float[np.ndarray, "frequencies window outputs"],
    inside: np.ndarray,
    chance: float,
) -> Float[np.ndarray, "frequencies outputs"]:
    """Ratio of residuals to the noise where it is larger than chance allows, else 1."""
    from scipy.special import fdtri

    count = np.maximum(np.sum(inside, axis=1), 1)[:, None]
    expected = noise.power[at] * np.sum(colour * inside[:, :, None], axis=1) / count
    left = np.real(np.diagonal(fit.scatter, axis1=1, axis2=2)) / expected
    freedom = 2 * np.maximum(fit.freedom, 1.0), 2 * np.maximum(noise.freedom[at], 1.0)
    return np.where(left > fdtri(*freedom, 1 - chance)[:, None], left, 1.0)


def _on_common_atoms(
    slopes: Complex[np.ndarray, "frequencies outputs inputs parameters"],
    models: SharedErrors,
    reach: Reach,
    count: int,
) -> tuple[np.ndarray, np.ndarray, Int[np.ndarray, " driven"]]:
    """Slopes by the parameters' errors of unit size, and their drive by atoms, with their numbers.

    The bins that no local fit uses are one more atom for each parameter, with the same covariance:
    their numbers follow those of the `count` bins.
    """
    size = np.sqrt(0.5 * models.power())
    size = np.where(size > 0, size, 1.0)
    mine = reach.reached(count)[models.places]
    values, vectors = np.linalg.eigh(_gram(models, ~mine) / np.outer(size, size))
    drive = models.drive_at(np.flatnonzero(mine)) / size[:, None, None]
    spare = np.zeros((size.size, size.size, drive.shape[2]), complex)
    spare[:, :, 0] = vectors * np.sqrt(np.maximum(values, 0.0))
    driven = np.concatenate([models.places[mine], count + np.arange(size.size)])
    return slopes * size, np.concatenate([drive, spare], axis=1), driven


_TOGETHER = 1024  # bins whose drives are taken at a time: those of a long record are many


def _gram(
    models: SharedErrors, taken: Bool[np.ndarray, " places"]
) -> Float[np.ndarray, "parameters parameters"]:
    """Real part of the products of all pairs of drives over the bins that are `taken`."""
    parameters, places = len(models.single), np.flatnonzero(taken)
    total = np.zeros((parameters, parameters))
    for first in range(0, places.size, _TOGETHER):
        part = models.drive_at(places[first : first + _TOGETHER]).reshape(parameters, -1)
        rows = np.ascontiguousarray(part).view(float)  # real and imaginary parts in turn
        total += rows @ rows.T
    return total
