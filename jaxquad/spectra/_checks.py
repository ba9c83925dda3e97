import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import ArrayLike, Float

from jaxquad.records import Record


_MOST_FREQUENCIES = 1024  # the covariance of a pair is made between all of them


def check_alike(records: Sequence[Record]) -> None:
    """Raise `ValueError` unless the records can be averaged."""
    if not records:
        raise ValueError("no record given: pass one jq.Record or a list of them")
    first = records[0]
    for other in records[1:]:
        if not math.isclose(other.dt, first.dt, rel_tol=1e-6):
            raise ValueError(
                f"records sampled at {first.sample_rate:.6g} and {other.sample_rate:.6g} Hz cannot "
                "be averaged: read them with the same sample_rate"
            )
        names = (other.input_names, other.output_names, other.reference_names)
        if names != (first.input_names, first.output_names, first.reference_names):
            raise ValueError(f"records hold different channels: {first} and {other}")


def check_distinct(records: Sequence[Record]) -> None:
    """Raise `ValueError` for a record given twice, or a channel that is another one."""
    for k, record in enumerate(records):
        if any(_same(record.outputs, other.outputs) for other in records[:k]):
            raise ValueError(f"record {k} of {len(records)} is there twice: its noise counts once")
        columns = [record.channel(name) for name in record.names]
        for a, name in enumerate(record.names):
            for b in range(a):
                if _same(columns[a], columns[b]):
                    raise ValueError(
                        f"{name!r} is the same signal as {record.names[b]!r}: a response needs an "
                        "input and an output, and a reference that comes from outside"
                    )


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Equality; most signals differ in their first samples."""
    return np.array_equal(a[:64], b[:64]) and np.array_equal(a, b)


def check_references(records: Sequence[Record]) -> None:
    """Raise `ValueError` unless there is one outside reference for each input."""
    names, inputs = records[0].reference_names, records[0].input_names
    if len(names) != len(inputs):
        raise ValueError(
            f"the joint estimate needs one outside reference for each input, the record has "
            f"{len(names)} references {list(names)} for {len(inputs)} inputs {list(inputs)}: name "
            "them with references=[...], pick channels with jq.records.select, or use "
            "estimator=jq.spectra.Composite()"
        )


def check_moving(
    records: Sequence[Record], method: Literal["direct", "joint"]
) -> Float[np.ndarray, " channels"]:
    """About the largest value of each channel; `ValueError` for one that never moves."""
    first = records[0]
    names = first.input_names + (first.reference_names if method == "joint" else ())
    largest = []
    for name in first.names:
        columns = [record.channel(name) for record in records]
        # A few thousand samples show the size, and nearly always that a channel moves.
        thin = [column[:: max(column.size // 2048, 1)] for column in columns]
        still = all(np.ptp(part) == 0 for part in thin)
        if still and all(np.ptp(column) == 0 for column in columns):
            if name in names + first.output_names:
                raise ValueError(f"no excitation: {name!r} is constant; check that it was logged")
        largest.append(max(float(np.max(np.abs(part))) for part in thin))
    return np.array(largest)


def check_band(omega: Float[ArrayLike, " frequencies"] | None, dt: float) -> None:
    """Raise `ValueError` for frequencies that no record at this rate can have."""
    if omega is None:
        return
    omega = np.asarray(omega, dtype=float)
    nyquist = np.pi / dt
    if omega.ndim != 1 or not 0 < omega.size <= _MOST_FREQUENCIES:
        raise ValueError(
            f"omega has shape {omega.shape}: give 1 to {_MOST_FREQUENCIES} frequencies in rad/s"
        )
    if not (np.all(np.diff(omega) > 0) and omega[0] > 0 and omega[-1] < nyquist):
        raise ValueError(
            f"omega must rise from above 0 to below the Nyquist frequency {nyquist:.4g} rad/s; "
            f"it runs from {omega.min():.4g} to {omega.max():.4g}"
        )
