"""Whether another signal, such as another axis' command, takes part in an output.

At the plant's input, the residual of the local linear model holds h W, where W is what that model
does not explain of the other signal: so far as it moves with the input, both are one. h is smooth:
complex, and linear in the logarithm of frequency. Its four factors are tested together.
Source: Bendat and Piersol, "Random Data", 4th ed., ch. 7 (partial coherence).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad.records import Record

from ._estimators import COHERENT, Method
from ._frequency_response import FrequencyResponse
from ._linearity import factors_of, fast_length, FEWEST, left_over, Spectra, transform_bins


Samples = Float[np.ndarray, " _samples"]
_FACTORS = 4  # of h
_ROUNDING = 1e-6  # of the power of a signal


class OtherInput(NamedTuple):
    """What a record tells of another signal."""

    chance: float  # that noise explains as much of the output as the signal does
    alone: float  # share of the signal's power that does not move with the input


def compare_with_input(
    records: Sequence[Record], frf: FrequencyResponse, signals: Sequence[Samples]
) -> OtherInput | None:
    """Compare another signal, sampled as each record is, with the first input of a response.

    None where the response has too few coherent points, or the records too few bins.
    """
    omega, method = np.asarray(frf.omega), frf.method
    response, coherence = (np.asarray(x)[:, 0, :1] for x in (frf.response, frf.coherence))
    used = (np.isfinite(response) & (coherence >= COHERENT))[:, 0]
    if np.sum(used) < FEWEST:
        return None
    low, high = omega[used][[0, -1]]
    spectra = [
        _spectra(record, method, signal, low, high)
        for record, signal in zip(records, signals, strict=True)
    ]
    left = left_over(spectra, omega[used], response[used], (0, 0))
    if left is None:
        return None
    from scipy.special import chdtrc

    added = left.added[:, :2]
    if not left.share[0] > _ROUNDING:
        return OtherInput(1.0, 0.0)
    clear = factors_of(left, np.hstack([added, 1j * added]))[2]
    alone = left.share[0] / np.mean(1 - left.leverage)  # the model takes its share of any signal
    return OtherInput(float(chdtrc(_FACTORS, clear**2)), float(min(alone, 1.0)))


def _spectra(record: Record, method: Method, signal: Samples, low: float, high: float) -> Spectra:
    count = fast_length(record.samples)
    inputs, outputs, other = (
        transform_bins(x[:count]) for x in (record.inputs, record.outputs, signal[:, None])
    )
    moving = inputs if method == "direct" else transform_bins(record.references[:count])
    grid = 2 * np.pi / (count * record.dt) * np.arange(len(inputs))
    slope = np.log(np.maximum(grid, grid[1]) ** 2 / (low * high))[:, None] / np.log(high / low)
    added = np.hstack([other, slope * other])
    return Spectra(grid, moving, inputs[:, :1], outputs[:, :1], added, record.inputs[:0, 0])
