"""Responses from the transforms of whole records, or of whole periods."""

from collections.abc import Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxquad.records import Record

from ._checks import check_moving
from ._feedback import remarks_on_feedback
from ._frequency_response import FrequencyResponse
from ._local_estimate import estimate_local_polynomial
from ._local_polynomial import LocalPolynomial
from ._one_blas_thread import one_blas_thread
from ._periodic import Periodic
from ._periodic_estimate import estimate_periodic


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
    records: Sequence[Record], omega: Grid, found: Any, method: Method, integrators: int
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
        distortion=getattr(found, "distortion", None),
    )


def _pairs(columns: Any) -> Float[np.ndarray, "frequencies pairs"]:
    return np.nan_to_num(np.asarray(columns).reshape(len(columns), -1))
