"""Responses by averages over windows: one length (Welch) or several (Composite)."""

from collections.abc import Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxquad.records import Record

from ._average import average, Averaged
from ._checks import check_excited, check_windows, checked_omega
from ._conditioned import Channels
from ._error_covariance import ErrorCovariance, overlaps, place_windows
from ._estimators import Composite, Welch
from ._feedback import remarks_on_feedback
from ._frequency_response import FrequencyResponse
from ._segments import Segments, transform_records
from ._window import coefficients


_TOGETHER = 0.5  # average coherence between inputs above which the textbook warns
_LOST = 0.9999


def remarks_on_inputs(
    omega: Float[np.ndarray, " frequencies"],
    coherence: Float[np.ndarray, "frequencies inputs"],
    names: Sequence[str],
) -> tuple[str, ...]:
    """`coherence` is the multiple coherence of each input with all others."""
    if len(names) < 2:
        return ()
    remarks = []
    for i, name in enumerate(names):
        lost = coherence[:, i] > _LOST
        if np.any(lost):
            span = omega[lost]
            remarks.append(
                f"input {name} cannot be told from the others at {lost.sum()} of {omega.size} "
                f"frequencies ({span[0]:.3g}..{span[-1]:.3g} rad/s), which are left out: move the "
                "inputs independently, one sweep after the other or with interleaved multisines"
            )
        elif np.mean(coherence[:, i]) > _TOGETHER:
            remarks.append(
                f"input {name} moves with the others: their coherence averages "
                f"{coherence[:, i].mean():.2f}, above 0.5; conditioned responses have larger errors"
            )
    return tuple(remarks)


Method = Literal["direct", "joint"]
_CYCLES = 2.0  # in a window, below which leakage outweighs what more averages gain
_FEW = (
    "only {count:.1f} independent windows: coherence is near 1 whatever the signals do, and errors "
    "are rough; record longer, or use a shorter window"
)


def by_windows(
    records: Sequence[Record],
    omega: Float[np.ndarray, " frequencies"] | None,
    spectra: Welch | Composite,
    method: Method,
) -> FrequencyResponse:
    """Averages over tapered windows of one or of several lengths."""
    members = (spectra,) if isinstance(spectra, Welch) else spectra.members(records, omega)
    omega = checked_omega(omega, records, members[0])
    segments = transform_records(records, omega, members)
    channels = _channels(records[0], method)
    independent = _independent(records, segments)
    check_windows(independent, segments, channels)
    found = average(
        segments.transforms, channels, omega, overlaps(segments.groups, members[0].shape),
        _scales(segments, members[0], records[0].dt), _resolved(segments, omega * records[0].dt),
        _freedom(independent, segments, members[0], channels.inputs),
    )  # fmt: skip
    check_excited(omega, np.asarray(found.excitation), records, members[0], method)
    return _result(records, omega, members, segments, found, method)


def _channels(record: Record, method: Method) -> Channels:
    instruments = len(record.reference_names) if method == "joint" else 0
    return Channels(len(record.input_names), len(record.output_names), instruments)


def _independent(records: Sequence[Record], segments: Segments) -> list[float]:
    """Windows that do not overlap, for each length (n_d)."""
    return [sum(record.samples for record in records) / length for length, _ in segments.groups]


def _scales(segments: Segments, welch: Welch, dt: float) -> Float[np.ndarray, " groups"]:
    """From mean squared transforms to one-sided densities."""
    level, cosine = coefficients(welch.shape)
    energy = level**2 + cosine**2 / 2
    return np.array([2 * dt / (energy * length) for length, _ in segments.groups])


def _resolved(
    segments: Segments, angle: Float[np.ndarray, " frequencies"]
) -> Bool[np.ndarray, "groups frequencies"]:
    """Where a window holds `_CYCLES`; the longest serves everywhere."""
    lengths = np.array([length for length, _ in segments.groups], float)
    lengths[0] = np.inf
    return angle[None, :] * lengths[:, None] >= 2 * np.pi * _CYCLES


def _freedom(
    independent: list[float], segments: Segments, welch: Welch, inputs: int
) -> Float[np.ndarray, "groups 2"]:
    """Independent windows and the residuals' degrees of freedom, less those that inputs take."""
    shared, at, rows = overlaps(segments.groups, welch.shape), 0, []
    for count, (_, starts) in zip(independent, segments.groups, strict=True):
        mine = shared[at : at + len(starts), at : at + len(starts)]
        left = np.trace(mine) ** 2 / np.sum(mine**2) - inputs
        rows.append((max(count - inputs + 1, 0.5), max(float(left), 0.5)))
        at += len(starts)
    return np.array(rows)


def _result(
    records: Sequence[Record],
    omega: Float[np.ndarray, " frequencies"],
    members: Sequence[Welch],
    segments: Segments,
    found: Averaged,
    method: Method,
) -> FrequencyResponse:
    first, dt = records[0], records[0].dt
    independent = _independent(records, segments)
    remarks = remarks_on_feedback(
        method, omega, *(_pairs(each) for each in (
            np.angle(found.response), found.random_error, found.coherence, found.direct_coherence
        ))
    )  # fmt: skip
    remarks += remarks_on_inputs(omega, np.asarray(found.input_coherence), first.input_names)
    if max(independent) < 3:
        remarks += (_FEW.format(count=max(independent)),)
    counts = tuple(len(starts) for _, starts in segments.groups)
    windows = place_windows(segments.groups, members[0].shape, dt, omega[-1] - omega[0])
    grid = jnp.asarray(omega)
    return FrequencyResponse(
        omega=grid,
        response=found.response,
        coherence=found.coherence,
        random_error=found.random_error,
        errors=ErrorCovariance(grid, found.effect, found.noise, found.share, windows, counts),
        direct_coherence=found.direct_coherence,
        multiple_coherence=found.multiple_coherence,
        method=method,
        input_names=first.input_names,
        output_names=first.output_names,
        remarks=remarks,
        integrators=members[0].integrators,
        resolution=2 * np.pi / (segments.groups[0][0] * dt),
    )


def _pairs(columns) -> Float[np.ndarray, "frequencies pairs"]:
    return np.asarray(columns).reshape(len(columns), -1)
