import functools as ft
from collections.abc import Sequence
from typing import Literal

import jax
import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from jaxquad._core import one_blas_thread, require_x64
from jaxquad.records import Record

from ._checks import (
    check_band,
    check_compatible,
    check_distinct,
    check_excitation,
    check_references,
)
from ._estimators import Composite, JointInputOutput, LocalPolynomial, Periodic, Welch
from ._feedback import remarks_on_feedback
from ._frequency_response import FrequencyResponse
from ._invariance import remarks_on_linearity
from ._local_polynomial import estimate_local_polynomial, LocalEstimate
from ._periodic import estimate_periodic, PeriodicEstimate
from ._remarks import Remark, Remarks
from ._welch import average_windows


_CYCLES = 2.0  # of the longest record, in the lowest frequency by default

Method = Literal["direct", "joint"]
Grid = Float[np.ndarray, " frequencies"]


@one_blas_thread()
def _by_polynomial(
    records: Sequence[Record], omega: Grid | None, options: LocalPolynomial, method: Method
) -> FrequencyResponse:
    """Response by local polynomials in frequency."""
    check_excitation(records, method)
    if omega is None:
        lowest = 2 * np.pi * _CYCLES / max(record.duration for record in records)
        omega = np.geomspace(lowest, 2 * np.pi / (10 * records[0].dt), 100)
    found = estimate_local_polynomial(records, omega, options, method)
    return _result(records, omega, found, method, options.integrators)


def _by_period(
    records: Sequence[Record], omega: Grid | None, options: Periodic, method: Method
) -> FrequencyResponse:
    """Response by averages over the periods of a periodic excitation, at its lines."""
    check_excitation(records, method)
    found = estimate_periodic(records, omega, options, method)
    return _result(records, found.omega, found, method, 0)


def _result(
    records: Sequence[Record],
    omega: Grid,
    found: LocalEstimate | PeriodicEstimate,
    method: Method,
    integrators: int,
) -> FrequencyResponse:
    response, coherence, direct = found.response, found.coherence, found.direct_coherence
    spread = np.sqrt(found.errors.variance() / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(np.isfinite(response), spread / np.abs(response), np.inf)
    # Not jnp.asarray: it compiles a program for each new shape.
    put = jax.device_put
    return FrequencyResponse(
        omega=put(omega),
        response=put(response),
        coherence=put(coherence),
        random_error=put(error),
        errors=found.errors,
        direct_coherence=put(direct),
        multiple_coherence=put(found.multiple_coherence),
        method=method,
        input_names=records[0].input_names,
        output_names=records[0].output_names,
        remarks=Remarks(ft.partial(_find_remarks, records, omega, found, error, method)),
        integrators=integrators,
        log_noise_covariance=found.log_noise_covariance,
        divided=found.divided if isinstance(found, LocalEstimate) else None,
        distortion=found.distortion if isinstance(found, PeriodicEstimate) else None,
        dt=records[0].dt,
        hold=records[0].hold,
        fed_back=bool(records[0].reference_names),
        input_units=records[0].input_units,
        output_units=records[0].output_units,
    )


def _find_remarks(
    records: Sequence[Record],
    omega: Grid,
    found: LocalEstimate | PeriodicEstimate,
    error: Float[np.ndarray, "frequencies outputs inputs"],
    method: Method,
) -> tuple[Remark, ...]:
    response, coherence, direct = found.response, found.coherence, found.direct_coherence
    names = records[0].output_names, records[0].input_names
    measured = omega, response, error, coherence, direct
    noted = remarks_on_feedback(records, method, *measured, names, found.errors)
    if isinstance(found, LocalEstimate):  # periods show their own distortion
        noted += remarks_on_linearity(records, omega, response, coherence, method)
        seconds = sum(record.duration for record in records)
        known = np.isfinite(response)
        sharp = known & (error <= _SHARP) & (coherence >= _COHERENT)
        used = np.any(sharp if sharp.any() else known, axis=(1, 2))
        noted += _remarks_on_length(seconds, np.asarray(omega), used)
    return noted + found.remarks


_SHARP, _COHERENT = 0.3, 0.6  # random error and coherence of frequencies that fits rest on
_GRID = 6.0  # frequencies that a record could tell apart in a grid that is not narrow by choice
# Frequencies that a record tells apart, at least, where it holds fewer cycles of the lowest: below,
# responses of sweeps in a closed loop were off by up to 180 claimed errors, above by 3 at most.
_LEAST = {5.0: 15.0, 10.0: 2.0}


def _remarks_on_length(
    seconds: float, omega: Grid, used: Bool[np.ndarray, " frequencies"]
) -> tuple[Remark, ...]:
    """Remark on a record that is too short for its band, where the grid is wide enough."""
    spacing = 2 * np.pi / seconds
    if not used.any() or omega[-1] - omega[0] < _GRID * spacing:
        return ()
    low, high = float(omega[used][0]), float(omega[used][-1])
    apart = (high - low) / spacing
    cycles = low / spacing
    missed = [limits for limits in _LEAST.items() if cycles < limits[0] and apart < limits[1]]
    if not missed:
        return ()
    least_cycles, least_apart = missed[0]
    needed = seconds * max(least_cycles / cycles, least_apart / max(apart, 1.0))
    remark = (
        f"the record is too short: its {seconds:.3g} s tell {apart:.1f} frequencies apart from "
        f"{low:.3g} to {high:.3g} rad/s ({low / (2 * np.pi):.3g} to {high / (2 * np.pi):.3g} Hz; "
        f"at least {least_apart:.0f}), and hold {cycles:.1f} cycles of the lowest (at least "
        f"{least_cycles:.0f}): 95 % intervals are too narrow there. Record at least {needed:.2g} "
        f"s, or a wider band"
    )
    return (Remark(remark, omega[used]),)


Estimator = Welch | Composite | LocalPolynomial | Periodic | JointInputOutput


def frequency_response(
    record: Record | Sequence[Record],
    omega: Float[ArrayLike, " frequencies"] | float | int | None = None,
    *,
    estimator: Estimator | None = None,
) -> FrequencyResponse:
    """Estimate the frequency responses of all outputs to all inputs.

    **Arguments:**

    - `record`: one `Record`, or several with the same channels and sample rate, which are taken
        together.
    - `omega`: frequencies in rad/s, increasing, or a single one; by default 100 log-spaced ones
        from two cycles of the longest record to a tenth of the sample rate (the excited lines with
        `jq.spectra.Periodic`).
    - `estimator`: one of `jq.spectra.LocalPolynomial`, `Composite`, `Welch`, `Periodic` and
        `JointInputOutput`. By default local polynomials, by the joint input-output method where the
        record has references, else directly from input to output (H1, equation (13) in
        docs/equations.md). Feedback biases the direct estimate towards -1/C.

    **Returns:** a `FrequencyResponse`. Several inputs are conditioned on each other.

    **Raises:**

    - `ValueError`: for frequencies that the records do not resolve, a channel that is constant or
        given twice, and a joint estimate without one reference for each input.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits; call `jq.enable_x64()` first.

    !!! Example

        ```python
        record = jq.read("log15.npz", inputs="M", outputs="q", references="x0", start=50, stop=76)
        response = jq.frequency_response(record, np.geomspace(1.0, 60.0, 80))
        print(response)
        ```
    """
    require_x64("a frequency response")
    records = [record] if isinstance(record, Record) else list(record)
    check_compatible(records)
    check_distinct(records)
    grid = None if omega is None else np.atleast_1d(np.asarray(omega, float))
    check_band(grid, records[0].dt)
    if estimator is None:
        estimator = JointInputOutput() if records[0].reference_names else LocalPolynomial()
    method = "direct"
    if not isinstance(estimator, Estimator):
        raise ValueError(
            f"estimator is {estimator!r}: give an object, such as jq.spectra.Welch() or "
            "jq.spectra.JointInputOutput(jq.spectra.LocalPolynomial())"
        )
    if isinstance(estimator, JointInputOutput):
        check_references(records)
        method, estimator = "joint", estimator.spectra
    if isinstance(estimator, LocalPolynomial):
        return _by_polynomial(records, grid, estimator, method)
    if isinstance(estimator, Periodic):
        return _by_period(records, grid, estimator, method)
    return average_windows(records, grid, estimator, method)
