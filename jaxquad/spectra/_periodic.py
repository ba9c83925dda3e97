from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float, Int

from jaxquad.records import Record


_DRIFT = 0.02  # samples by which the periods of a record may shift against its clock
_FAINT = 1e-4  # power of a line, to that of the strongest, below which it counts as unexcited
_CHANCE = 1e-4  # of taking noise for an excited line, in a whole spectrum


class Periodic(eqx.Module):
    """Averages over whole periods of a periodic excitation, at its own harmonics only.

    `period` is in s, a whole number of samples; `discard` periods at the start of each record
    count as transient. Several records are taken as realisations with phases of their own:
    what scatters between them beyond the noise is nonlinear distortion, and the response is the
    best linear approximation. Source: Pintelon and Schoukens, System Identification, 2nd ed.,
    sections 2.5 and 4.3.1 (robust method).
    """

    period: float = eqx.field(static=True)
    discard: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if not 0 < self.period < np.inf:
            raise ValueError(f"period {self.period} s must be positive")
        if self.discard < 0 or self.discard != int(self.discard):
            raise ValueError(f"discard {self.discard}: give a number of whole periods, 0 or more")

    def samples(self, record: Record) -> int:
        """Samples to a period; `ValueError` unless they are a whole number over the record."""
        exact = self.period / record.dt
        whole = int(round(exact))
        shift = abs(exact - whole) * record.samples / max(exact, 1.0)
        if whole < 4 or shift > _DRIFT:
            raise ValueError(
                f"the period of {self.period:.8g} s is {exact:.8g} samples at "
                f"{record.sample_rate:.6g} Hz, not a whole number of at least 4: over the record "
                f"the periods shift by {shift:.3g} samples (limit {_DRIFT}); give the exact "
                "period, or read the record with a sample_rate that divides it"
            )
        return whole


class Periods(eqx.Module):
    """Transforms of one record's periods: their mean, and the covariance of a single one.

    Scaled so that noise of unit variance has unit power; channels stand as in `Record.names`.
    """

    mean: Complex[np.ndarray, "lines channels"]
    covariance: Complex[np.ndarray, "lines channels channels"]  # of a single period
    count: int = eqx.field(static=True)
    settled: float = eqx.field(static=True)  # first period's departure from the rest, to the noise


def record_periods(record: Record, options: Periodic) -> Periods:
    """Transform the periods that are kept, at all harmonics below the Nyquist frequency.

    Raises `ValueError` where fewer than two are left.
    """
    samples = options.samples(record)
    count = record.samples // samples - options.discard
    if count < 2:
        raise ValueError(
            f"the record holds {record.samples / samples:.3g} periods of {options.period:.6g} s, "
            f"of which {options.discard} are discarded: two have to remain, four or more are better"
        )
    columns = np.hstack([record.inputs, record.outputs, record.references])
    kept = columns[options.discard * samples :][: count * samples]
    periods = kept.reshape(count, samples, -1) - kept.mean(axis=0)
    spectra = np.fft.rfft(periods, axis=1)[:, 1 : (samples - 1) // 2 + 1] / np.sqrt(samples)
    mean = spectra.mean(axis=0)
    apart = spectra - mean
    covariance = np.einsum("mka,mkb->kab", apart, np.conj(apart)) / (count - 1)
    return Periods(mean, covariance, count, _departure(spectra, record.inputs.shape[1]))


def _departure(spectra: Complex[np.ndarray, "periods lines channels"], inputs: int) -> float:
    """Power by which the first period differs from the later ones, over what noise makes of it."""
    if len(spectra) < 3:
        return 1.0
    first, later = spectra[0], spectra[1:]
    scatter = np.sum(np.abs(later - later.mean(axis=0)) ** 2, axis=0) / (len(later) - 1)
    apart = np.abs(first - later.mean(axis=0)) ** 2 / (1 + 1 / len(later))
    slow = slice(0, max(len(first) // 20, 8))  # A transient is slow, most noise is not.
    ratio = np.sum(apart[slow], axis=0) / np.maximum(np.sum(scatter[slow], axis=0), 1e-300)
    return float(np.max(ratio[inputs:]))


def line_frequencies(record: Record, options: Periodic) -> Float[np.ndarray, " lines"]:
    """All harmonics below the Nyquist frequency, in rad/s."""
    samples = options.samples(record)
    return 2 * np.pi * np.arange(1, (samples - 1) // 2 + 1) / (samples * record.dt)


def pooled(
    periods: Sequence[Periods],
) -> Complex[np.ndarray, "lines channels channels"]:
    """Covariance of all channels' noise in a single period, over all records."""
    weights = [float(each.count - 1) for each in periods]
    sums = sum(w * each.covariance for w, each in zip(weights, periods, strict=True))
    return np.asarray(sums) / sum(weights)


def excited_lines(periods: Sequence[Periods], channels: slice) -> Int[np.ndarray, " excited"]:
    """Places of the harmonics at which one of `channels` has power beyond its noise."""
    from scipy.special import fdtri

    power = np.mean([np.abs(each.mean[:, channels]) ** 2 for each in periods], axis=0)
    noise = np.real(np.diagonal(pooled(periods), axis1=1, axis2=2))[:, channels]
    noise = noise * np.mean([1 / each.count for each in periods])
    freedom = 2.0 * sum(each.count - 1 for each in periods)
    clear = power > fdtri(2.0 * len(periods), freedom, 1 - _CHANCE / len(power)) * noise
    return np.flatnonzero(np.any(clear & (power > _FAINT * np.max(power, axis=0)), axis=1))
