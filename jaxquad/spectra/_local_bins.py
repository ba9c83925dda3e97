"""The Fourier bins of whole records, and which of them a local window takes in."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from jaxquad.records import Record


class Bins(NamedTuple):
    """Transforms of whole records, all bins in rising order of frequency.

    Scaled by the root of the record's length: the noise is the same in a short record as in a
    long one. Neither the mean nor the Nyquist bin is there.
    """

    omega: Float[np.ndarray, " bins"]  # rad/s
    record: Int[np.ndarray, " bins"]  # which one it is of
    values: Complex[np.ndarray, "bins channels"]
    records: int


def record_bins(records: Sequence[Record], integrators: int, delay: float) -> Bins:
    """Transform all channels as `Record.names` has them.

    Outputs are differenced `integrators` times and advanced by `delay` (s); `recolour` undoes it.
    """
    parts, grids, owners = [], [], []
    for index, record in enumerate(records):
        columns = _columns(record, integrators)
        spectra = np.fft.rfft(columns - columns.mean(axis=0), axis=0) / np.sqrt(len(columns))
        last = (len(columns) - 1) // 2
        grid = 2 * np.pi * np.arange(1, last + 1) / (len(columns) * record.dt)
        spectra = spectra[1 : last + 1]
        first = record.inputs.shape[1]
        lag = np.exp(1j * delay * grid)[:, None]
        spectra[:, first : first + record.outputs.shape[1]] *= lag
        parts.append(spectra)
        grids.append(grid)
        owners.append(np.full(last, index))
    omega = np.concatenate(grids)
    order = np.argsort(omega, kind="stable")
    return Bins(
        omega[order], np.concatenate(owners)[order], np.concatenate(parts)[order], len(parts)
    )


def recolour(
    omega: Float[np.ndarray, " frequencies"], integrators: int, delay: float, dt: float
) -> Complex[np.ndarray, " frequencies"]:
    """What turns a response to the outputs of `record_bins` into one to the recorded outputs."""
    lag = integrators // 2 * dt + delay
    return np.exp(-1j * lag * omega) / (1 - np.exp(-1j * dt * omega)) ** integrators


def _columns(record: Record, n: int) -> Float[np.ndarray, "samples channels"]:
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
    """Raise `ValueError` where the records hold too few bins, or not the band of `omega`."""
    counts = np.bincount(bins.record, minlength=bins.records)
    spare = int(np.sum(np.maximum(counts - transient, 0)))
    if spare < columns + freedom:
        raise ValueError(
            f"records of {counts.tolist()} Fourier bins leave {spare} beside their transients, the "
            f"local fit needs {columns + freedom}: record longer, or lower the order"
        )
    if not (omega.size and np.all(np.diff(omega) > 0)):
        raise ValueError(f"{omega.size} frequencies: give one or more, in rising order, in rad/s")
    if omega[0] < 0.999 * bins.omega[0] or omega[-1] > 1.001 * bins.omega[-1]:
        raise ValueError(
            f"omega runs from {omega[0]:.4g} to {omega[-1]:.4g} rad/s, the records from one cycle, "
            f"{bins.omega[0]:.4g}, to {bins.omega[-1]:.4g} rad/s: keep it within, or record longer"
        )


def enough_bins(
    omega: Float[np.ndarray, " frequencies"],
    bins: Bins,
    columns: int,
    transient: int,
    freedom: int,
) -> Float[np.ndarray, " frequencies"]:
    """Half-widths in rad/s of the smallest windows that leave `freedom` residuals over.

    `columns` is the number of coefficients of the response, `transient` that of each record's own.
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
