from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxquad.records import Record
from jaxquad.spectra import require_x64

from ._coloured import orthonormal, projected_noise
from ._simulated import (
    check_channels,
    check_growth,
    forced,
    free,
    linear_model,
    Motions,
    motions_of,
)
from ._verification import agreements, Verification
from ._zero_phase import band_gain, filtered


_SEEN = 3.0  # standard errors from which a starting transient is one


def verify(
    model: Any,
    record: Record,
    *,
    band: tuple[float, float] | None = None,
    hold: str = "first",
    weights: Sequence[float] | None = None,
) -> Verification:
    """Simulate the measured inputs open loop and compare, on a record that was not fitted.

    `model` is a `TransferFunction`, a `StateSpace`, or has a method `transfer_function()` or
    `state_space()`. Constant biases on the state derivatives, the initial state and a shift of each
    output are estimated by least squares, for no record starts in perfect trim; fast starting
    transients only where they stand out from the (coloured) rest. `band` (rad/s) restricts the
    comparison: an integrating plant drifts on disturbances that no model predicts. `hold` says how
    inputs run between their samples: "first" (straight), which suits an identified model, whose
    delay contains the half sample for which an input is held; or "zero" (held), for one without.
    `weights` multiply the squares of the outputs in the measures of all together; give them where
    units differ, for by default they are 1.
    Raises ValueError for a model of other channels, and for one that outgrows the record.
    Source: Tischler & Remple, time-domain verification.
    """
    require_x64("a verification")
    plant = linear_model(model)
    check_channels(plant, record)
    gain, shares = band_gain(band, record), _weights(weights, record)
    check_growth(plant, record)
    motions = motions_of(plant, record.duration)
    parts = [
        jnp.asarray(record.outputs),
        forced(plant, jnp.asarray(record.inputs), record.dt, hold),
        free(plant, motions, record.samples, record.dt),
    ]
    gain = None if gain is None else jnp.asarray(gain)
    measured, driven, columns = (np.asarray(filtered(part, gain)) for part in parts)
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
            f"weights={weights}: give one positive number for each output, {record.output_names}"
        )
    return shares


def _spread(record: Record, measured: np.ndarray) -> Float[np.ndarray, " outputs"]:
    spread = np.std(measured, axis=0)
    for name, one in zip(record.output_names, spread, strict=True):
        if one == 0:
            raise ValueError(f"output {name} does not move: nothing to compare with")
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
    covariance = projected_noise(ways, left, orthonormal(columns))
    tested = found[-last:] * np.where(np.isfinite(scale[-last:]), scale[-last:], 0.0)
    size = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    apart = np.linalg.pinv(covariance / np.outer(size, size)) @ (tested / size)
    return float(tested / size @ apart) > last * _SEEN**2


def _physical(
    unknowns: Float[np.ndarray, " kept"], motions: Motions, outputs: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    slow, fast = np.asarray(motions.slow), np.asarray(motions.fast)
    shift, bias, start = np.split(unknowns, [outputs, outputs + slow.shape[1]])
    return shift, slow @ bias, fast[:, : start.size] @ start
