"""The broken loop of a flight, from its reference, output and input alone."""

from typing import get_args, Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxquad._core import Message
from jaxquad.records import Record


_LINES = 40  # frequencies, log-spaced
_CYCLES = 4  # of the lowest frequency in a window
_WINDOWS = 10  # that a record is cut into, about
_COHERENT = 0.6  # magnitude-squared coherence from which a frequency counts

Entry = Literal["set-point", "plant input"]
_Grid = Float[np.ndarray, " frequencies"]


class BrokenLoop(NamedTuple):
    """The response of a loop L that is broken at its error, as `estimate_broken_loop` finds it.

    **Attributes:**

    - `omega`: rad/s.
    - `response`: L, with negative feedback: closed as 1 + L = 0.
    - `error`: standard error, relative and in rad.
    - `coherence`: of the reference with what it was estimated from.
    """

    omega: _Grid
    response: Complex[np.ndarray, " frequencies"]
    error: _Grid
    coherence: _Grid

    @property
    def crossover(self) -> float:
        """Where |L| falls through 1 for the last time, in rad/s; nan if not in the band."""
        return self._crossing(np.log(np.abs(self.response)))[0]

    @property
    def phase_margin(self) -> tuple[float, float]:
        """At the crossover, with its standard error, in rad."""
        place, k, share = self._crossing(np.log(np.abs(self.response)))
        if np.isnan(place):
            return float("nan"), float("nan")
        phase = np.unwrap(np.angle(-self.response))
        margin = phase[k] + share * (phase[k + 1] - phase[k])
        turn = 2 * np.pi
        return float((margin + np.pi) % turn - np.pi), float(self.error[k : k + 2].max())

    @property
    def gain_margin(self) -> tuple[float, float]:
        """Factor at the first crossing of -180 deg beyond the crossover, and where in rad/s."""
        phase = np.unwrap(np.angle(-self.response))
        start = np.searchsorted(self.omega, self.crossover) if self.crossover > 0 else 0
        phase = phase - 2 * np.pi * np.round(phase[min(start, phase.size - 1)] / (2 * np.pi))
        falls = [k for k in np.flatnonzero(np.diff(np.sign(phase)) < 0) if k + 1 >= start]
        if not falls:
            return float("nan"), float("nan")
        k = int(falls[0])
        share = phase[k] / (phase[k] - phase[k + 1])
        level = np.log(np.abs(self.response))
        place = np.log(self.omega)
        gain = level[k] + share * (level[k + 1] - level[k])
        return float(np.exp(-gain)), float(np.exp(place[k] + share * (place[k + 1] - place[k])))

    def _crossing(self, level: _Grid) -> tuple[float, int, float]:
        falls = np.flatnonzero((level[:-1] > 0) & (level[1:] <= 0))
        if not falls.size:
            return float("nan"), 0, 0.0
        k = int(falls[-1])
        share = float(level[k] / (level[k] - level[k + 1]))
        place = np.log(self.omega)
        return float(np.exp(place[k] + share * (place[k + 1] - place[k]))), k, share


def estimate_broken_loop(
    record: Record,
    *,
    entry: Entry,
    reference: str | None = None,
    output: str | None = None,
    input: str | None = None,
    band: tuple[float, float] | None = None,
) -> BrokenLoop:
    """Estimate the broken loop L of a flight, without knowing plant or controller.

    A reference that is compared with the output closes as y = T r, T = L / (1 + L), so that
    L = T / (1 - T). One that is added to the plant's input closes as u = S r, S = 1 / (1 + L), so
    that L = 1 / S - 1. T and S are averages over tapered windows and neighbouring frequencies, and
    their errors are propagated to first order.
    Source: Tischler and Remple, "Aircraft and Rotorcraft System Identification", 2nd ed., sec. 5.7
    and 9.2 (the random error of an average).

    **Arguments:**

    - `record`: with a reference.
    - `entry`: where the reference enters, "set-point" or "plant input".
    - `reference`, `output`, `input`: channels, by default the first of each.
    - `band`: in rad/s; by default from four cycles in a window to a fifth of the sample rate.

    **Returns:** a `BrokenLoop` of the frequencies with a coherence of 0.6 or more; it may be empty.

    **Raises:** ValueError for a record without a reference, and for another entry.
    """
    if entry not in get_args(Entry):
        known = " or ".join(f"{each!r}" for each in get_args(Entry))
        raise ValueError(f"entry is {entry!r}: say where the reference enters, {known}")
    if reference is None and not record.reference_names:
        raise ValueError(
            Message(
                "the record has no reference, so its loop is not known: name one («reference=»)"
            )
        )
    source = reference or record.reference_names[0]
    answer = output or record.output_names[0]
    answer = answer if entry == "set-point" else input or record.input_names[0]
    omega, closed, error, coherence = _closed(record, source, answer, band)
    kept = (coherence >= _COHERENT) & (closed != 0) & (closed != 1)
    omega, closed, error, coherence = (x[kept] for x in (omega, closed, error, coherence))
    if entry == "set-point":
        loop, size = closed / (1 - closed), error / np.abs(1 - closed)
    else:
        loop, size = 1 / closed - 1, error / np.abs(1 - closed)
    return BrokenLoop(omega, loop, size, coherence)


def _closed(
    record: Record, source: str, answer: str, band: tuple[float, float] | None
) -> tuple[_Grid, Complex[np.ndarray, " frequencies"], _Grid, _Grid]:
    """Frequencies, transfer function, its relative error, coherence."""
    size = 2 * (record.samples // (_WINDOWS + 1))
    starts = np.arange(0, record.samples - size + 1, size // 2)
    taper = np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2
    one, other = (
        np.fft.rfft(taper * (x - x.mean())[starts[:, None] + np.arange(size)], axis=1)
        for x in (record.channel(source), record.channel(answer))
    )
    fine = 2 * np.pi * np.fft.rfftfreq(size, record.dt)
    low, high = band or (_CYCLES * fine[1], 0.2 * 2 * np.pi * record.sample_rate)
    edges = np.geomspace(max(low, 2 * fine[1]), min(high, fine[-2]), _LINES + 1)
    rows = [
        np.flatnonzero((fine >= a) & (fine < b)) for a, b in zip(edges, edges[1:], strict=False)
    ]
    rows = [row for row in rows if row.size]
    found = [_average(one[:, row], other[:, row], fine[row]) for row in rows]
    table = np.array(found, complex).reshape(-1, 4).T
    return table[0].real, table[1], table[2].real, table[3].real


def _average(
    one: np.ndarray, other: np.ndarray, omega: _Grid
) -> tuple[float, complex, float, float]:
    """Over windows and neighbours, at the frequency where the reference has its power."""
    each = np.abs(one) ** 2
    power = np.maximum(np.sum(each), 1e-150)
    cross = np.sum(np.conj(one) * other)
    whole = np.maximum(np.sum(np.abs(other) ** 2), 1e-150)
    # Windows that overlap, and neighbours of tapered spectra, are half as many as they seem.
    count = max(power**2 / np.maximum(np.sum(each**2), 1e-300) / 2, 1.0)
    raw = np.abs(cross) ** 2 / (power * whole)
    coherence = float(np.clip((count * raw - 1) / max(count - 1, 1e-3), 0.0, 1.0))
    error = np.sqrt((1 - coherence) / max(2 * count * coherence, 1e-9))
    middle = float(np.sum(each.sum(axis=0) * omega) / power)
    return middle, complex(cross / power), float(error), coherence
