"""Averages over the periods of a periodic excitation, at its own harmonics.

Source: Pintelon and Schoukens, System Identification, 2nd ed., sections 2.5 and 4.3.1.
"""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from jaxquad._core import Message
from jaxquad.records import Record

from ._error_covariance import ErrorCovariance
from ._estimators import adjoint, Covariances, diagonal, Grid, Levels, Method, Periodic, Remark
from ._frequency_response import Distortion, Estimate
from ._noise import smooth_noise, smoothed


_CHANCE = 1e-4  # of taking noise for an excited line, for distortion, or for a line in the noise
_FAINT = 1e-4  # power of a line, to that of the strongest, below which it counts as unexcited
_DEPENDENT = 1e-8  # smallest singular value of the inputs' cross powers, to the largest
_ROUNDING = 1e-24  # power of rounding errors, to that of the output
_UNKNOWN = 1e60  # error of what is not determined: infinity, but products with zero are zero
_UNSETTLED = 4.0  # power of the first period's departure, to that of the noise

Averages = Complex[np.ndarray, "frequencies _ realisations"]  # over a record's periods


class Periods(NamedTuple):
    """Transforms of a record's periods, scaled so that noise of unit variance has unit power."""

    mean: Complex[np.ndarray, "lines channels"]
    covariance: Complex[np.ndarray, "lines channels channels"]  # of a single period
    count: int
    departure: float  # power of the first period's difference, to that by noise


def record_periods(record: Record, options: Periodic) -> Periods:
    """Transform the periods that are kept, at all harmonics below the Nyquist frequency."""
    samples = options.samples(record)
    count = record.samples // samples - options.discard
    if count < 2:
        raise ValueError(
            f"the record holds {record.samples / samples:.3g} periods of {options.period:.6g} s, "
            f"of which {options.discard} are discarded: at least two must remain, better four or "
            "more. Record longer, or discard fewer"
        )
    columns = np.hstack([record.inputs, record.outputs, record.references])
    kept = columns[options.discard * samples :][: count * samples]
    periods = kept.reshape(count, samples, -1) - kept.mean(axis=0)
    spectra = np.fft.rfft(periods, axis=1)[:, 1 : (samples - 1) // 2 + 1] / np.sqrt(samples)
    mean = spectra.mean(axis=0)
    deviation = spectra - mean
    covariance = np.einsum("mka,mkb->kab", deviation, np.conj(deviation)) / (count - 1)
    departure = 1.0
    if count > 2:
        first, later = spectra[0], spectra[1:]
        scatter = np.sum(np.abs(later - later.mean(axis=0)) ** 2, axis=0) / (count - 2)
        power = np.abs(first - later.mean(axis=0)) ** 2 / (1 + 1 / (count - 1))
        slow = slice(0, max(len(first) // 20, 8))  # A transient is slow, most noise is not.
        ratio = np.sum(power[slow], axis=0) / np.maximum(np.sum(scatter[slow], axis=0), 1e-300)
        departure = float(np.max(ratio[record.inputs.shape[1] :]))
    return Periods(mean, covariance, count, departure)


def pooled(periods: Sequence[Periods]) -> Complex[np.ndarray, "lines channels channels"]:
    """Covariance of all channels' noise in a single period, over all records."""
    weights = [float(one.count - 1) for one in periods]
    sums = sum(w * one.covariance for w, one in zip(weights, periods, strict=True))
    return np.asarray(sums) / sum(weights)


def excited_lines(periods: Sequence[Periods], channels: slice) -> Int[np.ndarray, " excited"]:
    """Places of the harmonics at which one of `channels` has power beyond its noise."""
    from scipy.special import fdtri

    power = np.mean([np.abs(one.mean[:, channels]) ** 2 for one in periods], axis=0)
    noise = diagonal(pooled(periods))[:, channels]
    noise = noise * np.mean([1 / one.count for one in periods])
    freedom = 2.0 * sum(one.count - 1 for one in periods)
    clear = power > fdtri(2.0 * len(periods), freedom, 1 - _CHANCE / len(power)) * noise
    return np.flatnonzero(np.any(clear & (power > _FAINT * np.max(power, axis=0)), axis=1))


def estimate_periodic(
    records: Sequence[Record],
    omega: Float[np.ndarray, " response"] | None,
    options: Periodic,
    method: Method,
) -> Estimate:
    """Responses of all outputs to all inputs, by default at all lines that are excited.

    With Z the period averages of the references ("joint") or of the inputs ("direct") over the
    records, G = Y Z^H (U Z^H)^-1. For one input and one record that is Y / U, which fed-back noise
    does not bias either: only its average over the periods remains.
    """
    from scipy.special import fdtri, gammaincinv

    inputs, outputs = records[0].inputs.shape[1], records[0].outputs.shape[1]
    sizes = {options.samples(record) for record in records}
    if len(sizes) > 1:
        raise ValueError(
            f"the periods have {sorted(sizes)} samples: read all records with one sample rate"
        )
    if len(records) < inputs:
        raise ValueError(
            Message(
                f"{inputs} simultaneous inputs need at least as many records with different "
                f"phases; there are {len(records)}. Record more, or use "
                "«jq.spectra.LocalPolynomial()»"
            )
        )
    periods = [record_periods(record, options) for record in records]
    first = inputs + outputs if method == "joint" else 0
    instruments, samples = slice(first, first + inputs), options.samples(records[0])
    harmonics = np.arange(1, (samples - 1) // 2 + 1)  # below the Nyquist frequency
    grid = 2 * np.pi * harmonics / (samples * records[0].dt)
    lines = excited_lines(periods, instruments)
    if lines.size == 0:
        raise ValueError(
            "no harmonic of the period exceeds the noise in the input. Check the period; for an "
            "excitation that is not periodic use another estimator"
        )
    if omega is not None:
        excited = lines
        lines = lines[np.argmin(np.abs(grid[lines][None, :] - omega[:, None]), axis=1)]
        off = np.abs(grid[lines] - omega) > 1e-6 * omega + 1e-6 * grid[0]
        if np.any(off):
            raise ValueError(
                f"{omega[off][0]:.6g} rad/s is not an excited line; the nearest one is "
                f"{grid[lines][off][0]:.6g} rad/s. Without omega all {excited.size} lines are used"
            )
    averages, omega = np.stack([one.mean[lines] for one in periods], axis=2), grid[lines]
    u, y, z = averages[:, :inputs], averages[:, inputs : inputs + outputs], averages[:, instruments]
    # G = Y Z^H (U Z^H)^-1 at each line.
    cross = u @ adjoint(z)
    size = np.linalg.norm(u, axis=2)[:, :, None] * np.linalg.norm(z, axis=2)[:, None, :]
    strength = np.linalg.svd(cross / np.maximum(size, 1e-300), compute_uv=False)
    fine = strength[:, -1] > _DEPENDENT * np.maximum(strength[:, 0], 1e-300)
    inverse = np.linalg.inv(np.where(fine[:, None, None], cross, np.eye(inputs)))
    effect = np.swapaxes(adjoint(z) @ inverse, 1, 2)
    response, determined = np.swapaxes(effect @ np.swapaxes(y, 1, 2), 1, 2), fine[:, None, None]

    def smooth(covariance: Covariances, freedom: float) -> tuple[Levels, Covariances]:
        """Powers and roots, smooth along frequency except at lines that stand out."""
        spacing, counts = np.gradient(omega) if omega.size > 1 else omega, fine * freedom
        smooth = smooth_noise(omega, spacing, covariance, counts)
        raw, high = diagonal(covariance), gammaincinv(freedom, 1 - _CHANCE) / freedom
        power = np.where(raw > high * smooth.power, raw, smooth.power)
        return power, smooth._replace(power=power).root()

    # Noise between periods, from v = y - G u, and scatter between realisations. With input noise
    # and feedback, v is what perturbs G (Pintelon and Schoukens, eq. 2-25).
    count = 1 / float(np.mean([1 / one.count for one in periods]))
    freedom, spare = float(sum(one.count - 1 for one in periods)), float(u.shape[2] - inputs)
    ones = np.broadcast_to(np.eye(outputs), (len(lines), outputs, outputs))
    covariance = pooled(periods)[lines]
    left, first = np.concatenate([-response, ones], axis=2), inputs + outputs
    noise, root = smooth(left @ covariance[:, :first, :first] / count @ adjoint(left), freedom)
    significant, total, size = np.zeros(outputs, bool), noise, 2.0 * max(np.sum(fine), 1)
    if spare > 0:  # more realisations than inputs
        residual = y - response @ u
        between = residual @ adjoint(residual) / spare
        total, total_root = smooth(between, spare)
        ratio = 2 * np.sum(diagonal(between) / noise * fine[:, None], axis=0) / size
        significant = ratio > fdtri(size * spare, size * freedom, 1 - _CHANCE)
        # Rounding errors repeat from period to period, and not from one realisation to the next.
        output = np.mean(np.abs(y) ** 2, axis=(0, 2))
        significant &= np.mean(diagonal(between), axis=0) > _ROUNDING * output
        if np.any(significant):
            root = total_root * np.sqrt(np.maximum(noise, total) / total)[:, :, None]
            freedom = spare
    nonlinear = np.maximum(total - noise, 0.0)
    # Coherence is that of one period: the share of an output that an input explains, and of the
    # joint estimate the smaller of that and of the repeated share of the input.
    power = np.einsum("fir,fjr->fij", u, np.conj(u)) / u.shape[2]
    alone = 1 / diagonal(np.linalg.inv(np.where(determined, power, np.eye(inputs))))
    explained = np.abs(response) ** 2 * alone[:, None, :]
    left = noise * count + nonlinear
    direct = np.where(determined, explained / (explained + left[:, :, None]), 0.0)
    jitter = diagonal(covariance)[:, :inputs]
    steady = np.minimum(direct, (alone / (alone + jitter))[:, None, :] * determined)
    together = np.mean(np.abs(np.nan_to_num(response) @ u) ** 2, axis=2)
    # The noise of each line is independent: as many atoms as inputs at each.
    kernel = np.einsum("fir,fjr->fij", effect, np.conj(effect))
    kernel = np.where(determined, kernel, _UNKNOWN**2 * np.eye(inputs))
    values, vectors = np.linalg.eigh(kernel)
    effect = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    root = np.where(determined, root, np.eye(outputs))
    blank, names = 1.0 if spare > 0 else np.nan, records[0].output_names
    errors = ErrorCovariance(omega, effect, root, first=inputs * np.arange(omega.size))
    amplitude = np.sqrt(np.mean(np.abs(response @ u) ** 2, axis=2))
    scatter = np.sqrt(noise), np.sqrt(total) * blank, np.sqrt(nonlinear) * blank
    response = np.where(determined, response, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.sqrt(errors.variance() / 2) / np.abs(response)
    relative = np.where(np.isfinite(response), relative, np.inf)
    together, steady = together / (together + left), steady if method == "joint" else direct
    log_noise = smoothed(omega, np.eye(omega.size) / freedom, np.where(fine, freedom, 1e-9))
    remarks = ft.partial(_remarks, omega[~fine], bool(np.any(significant)), periods)
    distortion = Distortion(omega, amplitude, *scatter, significant, names, len(records))
    return Estimate(
        omega, response, steady, direct, together, errors, relative, log_noise, remarks,
        distortion=distortion,
    )  # fmt: skip


def _remarks(lost: Grid, distorted: bool, periods: Sequence[Periods]) -> tuple[Remark, ...]:
    remarks = []
    if lost.size:
        text = (
            "undetermined {where}: the inputs cannot be separated there. Use different phases in "
            "each record"
        )
        remarks.append(Remark(text, lost, kind="undetermined"))
    departures = [one.departure for one in periods if one.departure > _UNSETTLED]
    if departures:
        text = (
            f"the first period differs from the later ones by {max(departures):.3g} times the "
            "noise power, because a transient remains: discard more periods"
        )
        remarks.append(Remark(text, kind="transient"))
    if distorted:
        text = (
            "nonlinear distortion exceeds the noise: the error bars are those of the best linear "
            "approximation. Use a smaller amplitude, or take the fit as that at this amplitude"
        )
        remarks.append(Remark(text, kind="nonlinear"))
    return tuple(remarks)
