"""Windows of bins around each frequency, and the local fits in them."""

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from jaxquad.records import Record

from ._local_solve import (
    count_used,
    Inputs,
    normal_equations,
    regressors,
    Solution,
    solve_polynomial,
    solve_rational,
)


class Bins(NamedTuple):
    """Transforms of whole records, all bins in increasing order of frequency.

    Scaled by the root of the record's length: the noise is the same in a short record as in a long
    one. The mean and the Nyquist bin are left out.
    """

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
    """Transform all channels as `Record.names` has them.

    Outputs are differenced `integrators` times and advanced by `delay` (s); `recolour` undoes it.
    """
    parts, grids, owners = [], [], []
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
        parts.append(spectra)
        grids.append(grid)
        owners.append(np.full(last, index))
    if len(parts) == 1:
        return Bins(grids[0], owners[0], parts[0], 1, largest_values(parts[0]))
    omega, values = np.concatenate(grids), np.concatenate(parts)
    order = np.argsort(omega, kind="stable")
    owner, largest = np.concatenate(owners)[order], largest_values(values)
    return Bins(omega[order], owner, values[order], len(parts), largest)


def largest_values(
    values: Complex[np.ndarray, "bins channels"],
) -> Float[np.ndarray, " channels"]:
    """The largest magnitude of each channel."""
    return np.array([np.max(np.abs(channel), initial=0.0) for channel in values.T])


def recolour(
    omega: Float[np.ndarray, " frequencies"], integrators: int, delay: float, dt: float
) -> Complex[np.ndarray, " frequencies"]:
    """Factor from a response to the outputs of `record_bins` to one to the recorded outputs."""
    lag = integrators // 2 * dt + delay
    return np.exp(-1j * lag * omega) / (1 - np.exp(-1j * dt * omega)) ** integrators


def transformed_columns(record: Record, n: int) -> Float[np.ndarray, "samples channels"]:
    """Channels whose transforms are taken; outputs are differenced `n` times."""
    # A difference looks back by n/2 samples: inputs are taken from as much earlier.
    centre = slice(n - n // 2, record.samples - n // 2)
    outputs = np.diff(record.outputs, n, axis=0)
    return np.hstack([record.inputs[centre], outputs, record.references[centre]])


def check_bins(
    omega: Float[np.ndarray, " frequencies"],
    bins: Bins,
    columns: int,
    transient: int,
    freedom: int,
) -> None:
    """Raise `ValueError` where the records hold too few bins, or do not cover `omega`."""
    counts = np.bincount(bins.record, minlength=bins.records)
    spare = int(np.sum(np.maximum(counts - transient, 0)))
    if spare < columns + freedom:
        raise ValueError(
            f"the records have {counts.tolist()} Fourier bins, {spare} more than their transients "
            f"need; the local fit needs {columns + freedom}. Record longer, or use a lower order"
        )
    if not (omega.size and np.all(np.diff(omega) > 0)):
        raise ValueError(
            f"{omega.size} frequencies: give one or more, in increasing order, in rad/s"
        )
    if omega[0] < 0.999 * bins.omega[0] or omega[-1] > 1.001 * bins.omega[-1]:
        raise ValueError(
            f"the frequencies run from {omega[0]:.4g} to {omega[-1]:.4g} rad/s, but the records "
            f"hold one cycle of {bins.omega[0]:.4g} rad/s and reach {bins.omega[-1]:.4g} rad/s. "
            "Keep the frequencies within, or record longer"
        )


def smallest_widths(
    omega: Float[np.ndarray, " frequencies"],
    bins: Bins,
    columns: int,
    transient: int,
    freedom: int,
) -> Float[np.ndarray, " frequencies"]:
    """Half-widths in rad/s of the smallest windows with `freedom` more bins than coefficients.

    `columns` is the number of coefficients of the response, `transient` that of each record.
    """
    least, most = np.zeros_like(omega), np.full_like(omega, bins.omega[-1])
    for _ in range(40):
        middle = (least + most) / 2
        spare = np.zeros(omega.size, int)
        for r in range(bins.records):
            grid = bins.omega[bins.record == r]
            first, last = _between(grid, omega, middle)
            spare += np.maximum(last - first - transient, 0)
        enough = spare >= columns + freedom
        least, most = np.where(enough, least, middle), np.where(enough, middle, most)
    return most * (1 + 1e-9)


def window_slices(
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
    bins: Bins,
) -> tuple[Int[np.ndarray, " frequencies"], Int[np.ndarray, " frequencies"]]:
    """First bin, and one past the last, of every window."""
    return _between(bins.omega, omega, half_width)


def _between(
    grid: Float[np.ndarray, " bins"],
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
) -> tuple[Int[np.ndarray, " frequencies"], Int[np.ndarray, " frequencies"]]:
    first = np.searchsorted(grid, omega - half_width, "left")
    return first, np.searchsorted(grid, omega + half_width, "right")


def products(
    x: Complex[np.ndarray, "frequencies window channels"],
) -> Complex[np.ndarray, "frequencies channels channels"]:
    """Sums over the window of x_a conj(x_b)."""
    return np.swapaxes(x, 1, 2) @ np.conj(x)


_UNEXCITED = 1e-12  # of an input's largest bin: below, it is rounding errors
_LEAKED = 1e5  # ratio of an input's power to the part of it that transients cannot explain
_CHUNK = 32  # frequencies solved at once, padded to the longest window among them
_BINS = 32_768  # of them together: more take memory, and no less time


class LocalFit(NamedTuple):
    """Responses at the centre of each window, and the effect of noise on them.

    The error of output o to input i at f is `boost[f, o] sum_k effect[f, i, k] V_o[first[f] + k]`,
    V the transform of the output's noise. Where the inputs do not determine the response, all
    fields are nan.
    """

    response: Complex[np.ndarray, "frequencies outputs inputs"]
    effect: Complex[np.ndarray, "frequencies inputs window"]
    boost: Float[np.ndarray, "frequencies outputs"]
    gain: Float[np.ndarray, "frequencies outputs inputs"]  # mean squared error for unit noise
    first: Int[np.ndarray, " frequencies"]
    scatter: Complex[np.ndarray, "frequencies outputs outputs"]  # residual products over freedom
    freedom: Float[np.ndarray, " frequencies"]  # complex degrees of freedom
    power: Complex[np.ndarray, "frequencies inputs inputs"]  # of the inputs, mean over the window


def local_fit(
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
    bins: Bins,
    inputs: slice,
    outputs: slice,
    order: int,
    shape: Literal["polynomial", "rational"],
) -> LocalFit:
    """Fit the response and each record's transient around every frequency.

    `shape` says whether both are polynomials of `order`, or such polynomials over a common
    denominator of the first degree.
    """
    first, last = window_slices(omega, half_width, bins)
    longest, fields = max(int(np.max(last - first)), 1), []
    for chunk, window in _chunks(omega, half_width, first, last, bins):
        values = bins.values[window.index]
        used, own = _own_records(window, order, bins.records)
        u, y = (values[:, :, each] * used[:, :, None] for each in (inputs, outputs))
        solve = solve_polynomial if shape == "polynomial" else solve_rational
        solution = solve(window.place, u, y, own, order)
        excited = _excited(
            np.vecdot(solution.effect, solution.effect).real, u, bins.largest[inputs]
        )
        count = np.maximum(np.sum(used, axis=1), 1)[:, None, None]
        part = (*_padded(solution, excited, longest), products(u) / count)
        fields = fields or [np.empty((omega.size, *each.shape[1:]), each.dtype) for each in part]
        for field, each in zip(fields, part, strict=True):
            field[chunk] = each
    response, effect, boost, scatter, freedom, power = fields
    gain = boost[:, :, None] ** 2 * np.vecdot(effect, effect).real[:, None, :]
    return LocalFit(response, effect, boost, gain, first, scatter, freedom, power)


def left_power(
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
    bins: Bins,
    values: Complex[np.ndarray, "bins outputs"],
    order: int,
) -> Float[np.ndarray, " frequencies"]:
    """Power of all `values` in each window that `local_fit` by polynomials would leave.

    All channels of `bins` are the inputs; 0 where they do not determine a response.
    """
    left, power = np.zeros(omega.size), np.sum(np.abs(values) ** 2, axis=1)
    for chunk, window in _chunks(omega, half_width, *window_slices(omega, half_width, bins), bins):
        used, own = _own_records(window, order, bins.records)
        u = bins.values[window.index] * used[:, :, None]
        normal = normal_equations(regressors(window.place, u, own, order))
        central = np.arange(u.shape[2]) * (order + 1)
        effect = np.real(normal.inverse[:, central, central])  # its square, summed over the window
        known = _excited(effect, u, bins.largest)
        known &= normal.independent & (count_used(own) > normal.count)
        moved = normal.adjoint @ values[window.index]
        taken = np.sum(np.real(np.conj(moved) * (normal.inverse @ moved)), axis=(1, 2))
        left[chunk] = known * (np.sum(power[window.index] * used, axis=1) - taken)
    return np.maximum(left, 0.0)


def _chunks(
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
    first: Int[np.ndarray, " frequencies"],
    last: Int[np.ndarray, " frequencies"],
    bins: Bins,
) -> Iterator[tuple[Int[np.ndarray, " chunk"], "_Window"]]:
    """Frequencies whose windows are about as long, and these windows."""
    longest = max(int(np.max(last - first)), 1)
    places, size = np.argsort(last - first, kind="stable"), min(_CHUNK, max(_BINS // longest, 1))
    for chunk in np.array_split(places, -(-omega.size // size)):
        yield chunk, _gather(omega[chunk], half_width[chunk], first[chunk], last[chunk], bins)


def _excited(
    effect: Float[np.ndarray, "frequencies inputs"],
    u: Inputs,
    largest: Float[np.ndarray, " inputs"],
) -> Bool[np.ndarray, " frequencies"]:
    """Whether each input's power in the window is near that which determines its response.

    Beyond the end of a sweep the input's transform is what the ends of the record leak, as smooth
    along frequency as a transient, and says nothing about the response: the ratio, the summed
    squares of the `effect` times those of the input, is 1e9, or what rounding makes of it. A sweep
    that reaches the frequency has 2 to 30.
    """
    power = np.abs(u) ** 2
    found = np.all(np.max(power, axis=1) > (_UNEXCITED * largest) ** 2, axis=1)
    return found & np.all(effect * np.sum(power, axis=1) < _LEAKED, axis=1)


def replace_rows(fit: LocalFit, rows: Bool[np.ndarray, " frequencies"], part: LocalFit) -> LocalFit:
    """`fit` with the frequencies `rows` replaced by `part`."""
    longest = max(fit.effect.shape[2], part.effect.shape[2])
    whole, part = (
        each._replace(
            effect=np.pad(each.effect, ((0, 0), (0, 0), (0, longest - each.effect.shape[2])))
        )
        for each in (fit, part)
    )
    fields = [np.array(field) for field in whole]
    for field, new in zip(fields, part, strict=True):
        field[rows] = new
    return LocalFit(*fields)


def _padded(
    solution: Solution, excited: Bool[np.ndarray, " frequencies"], longest: int
) -> tuple[np.ndarray, ...]:
    """Response, effect, boost, scatter and freedom, nan where nothing determines them."""
    fine = solution.fine & excited
    blank = np.where(fine, 1.0, np.nan)[:, None, None]
    effect = solution.effect
    padded = np.zeros((*effect.shape[:2], longest), complex)
    padded[:, :, : effect.shape[2]] = effect
    freedom = np.where(fine, solution.freedom, 0.0)
    scatter = products(solution.residual) / np.maximum(freedom, 1.0)[:, None, None]
    return solution.response * blank, padded * blank, solution.boost, scatter * blank, freedom


class _Window(NamedTuple):
    index: Int[np.ndarray, "frequencies window"]
    inside: Bool[np.ndarray, "frequencies window"]  # false for padding
    place: Float[np.ndarray, "frequencies window"]  # -1 to 1
    record: Int[np.ndarray, "frequencies window"]


def _gather(
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
    first: Int[np.ndarray, " frequencies"],
    last: Int[np.ndarray, " frequencies"],
    bins: Bins,
) -> _Window:
    step = np.arange(max(int(np.max(last - first)), 1))
    inside = step < (last - first)[:, None]
    index = np.minimum(first[:, None] + step, bins.omega.size - 1)
    place = (bins.omega[index] - omega[:, None]) / half_width[:, None]
    return _Window(index, inside, place, bins.record[index])


def _own_records(
    window: _Window, order: int, records: int
) -> tuple[Bool[np.ndarray, "frequencies window"], Bool[np.ndarray, "frequencies window records"]]:
    """Bins that carry information on the response, and the record of each.

    A record with no more bins here than its transient has coefficients carries none.
    """
    own = window.inside[:, :, None] & (window.record[:, :, None] == np.arange(records))
    own &= (np.sum(own, axis=1) > order + 1)[:, None, :]
    return np.any(own, axis=2), own
