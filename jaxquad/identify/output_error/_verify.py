"""A model against a record that it was not fitted to: simulated, or predicted ahead."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Float, PyTree

from jaxquad._core import Message, one_blas_thread, require_x64
from jaxquad.records import Record

from ..uncertainty._verdict import UndeterminedError, Verdict
from ._noise import NoiseModel, orthonormal, projected_noise
from ._predict import AS_STATED, ESTIMATED, OF_FIT, predict_record, Prediction, WhiteNoise
from ._simulated import (
    band_filter,
    band_gain,
    check_channels,
    diverges,
    forced_and_free,
    growth_rate,
    inputs_between_samples,
    linear_model,
    Motions,
    Plant,
    unknown_motions,
)


Outputs = Float[np.ndarray, "samples outputs"]


class Agreement(eqx.Module):
    """How well one output, or all of them together, agree with the measurement."""

    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    rms: float  # J_rms, of the difference, in the unit
    tic: float  # Theil inequality coefficient, 0 to 1
    fit_percent: float  # 100 (1 - |difference| / |measured - mean|), the normalised rms fit
    variance_percent: float  # 100 (1 - |difference|^2 / |measured - mean|^2), accounted for

    def __str__(self) -> str:
        return (
            f"fit {self.fit_percent:.1f} %, variance accounted for {self.variance_percent:.1f} %, "
            f"TIC {self.tic:.3f} (good below 0.25), J_rms {self.rms:.4g} {self.unit}"
        ).rstrip()


AGREES, WEAK, CONTRADICTS = "agrees", "weak", "contradicts"  # kinds of `Verification.verdict`
GOOD_TIC = 0.25  # below which agreement is good
_WORSE = -5.0  # fit in % from which a model is worse than none, and no chance
_SHARE, _FACTOR = 0.5, 2.0  # of the output's variance that the model's shape explains; of its size


class Verification(eqx.Module):
    """A model's simulated outputs beside the measured ones (CIFER's VERIFY).

    A `prediction` says that `simulated` are predictions some samples ahead, and how; the verdict is
    then about the change of the outputs since the last measurement that they know.
    `rms`, `tic`, `fit_percent` and `variance_percent` are those of all outputs together under the
    weights; `outputs` holds those of each. With one output, `measured` and `simulated` have one
    axis. A Theil inequality coefficient (TIC) below 0.25 is good agreement.
    Source: Tischler & Remple, sec. 14.2.
    """

    time: Float[np.ndarray, " samples"]  # s
    measured: Float[np.ndarray, " samples *outputs"]  # within the band, if there is one
    simulated: Float[np.ndarray, " samples *outputs"]
    rms: float
    tic: float
    fit_percent: float
    variance_percent: float
    outputs: tuple[Agreement, ...]
    shift: Float[np.ndarray, " outputs"]  # reference shifts of the outputs
    bias: Float[np.ndarray, " states"]  # on the state derivatives, of `jq.models.realise(model)`
    initial: Float[np.ndarray, " states"]  # state at the first sample, of what decays
    omitted: int = eqx.field(static=True)  # starting transients that the record does not show
    band: tuple[float, float] | None = eqx.field(static=True)  # rad/s
    prediction: Prediction | None = None  # None where the record was simulated open loop
    change: Agreement | None = None  # of what changed within the prediction's horizon

    @property
    def residuals(self) -> Float[np.ndarray, " samples *outputs"]:
        """Measured less simulated."""
        return self.measured - self.simulated

    @property
    def method(self) -> str:
        """In words: simulated, or predicted so many samples ahead."""
        if self.prediction is None:
            return "simulated, open loop"
        count = self.prediction.horizon
        return (
            f"predicted {count} sample{'s' * (count > 1)} ({self.prediction.seconds:.3g} s) ahead"
        )

    @property
    def output_name(self) -> str:
        """Names of the outputs."""
        return ", ".join(one.name for one in self.outputs)

    @property
    def output_unit(self) -> str:
        """The unit of the outputs, empty where they have several."""
        units = {one.unit for one in self.outputs}
        return units.pop() if len(units) == 1 else ""

    @property
    def verdict(self) -> Message:
        """Whether the record "agrees", "contradicts", or is "weak" evidence, as its `kind` says.

        It agrees with a TIC below 0.25. It contradicts where the model is worse than the mean of
        the output (fit below -5 %), or has its shape but less than half or more than twice of it.
        A prediction agrees with a TIC below 0.25 of the change within its horizon, and contradicts
        where an input's effect is surely (3 standard errors) less than half or more than twice the
        model's: how far disturbances spread within the horizon is no fault of the model.
        """
        if not np.isfinite(self.tic):
            return Message("CONTRADICTS: the simulation diverges", CONTRADICTS)
        check = "check that both logs have the same vehicle, axis, channels and units"
        if self.prediction is not None and self.change is not None:
            return self._verdict_on_prediction(self.prediction, self.change, check)
        if self.tic < GOOD_TIC:
            return Message(f"AGREES: TIC {self.tic:.3f} is below {GOOD_TIC}", AGREES)
        spread = np.std(self.measured, axis=0)
        y, x = ((z - np.mean(z, axis=0)) / spread for z in (self.measured, self.simulated))
        both, energy = np.sum(y * x), np.sum(x * x)
        factor, share = both / max(energy, 1e-300), both**2 / max(energy * y.size, 1e-300)
        if share > _SHARE and not 1 / _FACTOR < factor < _FACTOR:
            text = f"the output is {factor:.3g} times what the model predicts: {check}"
            return Message(f"CONTRADICTS: {text}", CONTRADICTS)
        if self.fit_percent < _WORSE:
            text = f"the model is worse than the mean of the output (fit {self.fit_percent:.0f} %)"
            return Message(f"CONTRADICTS: {text}: {check}", CONTRADICTS)
        text = f"TIC {self.tic:.3f} is above {GOOD_TIC}, so more than the input moves the output"
        return Message(f"WEAK: {text}: excite more, in calm air", WEAK)

    def _verdict_on_prediction(self, how: Prediction, change: Agreement, check: str) -> Message:
        low = how.factor + _SIGNIFICANT * how.factor_error < 1 / _FACTOR
        high = how.factor - _SIGNIFICANT * how.factor_error > _FACTOR
        if np.any(low | high):
            k = int(np.argmax(low | high))
            size = f"{how.factor[k]:.3g} +- {how.factor_error[k]:.2g} (one standard error)"
            text = f"the effect of input {k + 1} is {size} times what the model predicts: {check}"
            return Message(f"CONTRADICTS: {text}", CONTRADICTS)
        what = f"the change within {how.seconds:.3g} s"
        if change.tic < GOOD_TIC:
            return Message(f"AGREES: TIC {change.tic:.3f} of {what} is below {GOOD_TIC}", AGREES)
        text = f"TIC {change.tic:.3f} of {what} is above {GOOD_TIC}, so more than the input moves"
        return Message(f"WEAK: {text} the output: excite more, in calm air", WEAK)

    def __str__(self) -> str:
        where = "whole band"
        if self.band:
            low, high = self.band
            hertz = f"{low / (2 * np.pi):.3g}..{high / (2 * np.pi):.3g} Hz"
            where = f"{low:.4g}..{high:.4g} rad/s ({hertz})"
        numbers = (self.rms, self.tic, self.fit_percent, self.variance_percent)
        together = Agreement(self.output_name, self.output_unit, *numbers)
        name = self.output_name if self.prediction is None else f"{self.output_name}, {self.method}"
        lines = [f"verification on {name}, {where}: {together}"]
        if len(self.outputs) > 1:
            lines += [f"  {one.name}: {one}" for one in self.outputs]
        if self.prediction is not None:
            lines += [f"  change since the last measurement: {self.change}", f"  {self.prediction}"]
        return "\n".join(lines)


def _agreement(
    name: str,
    unit: str,
    measured: Outputs,
    simulated: Outputs,
    weights: Float[np.ndarray, " outputs"],
    centre: Float[np.ndarray, " outputs"] | None = None,
) -> Agreement:
    """J_rms and TIC with a diagonal weight W. Source: Tischler & Remple, sec. 14.2."""
    size = lambda x: float(np.sqrt(np.mean(x**2 * weights)))
    centre = measured.mean(axis=0) if centre is None else centre
    rms, spread = size(measured - simulated), size(measured - centre)
    tic = rms / (size(measured) + size(simulated))
    return Agreement(
        name, unit, rms, tic, 100 * (1 - rms / spread), 100 * (1 - (rms / spread) ** 2)
    )


@runtime_checkable
class Fitted(Protocol):
    """What `jq.fit` returns."""

    model: PyTree
    verdict: Verdict
    noise_models: tuple[tuple[NoiseModel, ...], ...]

    @property
    def used_band(self) -> tuple[float, float] | None: ...

    def __call__(
        self, record: Record, *, band: tuple[float, float] | None, hold: str | None
    ) -> Verification: ...


_SIGNIFICANT = 3.0  # standard errors from which a starting transient is estimated
_PER_OCTAVE = 8  # lengths of records for which there is a program


def verify(
    model: PyTree,
    record: Record,
    *,
    band: tuple[float, float] | None = None,
    hold: str | None = None,
    weights: Sequence[float] | None = None,
) -> Verification:
    """Simulate the measured inputs open loop and compare the outputs (CIFER's VERIFY).

    Give a record that was not fitted. Constant biases on the state derivatives, the initial state
    and a shift of each output are estimated by least squares, as no record starts in perfect trim;
    fast starting transients only where they stand out from the (coloured) residual.

    An unstable model whose simulation diverges within the record (it grows by more than 1e10) is
    not simulated: `jq.predict` predicts the outputs as far ahead as the time in which its fastest
    unstable motion grows by e, and `Verification.prediction` has what was assumed of the noise.

    **Arguments:**

    - `model`: a fit; or a `jq.TransferFunction`, a `jq.StateSpace`, a
        `jq.models.DiscreteTransferFunction`, or one with `transfer_function()` or `state_space()`.
    - `record`: with the model's inputs and outputs.
    - `band`: (low, high) in rad/s, to compare within: an integrating plant drifts on disturbances
        that no model predicts. By default the band of the points that a fit used, and the whole
        band for a model.
    - `hold`: how inputs run between their samples, "zero" (held) or "first" (straight); by default
        as the record says (`Record.hold`), straight where it does not. A model that was identified
        from a record of unknown hold has half of it in its delay: straight inputs suit it.
    - `weights`: of the squares of the outputs in the measures of all together; give them where
        units differ. 1 by default.

    **Raises:**

    - `ValueError`: a model of other channels.
    - `UndeterminedError`, a `ValueError`: a fit that fitted nothing.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits.

    Source: Tischler & Remple, sec. 14.2, time-domain verification.
    """
    plant, _, used = _plant_of("verify", model, record)
    band = used if band is None else band
    gain, count = band_gain(band, record), len(record.output_names)
    shares = _weights_of(weights, record)
    if diverges(plant, record.duration):
        horizon = max(1, round(1 / (growth_rate(plant) * record.dt)))
        options = {"band": band, "hold": hold, "weights": weights}
        return predict(model, record, horizon=horizon, **options)
    u, between = inputs_between_samples(record, hold, plant)
    motions = unknown_motions(plant, record.duration)
    # One program serves records of about this length.
    step = max(2 ** (record.samples.bit_length() - 1) // _PER_OCTAVE, 1)
    padded = np.pad(u, ((0, -record.samples % step), (0, 0)), mode="edge")
    parts = forced_and_free(plant, motions, padded, np.asarray(record.dt), between)
    parts = [np.asarray(record.outputs), *(np.asarray(part)[: record.samples] for part in parts)]
    measured, driven, columns = (np.asarray(band_filter(part, gain)) for part in parts)
    spread = _spread_of(measured, record)
    scaled = columns / spread[None, :, None]
    unknowns = _significant_unknowns((measured - driven) / spread[None], scaled, motions)
    simulated = driven + columns[:, :, : unknowns.size] @ unknowns
    slow, fast = np.asarray(motions.slow), np.asarray(motions.fast)
    shift, bias, start = np.split(unknowns, [count, count + slow.shape[1]])
    omitted = columns.shape[2] - unknowns.size
    parts = shift, slow @ bias, fast[:, : start.size] @ start
    return _verification(record, measured, simulated, shares, parts, band, omitted)


def predict(
    model: PyTree,
    record: Record,
    *,
    horizon: int | float = 1,
    noise: WhiteNoise | Sequence[NoiseModel] | None = None,
    band: tuple[float, float] | None = None,
    hold: str | None = None,
    weights: Sequence[float] | None = None,
) -> Verification:
    """Predict each sample from the inputs, and from the outputs up to `horizon` samples before it.

    A steady-state observer (Kalman's gain) follows the outputs, so that unstable models that fly in
    a closed loop can be laid beside a record. Its start, constant biases on the state derivatives
    and a shift of each output are estimated by least squares of the one-step errors. Of the result,
    `simulated` are the predictions, `fit_percent` their normalised rms fit, and `prediction` has
    the errors' standard deviation by the noise with the share of errors within 95 %, a test of the
    one-step errors' whiteness, and where the noise is from. One sample ahead, any smooth record is
    predicted well: the verdict looks at the change within the horizon. Further ahead, the inputs of
    a closed loop answer to disturbances that a prediction does not know: the true model may then
    predict worse than another one, and only its `prediction.factor` (1) and the band are sure. The
    band counts neither the error of estimated noise nor that of the model.

    !!! example

        ```python
        check = jq.predict(fit, second_flight, horizon=20)
        reach = 1.96 * check.prediction.deviation  # 95 %
        ```

    **Arguments:**

    - `model`, `record`, `hold`, `weights`: as in `jq.verify`.
    - `band`: (low, high) in rad/s, to compare within, by default the whole one; the standard
        deviation, the coverage and the whiteness are always those of the whole band.
    - `horizon`: samples ahead. `np.inf` simulates from the estimated start.
    - `noise`: a `jq.identify.NoiseModel` for each output, at this sample rate, or a
        `jq.identify.WhiteNoise` of process and measurement. By default that of the fit
        (`jq.refine(..., noise="auto")`; of its first record). A model without one gets white
        process and measurement noise of greatest likelihood on this record, and the result says so.

    **Raises:**

    - `ValueError`: what `jq.verify` refuses; a horizon below 1, or one within which an unstable
        model grows by more than 1e10; noise of other outputs or states.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits.

    Source: Ljung, System Identification, sec. 3.2 and 4.3 (predictors, Kalman filter).
    """
    plant, models, _ = _plant_of("predict", model, record)
    shares, gain = _weights_of(weights, record), band_gain(band, record)
    within = lambda x: np.asarray(band_filter(x, gain))
    measured = within(np.asarray(record.outputs, float))
    _spread_of(measured, record)
    kind = AS_STATED if noise is not None else ESTIMATED if models is None else OF_FIT
    chosen = models if noise is None else noise
    with one_blas_thread():  # many small products: a second thread waits longer than it works
        parts, prediction, unknowns = predict_record(plant, record, horizon, chosen, kind, hold)
    late = np.maximum(np.arange(record.samples) - prediction.horizon, 0)
    predicted, before = within(parts), within(np.asarray(record.outputs, float)[late])
    check = _verification(record, measured, predicted, shares, unknowns, band, 0)
    y, x, none = measured - before, predicted - before, np.zeros(shares.size)
    return replace(
        check,
        prediction=prediction,
        change=_agreement("", check.output_unit, y, x, shares, none),
    )


def _plant_of(
    what: str, model: PyTree, record: Record
) -> tuple[Plant, tuple[NoiseModel, ...] | None, tuple[float, float] | None]:
    """The linear model, and the noise and the band of a fit; errors for what has none."""
    require_x64("a verification" if what == "verify" else "a prediction")
    if not isinstance(record, Record):
        raise ValueError(f"{what} needs a jq.Record, not a {type(record).__name__}: see jq.read")
    models = band = None
    if isinstance(model, Fitted):
        if not model.verdict.fitted:
            raise UndeterminedError(f"a verification needs a model: {model.verdict.summary}")
        models = model.noise_models[0] if model.noise_models else None
        model, band = model.model, model.used_band
    plant = linear_model(model)
    check_channels(plant, record)
    return plant, models, band


def _weights_of(weights: Sequence[float] | None, record: Record) -> Float[np.ndarray, " outputs"]:
    count = len(record.output_names)
    shares = np.ones(count) if weights is None else np.asarray(weights, float)
    if shares.shape != (count,) or not np.all(np.isfinite(shares) & (shares > 0)):
        raise ValueError(
            f"weights={weights}: give one positive number for each output: "
            f"{', '.join(record.output_names)}"
        )
    return shares


def _spread_of(measured: Outputs, record: Record) -> Float[np.ndarray, " outputs"]:
    """Standard deviations; an error for a constant output."""
    spread = np.std(measured, axis=0)
    for name, size in zip(record.output_names, spread, strict=True):
        if size == 0:
            raise ValueError(
                Message(f"output {name} is constant: leave it out« with jq.records.select»")
            )
    return spread


def _verification(
    record: Record,
    measured: Outputs,
    simulated: Outputs,
    weights: Float[np.ndarray, " outputs"],
    unknowns: tuple[np.ndarray, ...],
    band: tuple[float, float] | None,
    omitted: int,
) -> Verification:
    together = _agreement("", "", measured, simulated, weights)
    outputs = tuple(
        _agreement(name, unit, measured[:, [k]], simulated[:, [k]], np.ones(1))
        for k, (name, unit) in enumerate(zip(record.output_names, record.output_units, strict=True))
    )
    shown = slice(None) if len(outputs) > 1 else 0
    shift, bias, initial = unknowns
    return Verification(
        time=record.time,
        measured=measured[:, shown],
        simulated=simulated[:, shown],
        rms=together.rms,
        tic=together.tic,
        fit_percent=together.fit_percent,
        variance_percent=together.variance_percent,
        outputs=outputs,
        shift=shift,
        bias=bias,
        initial=initial,
        omitted=omitted,
        band=band,
    )


def _significant_unknowns(
    rest: Outputs, columns: Float[np.ndarray, "samples outputs unknowns"], motions: Motions
) -> Float[np.ndarray, " significant"]:
    """Least squares without the fast transients that do not stand out, the fastest first. They
    stand out where they are beyond their errors, in noise like what is left."""
    groups = list(motions.groups)
    while True:
        flat = columns.reshape(rest.size, -1)
        scale = np.linalg.norm(flat, axis=0)
        scale = np.where(scale > 1e-12 * scale.max(), scale, np.inf)
        unknowns = np.linalg.lstsq(flat / scale, rest.reshape(-1), rcond=1e-9)[0] / scale
        if not groups:
            return unknowns
        last, left = groups.pop(), rest - columns @ unknowns
        inverse = np.linalg.pinv(flat / scale, rcond=1e-9)[-last:]
        ways = inverse.T.reshape(*left.shape, last)
        covariance = projected_noise(ways, left, orthonormal(columns), 0)
        tested = unknowns[-last:] * np.where(np.isfinite(scale[-last:]), scale[-last:], 0.0)
        size = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
        scaled = np.linalg.pinv(covariance / np.outer(size, size)) @ (tested / size)
        if float(tested / size @ scaled) > last * _SIGNIFICANT**2:
            return unknowns
        columns = columns[:, :, :-last]
