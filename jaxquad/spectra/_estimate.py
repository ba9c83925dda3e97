from collections.abc import Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float, Int

from jaxquad.records import Record

from ._checks import (
    check_alike,
    check_distinct,
    check_excited,
    check_one_input,
    check_reference,
    checked_omega,
)
from ._feedback import remarks_on_feedback
from ._frequency_response import FrequencyResponse
from ._random_error import relative_covariance, window_grid
from ._welch import transform_records, Welch


_FEW = (
    "only {count:.1f} independent windows: coherence is near 1 whatever the signals do, and errors "
    "are rough; record longer, or use a shorter window"
)


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
    Without an `estimator`, the joint input-output estimate where the record has a reference,
    otherwise the direct one, H1 = S_uy / S_uu (Eq. 13), which then says that feedback may bias it.
    Raises `ValueError` for an unusable band or record, `PrecisionError` in 32 bits.
    """
    records = [record] if isinstance(record, Record) else list(record)
    check_alike(records)
    check_one_input(records)
    check_distinct(records)
    if estimator is None:
        estimator = JointInputOutput() if records[0].reference_names else Welch()
    if isinstance(estimator, JointInputOutput):
        check_reference(records)
        welch, method = estimator.welch, "joint"
    else:
        welch, method = estimator, "direct"
    return _respond(records, checked_omega(omega, records, welch), welch, method)


def _respond(
    records: Sequence[Record],
    omega: Float[np.ndarray, " frequencies"],
    welch: Welch,
    method: Literal["direct", "joint"],
) -> FrequencyResponse:
    segments = transform_records(records, omega, welch)
    times, windows = window_grid(welch.shape, segments.length, segments.starts)
    dt, outputs = records[0].dt, len(records[0].output_names)
    estimate = _by_instrument(
        segments.transforms, outputs, np.asarray(0 if method == "direct" else 1 + outputs),
        omega, times * dt, windows, np.asarray(2 * np.pi / (segments.length * dt)),
    )  # fmt: skip
    check_excited(omega, np.asarray(estimate.excitation), records, welch, method)
    columns = np.angle(estimate.response), estimate.random_error, estimate.coherence
    remarks = remarks_on_feedback(
        method, omega, *(np.asarray(c)[:, :, 0] for c in (*columns, estimate.direct_coherence))
    )
    independent = sum(record.samples for record in records) / segments.length
    if independent < 3:
        remarks += (_FEW.format(count=independent),)
    return FrequencyResponse(
        omega=jnp.asarray(omega),
        response=estimate.response,
        coherence=estimate.coherence,
        random_error=estimate.random_error,
        relative_covariance=estimate.relative_covariance,
        direct_coherence=estimate.direct_coherence,
        method=method,
        input_names=records[0].input_names,
        output_names=records[0].output_names,
        remarks=remarks,
        integrators=welch.integrators,
        resolution=2 * np.pi / (segments.length * dt),
    )


class Estimate(NamedTuple):
    response: Complex[Array, "frequencies outputs 1"]
    coherence: Float[Array, "frequencies outputs 1"]
    random_error: Float[Array, "frequencies outputs 1"]
    direct_coherence: Float[Array, "frequencies outputs 1"]
    relative_covariance: Complex[Array, "outputs 1 frequencies frequencies"]
    excitation: Float[Array, "channels frequencies"]  # power of the input, and of the reference


@eqx.filter_jit
def _by_instrument(
    transforms: Complex[Array, "segments frequencies channels"],
    outputs: int,
    instrument: Int[ArrayLike, ""],  # its channel
    omega: Float[ArrayLike, " frequencies"],
    times: Float[ArrayLike, " times"],
    windows: Float[ArrayLike, "segments times"],
    resolution: Float[ArrayLike, ""],
) -> Estimate:
    x = transforms[:, :, 0]
    z = jnp.take(transforms, instrument, axis=2)
    grid = [jnp.asarray(each) for each in (omega, times, windows, resolution)]
    columns, covariances = [], []
    for y in jnp.moveaxis(transforms[:, :, 1 : 1 + outputs], 2, 0):
        response = jnp.sum(jnp.conj(z) * y, axis=0) / jnp.sum(jnp.conj(z) * x, axis=0)
        covariances.append(relative_covariance(z, x, y, response, *grid))
        error = jnp.sqrt(jnp.real(jnp.diagonal(covariances[-1])) / 2)
        lesser = jnp.minimum(_coherence(z, y), _coherence(z, x))
        columns.append((response, lesser, error, _coherence(x, y)))
    response, coherence, error, direct = (
        jnp.stack(part, axis=1)[:, :, None] for part in zip(*columns, strict=True)
    )
    excitation = jnp.stack([jnp.mean(jnp.abs(each) ** 2, axis=0) for each in (x, z)])
    covariance = jnp.stack(covariances)[:, None]
    return Estimate(response, coherence, error, direct, covariance, excitation)


def _coherence(
    a: Complex[Array, "segments frequencies"], b: Complex[Array, "segments frequencies"]
) -> Float[Array, " frequencies"]:
    """Magnitude-squared coherence, from 0 to 1."""
    power = jnp.sum(jnp.abs(a) ** 2, axis=0) * jnp.sum(jnp.abs(b) ** 2, axis=0)
    return jnp.abs(jnp.sum(jnp.conj(a) * b, axis=0)) ** 2 / power
