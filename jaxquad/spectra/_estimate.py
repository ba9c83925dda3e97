import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from jaxquad.records import Record

from ._feedback import remarks_on_feedback
from ._frequency_response import FrequencyResponse
from ._random_error import relative_covariance, window_grid
from ._welch import transform_records, Welch


_MOST_FREQUENCIES = 1024  # the covariance between them is kept whole


class JointInputOutput(eqx.Module):
    """Response by way of an outside reference r: G = S_ry / S_ru, unbiased in closed loop.

    The noise that the controller feeds back to the input is uncorrelated with the reference,
    so it averages out; in the direct estimate it does not. `welch` sets windows and averaging.
    Needs a reference that no feedback computes. Source: joint input-output method, Tischler &
    Remple; instrumental variables.
    """

    welch: Welch = Welch()


def frequency_response(
    record: Record | Sequence[Record],
    omega: Float[ArrayLike, " frequencies"] | None = None,
    *,
    estimator: Welch | JointInputOutput | None = None,
) -> FrequencyResponse:
    """Frequency responses of all outputs to the input of one record, or of several taken together.

    `omega` in rad/s, by default 100 log-spaced values within what the window can resolve.
    Without an `estimator`, the joint input-output estimate where the record has a reference, otherwise
    the direct one, H1 = S_uy / S_uu (Eq. 13), which then says that feedback may bias it.
    Raises `ValueError` for an empty or unusable band, `PrecisionError` in 32 bits.
    """
    records = [record] if isinstance(record, Record) else list(record)
    _check_alike(records)
    if estimator is None:
        estimator = JointInputOutput() if records[0].reference_names else Welch()
    joint = isinstance(estimator, JointInputOutput)
    welch = estimator.welch if joint else estimator
    if joint and len(records[0].reference_names) != 1:
        raise ValueError(
            f"the joint estimate needs one outside reference, the record has "
            f"{len(records[0].reference_names)}: {list(records[0].reference_names)}; name one with "
            "references=[...], or use estimator=jq.Welch()"
        )
    method = "joint" if joint else "direct"
    return _respond(records, _checked_omega(omega, records, welch), welch, method)


def _respond(
    records: Sequence[Record],
    omega: Float[np.ndarray, " frequencies"],
    welch: Welch,
    method: Literal["direct", "joint"],
) -> FrequencyResponse:
    segments = transform_records(records, omega, welch)
    dt = records[0].dt
    times, windows = window_grid(welch.shape, segments.length, segments.starts)
    values = segments.transforms
    instrument = values["references" if method == "joint" else "inputs"][:, :, 0]
    estimate = _by_instrument(
        instrument, values["inputs"][:, :, 0], values["outputs"], jnp.asarray(omega),
        jnp.asarray(times * dt), jnp.asarray(windows),
        jnp.asarray(2 * np.pi / (segments.length * dt)),
    )  # fmt: skip
    lost = np.flatnonzero(~np.isfinite(np.asarray(estimate.response)).all(axis=(1, 2)))
    if lost.size:
        raise ValueError(
            f"no excitation at {omega[lost[0]]:.4g} rad/s: the input's spectrum is zero there; "
            "is a channel constant, or the band outside the excitation?"
        )
    columns = (np.angle(estimate.response), estimate.random_error, estimate.coherence)
    remarks = remarks_on_feedback(
        method, omega, *(np.asarray(c)[:, :, 0] for c in (*columns, estimate.direct_coherence))
    )
    return FrequencyResponse(
        jnp.asarray(omega), *estimate, method, records[0].input_names, records[0].output_names, remarks
    )


class Estimate(NamedTuple):
    response: Complex[Array, "frequencies outputs 1"]
    coherence: Float[Array, "frequencies outputs 1"]
    random_error: Float[Array, "frequencies outputs 1"]
    relative_covariance: Complex[Array, "outputs 1 frequencies frequencies"]
    direct_coherence: Float[Array, "frequencies outputs 1"]


@eqx.filter_jit
def _by_instrument(
    z: Complex[Array, "segments frequencies"],
    x: Complex[Array, "segments frequencies"],
    outputs: Complex[Array, "segments frequencies outputs"],
    omega: Float[Array, " frequencies"],
    times: Float[Array, " times"],
    windows: Float[Array, "segments times"],
    resolution: Float[Array, ""],
) -> Estimate:
    columns = []
    for o in range(outputs.shape[2]):
        y = outputs[:, :, o]
        response = jnp.sum(jnp.conj(z) * y, axis=0) / jnp.sum(jnp.conj(z) * x, axis=0)
        covariance = relative_covariance(z, x, y, response, omega, times, windows, resolution)
        error = jnp.sqrt(jnp.real(jnp.diagonal(covariance)) / 2)
        lesser = jnp.minimum(_coherence(z, y), _coherence(z, x))
        columns.append((response, lesser, error, covariance, _coherence(x, y)))
    stacked = [jnp.stack(parts, axis=0 if k == 3 else 1) for k, parts in enumerate(zip(*columns, strict=True))]
    return Estimate(*(jnp.expand_dims(part, 1 if k == 3 else 2) for k, part in enumerate(stacked)))


def _coherence(
    a: Complex[Array, "segments frequencies"], b: Complex[Array, "segments frequencies"]
) -> Float[Array, " frequencies"]:
    """Magnitude-squared coherence, from 0 to 1."""
    power = jnp.sum(jnp.abs(a) ** 2, axis=0) * jnp.sum(jnp.abs(b) ** 2, axis=0)
    return jnp.abs(jnp.sum(jnp.conj(a) * b, axis=0)) ** 2 / power


def _check_alike(records: Sequence[Record]) -> None:
    if not records:
        raise ValueError("no record given: pass one jq.Record or a list of them")
    first = records[0]
    for other in records[1:]:
        if not math.isclose(other.dt, first.dt, rel_tol=1e-6):
            raise ValueError(
                f"records sampled at {first.sample_rate:.6g} and {other.sample_rate:.6g} Hz cannot be "
                "averaged: read them with the same sample_rate"
            )
        names = (other.input_names, other.output_names, other.reference_names)
        if names != (first.input_names, first.output_names, first.reference_names):
            raise ValueError(f"records hold different channels: {first} and {other}")
    if len(first.input_names) != 1:
        raise ValueError(
            f"the record has {len(first.input_names)} inputs {list(first.input_names)}: "
            "one at a time; pick one with jq.select(record, inputs=[...])"
        )


def _checked_omega(omega, records, welch) -> Float[np.ndarray, " frequencies"]:
    if omega is None:
        return welch.default_omega(records)
    omega = np.asarray(omega, dtype=float)
    nyquist = np.pi / records[0].dt
    if omega.ndim != 1 or not 0 < omega.size <= _MOST_FREQUENCIES:
        raise ValueError(
            f"omega has shape {omega.shape}: give 1 to {_MOST_FREQUENCIES} frequencies in rad/s"
        )
    if not (np.all(np.diff(omega) > 0) and omega[0] > 0 and omega[-1] < nyquist):
        raise ValueError(
            f"omega must rise from above 0 to below the Nyquist frequency {nyquist:.4g} rad/s; "
            f"it runs from {omega.min():.4g} to {omega.max():.4g}"
        )
    lowest = 2 * np.pi / (welch.length(records) * records[0].dt)
    if omega[0] < 0.999 * lowest:
        raise ValueError(
            f"{omega[0]:.4g} rad/s is below the {lowest:.4g} rad/s that the window resolves "
            f"(one cycle): raise it, or set window_length above {2 * np.pi / omega[0]:.4g} s"
        )
    return omega
