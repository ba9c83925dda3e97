"""The outputs' noise, smooth along frequency, and how well its power is known.

Leakage is told from noise: behind a window w, y = g * x has the transform
sum_n j^n / n! G^(n) X_n, with X_n that of x behind the n-th derivative of w: the part beyond G X_0
is leakage, of the slope and the curvature of G. It is the same in each draw of the noise, so the
noise is what no combination of X_0, X_1, X_2 explains over the windows of one length. Y_1 is added
to these: poles outlast any series in the slopes of G, but with them w y' = (w y)' - w' y has a
transform that is linear in Y_1.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from jaxquad.records import Record

from ._estimators import (
    adjoint,
    Covariances,
    diagonal,
    Grid,
    Levels,
    Places,
    power_of,
    Responses,
    Square,
)
from ._fourier_sums import coefficients


_BANDWIDTH = 0.2  # of the smoothing, in ln(omega)
_WIDE = 2.0  # that of the correlations between outputs in open loop
_UNLIKELY = 1e-4  # chance at which a residual counts as a misfit, or a line in the noise
_NEAR = 1e-2  # of a pole: its neighbourhood's rounding is below 1e-13
_FLOOR = 1e-26  # of the output's power: below it lies rounding
_RIDGE = 1e-12  # of the columns' size, so that empty ones do no harm
_ROUNDING = 1e-7  # of a residual: the square is below rounding
_WITHIN = 1e-6  # of its size: an output's slope that inputs explain so well adds nothing
_FEW = 16  # windows taken at once: few others overlap them

Rows = Complex[np.ndarray, "frequencies _ windows"]
Gram = Complex[np.ndarray, "frequencies columns columns"]
Groups = Float[np.ndarray, "frequencies outputs groups"]
Overlap = Float[np.ndarray, "windows windows"]  # sums of the product of any two windows
Resolved = Bool[np.ndarray, "groups frequencies"]


class Noise(NamedTuple):
    """Noise covariance of the outputs at rising frequencies, power laws between them."""

    omega: Grid  # rad/s
    power: Levels
    correlation: Covariances
    freedom: Grid  # complex degrees of freedom behind a power

    def power_at(self, omega: Float[np.ndarray, " bins"]) -> Float[np.ndarray, "bins outputs"]:
        """Powers at other frequencies; beyond the ends, those at the ends."""
        place, grid = np.log(omega), np.log(self.omega)
        columns = [np.interp(place, grid, column) for column in np.log(self.power).T]
        return np.exp(np.stack(columns, axis=1))

    def root_at(
        self, omega: Float[np.ndarray, " bins"]
    ) -> Complex[np.ndarray, "bins outputs outputs"]:
        """Roots of the covariances at other frequencies, correlated as at the nearest one."""
        near = np.searchsorted(np.sqrt(self.omega[1:] * self.omega[:-1]), omega)
        scale = np.sqrt(self.power_at(omega) / self.power[near])
        return self.root()[near] * scale[:, :, None]

    def root(self) -> Covariances:
        """Roots of the covariances, which change along frequency as slowly as they do."""
        return np.sqrt(self.power)[:, :, None] * hermitian_root(self.correlation)


def hermitian_root(covariance: Covariances) -> Covariances:
    # Not Cholesky's: along frequency the root must change as slowly as the matrix does.
    values, vectors = np.linalg.eigh(covariance)
    stretched = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return stretched @ adjoint(vectors)


def smooth_noise(
    omega: Grid, half_width: Grid, scatter: Covariances, freedom: Grid, *, open_loop: bool = False
) -> Noise:
    """Smooth residual covariances, each of `freedom` complex degrees of freedom, along frequency.

    Powers by local lines in log-log, without outliers or the logarithm's bias; correlations by
    positive weights. In `open_loop` these are as in a wide band, as far as the narrow ones agree
    with it.
    """
    from scipy.special import digamma, gammaincinv

    def correlated(weight: Grid, bandwidth: float) -> Covariances:
        offset, size = place[None, :] - place[:, None], np.sqrt(raw)
        kernel = weight[None, :] * np.exp(-0.5 * (offset / bandwidth) ** 2)
        normal = np.where(weight[:, None, None] > 0, scatter, 0) / size[:, :, None]
        mixed = np.einsum("fg,gop->fop", kernel, normal / size[:, None, :])
        mixed += 1e-12 * np.eye(raw.shape[1])
        size = np.sqrt(diagonal(mixed))
        return mixed / (size[:, :, None] * size[:, None, :])

    finite = freedom > 0
    freedom = np.where(finite, freedom, 1.0)
    raw = diagonal(scatter)
    raw = np.where(finite[:, None], np.maximum(raw, 1e-300), 1.0)
    bias = (digamma(freedom) - np.log(freedom))[:, None]
    high = np.log(gammaincinv(freedom, 1 - _UNLIKELY) / freedom)[:, None]
    place, level = np.log(omega), np.log(raw) - bias
    weight = np.where(finite, freedom, 0.0)[:, None] * np.ones_like(level)
    smooth = _local_lines(omega, level, weight)
    for _ in range(3):
        outlier = finite[:, None] & (np.log(raw) > smooth + high)
        smooth = _local_lines(omega, level, np.where(outlier, 1e-9 * weight, weight))
    if np.any(finite):  # Far from all determined frequencies the kernel vanishes.
        isolated = np.interp(place, place[finite], np.arange(np.sum(finite)))
        isolated = np.abs(place - place[finite][np.round(isolated).astype(int)]) > 3 * _BANDWIDTH
        nearest = [np.interp(place, place[finite], column[finite]) for column in smooth.T]
        smooth = np.where(isolated[:, None], np.stack(nearest, axis=1), smooth)
    freedom = np.where(finite, freedom, 0.0)
    counts = freedom * (1 + np.sqrt(np.pi) * _BANDWIDTH * omega / half_width)
    correlation = correlated(freedom, _BANDWIDTH)
    if open_loop and raw.shape[1] > 1:
        # Wide ones where the narrow ones differ from them by chance, towards the narrow ones as the
        # squared differences grow to twice that: a complex correlation r of n complex degrees of
        # freedom has the variance (1 - |r|^2) / n.
        wide = correlated(counts, _WIDE)
        distance = np.sum(counts[:, None, None] * np.abs(correlation - wide) ** 2)
        chance = np.sum((1 - np.abs(wide) ** 2)[counts > 0])
        share = np.clip(distance / max(float(chance), 1e-300) - 1, 0.0, 1.0)
        correlation = wide + share * (correlation - wide)
    return Noise(omega, np.exp(smooth), correlation, counts)


def kernels(omega: Grid) -> Float[np.ndarray, "3 frequencies frequencies"]:
    """Weights of neighbours, times 1, the distance in ln(omega) and its square."""
    place = np.log(omega)
    offset = place[None, :] - place[:, None]
    kernel = np.exp(-0.5 * (offset / _BANDWIDTH) ** 2)
    return np.stack([kernel, kernel * offset, kernel * offset**2])


def _local_lines(omega: Grid, level: Levels, weight: Levels) -> Levels:
    """Weighted local straight lines along ln(omega)."""
    near = kernels(omega)
    (m0, m1, m2), (l0, l1, _) = near @ weight, near @ (weight * level)
    # A single frequency has no slope: a prior on the slope keeps the line flat there.
    spread = m2 + 1e-3 * _BANDWIDTH**2 * m0 + 1e-300
    return (spread * l0 - m1 * l1) / (spread * m0 - m1**2 + 1e-300)


def smoothed(omega: Grid, covariance: Square, weight: Grid) -> Square:
    """Covariance of the logarithm of noise powers after smoothing."""
    near = kernels(omega)
    m0, m1, m2 = (near @ weight)[:, :, None]
    # A single frequency has no slope: the small term keeps the line flat there.
    spread = m2 + 1e-3 * _BANDWIDTH**2 * m0 + 1e-300
    size = spread * m0 - m1**2 + 1e-300
    lines = (near[0] * (spread / size) - near[1] * (m1 / size)) * weight  # rows sum to one
    return lines @ covariance @ lines.T


def covariance_of_bands(first: Places, last: Places, freedom: Grid) -> Square:
    """Of the logarithm of mean residual powers over bins, by the bins that bands share."""
    count = np.maximum(last - first, 1)
    shared = np.minimum(last[:, None], last) - np.maximum(first[:, None], first)
    overlap = np.maximum(shared, 0) / np.sqrt(np.outer(count, count))
    return overlap / np.sqrt(np.outer(np.maximum(freedom, 1.0), np.maximum(freedom, 1.0)))


def covariance_of_windows(
    angle: Grid,
    levels: Float[np.ndarray, "frequencies groups"],
    shape: str,
    lengths: tuple[int, ...],
) -> Square:
    """Of the logarithm of residual powers of all lengths, whose standard errors are `levels`."""
    total, (level, cosine) = np.zeros((angle.size, angle.size)), coefficients(shape)
    terms = level**2 + cosine**2 / 2, level * cosine, cosine**2 / 4  # of the squared window
    for error, length in zip(levels.T, lengths, strict=True):
        # The squared correlation of white noise behind windows at two frequencies:
        # sinc(c - k) + sinc(c + k) for k = 0, 1, 2 have one sine in common, but poles at whole c.
        cycles = (angle[:, None] - angle) * length / (2 * np.pi)
        square = cycles**2
        poles = square * (square - 1) * (square - 4)
        near = np.abs(poles) < _NEAR
        poles = np.where(near, 1.0, poles)
        ratio = terms[0] * (square - 1) * (square - 4)
        ratio += 2 * square * (terms[2] * (square - 1) - terms[1] * (square - 4))
        correlation = np.sin(np.pi * cycles) * cycles * ratio / (np.pi * poles)
        close = cycles[near]
        correlation[near] = terms[0] * np.sinc(close)
        for k in (1, 2):
            correlation[near] += terms[k] * (np.sinc(close - k) + np.sinc(close + k))
        total += (correlation / terms[0]) ** 2 * error * error[:, None]
    return total


class Rest(NamedTuple):
    """What is left of the outputs' windows: sums of `conj(a) b`, and the energy of unit noise."""

    products: Complex[np.ndarray, "frequencies outputs outputs groups"]
    trace: Groups
    freedom: Groups  # complex
    fits: "tuple[Fit, ...]"


class Fit(NamedTuple):
    """Least squares of the outputs on inputs and leakage in windows of one length.

    An output's slope counts only for this output: q is what the common columns A leave of it, of
    unit length. Products with the overlap O of the windows say what noise does.
    """

    solver: Gram
    fitted: Complex[np.ndarray, "frequencies columns both"]  # of the outputs, then of their slopes
    inverse: Float[np.ndarray, "frequencies slopes"]  # of the length of q before
    along: Complex[np.ndarray, "frequencies slopes"]  # coefficients of q
    aa: Gram  # A^H O A
    aq: Complex[np.ndarray, "frequencies columns slopes"]  # A^H O q
    qq: Float[np.ndarray, "frequencies slopes"]  # q^H O q

    def bias(self, outputs: int, inputs: int) -> tuple[np.ndarray, np.ndarray]:
        """What leakage adds to the response, and its mean square under unit noise."""
        # The response took too much of the inputs: the first coefficients of what is left, less
        # `through` times those to its own column.
        taken, through = np.split(np.swapaxes(self.fitted[:, :inputs], 1, 2), [outputs], axis=1)
        through, to_x = through * self.inverse[:, :, None], self.solver[:, :inputs]
        plain = np.real(np.sum((to_x @ self.aa) * np.conj(to_x), axis=2))[:, None]
        if not through.shape[1]:
            return -taken, np.repeat(np.maximum(plain, 0.0), outputs, axis=1)
        mixed = 2 * np.real(np.conj(through) * np.swapaxes(to_x @ self.aq, 1, 2))
        square = plain - mixed + power_of(through) * self.qq[:, :, None]
        return through * self.along[:, :, None] - taken, np.maximum(square, 0.0)


def shows_leakage(windows: int, inputs: int) -> bool:
    """Whether there are enough windows of one length to tell leakage from noise."""
    return windows >= 3 * inputs + 3


def without_leakage(
    windows: Sequence[tuple[np.ndarray, np.ndarray]],
    response: Responses,
    slopes: Sequence[tuple[np.ndarray, np.ndarray]],
    overlap: Overlap,
    resolved: Resolved,
) -> Rest:
    """Outputs less all that inputs and leakage explain, by window length, from where it is
    `resolved`.

    A length with too few windows for its leakage keeps it, as noise; its slopes do not matter. With
    P the projection and O the overlap: tr(P O), the degrees of freedom tr(P O)^2 / tr(P O P O).
    """
    parts, end, outputs = [], 0, response.shape[1]
    for pair, derivatives, where in zip(windows, slopes, resolved, strict=True):
        # What a window does not resolve lies below what it does, and has no weight.
        few = slice(int(np.argmax(where)), None)
        x, y, x1, x2 = (np.swapaxes(part[few], 1, 2) for part in (*pair, *derivatives))
        inputs, count = x.shape[1:]
        columns, both = x, y - response[few] @ x
        if shows_leakage(count, inputs):  # each output on its own slope, too, behind it in `both`
            columns = np.concatenate([x, x1[:, :inputs], x2], axis=1)
            both = np.concatenate([both, x1[:, inputs:]], axis=1)
        begin, end = end, end + count
        mutual = overlap[begin:end, begin:end]
        columns = np.ascontiguousarray(columns)
        size, conjugate = columns.shape[1], np.conj(columns)
        weighed = _times_overlap(columns, mutual)
        # One product of all: many small ones take as long to begin as to make.
        stacked = conjugate @ np.swapaxes(np.concatenate([columns, weighed, both], axis=1), 1, 2)
        gram, aa = stacked[:, :, :size], stacked[:, :, size : 2 * size]
        power = diagonal(gram)
        units = 1 / np.maximum(np.sqrt(power), 1e-100)
        units = units[:, :, None] * units[:, None, :]
        solver = np.linalg.inv(gram * units + _RIDGE * np.eye(size)) * units
        fitted = solver @ stacked[:, :, 2 * size :]
        rest = both - np.swapaxes(fitted, 1, 2) @ columns
        before, left = (np.sqrt(_inner(part, part)) for part in (both, rest))
        # Nearly dependent columns leave a part of themselves: orthogonal to all else, so its square
        # counts.
        least = diagonal(solver) * power
        if np.any(2e-16 * np.max(least, axis=1, keepdims=True) * before > _ROUNDING * left):
            rest -= np.swapaxes(solver @ (conjugate @ np.swapaxes(rest, 1, 2)), 1, 2) @ columns
            left = np.sqrt(_inner(rest, rest))
        rest, q, length = rest[:, :outputs], rest[:, outputs:], left[:, outputs:]
        inverse = np.where(
            length > _WITHIN * before[:, outputs:], 1 / np.maximum(length, 1e-300), 0.0
        )
        q = q * inverse[:, :, None]
        along = np.vecdot(q, rest[:, : q.shape[1]])
        if q.shape[1]:
            rest = rest - q * along[:, :, None]
        weighed_q = _times_overlap(q, mutual)
        products = np.conj(weighed) @ np.swapaxes(np.concatenate([weighed, q], axis=1), 1, 2)
        aa_twice, aq = products[:, :, :size], products[:, :, size:]
        qq, qq_twice = _inner(q, weighed_q), _inner(weighed_q, weighed_q)
        through = solver @ aa
        trace = (np.trace(mutual) - _trace(solver, aa))[:, None]
        square = np.sum(mutual**2) - 2 * _trace(solver, aa_twice)
        square = (square + _trace(through, adjoint(through)))[:, None]
        if q.shape[1]:
            crossed = qq_twice - np.sum(np.conj(aq) * (solver @ aq), axis=1).real
            trace, square = trace - qq, square - 2 * crossed + qq**2
        freedom = np.maximum(trace**2 / square, 0.5)
        if not q.shape[1]:
            trace, freedom = (np.repeat(part, outputs, axis=1) for part in (trace, freedom))
        products = np.conj(rest) @ np.swapaxes(rest, 1, 2)
        fit = Fit(solver, fitted, inverse, along, aa, aq, qq)
        parts.append((products, trace, freedom, fit))
    *sums, fits = zip(*parts, strict=True)
    products, trace, freedom = (padded(part, len(response)) for part in sums)
    return Rest(products, np.where(trace > 0, trace, 1.0), np.maximum(freedom, 0.5), fits)


def padded(parts: Sequence[np.ndarray], frequencies: int) -> np.ndarray:
    """Side by side, with zeros at the lowest frequencies that some lack."""
    joined = np.zeros((frequencies, *parts[0].shape[1:], len(parts)), parts[0].dtype)
    for k, part in enumerate(parts):
        joined[frequencies - len(part) :, ..., k] = part
    return joined


def _times_overlap(rows: Rows, overlap: Overlap) -> Rows:
    """Rows times the overlap of the windows, a few windows with those that overlap them."""
    flat = rows.reshape(-1, rows.shape[2])
    weighed = np.empty_like(flat)
    for first in range(0, len(overlap), _FEW):
        few = slice(first, first + _FEW)
        places = np.flatnonzero(np.any(overlap[few], axis=0))
        others = slice(places[0], places[-1] + 1)
        weighed[:, few] = flat[:, others] @ overlap[others, few].astype(complex)
    return weighed.reshape(rows.shape)


def _inner(
    a: Complex[np.ndarray, "*rows terms"], b: Complex[np.ndarray, "*rows terms"]
) -> Float[np.ndarray, "*rows"]:
    """The real part of `conj(a) b`, summed over the last axis."""
    return np.vecdot(a.view(float), b.view(float))


def _trace(a: Gram, b: Gram) -> Grid:
    """The real part of the trace of the product of `a` with the adjoint of `b`."""
    a, b = (np.ascontiguousarray(part).reshape(len(part), -1) for part in (a, b))
    return _inner(a, b)


def noise_root(omega: Grid, rest: Rest, outputs: Groups, weights: Groups) -> Covariances:
    """Hermitian root of the noise's covariance, from what is left, by local lines in log-log."""
    freedom = rest.freedom
    near = kernels(omega)
    energy = np.real(np.einsum("foog->fog", rest.products))
    # The logarithm of a chi-squared variable is biased by digamma(f) - ln(f).
    low = -1 / (2 * freedom) - 1 / (12 * freedom**2)
    levels = np.log(np.maximum(energy, _FLOOR * outputs + 1e-280) / rest.trace) - low
    level, weight = np.sum(weights * levels, axis=2), np.sum(weights * freedom, axis=2)
    count = weight.shape[1]
    moments = near @ np.concatenate([weight, weight * level], axis=1)
    (m0, m1, m2), (l0, l1, _) = moments[:, :, :count], moments[:, :, count:]
    # A single frequency has no slope: the small term keeps the line flat there.
    spread = m2 + 1e-9 * m0
    root = np.exp((spread * l0 - m1 * l1) / (spread * m0 - m1**2) / 2)
    if count == 1:
        return root[:, :, None].astype(complex)
    scale = np.sqrt(np.mean(weights, axis=1, keepdims=True) / (energy + 1e-280))
    unit = np.sum(np.conj(rest.products) * (scale[:, :, None] * scale[:, None]), axis=3)
    smooth = (near[0] @ unit.reshape(len(unit), -1).view(float)).view(complex).reshape(unit.shape)
    deviation = np.sqrt(np.maximum(diagonal(smooth), 1e-300))
    coherency = smooth / (deviation[:, :, None] * deviation[:, None, :])
    place = np.arange(count)
    coherency[:, place, place] = 1.0  # also of an output that the inputs explain exactly
    return hermitian_root(coherency * (root[:, :, None] * root[:, None, :]))


# A narrow line in a spectrum, as of motors, over the running median of its surroundings.

_SECONDS = 0.5  # of a window: motors change their speed little meanwhile
_SHORTEST, _LONGEST = 64, 4096  # samples of a window
_MOST = 200  # windows that are looked at
_STANDS = 13.0  # dB above the floor: noise alone gets there once in a million
_ALSO = 8.0  # dB, of a harmonic, in the median of all windows
_OFTEN = 0.5  # share of the windows


class SpectralLine(NamedTuple):
    """The strongest narrow line of a channel, as `find_line` returns it."""

    omega: float  # rad/s, median of the windows in which it stands out
    low: float  # rad/s; it lies between this and `high` in 90 % of these windows
    high: float
    height: float  # dB above its surroundings, median
    share: float  # of the windows in which it stands out
    harmonics: tuple[int, ...]  # which multiples of it stand out, too
    follows: float  # rank correlation with another channel, -1 to 1; nan without one


def find_line(
    record: Record, channel: str, *, above: float = 0.0, over: str | None = None
) -> SpectralLine | None:
    """Find the strongest narrow line in the spectrum of a channel.

    In each window of half a second the line is the frequency that is highest above the running
    median of its surroundings. Motors and propellers make lines with harmonics that follow the
    throttle; a resonance of the frame stays where it is.

    **Arguments:**

    - `record`: what was flown.
    - `channel`: whose spectrum.
    - `above`: rad/s, below which no line is looked for, such as the top of the identified band.
    - `over`: a channel that the line may follow, such as the throttle.

    **Returns:** a `SpectralLine`; None where none stands 13 dB out of half of the windows.
    """
    size = int(2 ** np.round(np.log2(np.clip(_SECONDS / record.dt, _SHORTEST, _LONGEST))))
    if size > record.samples:
        return None
    starts = np.arange(0, record.samples - size + 1, size // 2)
    places = starts[:: -(-starts.size // _MOST), None] + np.arange(size)
    omega = 2 * np.pi * np.fft.rfftfreq(size, record.dt)
    parts = record.channel(channel)[places]
    spectra = np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * np.hanning(size), axis=1)
    level = 10 * np.log10(np.maximum(np.abs(spectra) ** 2, 1e-300))
    reach = max(8, size // 32)
    padded = np.pad(level, ((0, 0), (reach, reach)), mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=1)
    excess = level - np.median(around, axis=2)
    excess[:, :4] = -np.inf  # the mean, and what a taper makes of a trend
    searched = np.where(omega > above, excess, -np.inf)
    bins = np.argmax(searched, axis=1)
    heights = np.max(searched, axis=1)
    stands = heights > _STANDS
    if np.mean(stands) < _OFTEN:
        return None
    lines = omega[bins[stands]]
    low, middle, high = np.percentile(lines, [5, 50, 95])
    follows = np.nan
    if over is not None:
        levels = record.channel(over)[places].mean(axis=1)[stands]
        follows = 0.0
        if np.ptp(lines) and np.ptp(levels):  # Spearman's, without a correction for ties
            ranks = [
                np.argsort(np.argsort(x, kind="stable"), kind="stable") for x in (lines, levels)
            ]
            follows = float(np.asarray(np.corrcoef(ranks)).flat[1])
    harmonics, excess, bins = [], excess[stands], bins[stands]
    for multiple in (2, 3, 4):
        near = multiple * bins[:, None] + np.arange(-multiple, multiple + 1)
        if np.median(near[:, -1]) >= excess.shape[1]:
            break
        near = np.minimum(near, excess.shape[1] - 1)
        level = excess[np.arange(len(bins))[:, None], near].max(axis=1)
        harmonics += [multiple] if np.median(level) > _ALSO else []
    return SpectralLine(
        float(middle), float(low), float(high), float(np.median(heights[stands])),
        float(np.mean(stands)), tuple(harmonics), float(follows),
    )  # fmt: skip
