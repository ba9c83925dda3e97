"""Settings of estimators, and what they share: shapes of arrays, checks of records, remarks."""

import functools as ft
import math
from collections.abc import Callable, Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from jaxquad._core import Message
from jaxquad.records import Record

from ._fourier_sums import coefficients


Method = Literal["direct", "joint"]
Grid = Float[np.ndarray, " frequencies"]  # rad/s
Where = Bool[np.ndarray, " frequencies"]
Places = Int[np.ndarray, " frequencies"]
Levels = Float[np.ndarray, "frequencies outputs"]
Pairs = Float[np.ndarray, "frequencies outputs inputs"]
Response = Complex[np.ndarray, " frequencies"]
Responses = Complex[np.ndarray, "frequencies outputs inputs"]
Covariances = Complex[np.ndarray, "frequencies outputs outputs"]
Square = Float[np.ndarray, "frequencies frequencies"]

_MOST_FREQUENCIES = 1024  # the covariance of a pair is made between all of them
COHERENT = 0.6  # magnitude-squared coherence from which a frequency is commonly used


def diagonal(matrix: Complex[np.ndarray, "*batch rows rows"]) -> Float[np.ndarray, "*batch rows"]:
    """The real diagonals of Hermitian matrices."""
    return np.real(np.diagonal(matrix, axis1=-2, axis2=-1))


def adjoint(matrix: Complex[np.ndarray, "*batch rows columns"]) -> np.ndarray:
    """Transposed and conjugate matrices."""
    return np.conj(np.swapaxes(matrix, -2, -1))


def sums_between(
    x: Float[np.ndarray, "..."], first: Int[np.ndarray, " some"], last: Int[np.ndarray, " some"]
) -> Float[np.ndarray, "..."]:
    """Sums of the rows from each of `first` to before each of `last`."""
    running = np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)])
    return running[last] - running[first]


def power_of(x: Complex[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The square of the absolute value, which itself takes a library as long as ten products."""
    return np.real(x) ** 2 + np.imag(x) ** 2


def in_hertz(omega: Grid) -> str:
    """The range of frequencies as messages give it: `2.3 to 619 rad/s (0.37 to 98.5 Hz)`."""
    ends = np.unique([np.min(omega), np.max(omega)])
    rad, hertz = (" to ".join(f"{x:.3g}" for x in part) for part in (ends, ends / (2 * np.pi)))
    return f"{rad} rad/s ({hertz} Hz)"


def compatible(record: Record | Sequence[Record]) -> list[Record]:
    """As a list; `ValueError` unless all have the same channels, sample rate and hold."""
    records = [record] if isinstance(record, Record) else list(record)
    if not records:
        raise ValueError("no record is given: pass one jq.Record or a list of them")
    odd = [type(one).__name__ for one in records if not isinstance(one, Record)]
    if odd:
        raise ValueError(
            f"the records hold a {odd[0]}: pass one jq.Record or a list of them, see jq.read"
        )
    first = records[0]
    for other in records[1:]:
        if not math.isclose(other.dt, first.dt, rel_tol=1e-6):
            raise ValueError(
                Message(
                    f"the records are sampled at {first.sample_rate:.6g} and "
                    f"{other.sample_rate:.6g} Hz: read them with the same sample rate "
                    "(«sample_rate=»)"
                )
            )
        names = (other.input_names, other.output_names, other.reference_names)
        if names != (first.input_names, first.output_names, first.reference_names):
            raise ValueError(f"the records have different channels: {first} and {other}")
        if other.hold != first.hold:
            raise ValueError(
                Message(
                    f"the inputs of the records are held for {first.hold} and {other.hold} s: give "
                    "all records of one response the same hold («hold=»)"
                )
            )
    return records


def check_distinct(records: Sequence[Record]) -> None:
    """Raise `ValueError` for a record given twice, or a channel that is another one."""
    for k, record in enumerate(records):
        if any(_same(record.outputs, other.outputs) for other in records[:k]):
            raise ValueError(
                f"record {k} of {len(records)} is given twice: its errors would seem smaller than "
                "they are"
            )
        columns = [record.channel(name) for name in record.names]
        for a, name in enumerate(record.names):
            for b in range(a):
                if _same(columns[a], columns[b]):
                    if np.ptp(columns[a]) == 0:
                        raise ValueError(
                            f"{record.names[b]!r} and {name!r} are both {columns[a][0]:g} "
                            "throughout: choose channels that move, or another part of the log"
                        )
                    raise ValueError(
                        f"{name!r} is the same signal as {record.names[b]!r}: choose different "
                        "channels for input, output and reference"
                    )


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Equality; most signals differ in their first samples."""
    return np.array_equal(a[:64], b[:64]) and np.array_equal(a, b)


def check_references(records: Sequence[Record], others: int = 0) -> None:
    """Raise `ValueError` unless there is one reference for each input, before the `others`."""
    names, inputs = records[0].reference_names, records[0].input_names
    if len(names) != len(inputs) + others:
        more = f" and {others} others" if others else ""
        raise ValueError(
            Message(
                "the joint estimate needs one external reference for each input, but the record "
                f"has {len(names)} references {list(names)} for {len(inputs)} inputs "
                f"{list(inputs)}{more}. Name them («references=»), «select other channels with "
                "jq.records.select, or »use a direct estimate« "
                "(estimator=jq.spectra.LocalPolynomial())»"
            )
        )


def check_excitation(records: Sequence[Record], method: Method) -> Float[np.ndarray, " channels"]:
    """About the largest value of each channel; `ValueError` for one that is constant."""
    first = records[0]
    names = first.input_names + (first.reference_names if method == "joint" else ())
    # A few thousand samples show the size, and nearly always that a channel moves.
    ends = []
    for record in records:
        step = max(record.samples // 2048, 1)
        groups = record.inputs, record.outputs, record.references
        thin = np.concatenate([group[::step].T for group in groups])
        ends.append((np.min(thin, axis=1), np.max(thin, axis=1)))
    for k in np.flatnonzero(np.all([low == high for low, high in ends], axis=0)):
        name = first.names[k]
        if name in names + first.output_names:
            if all(np.ptp(record.channel(name)) == 0 for record in records):
                raise ValueError(
                    f"no excitation: {name!r} is constant. Check that it was excited and logged"
                )
    return np.max([np.maximum(high, -low) for low, high in ends], axis=0)


def check_band(omega: Float[np.ndarray, "..."] | None, dt: float) -> None:
    """Raise `ValueError` for frequencies that no record at this rate can have."""
    if omega is None:
        return
    nyquist = np.pi / dt
    if omega.ndim != 1 or not 0 < omega.size <= _MOST_FREQUENCIES:
        raise ValueError(
            f"omega has shape {omega.shape}: give 1 to {_MOST_FREQUENCIES} frequencies in rad/s"
        )
    falls = np.flatnonzero(~(np.diff(omega) > 0))
    if falls.size:
        raise ValueError(
            f"the frequencies must increase, but {omega[falls[0]]:.4g} rad/s is followed by "
            f"{omega[falls[0] + 1]:.4g} rad/s: sort them, each once"
        )
    if not (omega[0] > 0 and omega[-1] < nyquist):
        raise ValueError(
            f"the frequencies must lie above 0 and below the Nyquist frequency of "
            f"{nyquist:.4g} rad/s ({nyquist / (2 * np.pi):.4g} Hz); they run from "
            f"{omega.min():.4g} to {omega.max():.4g} rad/s"
        )


Pair = tuple[str, str]  # output, input
DOMINATED, EARLY = "feedback-dominated", "output before input"  # kinds of remarks


class Remark(Message):
    """A sentence about a response that knows which frequencies it is about.

    It is the text itself, so it prints, joins and compares like any other string.

    **Arguments:**

    - `text`: what happened, the number, and what to do. `{where}` stands for the frequencies.
    - `omega`: the frequencies that it is about, in rad/s; none for the response as a whole.
    - `pair`: names of the output and the input that it is about; `None` for all pairs.
    - `kind`: what it is about, such as "leakage" or "nonlinear", for code that decides by it.
    """

    text: str
    omega: tuple[float, ...]
    pair: Pair | None

    def __new__(
        cls,
        text: str,
        omega: Sequence[float] | Float[np.ndarray, " points"] = (),
        pair: Pair | None = None,
        kind: str = "",
    ) -> "Remark":
        points = tuple(float(x) for x in omega)
        place = "everywhere"
        if points:
            place = "near" if len(points) == 1 else f"at {len(points)} frequencies,"
            place = f"{place} {in_hertz(np.array(points))}"
        sentence = text.replace("{where}", place)
        self: Remark = super().__new__(cls, sentence, kind)  # pyright: ignore[reportAssignmentType]
        self.text, self.omega, self.pair = text, points, pair
        return self

    def __getnewargs__(self) -> tuple[str, tuple[float, ...], Pair | None, str]:
        return self.text, self.omega, self.pair, self.kind

    def within(self, omega: Float[np.ndarray, " used"]) -> "Remark | None":
        """The same about those of its frequencies that are in `omega`; `None` for none of them."""
        if not self.omega:
            return self
        kept = [x for x in self.omega if np.any(np.abs(omega - x) <= 1e-9 * x)]
        return Remark(self.text, kept, self.pair, self.kind) if kept else None


class Remarks(Sequence[Remark]):
    """Remarks that are found when they are first looked at: tests take longer than an estimate."""

    def __init__(self, find: Callable[[], tuple[Remark, ...]]):
        self._find = find

    @ft.cached_property
    def _remarks(self) -> tuple[Remark, ...]:
        remarks = self._find()
        del self._find  # and with it the records
        return remarks

    def __len__(self) -> int:
        return len(self._remarks)

    def __getitem__(self, place):
        return self._remarks[place]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, tuple | Remarks) and self._remarks == tuple(other)

    def __hash__(self) -> int:
        return hash(self._remarks)

    def __repr__(self) -> str:
        return repr(self._remarks)

    def __reduce__(self) -> tuple[type[tuple], tuple[tuple[Remark, ...]]]:
        return tuple, (self._remarks,)


def _check_colour(integrators: int, delay: float) -> None:
    if integrators not in (0, 1, 2, 3):
        raise ValueError(f"integrators is {integrators}: use 0 to 3")
    if not 0 <= delay < 10:
        raise ValueError(f"delay is {delay} s: use 0 to 10 s")


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

    **Raises:** ValueError for values out of range.
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
        _check_colour(self.integrators, self.delay)


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

    **Raises:** ValueError for values out of range.
    """

    window_length: float | None = eqx.field(static=True, default=None)
    overlap: float = eqx.field(static=True, default=0.8)
    shape: str = eqx.field(static=True, default="hann")
    detrend: str = eqx.field(static=True, default="constant")
    integrators: int = eqx.field(static=True, default=0)
    delay: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        coefficients(self.shape)
        if not 0 <= self.overlap < 1:
            raise ValueError(
                f"overlap is {self.overlap}: it must be at least 0 and below 1 (usually 0.5 or 0.8)"
            )
        if self.detrend not in ("none", "constant", "linear"):
            raise ValueError(f"detrend is {self.detrend!r}: use none, constant or linear")
        _check_colour(self.integrators, self.delay)
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

    **Raises:** ValueError for values out of range, and for no window or two equal ones.
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

    def windowed(self, records: Sequence[Record], omega: Grid | None) -> tuple[Welch, ...]:
        """One estimator for each window length, the longest first."""
        lengths, dt = self.windows, records[0].dt
        if not lengths:
            spans = [(record.samples - self.integrators) * dt for record in records]
            longest = min(max(spans) / 2, sum(spans) / 3, min(spans) * 0.9)
            highest = 2 * np.pi / (10 * dt) if omega is None else float(np.max(omega))
            shortest = np.clip(_CYCLES * 2 * np.pi / highest, longest / 10, longest)
            lengths = np.unique(np.geomspace(shortest, longest, _LENGTHS)).tolist()
        return tuple(self._welch(length) for length in sorted(lengths, reverse=True))

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

    **Raises:** ValueError for values out of range.
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


# To add one: settings here, and a function of (records, omega, settings, method) that returns an
# `Estimate`, as `estimate_periodic`, which `frequency_response` calls.
DirectEstimator = Welch | Composite | LocalPolynomial | Periodic


class JointInputOutput(eqx.Module):
    """Response estimated with external references r: G = S_ry S_ru^-1, unbiased in closed loop.

    The noise that the controller feeds back to the input is uncorrelated with the references, so it
    averages out; in the direct estimate it does not. There must be one reference for each input,
    and none may be computed from the outputs. Source: joint input-output method (Tischler and
    Remple, "Aircraft and Rotorcraft System Identification"; instrumental variables in Pintelon and
    Schoukens, "System Identification", 2nd ed., section 2.6).

    **Arguments:**

    - `spectra`: any of the other estimators.
    - `others`: how many of the last references are signals of another kind, which move the outputs
        beside the inputs, such as another axis' command: their part is taken out.

    **Raises:** ValueError for `others` without local polynomials.
    """

    spectra: DirectEstimator = LocalPolynomial()
    others: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        if self.others and not isinstance(self.spectra, LocalPolynomial):
            raise ValueError(
                f"others is {self.others}, which needs local polynomials: leave it out, or give "
                "jq.spectra.LocalPolynomial()"
            )


Estimator = DirectEstimator | JointInputOutput
