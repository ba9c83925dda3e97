from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Float

from jaxquad._core import Message
from jaxquad.records import Record

from ._fourier_sums import window


class LocalPolynomial(eqx.Module):
    """Local polynomial estimates from the transforms of whole records, at any frequencies.

    Around each frequency the response and the transients of the records' two ends are polynomials
    in frequency, so that leakage is estimated instead of windowed. Where a resonance is sharper
    than the smallest band, a rational function replaces the polynomial. Source: Pintelon and
    Schoukens, "System Identification", 2nd ed., section 7.2; McKelvey and Guerin (2012) for the
    rational function.

    **Arguments:**

    - `order`: of the polynomials, 0 to 6.
    - `width`: half-width of the band that a polynomial spans, in rad/s. By default it is chosen for
        each frequency, as wide as possible without a visible bias. Where a given width holds too
        few Fourier bins, the response is nan.
    - `integrators`: number of pure integrations between input and output, 0 to 3. The outputs are
        differenced as often, and the response is divided by the differencing filter.
    - `delay`: approximate delay of the output in s, which is removed before the fit and restored
        afterwards.
    - `global_order`: largest order, 0 to 20, of a rational model of the whole record with the
        transients of its ends. The data choose its order; it is subtracted before the local fits
        and added back, so that modes which still ring at the record's end do not spoil them. 0
        switches it off.

    **Raises:**

    - `ValueError`: for values out of range.
    """

    order: int = eqx.field(static=True, default=2)
    width: float | None = eqx.field(static=True, default=None)
    integrators: int = eqx.field(static=True, default=0)
    delay: float = eqx.field(static=True, default=0.0)
    global_order: int = eqx.field(static=True, default=12)

    def __check_init__(self):
        if self.order not in range(7):
            raise ValueError(f"order is {self.order}: use 0 to 6 (usually 2)")
        if self.global_order not in range(21):
            raise ValueError(f"global_order is {self.global_order}: use 0 to 20 (usually 12)")
        if self.width is not None and not 0 < self.width < np.inf:
            raise ValueError(f"width is {self.width} rad/s: it must be positive, or None")
        if self.integrators not in (0, 1, 2, 3):
            raise ValueError(f"integrators is {self.integrators}: use 0 to 3")
        if not 0 <= self.delay < 10:
            raise ValueError(f"delay is {self.delay} s: use 0 to 10 s")


class Welch(eqx.Module):
    """Averaged spectra of overlapping windows at any frequencies (CIFER's FRESPID).

    Source: Tischler and Remple, "Aircraft and Rotorcraft System Identification", ch. 7.

    **Arguments:**

    - `window_length`: in s; by default a fifth of the longest record, so that five independent
        windows are averaged.
    - `overlap`: of neighbouring windows, from 0 to below 1.
    - `shape`: `"hann"`, `"hamming"` or `"rectangular"`.
    - `detrend`: what is removed from each window, `"constant"`, `"linear"` or `"none"`.
    - `integrators`: number of pure integrations between input and output, 0 to 3. The output is
        differenced as often before windowing, and the response is divided by the differencing
        filter. Without it the steep response of 1/s^n leaks through the window (a 40 s Hann window
        is wrong by 10 % at 0.4 rad/s).
    - `delay`: approximate delay of the output in s, which is removed before windowing and restored
        afterwards: otherwise input and output are weighted differently (1 % at the end of a sweep).

    **Raises:**

    - `ValueError`: for values out of range.
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
            raise ValueError(
                f"overlap is {self.overlap}: it must be at least 0 and below 1 (usually 0.5 or 0.8)"
            )
        if self.detrend not in ("none", "constant", "linear"):
            raise ValueError(f"detrend is {self.detrend!r}: use none, constant or linear")
        if self.integrators not in (0, 1, 2, 3):
            raise ValueError(f"integrators is {self.integrators}: use 0 to 3")
        if not 0 <= self.delay < 10:
            raise ValueError(f"delay is {self.delay} s: use 0 to 10 s")
        if self.window_length is not None and not self.window_length > 0:
            raise ValueError(f"window_length is {self.window_length} s: it must be positive")

    def length(self, records: Sequence[Record]) -> int:
        """Samples in a window."""
        usable = max(record.samples for record in records) - self.integrators
        shortest = min(record.samples for record in records) - self.integrators
        seconds = self.window_length or usable * records[0].dt / 5
        length = int(round(seconds / records[0].dt))
        if length < 8 or length > shortest or (length == shortest and len(records) < 2):
            raise ValueError(
                f"a window of {seconds:.4g} s has {length} samples, and the shortest record "
                f"{shortest}: at least two windows of at least 8 samples must fit. Use a window "
                f"shorter than {shortest * records[0].dt / 2:.4g} s"
            )
        if self.delay >= length * records[0].dt:
            raise ValueError(
                f"delay is {self.delay:.4g} s: it must be below the window's {seconds:.4g} s"
            )
        return length

    def delay_samples(self, record: Record) -> int:
        """`delay` in samples."""
        return int(round(self.delay / record.dt))

    def default_omega(self, records: Sequence[Record]) -> Float[np.ndarray, " frequencies"]:
        """100 log-spaced frequencies, from three cycles in a window to a tenth of the sample rate.

        Below them, leakage through the window exceeds the random error of a good record.
        """
        length, dt = self.length(records), records[0].dt
        if length <= 30:
            raise ValueError(
                Message(
                    f"a window of {length} samples is too short for frequencies up to a tenth of "
                    "the sample rate: use a longer window («window_length=»)«, or give the "
                    "frequencies (omega=)»"
                )
            )
        return np.geomspace(6 * np.pi / (length * dt), 2 * np.pi / (10 * dt), 100)


_LENGTHS = 5
_CYCLES = 20  # of the highest frequency, in the shortest window


class Composite(eqx.Module):
    """Averaged spectra of several window lengths, combined at every frequency (CIFER's COMPOSITE).

    Long windows resolve the low frequencies; short ones average more, which is better at high
    frequencies. The spectra of each pair are weighted by (eps_i / eps_min)^-4 of their random
    errors (Tischler and Remple, "Aircraft and Rotorcraft System Identification", eq. 10.4).

    **Arguments:**

    - `windows`: lengths in s, rounded to whole blocks of samples that they share; by default five,
        log-spaced from a third of all records together (half a record at most) to 20 cycles of the
        highest frequency.
    - `overlap`, `shape`, `detrend`, `integrators`, `delay`: as in `Welch`.

    **Raises:**

    - `ValueError`: for values out of range, and for no window or two equal ones.
    """

    windows: tuple[float, ...] | None = eqx.field(static=True, default=None)
    overlap: float = eqx.field(static=True, default=0.8)
    shape: str = eqx.field(static=True, default="hann")
    detrend: str = eqx.field(static=True, default="constant")
    integrators: int = eqx.field(static=True, default=0)
    delay: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        if self.windows is not None and len(set(self.windows)) < max(len(self.windows), 1):
            raise ValueError(f"windows are {self.windows}: give one or more different lengths in s")
        for length in self.windows or (None,):
            self._welch(length)

    def windowed(
        self, records: Sequence[Record], omega: Float[ArrayLike, " frequencies"] | None
    ) -> tuple[Welch, ...]:
        """One estimator for each window length, the longest first."""
        lengths = self.windows or self._lengths(records, omega)
        return tuple(self._welch(length) for length in sorted(lengths, reverse=True))

    def _lengths(
        self, records: Sequence[Record], omega: Float[ArrayLike, " frequencies"] | None
    ) -> list[float]:
        dt = records[0].dt
        spans = [(record.samples - self.integrators) * dt for record in records]
        longest = min(max(spans) / 2, sum(spans) / 3, min(spans) * 0.9)
        highest = 2 * np.pi / (10 * dt) if omega is None else float(np.max(omega))
        shortest = np.clip(_CYCLES * 2 * np.pi / highest, longest / 10, longest)
        return np.unique(np.geomspace(shortest, longest, _LENGTHS)).tolist()

    def _welch(self, length: float | None) -> Welch:
        return Welch(length, self.overlap, self.shape, self.detrend, self.integrators, self.delay)


_DRIFT = 0.02  # samples by which the periods of a record may shift against its clock


class Periodic(eqx.Module):
    """Averages over whole periods of a periodic excitation, at its own harmonics only.

    Several records are taken as realisations with different phases: their scatter beyond the noise
    is nonlinear distortion, and the response is the best linear approximation. Source: Pintelon and
    Schoukens, "System Identification", 2nd ed., sections 2.5 and 4.3.1 (robust method).

    **Arguments:**

    - `period`: in s, a whole number of samples.
    - `discard`: number of periods at the start of each record that are left out as transient.

    **Raises:**

    - `ValueError`: for values out of range.
    """

    period: float = eqx.field(static=True)
    discard: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if not 0 < self.period < np.inf:
            raise ValueError(f"period is {self.period} s: it must be positive and finite")
        if self.discard < 0 or self.discard != int(self.discard):
            raise ValueError(f"discard is {self.discard}: use a whole number of periods, 0 or more")

    def samples(self, record: Record) -> int:
        """Samples in a period; `ValueError` unless this is a whole number."""
        exact = self.period / record.dt
        samples = int(round(exact))
        shift = abs(exact - samples) * record.samples / max(exact, 1.0)
        if samples < 4 or shift > _DRIFT:
            raise ValueError(
                f"the period of {self.period:.8g} s is {exact:.8g} samples at "
                f"{record.sample_rate:.6g} Hz, not a whole number of at least 4: over the record "
                f"the periods shift by {shift:.3g} samples (limit {_DRIFT}). Give the exact "
                "period, or read the record with a sample rate at which it is a whole number of "
                "samples"
            )
        return samples


class JointInputOutput(eqx.Module):
    """Response estimated with external references r: G = S_ry S_ru^-1, unbiased in closed loop.

    The noise that the controller feeds back to the input is uncorrelated with the references, so it
    averages out; in the direct estimate it does not. There must be one reference for each input,
    and none may be computed from the outputs. Source: joint input-output method (Tischler and
    Remple, "Aircraft and Rotorcraft System Identification"; instrumental variables in Pintelon and
    Schoukens, "System Identification", 2nd ed., section 2.6).

    **Arguments:**

    - `spectra`: any of the other estimators.
    """

    spectra: Welch | Composite | LocalPolynomial | Periodic = LocalPolynomial()


Estimator = Welch | Composite | LocalPolynomial | Periodic | JointInputOutput
