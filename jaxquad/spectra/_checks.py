import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from jaxquad._core import Message
from jaxquad.records import Record


_MOST_FREQUENCIES = 1024  # the covariance of a pair is made between all of them


def in_hertz(omega: Float[np.ndarray, " frequencies"]) -> str:
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


def check_excitation(
    records: Sequence[Record], method: Literal["direct", "joint"]
) -> Float[np.ndarray, " channels"]:
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
