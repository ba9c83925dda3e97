from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxquad.models import free_responses, simulate_linear, TransferFunction
from jaxquad.records import Record
from jaxquad.spectra import require_x64


class Verification(eqx.Module):
    """A model's simulated output beside a measured one (CIFER's VERIFY).

    Guidelines: a Theil inequality coefficient below 0.25 is good agreement.
    """

    time: Float[np.ndarray, " samples"]  # s
    measured: Float[np.ndarray, " samples"]  # within the band, if there is one
    simulated: Float[np.ndarray, " samples"]
    rms: float  # J_rms, of the difference, in the output's unit
    tic: float  # Theil inequality coefficient, 0 to 1
    fit_percent: float  # 100 (1 - |difference| / |measured - mean|), the normalised rms fit
    variance_percent: float  # 100 (1 - |difference|^2 / |measured - mean|^2), accounted for
    shift: float  # reference shift of the output
    bias: Float[np.ndarray, " states"]  # on the state derivatives of `jq.realise(model)`
    band: tuple[float, float] | None = eqx.field(static=True)  # rad/s
    output_name: str = eqx.field(static=True)
    output_unit: str = eqx.field(static=True)

    def __str__(self) -> str:
        where = "whole band"
        if self.band:
            where = f"{self.band[0]:.4g}..{self.band[1]:.4g} rad/s"
        return (
            f"verification on {self.output_name}, {where}: fit {self.fit_percent:.1f} %, "
            f"variance accounted for {self.variance_percent:.1f} %, TIC {self.tic:.3f} (good "
            f"below 0.25), J_rms {self.rms:.4g} {self.output_unit}"
        ).rstrip()


def verify(
    model: Any,
    record: Record,
    *,
    band: tuple[float, float] | None = None,
    hold: str = "first",
) -> Verification:
    """Simulate the measured input open loop and compare, on a record that was not fitted.

    `model` is a `TransferFunction` or has a method `transfer_function()`. Constant biases
    on the state derivatives and a shift of the output are estimated by least squares, for no
    record starts in perfect trim. `band` (rad/s) restricts the comparison: an
    integrating plant drifts on disturbances that no model predicts. `hold` says how the input
    runs between its samples: "first" (straight), which suits an identified model, whose delay
    contains the half sample for which an input is held; or "zero" (held), for one without.
    Source: Tischler & Remple, time-domain verification.
    """
    require_x64("a verification")
    if len(record.input_names) != 1 or len(record.output_names) != 1:
        raise ValueError(
            f"verify compares one input with one output, the record has {record.input_names} and "
            f"{record.output_names}: pick them with jq.select"
        )
    plant = _transfer_function(model)
    u, y = record.inputs[:, 0], record.outputs[:, 0]
    forced = np.asarray(simulate_linear(plant, jnp.asarray(u - u[0]), record.dt, hold=hold))
    biases = np.asarray(free_responses(plant, record.samples, record.dt)[1])
    columns = np.column_stack([y, forced, np.ones_like(y), biases])
    if not np.all(np.isfinite(columns)):
        raise ValueError(
            f"the model's open-loop response overflows within {record.duration:.4g} s: its poles "
            f"are {np.asarray(plant.poles)}; verify an unstable model on a shorter record"
        )
    return _compare(record, _filtered(columns, record, band), biases.shape[1], band)


def _transfer_function(model: Any) -> TransferFunction:
    if isinstance(model, TransferFunction):
        return model
    if not hasattr(model, "transfer_function"):
        raise ValueError(
            f"{type(model).__name__} has no transfer_function(): verify needs a "
            "jq.TransferFunction, or a model with that method"
        )
    return model.transfer_function()


def _filtered(
    columns: Float[np.ndarray, "samples columns"],
    record: Record,
    band: tuple[float, float] | None,
) -> Float[np.ndarray, "samples columns"]:
    if band is None:
        return columns
    nyquist = np.pi / record.dt
    if not 0 < band[0] < band[1] < nyquist:
        raise ValueError(
            f"band {band} rad/s must rise and lie between 0 and the Nyquist frequency {nyquist:.4g}"
        )
    from scipy.signal import butter, sosfiltfilt

    sections = butter(3, np.asarray(band) / nyquist, "bandpass", output="sos")
    return sosfiltfilt(sections, columns, axis=0)


def _compare(
    record: Record,
    columns: Float[np.ndarray, "samples columns"],
    states: int,
    band: tuple[float, float] | None,
) -> Verification:
    measured, forced, free = columns[:, 0], columns[:, 1], columns[:, 2:]
    scale = np.linalg.norm(free, axis=0)
    scale = np.where(scale > 1e-12 * scale.max(), scale, np.inf)
    weights = np.linalg.lstsq(free / scale, measured - forced, rcond=1e-9)[0] / scale
    simulated = forced + free @ weights
    difference = measured - simulated
    rms = float(np.sqrt(np.mean(difference**2)))
    sizes = [float(np.sqrt(np.mean(x**2))) for x in (measured, simulated)]
    spread = float(np.std(measured))
    if spread == 0:
        raise ValueError(f"output {record.output_names[0]} does not move: nothing to compare with")
    return Verification(
        time=record.time,
        measured=measured,
        simulated=simulated,
        rms=rms,
        tic=rms / sum(sizes),
        fit_percent=100 * (1 - rms / spread),
        variance_percent=100 * (1 - (rms / spread) ** 2),
        shift=float(weights[0]),
        bias=weights[1 : 1 + states],
        band=band,
        output_name=record.output_names[0],
        output_unit=record.output_units[0],
    )
