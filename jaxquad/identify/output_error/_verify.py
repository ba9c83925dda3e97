"""Models against records that they were not fitted to: one verified, several compared."""

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Float, PyTree

from jaxquad._core import Message, require_x64
from jaxquad.records import Record

from ..uncertainty._verdict import UndeterminedError, Verdict
from ._noise import orthonormal, projected_noise
from ._simulated import (
    band_filter,
    band_gain,
    check_plant,
    forced_and_free,
    inputs_between_samples,
    linear_model,
    Motions,
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
        """
        if not np.isfinite(self.tic):
            return Message("CONTRADICTS: the simulation diverges", CONTRADICTS)
        if self.tic < GOOD_TIC:
            return Message(f"AGREES: TIC {self.tic:.3f} is below {GOOD_TIC}", AGREES)
        spread = np.std(self.measured, axis=0)
        y, x = ((z - np.mean(z, axis=0)) / spread for z in (self.measured, self.simulated))
        both, energy = np.sum(y * x), np.sum(x * x)
        factor, share = both / max(energy, 1e-300), both**2 / max(energy * y.size, 1e-300)
        check = "check that both logs have the same vehicle, axis, channels and units"
        if share > _SHARE and not 1 / _FACTOR < factor < _FACTOR:
            text = f"the output is {factor:.3g} times what the model predicts: {check}"
            return Message(f"CONTRADICTS: {text}", CONTRADICTS)
        if self.fit_percent < _WORSE:
            text = f"the model is worse than the mean of the output (fit {self.fit_percent:.0f} %)"
            return Message(f"CONTRADICTS: {text}: {check}", CONTRADICTS)
        text = f"TIC {self.tic:.3f} is above {GOOD_TIC}, so more than the input moves the output"
        return Message(f"WEAK: {text}: excite more, in calm air", WEAK)

    def __str__(self) -> str:
        where = "whole band"
        if self.band:
            low, high = self.band
            hertz = f"{low / (2 * np.pi):.3g}..{high / (2 * np.pi):.3g} Hz"
            where = f"{low:.4g}..{high:.4g} rad/s ({hertz})"
        numbers = (self.rms, self.tic, self.fit_percent, self.variance_percent)
        together = Agreement(self.output_name, self.output_unit, *numbers)
        lines = [f"verification on {self.output_name}, {where}: {together}"]
        if len(self.outputs) > 1:
            lines += [f"  {one.name}: {one}" for one in self.outputs]
        return "\n".join(lines)


def _agreement(
    name: str,
    unit: str,
    measured: Outputs,
    simulated: Outputs,
    weights: Float[np.ndarray, " outputs"],
) -> Agreement:
    """J_rms and TIC with a diagonal weight W. Source: Tischler & Remple, sec. 14.2."""
    size = lambda x: float(np.sqrt(np.mean(x**2 * weights)))
    rms, spread = size(measured - simulated), size(measured - measured.mean(axis=0))
    tic = rms / (size(measured) + size(simulated))
    return Agreement(
        name, unit, rms, tic, 100 * (1 - rms / spread), 100 * (1 - (rms / spread) ** 2)
    )


@runtime_checkable
class _Fitted(Protocol):
    """What `jq.fit` returns."""

    model: PyTree
    verdict: Verdict

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

    **Arguments:**

    - `model`: a fit; or a `jq.TransferFunction`, a `jq.StateSpace`, or a model with
        `transfer_function()` or `state_space()`.
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

    - `ValueError`: a model of other channels, or one that is too unstable to be simulated.
    - `UndeterminedError`, a `ValueError`: a fit that fitted nothing.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits.

    Source: Tischler & Remple, sec. 14.2, time-domain verification.
    """
    require_x64("a verification")
    if not isinstance(record, Record):
        raise ValueError(f"verify needs a jq.Record, not a {type(record).__name__}: see jq.read")
    if isinstance(model, _Fitted):
        if not model.verdict.fitted:
            raise UndeterminedError(f"a verification needs a model: {model.verdict.summary}")
        model, band = model.model, model.used_band if band is None else band
    plant = linear_model(model)
    check_plant(plant, record)
    gain, count = band_gain(band, record), len(record.output_names)
    shares = np.ones(count) if weights is None else np.asarray(weights, float)
    if shares.shape != (count,) or not np.all(np.isfinite(shares) & (shares > 0)):
        raise ValueError(
            f"weights={weights}: give one positive number for each output: "
            f"{', '.join(record.output_names)}"
        )
    u, between = inputs_between_samples(record, hold)
    motions = unknown_motions(plant, record.duration)
    # One program serves records of about this length.
    step = max(2 ** (record.samples.bit_length() - 1) // _PER_OCTAVE, 1)
    padded = np.pad(u, ((0, -record.samples % step), (0, 0)), mode="edge")
    parts = forced_and_free(plant, motions, padded, np.asarray(record.dt), between)
    parts = [np.asarray(record.outputs), *(np.asarray(part)[: record.samples] for part in parts)]
    measured, driven, columns = (np.asarray(band_filter(part, gain)) for part in parts)
    spread = np.std(measured, axis=0)
    for name, size in zip(record.output_names, spread, strict=True):
        if size == 0:
            raise ValueError(
                Message(f"output {name} is constant: leave it out« with jq.records.select»")
            )
    scaled = columns / spread[None, :, None]
    unknowns = _significant_unknowns((measured - driven) / spread[None], scaled, motions)
    simulated = driven + columns[:, :, : unknowns.size] @ unknowns
    together = _agreement("", "", measured, simulated, shares)
    outputs = tuple(
        _agreement(name, unit, measured[:, [k]], simulated[:, [k]], np.ones(1))
        for k, (name, unit) in enumerate(zip(record.output_names, record.output_units, strict=True))
    )
    slow, fast = np.asarray(motions.slow), np.asarray(motions.fast)
    shift, bias, start = np.split(unknowns, [count, count + slow.shape[1]])
    shown = slice(None) if len(outputs) > 1 else 0
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
        bias=slow @ bias,
        initial=fast[:, : start.size] @ start,
        omitted=columns.shape[2] - unknowns.size,
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


class Comparison(eqx.Module):
    """How well each of several models predicts one record; prints as a table.

    `jq.plot.compare` draws it. `checks[name].simulated` is what a model predicts.
    """

    checks: dict[str, Verification]  # by the models' names
    source: str = eqx.field(static=True)  # of the record

    @property
    def fit_percent(self) -> dict[str, float]:
        """100 (1 - |difference| / |measured - mean|) of each model, over all outputs."""
        return {name: check.fit_percent for name, check in self.checks.items()}

    @property
    def best(self) -> str:
        """The name of the model that predicts the record best."""
        return max(self.fit_percent, key=lambda name: np.nan_to_num(self.fit_percent[name]))

    def __str__(self) -> str:
        heads = ("model", "output", "fit %", "accounted for %", "TIC", "rms difference")
        rows: list[tuple[str, ...]] = [heads]
        for name, check in self.checks.items():
            for one in check.outputs:
                numbers = (f"{one.fit_percent:.1f}", f"{one.variance_percent:.1f}")
                numbers = (*numbers, f"{one.tic:.3f}", f"{one.rms:.4g} {one.unit}".rstrip())
                rows.append((name, one.name, *numbers))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        texts = lambda row: [f"{c:<{w}}" for c, w in zip(row[:2], widths, strict=False)]
        numbers = lambda row: [f"{c:>{w}}" for c, w in zip(row[2:], widths[2:], strict=True)]
        lines = ["  ".join([*texts(row), *numbers(row)]).rstrip() for row in rows]
        return "\n".join(lines + ["(TIC: Theil inequality coefficient, good below 0.25)"])


def compare(
    models: PyTree | Mapping[str, PyTree] | Sequence[PyTree],
    record: Record,
    *,
    band: tuple[float, float] | None = None,
    hold: str | None = None,
) -> Comparison:
    """Simulate models on a record that none of them was fitted to, and compare them.

    !!! example

        ```python
        print(jq.compare({"with lag": one, "without": other}, second_flight))
        ```

    **Arguments:**

    - `models`: by name, or a list, or one: models as `jq.verify` takes them, or fits.
    - `record`: with their inputs and outputs.
    - `band`, `hold`: as in `jq.verify`.

    **Raises:** what `jq.verify` raises; ValueError for no model, and for a fit that found none.
    """
    if isinstance(models, Mapping):
        named = {str(name): model for name, model in models.items()}
    elif isinstance(models, list | tuple):
        named = {f"model {k}": model for k, model in enumerate(models, start=1)}
    else:
        named = {"model": models}
    if not named:
        raise ValueError("there is no model to compare: give one or more, by name")
    checks = {
        name: model(record, band=band, hold=hold)
        if isinstance(model, _Fitted)
        else verify(model, record, band=band, hold=hold)
        for name, model in named.items()
    }
    return Comparison(checks, record.source)
