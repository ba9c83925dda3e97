from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Float, PyTree

from jaxquad._core import Message, require_x64
from jaxquad.models import StateSpace, TransferFunction
from jaxquad.records import Record

from ..uncertainty._accuracy import orthonormal, projected_noise
from ..uncertainty._verdict import UndeterminedError, Verdict
from ._simulated import (
    band_filter,
    band_gain,
    check_channels,
    check_growth,
    forced_and_free,
    inputs_between_samples,
    linear_model,
    Motions,
    unknown_motions,
)


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

    def __str__(self) -> str:
        where = "whole band"
        if self.band:
            low, high = self.band
            hertz = f"{low / (2 * np.pi):.3g}..{high / (2 * np.pi):.3g} Hz"
            where = f"{low:.4g}..{high:.4g} rad/s ({hertz})"
        numbers = (self.rms, self.tic, self.fit_percent, self.variance_percent)
        whole = Agreement(self.output_name, self.output_unit, *numbers)
        lines = [f"verification on {self.output_name}, {where}: {whole}"]
        if len(self.outputs) > 1:
            lines += [f"  {one.name}: {one}" for one in self.outputs]
        return "\n".join(lines)


def agreement(
    name: str,
    unit: str,
    measured: Float[np.ndarray, "samples outputs"],
    simulated: Float[np.ndarray, "samples outputs"],
    weights: Float[np.ndarray, " outputs"],
) -> Agreement:
    """The textbook's measures over some outputs.

    Source: Tischler & Remple, sec. 14.2, J_rms and TIC with a diagonal weight W.
    """
    size = lambda x: float(np.sqrt(np.mean(x**2 * weights)))
    rms, spread = size(measured - simulated), size(measured - measured.mean(axis=0))
    return Agreement(
        name,
        unit,
        rms,
        rms / (size(measured) + size(simulated)),
        100 * (1 - rms / spread),
        100 * (1 - (rms / spread) ** 2),
    )


def agreements(
    record: Record,
    measured: Float[np.ndarray, "samples outputs"],
    simulated: Float[np.ndarray, "samples outputs"],
    weights: Float[np.ndarray, " outputs"],
) -> tuple[Agreement, tuple[Agreement, ...]]:
    """Of all outputs together, and of each."""
    one = np.ones(1)
    each = [
        agreement(name, unit, measured[:, [k]], simulated[:, [k]], one)
        for k, (name, unit) in enumerate(zip(record.output_names, record.output_units, strict=True))
    ]
    return agreement("", "", measured, simulated, weights), tuple(each)


@runtime_checkable
class _Fitted(Protocol):
    """What `jq.fit` returns."""

    model: PyTree
    verdict: Verdict

    @property
    def used_band(self) -> tuple[float, float] | None: ...


_SIGNIFICANT = 3.0  # standard errors from which a starting transient is estimated


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

    **Returns:**

    `jq.identify.Verification`.

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
    check_channels(plant, record)
    gain, shares = band_gain(band, record), _weights(weights, record)
    u, between = inputs_between_samples(record, hold)
    check_growth(plant, record)
    motions = unknown_motions(plant, record.duration)
    parts = [np.asarray(record.outputs), *_simulated(plant, motions, u, record.dt, between)]
    measured, driven, columns = (np.asarray(band_filter(part, gain)) for part in parts)
    unknowns, kept = _unknowns(measured - driven, columns, motions, _spread(record, measured))
    simulated = driven + columns[:, :, :kept] @ unknowns
    whole, each = agreements(record, measured, simulated, shares)
    shift, bias, initial = _physical(unknowns, motions, measured.shape[1])
    shown = slice(None) if len(each) > 1 else 0
    return Verification(
        time=record.time,
        measured=measured[:, shown],
        simulated=simulated[:, shown],
        rms=whole.rms,
        tic=whole.tic,
        fit_percent=whole.fit_percent,
        variance_percent=whole.variance_percent,
        outputs=each,
        shift=shift,
        bias=bias,
        initial=initial,
        omitted=columns.shape[2] - kept,
        band=band,
    )


def _weights(weights: Sequence[float] | None, record: Record) -> Float[np.ndarray, " outputs"]:
    count = len(record.output_names)
    shares = np.ones(count) if weights is None else np.asarray(weights, float)
    if shares.shape != (count,) or not np.all(np.isfinite(shares) & (shares > 0)):
        raise ValueError(
            f"weights={weights}: give one positive number for each output: "
            f"{', '.join(record.output_names)}"
        )
    return shares


_PER_OCTAVE = 8  # lengths of records for which there is a program


def _simulated(
    plant: TransferFunction | StateSpace,
    motions: Motions,
    u: Float[np.ndarray, "samples inputs"],
    dt: float,
    hold: str,
) -> tuple[Float[np.ndarray, "samples outputs"], Float[np.ndarray, "samples outputs unknowns"]]:
    """What inputs and unknown motions do, by a program for records of about this length."""
    samples = len(u)
    step = max(2 ** (samples.bit_length() - 1) // _PER_OCTAVE, 1)
    padded = np.pad(u, ((0, -samples % step), (0, 0)), mode="edge")
    driven, columns = forced_and_free(plant, motions, padded, np.asarray(dt), hold)
    return np.asarray(driven)[:samples], np.asarray(columns)[:samples]


def _spread(record: Record, measured: np.ndarray) -> Float[np.ndarray, " outputs"]:
    spread = np.std(measured, axis=0)
    for name, one in zip(record.output_names, spread, strict=True):
        if one == 0:
            raise ValueError(
                Message(f"output {name} is constant: leave it out« with jq.records.select»")
            )
    return spread


def _unknowns(
    rest: Float[np.ndarray, "samples outputs"],
    columns: Float[np.ndarray, "samples outputs unknowns"],
    motions: Motions,
    spread: Float[np.ndarray, " outputs"],
) -> tuple[Float[np.ndarray, " kept"], int]:
    """Least squares without the fast transients that do not stand out, the fastest first."""
    rest, columns = rest / spread[None], columns / spread[None, :, None]
    kept, groups = columns.shape[2], list(motions.groups)
    while True:
        found, left = _least_squares(rest, columns[:, :, :kept])
        if not groups or _stands_out(columns[:, :, :kept], left, found, groups[-1]):
            return found, kept
        kept -= groups.pop()


def _least_squares(
    rest: np.ndarray, columns: np.ndarray
) -> tuple[Float[np.ndarray, " unknowns"], Float[np.ndarray, "samples outputs"]]:
    flat = columns.reshape(rest.size, -1)
    scale = np.linalg.norm(flat, axis=0)
    scale = np.where(scale > 1e-12 * scale.max(), scale, np.inf)
    found = np.linalg.lstsq(flat / scale, rest.reshape(-1), rcond=1e-9)[0] / scale
    return found, rest - columns @ found


def _stands_out(columns: np.ndarray, left: np.ndarray, found: np.ndarray, last: int) -> bool:
    """Whether the last unknowns are beyond their errors, in noise like what is left."""
    flat = columns.reshape(left.size, -1)
    scale = np.linalg.norm(flat, axis=0)
    scale = np.where(scale > 1e-12 * scale.max(), scale, np.inf)
    inverse = np.linalg.pinv(flat / scale, rcond=1e-9)[-last:]
    ways = inverse.T.reshape(*left.shape, last)
    covariance = projected_noise(ways, left, orthonormal(columns), 0)
    tested = found[-last:] * np.where(np.isfinite(scale[-last:]), scale[-last:], 0.0)
    size = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    scaled = np.linalg.pinv(covariance / np.outer(size, size)) @ (tested / size)
    return float(tested / size @ scaled) > last * _SIGNIFICANT**2


def _physical(
    unknowns: Float[np.ndarray, " kept"], motions: Motions, outputs: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    slow, fast = np.asarray(motions.slow), np.asarray(motions.fast)
    shift, bias, start = np.split(unknowns, [outputs, outputs + slow.shape[1]])
    return shift, slow @ bias, fast[:, : start.size] @ start
