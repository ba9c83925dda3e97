"""What a misfit costs: weights on the logarithm of the ratio of model to measurement."""

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
