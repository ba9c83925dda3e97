"""Local fits: how wide their windows may be, and the errors and coherence from what they leave."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from ._error_covariance import ErrorCovariance, reach_of
from ._estimators import diagonal, Grid, Levels, LocalPolynomial, Pairs, Places, Where
from ._local_fit import Bins, LocalFit, window_slices
from ._noise import Noise


_CHANCE_OF_MISFIT = 1e-5  # of calling a residual a misfit
_FALSE_ALARM = 1e-3  # chance that noise alone leaves any of a record's responses unresolved
_HARMLESS = 1e-4  # share of the moved channel's power
_FAR_OFF = 10.0  # residual power over that of the noise from which a response is unresolved
_UNKNOWN = 1e60  # error of what is not determined: infinity, but products with zero are zero
_FREEDOM = 10  # complex degrees of freedom left over by the least window
_NARROW = 0.15  # half-width, relative to the frequency, at which noise and powers are estimated
WIDENED, WIDENINGS = 1.5, 6  # ratio and number of the steps from a window that is undetermined
_WIDEST, _LEAST_SPAN = 1.2, 3.0  # widest: relative to the frequency, or to the least window
_MOST = 4096  # Fourier bins of a window, unless more lie around a frequency of the grid
_PER_OCTAVE = 4  # further frequencies, which help to choose the widths
_RATIO = 1.8  # of successive half-widths
_SMOOTHING = 0.2  # of the tests for bias, in ln(omega)
_CHANCE = 3e-4  # of refusing a window whose differences, averaged over neighbours, are noise
_CHANCE_ALONE = 1e-5  # of refusing it for the difference at one frequency
_NOISIER = 4.0  # ratio of variances from which a narrower window counts for less
_QUIETER = 0.7  # ratio of variances from which a narrower window is preferred
_ACCURATE = 0.1  # largest relative error of a rational function that is used
_DOMINATED = 30.0  # ratio of input powers from which a window's side outweighs its centre
_STEP = 1.3  # of the half-widths that are tried

Shape = Literal["polynomial", "rational"]
Respond = Callable[[Grid, Grid, Shape], LocalFit]
Left = Complex[np.ndarray, "frequencies outputs moved"]


class Windows(NamedTuple):
    """Frequencies and half-widths in rad/s; those beyond the band help to choose the widths."""

    grid: Grid  # frequencies of the response, and others to an octave beyond them
    at: Int[np.ndarray, " response"]  # places in the grid of those of the response
    least: Grid  # half-widths that hold enough bins
    narrow: Grid  # at which noise and powers are estimated
    most: Grid  # beyond which a window only costs memory and time

    @property
    def widest(self) -> Grid:
        """Half-widths that are tried at the most."""
        return np.minimum(np.maximum(_WIDEST * self.grid, _LEAST_SPAN * self.least), self.most)

    def furthest(self, width: float | None) -> float:
        """The end in rad/s of the windows that reach furthest: no bin beyond it matters."""
        widest = np.maximum(self.narrow * WIDENED**WIDENINGS, self.most)
        return float(np.max(self.grid + np.maximum(widest, width or 0.0)))


def make_windows(
    omega: Float[np.ndarray, " response"], bins: Bins, options: LocalPolynomial, inputs: int
) -> Windows:
    """Around increasing `omega`. Raises `ValueError` where the bins are too few."""
    coefficients, transients = inputs * (options.order + 1), options.order + 1
    counts = np.bincount(bins.record, minlength=bins.records)
    spare = int(np.sum(np.maximum(counts - transients, 0)))
    if spare < coefficients + _FREEDOM:
        raise ValueError(
            f"the records have {counts.tolist()} Fourier bins, {spare} more than their transients "
            f"need; the local fit needs {coefficients + _FREEDOM}. Record longer, or use a lower "
            "order"
        )
    if omega[0] < 0.999 * bins.omega[0] or omega[-1] > 1.001 * bins.omega[-1]:
        raise ValueError(
            f"the frequencies run from {omega[0]:.4g} to {omega[-1]:.4g} rad/s, but the records "
            f"hold one cycle of {bins.omega[0]:.4g} rad/s and reach {bins.omega[-1]:.4g} rad/s. "
            "Keep the frequencies within, or record longer"
        )
    first, last = max(omega[0] / 2, bins.omega[0]), min(omega[-1] * 2, bins.omega[-1])
    steps = _PER_OCTAVE * np.log2([first, last])
    octaves = np.arange(np.ceil(steps[0]), np.floor(steps[1]) + 1) / _PER_OCTAVE
    grid = np.union1d(omega, 2**octaves)
    # The smallest windows with enough more bins than response and transients have coefficients.
    low, high = np.zeros_like(grid), np.full_like(grid, bins.omega[-1])
    parts = [bins.omega[bins.record == r] for r in range(bins.records)]
    for _ in range(40):
        middle, spare = (low + high) / 2, np.zeros(grid.size, int)
        for part in parts:
            first = np.searchsorted(part, grid - middle, "left")
            last = np.searchsorted(part, grid + middle, "right")
            spare += np.maximum(last - first - transients, 0)
        enough = spare >= coefficients + _FREEDOM
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    least = high * (1 + 1e-9)
    # Windows that reach half of the way to the next frequency leave nothing of a record out.
    density = bins.omega.size / (bins.omega[-1] - bins.omega[0])
    gaps = np.diff(grid)
    spacing = np.maximum(np.append(gaps, gaps[-1:]), np.insert(gaps, 0, gaps[:1]))
    most = np.maximum(least, np.maximum(spacing, _MOST / density) / 2)
    narrow = np.clip(_NARROW * grid, least, most)
    return Windows(grid, np.searchsorted(grid, omega), least, narrow, most)


def choose_widths(
    omega: Grid, least: Grid, reach: Grid, noise: Noise, respond: Respond
) -> tuple[Grid, Where]:
    """Half-widths from `least` to `reach`, by intersecting confidence intervals; where rational.

    A wider window is used while its response agrees with those of all narrower ones within the
    variance of their difference (Goldenshluger and Nemirovski, 1997), also on average over its
    neighbours. The test cannot see a bias of the size of the noise: the window is one step smaller,
    its bias a fifth.
    """
    from scipy.special import fdtri

    def without_effect(omega: Grid, width: Grid) -> LocalFit:
        """A fit without its largest array: the tests look at all widths at once."""
        fit = respond(omega, width, "polynomial")
        return fit._replace(effect=fit.effect[:, :, :0])

    def quantile(count: Grid | float, chance: float) -> Grid:
        """Of the mean of `count` squared differences over their estimated variance."""
        return fdtri(2 * count, 2 * np.maximum(noise.freedom, 1.0), 1 - chance)

    def differences(wide: LocalFit, narrow: LocalFit) -> tuple[Grid, Grid]:
        """Sums over pairs of squared differences over their variance, and how many pairs count."""
        # A narrow window much noisier than the wide one says little about its bias.
        doubt = np.maximum(1.0, narrow.gain / (_NOISIER * np.maximum(wide.gain, 1e-300)))
        variance = power * (narrow.gain - wide.gain) * doubt
        tested = variance > 0.02 * power * wide.gain
        tested &= np.isfinite(wide.response) & np.isfinite(narrow.response)
        difference = np.abs(wide.response - narrow.response) ** 2
        statistic = np.where(tested, difference / np.where(tested, variance, 1.0), 0.0)
        return np.sum(statistic, axis=(1, 2)), np.sum(tested, axis=(1, 2)).astype(float)

    widest, power = np.maximum(reach, least), noise.power[:, :, None]
    steps = int(np.ceil(np.log(np.max(widest / least)) / np.log(_RATIO) - 1e-9)) + 1
    widths = np.stack([np.minimum(least * _RATIO**m, widest) for m in range(steps)])
    fits = [without_effect(omega, widths[0])]
    for below, width in zip(widths[:-1], widths[1:], strict=True):
        wider = width > below
        fits.append(fits[-1].replace_rows(wider, without_effect(omega[wider], width[wider])))
    # Where a polynomial is wrong and a rational function accurate: its error linear in the noise.
    sharp = respond(omega, least, "rational")
    pairs = float(sharp.response.shape[1] * sharp.response.shape[2])
    alone = quantile(pairs, _CHANCE_ALONE)
    left = diagonal(fits[0].scatter) / noise.power
    rational = np.any(left > quantile(fits[0].freedom, _CHANCE_ALONE)[:, None], axis=1)
    for wide in fits[1:2]:
        statistic, count = differences(wide, fits[0])
        rational |= statistic > alone * np.maximum(count, 1)
    accurate = power * sharp.gain < _ACCURATE**2 * np.abs(sharp.response) ** 2
    rational &= np.all(accurate, axis=(1, 2))
    # The widest without a visible bias.
    step, going = np.zeros(omega.size, int), np.ones(omega.size, bool)
    kernel = np.exp(-0.5 * ((np.log(omega)[:, None] - np.log(omega)) / _SMOOTHING) ** 2)
    for m in range(1, len(fits)):
        windows = 1 + np.sqrt(np.pi) * _SMOOTHING * omega / widths[m]
        shared = quantile(pairs * windows, _CHANCE)
        for narrow in fits[:m]:
            statistic, count = differences(fits[m], narrow)
            # One frequency far off, as beside a resonance, says nothing about its neighbours.
            total = kernel @ np.minimum(statistic, alone * count)
            going &= total <= shared * (kernel @ count)
            going &= statistic <= alone * pairs
        step = np.where(going, m, step)
    place, gain = np.arange(omega.size), np.stack([np.mean(x.gain, axis=(1, 2)) for x in fits])
    gain = np.where(np.isfinite(gain), gain, np.inf)
    # At the lowest frequencies one step less can cost more than any bias.
    below = gain[np.maximum(step - 1, 0), place]
    costly = ~(below <= _NOISIER * gain[step, place])
    climbed = np.maximum(widths[step, place] / np.where(costly, 1.0, _RATIO), least)
    # In noise that rises steeply to one side, wider is not always better.
    kept = np.where((widths < climbed) & (gain < _QUIETER * below), gain, np.inf)
    quiet = np.min(kept, axis=0) < np.inf
    climbed = np.where(quiet, widths[np.argmin(kept, axis=0), place], climbed)
    return np.where(rational, least, climbed), rational


def reach(omega: Grid, centre: Grid, widest: Grid, bins: Bins, columns: slice) -> Grid:
    """Half-widths of even excitation: beyond a sweep's end a window would take its response."""
    running = np.cumsum(np.abs(bins.values[:, columns]) ** 2, axis=0)
    running = np.concatenate([np.zeros((1, running.shape[1])), running])

    def mean(first: np.ndarray, last: np.ndarray) -> Float[np.ndarray, "frequencies columns"]:
        """Power per bin from `first` to before `last`; 0 where there is none."""
        return (running[last] - running[first]) / np.maximum(last - first, 1)[:, None]

    inner = window_slices(omega, centre, bins)
    middle = mean(*inner)
    far, going = np.minimum(centre, widest), np.ones(omega.size, bool)
    while np.any(going):
        wider = np.minimum(_STEP * far, widest)
        first, last = window_slices(omega, wider, bins)
        low, high = mean(first, inner[0]), mean(inner[1], last)
        even = np.maximum(middle, np.minimum(low, high))
        going &= np.all(np.maximum(low, high) <= _DOMINATED * even, axis=1)
        far, going = np.where(going, wider, far), going & (wider < widest)
    return far


def error_covariance(
    omega: Grid,
    fit: LocalFit,
    noise: Noise,
    at: Places,
    bins: Bins,
    back: Complex[np.ndarray, "frequencies 1 1"],
    sources: Noise,
    left: Left,
) -> tuple[ErrorCovariance, Bool[np.ndarray, " bins"]]:
    """Errors of `fit` by the noise `left` times `sources`, more where misfit; the bins in use."""
    colour = _colour_of_noise(sources, left, omega, bins, fit)
    effect = fit.effect * np.exp(0.5 * np.mean(np.log(colour), axis=2))[:, None, :]
    scale = fit.boost * np.sqrt(_misfit(fit, noise, at, colour, _CHANCE_OF_MISFIT))
    root = left @ sources.root()[at]
    size = np.sqrt(noise.power[at]) * scale / np.maximum(np.linalg.norm(root, axis=2), 1e-300)
    root = root * size[:, :, None]
    finite = fit.determined
    root = np.where(finite[:, None, None], root, np.eye(*root.shape[1:]))
    effect = np.where(finite[:, None, None], effect * back, 0)
    reach = reach_of(effect, fit.first)
    effect = effect[:, :, : max(np.max(reach.last - reach.first), 1)].copy()
    effect[~finite, :, 0] = _UNKNOWN
    first = np.where(finite, fit.first, 0)
    errors = ErrorCovariance(np.asarray(omega), effect, root, first=first)
    return errors, reach.reached(bins.omega.size)


def _colour_of_noise(
    sources: Noise, left: Left, omega: Grid, bins: Bins, fit: LocalFit
) -> Float[np.ndarray, "frequencies window outputs"]:
    """Power of `left` times the noise at the bins of each window, to that at its centre."""
    places = _window_places(fit, bins)
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


def _window_places(fit: LocalFit, bins: Bins) -> Int[np.ndarray, "frequencies window"]:
    """The bins of each window, padded."""
    return np.minimum(fit.first[:, None] + np.arange(fit.effect.shape[2]), bins.omega.size - 1)


def coloured_gain(fit: LocalFit, sources: Noise, left: Left, omega: Grid, bins: Bins) -> LocalFit:
    """The fit with the gain of noise that is of unit power at the window's centre only."""
    colour = _colour_of_noise(sources, left, omega, bins, fit)
    gain = np.einsum("fik,fko->foi", np.abs(fit.effect) ** 2, colour)
    return fit._replace(gain=fit.boost[:, :, None] ** 2 * gain)


def partial_coherence(fit: LocalFit, noise: Levels) -> Pairs:
    """Share of each output's power that an input explains beyond the other inputs, 0 to 1."""
    response = np.where(fit.determined[:, None, None], fit.response, 0)
    explained = np.abs(response) ** 2 * power_alone(fit)[:, None, :]
    return explained / (explained + noise[:, :, None])


def power_alone(fit: LocalFit) -> Float[np.ndarray, "frequencies inputs"]:
    """Power of each input that no other input explains; 1 where nothing is determined."""
    power = np.where(fit.determined[:, None, None], fit.power, np.eye(fit.power.shape[1]))
    return 1 / diagonal(np.linalg.inv(power))


def multiple_coherence(fit: LocalFit, noise: Levels) -> Levels:
    """Share of each output's power that all inputs together explain, 0 to 1."""
    finite = fit.determined[:, None, None]
    response, power = np.where(finite, fit.response, 0), np.where(finite, fit.power, 0)
    explained = np.real(np.einsum("foi,fij,foj->fo", response, power, np.conj(response)))
    return explained / (explained + noise)


def unresolved(
    omega: Grid, fit: LocalFit, noise: Noise, at: Places, bins: Bins, moved: slice
) -> Where:
    """Where `fit` leaves far more than the noise, and than a hundredth of what `moved`."""
    outputs = fit.response.shape[1]
    left = np.broadcast_to(np.eye(outputs, dtype=complex), (omega.size, outputs, outputs))
    colour = _colour_of_noise(noise, left, omega, bins, fit)
    ratio = _misfit(fit, noise, at, colour, _FALSE_ALARM / (omega.size * outputs))
    inside = np.any(fit.effect != 0, axis=1)[:, :, None]
    values = np.abs(bins.values[:, moved]) ** 2
    power = np.sum(values[_window_places(fit, bins)] * inside, axis=1) / np.sum(inside, axis=1)
    left = diagonal(fit.scatter)
    large = (ratio > _FAR_OFF) & (left > _HARMLESS * power)
    return fit.determined & np.any(large, axis=1)


def _misfit(fit: LocalFit, noise: Noise, at: Places, colour: np.ndarray, chance: float) -> Levels:
    """Ratio of residuals to the noise where it is larger than chance allows, else 1."""
    from scipy.special import fdtri

    inside = np.any(fit.effect != 0, axis=1)
    count = np.maximum(np.sum(inside, axis=1), 1)[:, None]
    expected = noise.power[at] * np.sum(colour * inside[:, :, None], axis=1) / count
    left = diagonal(fit.scatter) / expected
    freedom = 2 * np.maximum(fit.freedom, 1.0), 2 * np.maximum(noise.freedom[at], 1.0)
    return np.where(left > fdtri(*freedom, 1 - chance)[:, None], left, 1.0)
