"""Frequency responses: estimates of records, and tables that were measured elsewhere."""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from jaxquad._core import (
    pytree_node,
    require_float64,
    require_x64,
)
from jaxquad.records import Record

from ._error_covariance import ErrorCovariance, independent_errors
from ._estimators import (
    check_band,
    check_distinct,
    check_excitation,
    check_references,
    COHERENT,
    compatible,
    Composite,
    DOMINATED,
    Estimator,
    Grid,
    in_hertz,
    JointInputOutput,
    Levels,
    LocalPolynomial,
    Method,
    Pairs,
    Periodic,
    Remark,
    Remarks,
    Responses,
    Square,
    Welch,
)
from ._table import (
    as_grid,
    as_responses,
    channel_names,
    FrequencyUnit,
    HasFrequencyData,
    on_host,
    random_errors,
    read_idfrd,
)


class Distortion(eqx.Module):
    """Scatter around the best linear approximation: noise and nonlinear distortion.

    All are amplitudes in output units, for each line, of the average over a record's periods:
    `amplitude` is that of the output that the response explains, `noise` the scatter between
    periods, `total` that between realisations, and `nonlinear` the part of it that the noise does
    not explain. The last two are nan for a single realisation. Source: Pintelon and Schoukens,
    "System Identification", 2nd ed., section 4.3.1.
    """

    omega: Grid  # rad/s
    amplitude: Levels
    noise: Levels
    total: Levels
    nonlinear: Levels
    significant: Bool[np.ndarray, " outputs"]  # whether the scatter exceeds that of the noise
    output_names: tuple[str, ...] = eqx.field(static=True)
    realisations: int = eqx.field(static=True)

    def __str__(self) -> str:
        lines = [
            f"scatter of the period averages relative to the output: {self.omega.size} lines, "
            f"{self.realisations} realisation{'s' if self.realisations > 1 else ''}"
        ]
        for o, name in enumerate(self.output_names):
            output = np.sqrt(np.mean(self.amplitude[:, o] ** 2))
            noise, nonlinear = (
                20 * np.log10(max(np.sqrt(np.mean(part[:, o] ** 2)) / output, 1e-15))
                for part in (self.noise, self.nonlinear)
            )
            if np.isnan(nonlinear):
                distortion = "unknown (record the same lines with other phases)"
            elif self.significant[o]:
                distortion = f"{nonlinear:.1f} dB"
            else:
                distortion = "below the noise"
            lines.append(f"  {name}: noise {noise:.1f} dB, nonlinear distortion {distortion}")
        return "\n".join(lines)


_METHODS = {
    "direct": "direct estimate (H1, unbiased in open loop; with feedback, name a reference)",
    "joint": "joint estimate",
}


@pytree_node
class FrequencyResponse:
    """Measured frequency responses of every output to every input, with their random errors.

    With several inputs, responses are conditioned on the other inputs and `coherence` is partial.
    Where the inputs cannot be separated, the response is nan and its random error infinite.
    `errors` is the covariance of all random errors: neighbouring frequencies share part of their
    noise. `log_noise_covariance` says how well that noise is known: the covariance of the logarithm
    of its estimated power between frequencies; without it, the noise counts as known. A joint
    estimate divides by the inputs' responses to the references: `divided` is the share of the
    squared error that these make. `remarks` are what a user of the response should know: sentences
    that know the frequencies they are about.
    """

    omega: Float[Array | np.ndarray, " frequencies"]  # rad/s
    response: Complex[Array, "frequencies outputs inputs"]  # output unit per input unit
    coherence: Float[Array, "frequencies outputs inputs"]  # of the joint estimate: the smaller one
    random_error: Float[Array, "frequencies outputs inputs"]  # 1 sigma: relative, and in rad
    errors: ErrorCovariance
    direct_coherence: Float[Array, "frequencies outputs inputs"]  # input to output, no reference
    multiple_coherence: Float[Array, "frequencies outputs"]  # of the output with all inputs
    method: Method = eqx.field(static=True)
    input_names: tuple[str, ...] = eqx.field(static=True)
    output_names: tuple[str, ...] = eqx.field(static=True)
    remarks: Sequence[Remark] = eqx.field(static=True, default=())
    resolution: float = eqx.field(static=True, default=0.0)  # one cycle in a window, rad/s
    distortion: Distortion | None = None  # of a periodic excitation
    log_noise_covariance: Square | None = None
    divided: Pairs | Array | None = None  # 0 to 1; 0 without
    swept_at: Float[Array | np.ndarray, "frequencies inputs"] | None = None  # s, of a sweep
    dt: float = eqx.field(static=True, default=0.0)  # s; 0 where nothing was sampled
    hold: float | None = eqx.field(static=True, default=None)  # s
    fed_back: bool = eqx.field(static=True, default=False)  # the records had references: a loop
    input_units: tuple[str, ...] = eqx.field(static=True, default=())  # empty where unknown
    output_units: tuple[str, ...] = eqx.field(static=True, default=())

    def __post_init__(self):
        if not isinstance(self.omega, Array | np.ndarray):
            return
        require_float64("the frequency response", self.response)

    @classmethod
    def from_table(
        cls,
        omega: Float[ArrayLike, " frequencies"] | HasFrequencyData,
        response: Complex[ArrayLike, "frequencies ..."] | None = None,
        *,
        magnitude_db: Float[ArrayLike, "frequencies ..."] | None = None,
        phase_deg: Float[ArrayLike, "frequencies ..."] | None = None,
        frequency_unit: FrequencyUnit = "rad/s",
        coherence: Float[ArrayLike, "..."] | None = None,
        averages: float | int | None = None,
        random_error: Float[ArrayLike, "..."] | None = None,
        input_names: Sequence[str] = (),
        output_names: Sequence[str] = (),
        dt: float = 0.0,
        hold: float | None = None,
    ) -> "FrequencyResponse":
        """A response that was measured elsewhere, as every fit and margin takes it.

        **Arguments:**

        - `omega`: frequencies, rising; or a `FrequencyResponseData` of python-control alone, whose
            names and sample interval are kept.
        - `response`: complex, one number for each frequency, or (frequencies, outputs, inputs).
        - `magnitude_db`, `phase_deg`: instead, in the same shapes.
        - `frequency_unit`: of `omega`: "rad/s" or "Hz".
        - `coherence`: of each number (gamma squared). Then the relative random error is
            sqrt((1 - coherence) / (2 averages coherence)).
        - `averages`: how many independent windows the coherence is from.
        - `random_error`: instead, relative and in rad, one standard error.
        - `input_names`, `output_names`: by default `u0`, `y0`, and so on.
        - `dt`, `hold`: sample interval, and time for which the inputs were held, in s.

        **Returns:** a `FrequencyResponse` whose errors at different frequencies are independent.

        **Raises:** ValueError for shapes that differ, numbers that are not finite, frequencies that
        do not rise from above 0, and for none or both of `coherence` and `random_error`.

        Source: Bendat and Piersol, "Random Data", 4th ed., Table 9.6.
        """
        if isinstance(omega, HasFrequencyData):
            columns = response, magnitude_db, phase_deg
            if any(x is not None for x in columns) or frequency_unit != "rad/s":
                raise ValueError("give a FrequencyResponseData alone, or omega and response")
            input_names = input_names or omega.input_labels
            output_names = output_names or omega.output_labels
            if not isinstance(omega.dt, bool):  # True is a sampled system of unknown interval
                dt = dt or omega.dt or 0.0
            omega, response = np.asarray(omega.omega), np.moveaxis(np.asarray(omega.frdata), -1, 0)
        grid = as_grid(omega, frequency_unit)
        values = as_responses(grid, response, magnitude_db, phase_deg)
        coherent, error = random_errors(values, coherence, averages, random_error)
        variance = 2 * (on_host(error) * np.abs(on_host(values))) ** 2
        _, outputs, inputs = values.shape
        return cls(
            omega=jnp.asarray(grid),
            response=jnp.asarray(values),
            coherence=jnp.asarray(coherent),
            random_error=jnp.asarray(error),
            errors=independent_errors(grid, variance),
            direct_coherence=jnp.asarray(coherent),
            multiple_coherence=jnp.asarray(coherent.max(axis=2)),
            method="direct",
            input_names=channel_names("input_names", input_names, "u", inputs),
            output_names=channel_names("output_names", output_names, "y", outputs),
            dt=dt,
            hold=hold,
        )

    @classmethod
    def from_idfrd(
        cls,
        path: str | Path,
        variable: str | None = None,
        *,
        coherence: Float[ArrayLike, "..."] | None = None,
        averages: float | int | None = None,
        random_error: Float[ArrayLike, "..."] | None = None,
    ) -> "FrequencyResponse":
        """The response of a MAT file with the properties of an `idfrd` of MATLAB's toolbox.

        In MATLAB: `s = get(g); save('g.mat', 's', '-v7')`.

        **Arguments:**

        - `path`: the file.
        - `variable`: the name of the struct, where the file has several.
        - `coherence`, `averages`, `random_error`: as in `from_table`, for an `idfrd` without
            `CovarianceData`, as `etfe` makes it; or in their place.

        **Raises:** ValueError as `from_table`, and for delays or units that the response does not
        contain; `jq.records.ReadError` for a file that holds no such struct.
        """
        table = read_idfrd(path, variable)
        if coherence is None and random_error is None:
            random_error = table.random_error
        return cls.from_table(
            table.omega, table.response, coherence=coherence, averages=averages,
            random_error=random_error, input_names=table.input_names,
            output_names=table.output_names, dt=table.dt, hold=table.hold,
        )  # fmt: skip

    @property
    def magnitude_db(self) -> Pairs:
        """20 log10 of the magnitude."""
        return 20 * np.log10(np.abs(np.asarray(self.response)))

    @property
    def phase_deg(self) -> Pairs:
        """Phase in degrees, unwrapped along frequency."""
        return np.degrees(np.unwrap(np.angle(np.asarray(self.response)), axis=0))

    def remarks_about(
        self, used: Bool[np.ndarray, "frequencies outputs inputs"]
    ) -> tuple[Remark, ...]:
        """Those of the remarks that concern the points in use, restricted to these, each once."""
        omega, kept = np.asarray(self.omega), []
        for remark in self.remarks:
            mine = np.any(used, axis=(1, 2))
            if remark.pair is not None:
                output, source = remark.pair
                mine = used[:, self.output_names.index(output), self.input_names.index(source)]
            part = remark.within(omega[mine]) if np.any(mine) else None
            kept += [] if part is None else [part]
        return tuple(dict.fromkeys(kept))

    @property
    def of_controller(self) -> Bool[np.ndarray, "frequencies outputs inputs"]:
        """Points that remarks name as dominated by feedback: there, the response is -1/C."""
        dominated, omega = np.zeros(self.response.shape, bool), np.asarray(self.omega)
        for remark in (remark for remark in self.remarks if remark.kind == DOMINATED):
            every = itertools.product(self.output_names, self.input_names)
            for output, source in [remark.pair] if remark.pair else every:
                place = self.output_names.index(output), self.input_names.index(source)
                dominated[np.isin(omega, remark.omega), *place] = True
        return dominated

    def pair(self, output: int = 0, input: int = 0) -> "FrequencyResponse":
        """The response of one output to one input, beside the other inputs."""
        name = self.output_names[output], self.input_names[input]
        o, i = slice(output, output + 1), slice(input, input + 1)
        pick = lambda values: None if values is None else values[:, o, i]
        about = lambda: tuple(one for one in self.remarks if one.pair in (None, name))
        return dataclasses.replace(
            self,
            response=pick(self.response),
            coherence=pick(self.coherence),
            random_error=pick(self.random_error),
            errors=self.errors.pair(output, input),
            divided=pick(self.divided),
            swept_at=None if self.swept_at is None else self.swept_at[:, i],
            direct_coherence=pick(self.direct_coherence),
            multiple_coherence=self.multiple_coherence[:, o],
            input_names=self.input_names[i],
            output_names=self.output_names[o],
            input_units=self.input_units[i],
            output_units=self.output_units[o],
            remarks=Remarks(about),
        )

    def relative_covariance(
        self, output: int = 0, input: int = 0
    ) -> Complex[np.ndarray, "frequencies frequencies"]:
        """Covariance of one response's relative error between all pairs of frequencies.

        Its diagonal is `2 random_error**2`.
        """
        response = np.asarray(self.response)[:, output, input]
        covariance = self.errors.between((output, input), (output, input))
        return covariance / np.outer(response, response.conj())

    @property
    def error_exponent(self) -> Pairs | Array:
        """The power p of |measurement / model| in the random error relative to a model.

        Noise of a numerator is relative to the measured one: error |measurement| / |model|, p = 1.
        Noise of a denominator turns this round: one that came out large by chance makes the
        response small and its own relative error small, p = -1.
        """
        shape = self.response.shape
        return np.ones(shape) if self.divided is None else 1 - 2 * self.divided

    def __str__(self) -> str:
        omega, coherence = np.asarray(self.omega), np.asarray(self.coherence)
        lines = [f"frequency response, {_METHODS[self.method]}, {omega.size} frequencies"]
        for o, output in enumerate(self.output_names):
            for i, source in enumerate(self.input_names):
                good = omega[coherence[:, o, i] >= COHERENT]
                where = f", {in_hertz(good)}" if good.size else ""
                lines.append(
                    f"  {source} -> {output}: coherence above 0.6 at {good.size} frequencies{where}"
                )
        coherent = coherence >= COHERENT
        shown = self.remarks_about(coherent) if np.any(coherent) else self.remarks
        return "\n".join(lines + [f"  ! {remark}" for remark in shown])


class Estimate(NamedTuple):
    """What an estimator makes of records; nan and infinite errors where it is undetermined.

    `independent_errors` makes the `errors` of estimates that share no noise between frequencies;
    `log_noise_covariance` of n independent averages is then the identity over n.
    """

    omega: Grid
    response: Responses
    coherence: Pairs
    direct_coherence: Pairs
    multiple_coherence: Levels
    errors: ErrorCovariance
    random_error: Pairs
    log_noise_covariance: Square
    remarks: Callable[[], tuple[Remark, ...]]
    divided: Pairs | None = None
    distortion: Distortion | None = None
    resolution: float = 0.0


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
    from ._average import average_windows
    from ._local_polynomial import estimate_local_polynomial
    from ._other_inputs import sweep_times
    from ._periodic import estimate_periodic

    require_x64("a frequency response")
    records = compatible(record)
    check_distinct(records)
    first, method = records[0], "direct"
    grid = None if omega is None else np.atleast_1d(np.asarray(omega, float))
    check_band(grid, first.dt)
    if estimator is None:
        estimator = JointInputOutput() if first.reference_names else LocalPolynomial()
    if not isinstance(estimator, Estimator):
        raise ValueError(
            f"estimator is {estimator!r}: give an object, such as jq.spectra.Welch() or "
            "jq.spectra.JointInputOutput(jq.spectra.LocalPolynomial())"
        )
    if isinstance(estimator, JointInputOutput):
        check_references(records, estimator.others)
        method, estimator = "joint", estimator.spectra
    if isinstance(estimator, Welch | Composite):
        estimate = average_windows(records, grid, estimator, method)
    else:
        check_excitation(records, method)
        if isinstance(estimator, Periodic):
            estimate = estimate_periodic(records, grid, estimator, method)
        else:
            estimate = estimate_local_polynomial(records, grid, estimator, method)

    def find_remarks() -> tuple[Remark, ...]:
        from ._actuator import remarks_on_actuator
        from ._feedback import remarks_on_feedback
        from ._linearity import remarks_on_linearity
        from ._other_inputs import remarks_on_clock

        remarks = remarks_on_feedback(records, method, estimate)
        if estimate.distortion is None:  # periods show their own
            of_actuator, corrected, behind = remarks_on_actuator(records, method, estimate)
            remarks += of_actuator + remarks_on_linearity(corrected, method, behind)
        if method == "joint":
            remarks += remarks_on_clock(records, estimate)
        return remarks + estimate.remarks()

    # Not jnp.asarray: it compiles a program for each new shape. Each array once, in one go.
    names = "omega response coherence random_error direct_coherence multiple_coherence".split()
    put = jax.device_put({name: getattr(estimate, name) for name in names})
    return FrequencyResponse(
        **put,
        errors=estimate.errors,
        method=method,
        input_names=first.input_names,
        output_names=first.output_names,
        remarks=Remarks(find_remarks),
        resolution=estimate.resolution,
        distortion=estimate.distortion,
        log_noise_covariance=estimate.log_noise_covariance,
        divided=estimate.divided,
        swept_at=sweep_times(records, method, estimate.omega),
        dt=first.dt,
        hold=first.hold,
        fed_back=bool(first.reference_names),
        input_units=first.input_units,
        output_units=first.output_units,
    )
