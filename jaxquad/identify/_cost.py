"""What a misfit costs: weights on the logarithm of the ratio of model to measurement."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxquad.spectra import FrequencyResponse


_DB = 20 / np.log(10)  # dB to a unit of natural logarithm
_W_P = 0.01745  # 1 dB weighs as much as 7.57 deg

Mask = Bool[np.ndarray, "frequencies outputs inputs"]
Ratio = Float[np.ndarray, "frequencies outputs inputs"]
Weights = Float[np.ndarray, "frequencies outputs inputs 2"]


@runtime_checkable
class Cost(Protocol):
    """Gives the weights of `ln|T/T^|` and of `angle(T/T^)` in rad, zero outside the mask."""

    def weights(self, frf: FrequencyResponse, used: Mask, ratio: Ratio) -> Weights:
        """`ratio` is |model / measurement|, 1 before there is a model."""
        ...


class CoherenceWeighted(eqx.Module):
    """The cost of Eq. (14), corrected: J = 20/n sum W_gamma [W_g dB^2 + W_p deg^2].

    W_gamma = [1.58 (1 - exp(-gamma^2))]^2, W_g = 1, W_p = 0.01745, summed over the responses.
    J below 100 is acceptable, below 50 very good. Source: Tischler & Remple eq. 11.4; the paper
    prints a minus and an unsquared weight.
    """

    def weights(self, frf: FrequencyResponse, used: Mask, ratio: Ratio) -> Weights:
        points = np.maximum(used.sum(axis=0, keepdims=True), 1)
        trust = 1.58 * (1 - np.exp(-np.asarray(frf.coherence)))
        root = np.where(used, np.sqrt(20 / points) * trust, 0.0)
        return np.stack([root * _DB, root * np.sqrt(_W_P) * np.degrees(1.0)], axis=-1)


class MaximumLikelihood(eqx.Module):
    """Squared log-ratio over the response's random error: the likelihood of Gaussian noise.

    The logarithm of the ratio is unbiased for circular noise. The random error is taken relative to
    the model: relative to the measurement, points that came out low by chance would weigh more.
    """

    def weights(self, frf: FrequencyResponse, used: Mask, ratio: Ratio) -> Weights:
        # 1e-7 keeps noise-free records from weights that overflow.
        error = np.maximum(np.asarray(frf.random_error), 1e-7)
        root = np.where(used, ratio / error, 0.0)
        return np.stack([root, root], axis=-1)


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
