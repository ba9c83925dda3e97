"""What all estimators share: shapes of arrays, checks of records and frequencies, remarks."""

import functools as ft
import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from jaxquad._core import Message
from jaxquad.records import Record


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


def power_of(x: Complex[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The square of the absolute value, which itself takes a library as long as ten products."""
    return np.real(x) ** 2 + np.imag(x) ** 2


def in_hertz(omega: Grid) -> str:
    """The range of frequencies as messages give it: `2.3 to 619 rad/s (0.37 to 98.5 Hz)`."""
    ends = np.unique([np.min(omega), np.max(omega)])
    rad, hertz = (" to ".join(f"{x:.3g}" for x in part) for part in (ends, ends / (2 * np.pi)))
    return f"{rad} rad/s ({hertz} Hz)"


def check_compatible(records: Sequence[Record]) -> None:
    """Raise `ValueError` unless the records have the same channels, sample rate and hold."""
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
                    raise ValueError(
                        f"{name!r} is the same signal as {record.names[b]!r}: choose different "
                        "channels for input, output and reference"
                    )


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Equality; most signals differ in their first samples."""
    return np.array_equal(a[:64], b[:64]) and np.array_equal(a, b)


def check_references(records: Sequence[Record]) -> None:
    """Raise `ValueError` unless there is one external reference for each input."""
    names, inputs = records[0].reference_names, records[0].input_names
    if len(names) != len(inputs):
        raise ValueError(
            Message(
                "the joint estimate needs one external reference for each input, but the record "
                f"has {len(names)} references {list(names)} for {len(inputs)} inputs "
                f"{list(inputs)}. Name them («references=»), «select other channels with "
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
