from collections.abc import Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import one_blas_thread, require_x64
from jaxquad.records import Record

from ._checks import check_alike, check_band, check_distinct, check_moving, check_references
from ._estimators import Composite, JointInputOutput, LocalPolynomial, Periodic, Welch
from ._feedback import remarks_on_feedback
from ._frequency_response import FrequencyResponse
from ._local_estimate import estimate_local_polynomial, LocalEstimate
from ._periodic import estimate_periodic, PeriodicEstimate
from ._welch import by_windows


_CYCLES = 5.0  # of the longest record, in the lowest frequency by default

Method = Literal["direct", "joint"]
Grid = Float[np.ndarray, " frequencies"]


@one_blas_thread()
def by_polynomial(
    records: Sequence[Record], omega: Grid | None, options: LocalPolynomial, method: Method
) -> FrequencyResponse:
    """Local polynomials in frequency, which leakage does not bias."""
    check_moving(records, method)
    if omega is None:
        lowest = 2 * np.pi * _CYCLES / max(record.duration for record in records)
        omega = np.geomspace(lowest, 2 * np.pi / (10 * records[0].dt), 100)
    found = estimate_local_polynomial(records, omega, options, method)
    return _result(records, omega, found, method, options.integrators)


def by_period(
    records: Sequence[Record], omega: Grid | None, options: Periodic, method: Method
) -> FrequencyResponse:
    """Averages over the periods of a periodic excitation, at its lines."""
    check_moving(records, method)
    found = estimate_periodic(records, omega, options, method)
    return _result(records, found.omega, found, method, 0)


def _result(
    records: Sequence[Record],
    omega: Grid,
    found: LocalEstimate | PeriodicEstimate,
    method: Method,
    integrators: int,
) -> FrequencyResponse:
    known = np.isfinite(np.asarray(found.response))
    spread = np.sqrt(np.asarray(found.errors.variance()) / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(known, spread / np.abs(np.asarray(found.response)), np.inf)
    columns = np.angle(found.response), error, found.coherence, found.direct_coherence
    remarks = remarks_on_feedback(method, omega, *(_pairs(each) for each in columns))
    return FrequencyResponse(
        omega=jnp.asarray(omega),
        response=found.response,
        coherence=found.coherence,
        random_error=jnp.asarray(error),
        errors=found.errors,
        direct_coherence=found.direct_coherence,
        multiple_coherence=found.multiple_coherence,
        method=method,
        input_names=records[0].input_names,
        output_names=records[0].output_names,
        remarks=remarks + found.remarks,
        integrators=integrators,
        distortion=found.distortion if isinstance(found, PeriodicEstimate) else None,
    )


def _pairs(columns: np.ndarray | Array) -> Float[np.ndarray, "frequencies pairs"]:
    return np.nan_to_num(np.asarray(columns).reshape(len(columns), -1))


Estimator = Welch | Composite | LocalPolynomial | Periodic | JointInputOutput


def frequency_response(
    record: Record | Sequence[Record],
    omega: Float[ArrayLike, " frequencies"] | None = None,
    *,
    estimator: Estimator | None = None,
) -> FrequencyResponse:
    """Frequency responses of all outputs to all inputs, of one record or of several together.

    `omega` in rad/s, by default 100 log-spaced values within what the records can resolve.
    Several inputs are conditioned on each other. Without an `estimator`, local polynomials, by the
    joint input-output method where the record has references, otherwise direct, from input to
    output (H1, Eq. 13), which then says that feedback may bias it.
    Raises `ValueError` for an unusable band or record, `PrecisionError` in 32 bits.
    """
    require_x64("a frequency response")
    records = [record] if isinstance(record, Record) else list(record)
    check_alike(records)
    check_distinct(records)
    check_band(omega, records[0].dt)
    if estimator is None:
        estimator = JointInputOutput() if records[0].reference_names else LocalPolynomial()
    method = "direct"
    if isinstance(estimator, JointInputOutput):
        check_references(records)
        method, estimator = "joint", estimator.spectra
    asked = None if omega is None else np.asarray(omega, float)
    if isinstance(estimator, LocalPolynomial):
        return by_polynomial(records, asked, estimator, method)
    if isinstance(estimator, Periodic):
        return by_period(records, asked, estimator, method)
    return by_windows(records, asked, estimator, method)
