from collections.abc import Sequence

import numpy as np
from jaxtyping import ArrayLike, Float

from jaxquad.records import Record

from ._checks import check_alike, check_band, check_distinct, check_references
from ._composite import Composite
from ._frequency_response import FrequencyResponse
from ._from_bins import by_period, by_polynomial
from ._from_windows import by_windows
from ._joint import JointInputOutput
from ._local_polynomial import LocalPolynomial
from ._periodic import Periodic
from ._precision import require_x64
from ._welch import Welch


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
