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
from ._linearity import remarks_on_linearity
from ._local_polynomial import estimate_local_polynomial, LocalEstimate
from ._periodic import estimate_periodic, PeriodicEstimate
from ._remarks import Remark, Remarks
from ._welch import average_windows


_CYCLES = 2.0  # of the longest record, in the lowest frequency by default

_SHARP, _COHERENT = 0.3, 0.6  # random error and coherence of frequencies that fits rest on
_GRID = 6.0  # frequencies that a record could tell apart in a grid that is not narrow by choice
# Frequencies that a record tells apart, at least, where it holds fewer cycles of the lowest: below,
# responses of sweeps in a closed loop were off by up to 180 claimed errors, above by 3 at most.
_LEAST = {5.0: 15.0, 10.0: 2.0}

Method = Literal["direct", "joint"]
Grid = Float[np.ndarray, " frequencies"]
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
    if isinstance(estimator, Welch | Composite):
        return average_windows(records, grid, estimator, method)
    check_excitation(records, method)
    if isinstance(estimator, Periodic):
        periods = estimate_periodic(records, grid, estimator, method)
        return _finish(records, periods.omega, periods, method, 0)
    if grid is None:
        lowest = 2 * np.pi * _CYCLES / max(record.duration for record in records)
        grid = np.geomspace(lowest, 2 * np.pi / (10 * records[0].dt), 100)
    with one_blas_thread():
        local = estimate_local_polynomial(records, grid, estimator, method)
        return _finish(records, grid, local, method, estimator.integrators)


def _finish(
    records: Sequence[Record],
    omega: Grid,
    estimate: LocalEstimate | PeriodicEstimate,
    method: Method,
    integrators: int,
) -> FrequencyResponse:
    response, coherence, direct = estimate.response, estimate.coherence, estimate.direct_coherence
    spread = np.sqrt(estimate.errors.variance() / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(np.isfinite(response), spread / np.abs(response), np.inf)
    # Not jnp.asarray: it compiles a program for each new shape.
    put = jax.device_put
    return FrequencyResponse(
        omega=put(omega),
        response=put(response),
        coherence=put(coherence),
        random_error=put(error),
        errors=estimate.errors,
        direct_coherence=put(direct),
        multiple_coherence=put(estimate.multiple_coherence),
        method=method,
        input_names=records[0].input_names,
        output_names=records[0].output_names,
        remarks=Remarks(ft.partial(_find_remarks, records, omega, estimate, error, method)),
        integrators=integrators,
        log_noise_covariance=estimate.log_noise_covariance,
        divided=estimate.divided if isinstance(estimate, LocalEstimate) else None,
        distortion=estimate.distortion if isinstance(estimate, PeriodicEstimate) else None,
        dt=records[0].dt,
        hold=records[0].hold,
        fed_back=bool(records[0].reference_names),
        input_units=records[0].input_units,
        output_units=records[0].output_units,
    )


def _find_remarks(
    records: Sequence[Record],
    omega: Grid,
    estimate: LocalEstimate | PeriodicEstimate,
    error: Float[np.ndarray, "frequencies outputs inputs"],
    method: Method,
) -> tuple[Remark, ...]:
    response, coherence, direct = estimate.response, estimate.coherence, estimate.direct_coherence
    names = records[0].output_names, records[0].input_names
    measured = omega, response, error, coherence, direct
    remarks = remarks_on_feedback(records, method, *measured, names, estimate.errors)
    if isinstance(estimate, LocalEstimate):  # periods show their own distortion
        remarks += remarks_on_linearity(records, omega, response, coherence, method)
        seconds = sum(record.duration for record in records)
        finite = np.isfinite(response)
        sharp = finite & (error <= _SHARP) & (coherence >= _COHERENT)
        used = np.any(sharp if sharp.any() else finite, axis=(1, 2))
        remarks += _remarks_on_length(seconds, np.asarray(omega), used)
    return remarks + estimate.remarks


def _remarks_on_length(
    seconds: float, omega: Grid, used: Bool[np.ndarray, " frequencies"]
) -> tuple[Remark, ...]:
    """Remark on a record that is too short for its band, where the grid is wide enough."""
    spacing = 2 * np.pi / seconds
    if not used.any() or omega[-1] - omega[0] < _GRID * spacing:
        return ()
    low, high = float(omega[used][0]), float(omega[used][-1])
    count = (high - low) / spacing
    cycles = low / spacing
    missed = [limits for limits in _LEAST.items() if cycles < limits[0] and count < limits[1]]
    if not missed:
        return ()
    least_cycles, least_count = missed[0]
    needed = seconds * max(least_cycles / cycles, least_count / max(count, 1.0))
    remark = (
        f"the record is too short: its {seconds:.3g} s tell {count:.1f} frequencies apart from "
        f"{low:.3g} to {high:.3g} rad/s ({low / (2 * np.pi):.3g} to {high / (2 * np.pi):.3g} Hz; "
        f"at least {least_count:.0f}), and hold {cycles:.1f} cycles of the lowest (at least "
        f"{least_cycles:.0f}): 95 % intervals are too narrow there. Record at least {needed:.2g} "
        f"s, or a wider band"
    )
    return (Remark(remark, omega[used], kind="short record"),)
