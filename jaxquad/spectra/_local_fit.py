"""Local fits: response and transients around each frequency, from the transforms of records.

Source: Pintelon and Schoukens, System Identification, 2nd ed., section 7.2.
"""

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from jaxquad.records import Record

from ._estimators import (
    adjoint,
    Covariances,
    diagonal,
    Grid,
    Levels,
    Pairs,
    Places,
    Response,
    Responses,
    Where,
)


_UNEXCITED = 1e-12  # of an input's largest bin: below, it is rounding errors
_LEAKED = 1e5  # ratio of an input's power to the part of it that transients cannot explain
_CHUNK = 32  # frequencies solved at once, padded to the longest window among them
_BINS = 32_768  # of them together: more take memory, and no less time
_DEPENDENT = 1e-6  # smallest singular value of the scaled regressors, to the largest
_ROUNDING = 1e-14  # added to the products of unit columns, so that they have an inverse
_STEPS = 2  # of Gauss-Newton, after the linear estimate of a denominator
_NEAREST = 1e-3  # size of the denominator, so that no pole falls onto a bin

InWindow = Float[np.ndarray, "frequencies window"]
Inputs = Complex[np.ndarray, "frequencies window inputs"]
Outputs = Complex[np.ndarray, "frequencies window outputs"]
Owner = Bool[np.ndarray, "frequencies window records"]
Columns = Complex[np.ndarray, "frequencies window columns"]


class Bins(NamedTuple):
    """Transforms of whole records over the root of their length; no mean, no Nyquist bin."""

    omega: Float[np.ndarray, " bins"]  # rad/s
    record: Int[np.ndarray, " bins"]  # number of the record that it belongs to
    values: Complex[np.ndarray, "bins channels"]
    records: int
    largest: Float[np.ndarray, " channels"]  # magnitudes at any bin, those left out included
    above: int = 0  # number of bins that `up_to` left out

    def up_to(self, highest: float) -> "Bins":
        """A copy of the bins up to `highest` in rad/s, or these where there are no others."""
        count = int(np.searchsorted(self.omega, highest, "right"))
        if count == self.omega.size:
            return self
        return self._replace(
            omega=self.omega[:count].copy(),
            record=self.record[:count].copy(),
            values=self.values[:count].copy(),
            above=self.above + self.omega.size - count,
        )


def record_bins(records: Sequence[Record], integrators: int, delay: float) -> Bins:
    """Transform all channels; outputs differenced, and advanced by `delay` in s: see `recolour`."""
    values, grids, owners = [], [], []
    for index, record in enumerate(records):
        columns = transformed_columns(record, integrators)
        last = (len(columns) - 1) // 2
        grid = 2 * np.pi * np.arange(1, last + 1) / (len(columns) * record.dt)
        spectra = np.empty((last, columns.shape[1]), complex)
        for channel, column in zip(spectra.T, columns.T, strict=True):
            transform = np.fft.rfft(column - column.mean())
            np.divide(transform[1 : last + 1], np.sqrt(len(columns)), out=channel)
        first = record.inputs.shape[1]
        lag = np.exp(1j * delay * grid)[:, None]
        spectra[:, first : first + record.outputs.shape[1]] *= lag
        values.append(spectra)
        grids.append(grid)
        owners.append(np.full(last, index))
    omega, owner, joined = grids[0], owners[0], values[0]
    if len(records) > 1:
        order = np.argsort(np.concatenate(grids), kind="stable")
        omega, owner, joined = (np.concatenate(part)[order] for part in (grids, owners, values))
    largest = np.array([np.max(np.abs(channel), initial=0.0) for channel in joined.T])
    return Bins(omega, owner, joined, len(records), largest)


def recolour(omega: Grid, integrators: int, delay: float, dt: float) -> Response:
    """Factor from a response to the outputs of `record_bins` to one to the recorded outputs."""
    lag = integrators // 2 * dt + delay
    return np.exp(-1j * lag * omega) / (1 - np.exp(-1j * dt * omega)) ** integrators


def transformed_columns(record: Record, n: int) -> Float[np.ndarray, "samples channels"]:
    """Channels whose transforms are taken; outputs are differenced `n` times."""
    # A difference looks back by n/2 samples: inputs are taken from as much earlier.
    centre = slice(n - n // 2, record.samples - n // 2)
    outputs = np.diff(record.outputs, n, axis=0)
    return np.hstack([record.inputs[centre], outputs, record.references[centre]])


def window_slices(omega: Grid, half_width: Grid, bins: Bins) -> tuple[Places, Places]:
    """First bin, and one past the last, of every window."""
    first = np.searchsorted(bins.omega, omega - half_width, "left")
    return first, np.searchsorted(bins.omega, omega + half_width, "right")


class LocalFit(NamedTuple):
    """Responses at the centre of each window, and the effect of noise on them; nan if undetermined.

    The error of output o to input i at f is `boost[f, o] sum_k effect[f, i, k] V_o[first[f] + k]`.
    """

    response: Responses
    effect: Complex[np.ndarray, "frequencies inputs window"]
    boost: Levels
    gain: Pairs  # mean squared error for unit noise
    first: Places
    scatter: Covariances  # residual products over freedom
    freedom: Grid  # complex degrees of freedom
    power: Complex[np.ndarray, "frequencies inputs inputs"]  # of the inputs, mean over the window

    @property
    def determined(self) -> Where:
        """Whether the inputs determine the response."""
        return np.isfinite(self.response[:, 0, 0])

    def rows(self, rows: Where) -> "LocalFit":
        """The fit at some of its frequencies."""
        return LocalFit(*(field[rows] for field in self))

    def replace_rows(self, rows: Where, part: "LocalFit") -> "LocalFit":
        """The fit with the frequencies `rows` replaced by `part`."""
        spare = part.effect.shape[2] - self.effect.shape[2]
        old, new = (
            fit._replace(effect=np.pad(fit.effect, ((0, 0), (0, 0), (0, max(more, 0)))))
            for fit, more in ((self, spare), (part, -spare))
        )
        fields = [np.array(field) for field in old]
        for field, values in zip(fields, new, strict=True):
            field[rows] = values
        return LocalFit(*fields)


def local_fit(
    omega: Grid,
    half_width: Grid,
    bins: Bins,
    inputs: slice,
    outputs: slice,
    order: int,
    shape: Literal["polynomial", "rational"],
) -> LocalFit:
    """Fit polynomials of `order`, or these over a linear denominator, and transients."""
    first, last = window_slices(omega, half_width, bins)
    longest, fields = max(int(np.max(last - first)), 1), []
    for chunk, window in _chunks(omega, half_width, bins, order):
        u, y = (bins.values[window.index][:, :, c] * window.used[:, :, None]
                for c in (inputs, outputs))  # fmt: skip
        solve = solve_polynomial if shape == "polynomial" else solve_rational
        solution = solve(window.place, u, y, window.owner, order)
        effect = solution.effect
        fine = solution.fine & _excited(np.vecdot(effect, effect).real, u, bins.largest[inputs])
        blank = np.where(fine, 1.0, np.nan)[:, None, None]
        padded = np.zeros((*effect.shape[:2], longest), complex)
        padded[:, :, : effect.shape[2]] = effect
        freedom = np.where(fine, solution.freedom, 0.0)
        left, power = (np.swapaxes(x, 1, 2) @ np.conj(x) for x in (solution.residual, u))
        scatter = left / np.maximum(freedom, 1.0)[:, None, None]
        count = np.maximum(np.sum(window.used, axis=1), 1)[:, None, None]
        part = (solution.response * blank, padded * blank, solution.boost, scatter * blank,
                freedom, power / count)  # fmt: skip
        fields = fields or [np.empty((omega.size, *x.shape[1:]), x.dtype) for x in part]
        for field, values in zip(fields, part, strict=True):
            field[chunk] = values
    response, effect, boost, scatter, freedom, power = fields
    gain = boost[:, :, None] ** 2 * np.vecdot(effect, effect).real[:, None, :]
    return LocalFit(response, effect, boost, gain, first, scatter, freedom, power)


def left_power(omega: Grid, half_width: Grid, bins: Bins, values: np.ndarray, order: int) -> Grid:
    """Power of `values` that `local_fit` by polynomials would leave; 0 without a fit."""
    left, power = np.zeros(omega.size), np.sum(np.abs(values) ** 2, axis=1)
    for chunk, window in _chunks(omega, half_width, bins, order):
        u = bins.values[window.index] * window.used[:, :, None]
        normal = Normal.of(regressors(window.place, u, window.owner, order))
        central = np.arange(u.shape[2]) * (order + 1)
        effect = np.real(normal.inverse[:, central, central])  # its square, summed over the window
        fine = normal.independent & _excited(effect, u, bins.largest)
        fine &= np.sum(window.used, axis=1) > normal.count
        moved = normal.adjoint @ values[window.index]
        taken = np.sum(np.real(np.conj(moved) * (normal.inverse @ moved)), axis=(1, 2))
        left[chunk] = fine * (np.sum(power[window.index] * window.used, axis=1) - taken)
    return np.maximum(left, 0.0)


class _Window(NamedTuple):
    index: Int[np.ndarray, "frequencies window"]
    place: InWindow  # -1 to 1
    used: Bool[np.ndarray, "frequencies window"]  # bins with information on the response
    owner: Owner  # the record of each of them


def _chunks(
    omega: Grid, half_width: Grid, bins: Bins, order: int
) -> Iterator[tuple[Int[np.ndarray, " chunk"], _Window]]:
    """Frequencies with windows of about one length, padded; too few bins take no part."""
    first, last = window_slices(omega, half_width, bins)
    longest = max(int(np.max(last - first)), 1)
    places, size = np.argsort(last - first, kind="stable"), min(_CHUNK, max(_BINS // longest, 1))
    for chunk in np.array_split(places, -(-omega.size // size)):
        begin, count = first[chunk][:, None], (last - first)[chunk][:, None]
        step = np.arange(max(int(np.max(count)), 1))
        index = np.minimum(begin + step, bins.omega.size - 1)
        place = (bins.omega[index] - omega[chunk][:, None]) / half_width[chunk][:, None]
        inside = (step < count)[:, :, None]
        owner = inside & (bins.record[index][:, :, None] == np.arange(bins.records))
        owner &= (np.sum(owner, axis=1) > order + 1)[:, None, :]
        yield chunk, _Window(index, place, np.any(owner, axis=2), owner)


def _excited(effect: np.ndarray, u: Inputs, largest: Float[np.ndarray, " inputs"]) -> Where:
    """Whether each input's power in the window is near that which determines its response.

    Beyond a sweep's end an input leaks as smoothly as a transient: the ratio, 2 to 30 within, is
    1e9.
    """
    power = np.abs(u) ** 2
    excited = np.all(np.max(power, axis=1) > (_UNEXCITED * largest) ** 2, axis=1)
    return excited & np.all(effect * np.sum(power, axis=1) < _LEAKED, axis=1)


class Solution(NamedTuple):
    """Response at place 0, how the noise of each bin enters it, and the residual."""

    response: Responses
    effect: Complex[np.ndarray, "frequencies inputs window"]
    boost: Levels  # of the effect on each output
    residual: Outputs
    freedom: Grid  # complex
    fine: Where  # whether the window determines the response


def solve_polynomial(place: InWindow, u: Inputs, y: Outputs, owner: Owner, order: int) -> Solution:
    """Y = sum_s (g_s U + t_s) place^s, with different t_s for each record."""
    return _least_squares(regressors(place, u, owner, order), y, owner, u.shape[2], order)


def solve_rational(place: InWindow, u: Inputs, y: Outputs, owner: Owner, order: int) -> Solution:
    """The same over 1 + a place (local rational method, McKelvey and Guerin, 2012), a for each
    output.

    By the linear equation error, then Gauss-Newton; all outputs use the effect of the first,
    scaled.
    """
    columns, x = regressors(place, u, owner, order), place[:, :, None]
    normal = Normal.of(columns)
    poles = _slope(normal.left(-(x * y)), normal.left(y))
    solutions = []
    for o in range(y.shape[2]):
        one, pole, joined = y[:, :, o : o + 1], poles[:, None, o : o + 1], columns
        for step in range(_STEPS):
            below = 1 + pole * x
            over = 1 / np.where(np.abs(below) < _NEAREST, _NEAREST, below)
            shaped = Normal.of(columns * over)
            left = shaped.left(one)
            slope = x * (one - left) * over
            joined = np.concatenate([shaped.columns, slope], axis=2)
            if step + 1 < _STEPS:
                pole = pole - _slope(shaped.left(slope), left)[:, None]
        solutions.append(_least_squares(joined, one, owner, u.shape[2], order))
    gains = [np.sum(np.vecdot(one.effect, one.effect).real, axis=1) for one in solutions]
    gain = np.stack(gains, axis=1)
    return Solution(
        np.concatenate([one.response for one in solutions], axis=1),
        solutions[0].effect,
        np.sqrt(gain / np.maximum(gain[:, :1], 1e-300)),
        np.concatenate([one.residual for one in solutions], axis=2),
        solutions[0].freedom,
        np.all([one.fine for one in solutions], axis=0),
    )


def _slope(x: Outputs, y: Outputs) -> Complex[np.ndarray, "frequencies outputs"]:
    """The multiple of each column of `x` that is nearest to that of `y`."""
    x, y = (np.swapaxes(part, 1, 2) for part in (x, y))
    return np.vecdot(x, y) / np.maximum(np.vecdot(x, x).real, 1e-300)


def regressors(place: InWindow, u: Inputs, owner: Owner, order: int) -> Columns:
    """Each input, then each record, times the powers of `place`; a column lies in one piece."""
    moving = np.concatenate([u, owner], axis=2)
    rows = np.empty((len(place), moving.shape[2], order + 1, place.shape[1]), complex)
    rows[:, :, 0] = np.swapaxes(moving, 1, 2)
    for power in range(order):
        np.multiply(rows[:, :, power], place[:, None], out=rows[:, :, power + 1])
    return np.swapaxes(rows.reshape(len(place), -1, place.shape[1]), 1, 2)


class Normal(NamedTuple):
    """Normal equations of some columns.

    What their inverse gives is corrected once by what it leaves: as good as a QR decomposition up
    to a condition of 1e4, and good to some 1e-5 where columns are as dependent as is allowed.
    """

    columns: Columns
    adjoint: Complex[np.ndarray, "frequencies columns window"]
    inverse: Complex[np.ndarray, "frequencies columns columns"]
    independent: Where
    count: Places  # of the columns that are not empty

    @classmethod
    def of(cls, columns: Columns) -> "Normal":
        """A record without bins here has empty columns, which take no part."""
        turned = adjoint(columns)
        gram = turned @ columns
        length = np.sqrt(diagonal(gram))
        empty = length == 0
        length = np.where(empty, 1.0, length)
        area = length[:, :, None] * length[:, None, :]
        unit = gram / area + (empty[:, :, None] + _ROUNDING) * np.eye(empty.shape[1])
        inverse = np.linalg.inv(unit)
        # By norms, which bound the condition, or by the eigenvalues.
        norms = [np.linalg.norm(part, axis=(1, 2)) for part in (unit, inverse)]
        independent = np.prod(norms, axis=0) < 1 / _DEPENDENT**2
        if not np.all(independent):
            value = np.linalg.eigvalsh(unit[~independent])
            independent[~independent] = value[:, 0] > _DEPENDENT**2 * value[:, -1]
        return cls(columns, turned, inverse / area, independent, np.sum(~empty, axis=1))

    def left(self, y: Outputs) -> Outputs:
        """What the columns do not explain of `y`."""
        for _ in range(2):
            y = y - self.columns @ (self.inverse @ (self.adjoint @ y))
        return y


def _least_squares(columns: Columns, y: Outputs, owner: Owner, inputs: int, order: int) -> Solution:
    normal, which = Normal.of(columns), slice(0, inputs * (order + 1), order + 1)
    bins = np.sum(np.any(owner, axis=2), axis=1)
    freedom = np.maximum(bins - normal.count, 0).astype(float)
    # How each bin of an output enters the coefficients that are the response at place 0.
    effect = normal.inverse[:, which] @ normal.adjoint
    missing = np.eye(columns.shape[2])[which] - effect @ columns
    effect = effect + missing @ normal.inverse @ normal.adjoint
    response = np.swapaxes(effect @ y, 1, 2)
    fine = normal.independent & (freedom > 0)
    return Solution(response, effect, np.ones(y.shape[::2]), normal.left(y), freedom, fine)
