import functools as ft
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Float

from jaxquad.records import Record

from ._window import window


class LocalPolynomial(eqx.Module):
    """Local polynomial estimates from the transforms of whole records, at any frequencies.

    Around each frequency the response and the transients of the records' two ends are polynomials
    of `order` in frequency: what leaks is estimated and not windowed away. `width`, in rad/s, is
    the half-width of the band that the polynomials span; by default it is chosen frequency by
    frequency, as wide as shows no bias above the noise, and where a resonance is sharper than the
    least band, a rational function takes the polynomial's place. A width that is set is kept to:
    where it holds too few bins, the response is nan.

    `integrators` is the number of pure integrations between input and output: outputs are
    differenced so many times, and the response divided by the differencing filter. `delay`, in s,
    is about how much the output lags: taken out before the fit and put back after.
    Source: Pintelon and Schoukens, System Identification, 2nd ed., section 7.2; McKelvey and
    Guerin (2012) for the rational function.
    """

    order: int = eqx.field(static=True, default=2)
    width: float | None = eqx.field(static=True, default=None)
    integrators: int = eqx.field(static=True, default=0)
    delay: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        if self.order not in range(7):
            raise ValueError(f"order {self.order}: give 0 to 6; 2 is usual")
        if self.width is not None and not 0 < self.width < np.inf:
            raise ValueError(f"width {self.width} rad/s must be positive; None chooses one")
        if self.integrators not in (0, 1, 2, 3):
            raise ValueError(f"integrators {self.integrators}: give 0 to 3 integrations")
        if not 0 <= self.delay < 10:
            raise ValueError(f"delay {self.delay} s: give 0 to 10 s")


class Welch(eqx.Module):
    """Averaged spectra of overlapping windows at any frequencies (CIFER's FRESPID).

    `window_length` in s; by default a fifth of the longest record, so that five independent
    windows are averaged. `integrators` is the number of pure integrations between input and
    output: the output is differenced so many times before it is windowed, and the response divided
    by the differencing filter. That keeps the steep response of 1/s^n from leaking
    through the window (a 40 s Hann window is wrong by 10 % at 0.4 rad/s without it). `delay`, in s,
    is about how much the output lags the input: it is taken out before windowing and put back
    after, since a late output is weighed by another part of the window (1 % at the end of a sweep).
    `detrend` removes from each segment its "constant", its "linear" trend, or "none".
    """

    window_length: float | None = eqx.field(static=True, default=None)
    overlap: float = eqx.field(static=True, default=0.8)
    shape: str = eqx.field(static=True, default="hann")
    detrend: str = eqx.field(static=True, default="constant")
    integrators: int = eqx.field(static=True, default=0)
    delay: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        window(self.shape, 4)
        if not 0 <= self.overlap < 1:
            raise ValueError(f"overlap {self.overlap} is not in [0, 1): 0.5 or 0.8 are usual")
        if self.detrend not in ("none", "constant", "linear"):
            raise ValueError(f"detrend {self.detrend!r}: choose none, constant or linear")
        if self.integrators not in (0, 1, 2, 3):
            raise ValueError(f"integrators {self.integrators}: give 0 to 3 integrations")
        if not 0 <= self.delay < 10:
            raise ValueError(f"delay {self.delay} s: give 0 to 10 s")
        if self.window_length is not None and not self.window_length > 0:
            raise ValueError(f"window_length {self.window_length} s must be positive")

    def length(self, records: Sequence[Record]) -> int:
        """Samples to a window."""
        usable = max(record.samples for record in records) - self.integrators
        shortest = min(record.samples for record in records) - self.integrators
        seconds = self.window_length or usable * records[0].dt / 5
        length = int(round(seconds / records[0].dt))
        if length < 8 or length > shortest or (length == shortest and len(records) < 2):
            raise ValueError(
                f"a window of {seconds:.4g} s has {length} samples, the shortest record "
                f"{shortest}: at least two windows of 8 samples must fit; set window_length "
                f"below {shortest * records[0].dt / 2:.4g} s"
            )
        if self.delay >= length * records[0].dt:
            raise ValueError(
                f"a delay of {self.delay:.4g} s is not shorter than the window of {seconds:.4g} s"
            )
        return length

    def late(self, record: Record) -> int:
        """Samples of `delay`."""
        return int(round(self.delay / record.dt))

    def default_omega(self, records: Sequence[Record]) -> Float[np.ndarray, " frequencies"]:
        """100 log-spaced frequencies, from three cycles to a window to a tenth of the sample rate.

        Below, what leaks through the window outweighs the random error of a good record.
        """
        dt = records[0].dt
        length = self.length(records)
        if length <= 30:
            raise ValueError(
                f"a window of {length} samples resolves nothing below a tenth of the sample rate: "
                "set a longer window_length, or name the frequencies with omega="
            )
        return np.geomspace(6 * np.pi / (length * dt), 2 * np.pi / (10 * dt), 100)


_LENGTHS = 5
_CYCLES = 20  # of the highest frequency, in the shortest window


class Composite(eqx.Module):
    """Several window lengths, combined at every frequency (CIFER's FRESPID and COMPOSITE).

    Long windows serve the low frequencies, short ones average more and serve the high ones. Each
    pair's spectra are weighed by (eps_i / eps_min)^-4 of their random errors. `windows` are lengths
    in s; by default five, log-spaced from a third of all records together (half a record at most)
    to 20 cycles of the highest frequency. Lengths are rounded to whole blocks of samples that they
    share. The other options are those of `jq.spectra.Welch`.
    """

    windows: tuple[float, ...] | None = eqx.field(static=True, default=None)
    overlap: float = eqx.field(static=True, default=0.8)
    shape: str = eqx.field(static=True, default="hann")
    detrend: str = eqx.field(static=True, default="constant")
    integrators: int = eqx.field(static=True, default=0)
    delay: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        if self.windows is not None and len(set(self.windows)) < max(len(self.windows), 1):
            raise ValueError(f"windows {self.windows}: give one or more different lengths in s")
        for length in self.windows or (None,):
            self._member(length)

    def members(
        self, records: Sequence[Record], omega: Float[ArrayLike, " frequencies"] | None
    ) -> tuple[Welch, ...]:
        """One estimator for each window length, the longest first."""
        lengths = self.windows or self._lengths(records, omega)
        return tuple(self._member(length) for length in sorted(lengths, reverse=True))

    def _lengths(
        self, records: Sequence[Record], omega: Float[ArrayLike, " frequencies"] | None
    ) -> list[float]:
        dt = records[0].dt
        spans = [(record.samples - self.integrators) * dt for record in records]
        longest = min(max(spans) / 2, sum(spans) / 3, min(spans) * 0.9)
        highest = 2 * np.pi / (10 * dt) if omega is None else float(np.max(omega))
        shortest = np.clip(_CYCLES * 2 * np.pi / highest, longest / 10, longest)
        return np.unique(np.geomspace(shortest, longest, _LENGTHS)).tolist()

    def _member(self, length: float | None) -> Welch:
        return _welch(length, self.overlap, self.shape, self.detrend, self.integrators, self.delay)


# Making and checking a module takes as long as transforming one window length.
_welch = ft.lru_cache(maxsize=64)(Welch)


_DRIFT = 0.02  # samples by which the periods of a record may shift against its clock


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


class JointInputOutput(eqx.Module):
    """Response by way of outside references r: G = S_ry S_ru^-1, unbiased in closed loop.

    The noise that the controller feeds back to the input is uncorrelated with the reference,
    so it averages out; in the direct estimate it does not. `spectra` is any of the estimators.
    Needs one reference for each input, and none that a feedback computes. Source: joint
    input-output method, Tischler & Remple; instrumental variables.
    """

    spectra: Welch | Composite | LocalPolynomial | Periodic = LocalPolynomial()
