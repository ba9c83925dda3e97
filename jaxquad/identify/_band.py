"""Which frequencies of which response pair a fit uses."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from jaxquad.spectra import FrequencyResponse

from ._cost import Mask


Range = tuple[float, float]
Band = Range | Mapping[tuple[str, str], Range | None] | None


def usable(frf: FrequencyResponse, band: Band, least: float) -> Mask:
    """Known, within the band of its pair, and coherent on the local average."""
    known = np.isfinite(np.asarray(frf.response)) & np.isfinite(np.asarray(frf.random_error))
    coherent = _local_mean(np.asarray(frf.omega), np.asarray(frf.coherence)) >= least
    return known & coherent & _inside(frf, band)


def _inside(frf: FrequencyResponse, band: Band) -> Bool[np.ndarray, "frequencies outputs inputs"]:
    if not isinstance(band, Mapping):
        one = _between(frf, band)
        return np.broadcast_to(one[:, None, None], frf.response.shape)
    inside = np.ones(frf.response.shape, dtype=bool)
    for pair, limits in band.items():
        if pair not in (pairs := _pairs(frf)):
            raise ValueError(
                f"no response pair {pair!r} for a band: (output, input) is one of {list(pairs)}"
            )
        inside[(slice(None), *pairs[pair])] = limits is not None and _between(frf, limits)
    return inside


def _pairs(frf: FrequencyResponse) -> dict[tuple[str, str], tuple[int, int]]:
    return {
        (output, source): (o, i)
        for o, output in enumerate(frf.output_names)
        for i, source in enumerate(frf.input_names)
    }


def _between(frf: FrequencyResponse, band: Range | None) -> Bool[np.ndarray, " frequencies"]:
    omega = np.asarray(frf.omega)
    low, high = band or (0.0, np.inf)
    if not low < high or not np.any((omega >= low) & (omega <= high)):
        raise ValueError(
            f"band {band} rad/s holds none of the response's frequencies, which run from "
            f"{omega[0]:.4g} to {omega[-1]:.4g} rad/s"
        )
    return (omega >= low) & (omega <= high)


def _local_mean(
    omega: Float[np.ndarray, " frequencies"],
    values: Float[np.ndarray, "frequencies outputs inputs"],
) -> Float[np.ndarray, "frequencies outputs inputs"]:
    """Mean over about a third of an octave.

    Points chosen one by one, because their own coherence came out high by chance, are biased.
    """
    apart = np.log(omega[:, None] / omega[None, :])
    kernel = np.exp(-0.5 * (apart / 0.2) ** 2)
    return np.einsum("fg,goi->foi", kernel / kernel.sum(axis=1, keepdims=True), values)
