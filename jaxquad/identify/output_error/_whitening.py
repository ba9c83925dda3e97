"""Outputs through the inverse of their noise models, within a compiled problem."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from ._noise_model import LONGEST, NoiseModel, shocks_of


class Whitener(eqx.Module):
    """`shocks_of` as a convolution: noise models of any order make arrays of the same shapes."""

    spectrum: Complex[Array, "bins outputs"]  # of the filter from rest
    memory: Float[Array, "samples heads outputs"]  # what the first samples left in that filter
    start: Int[Array, " outputs"]  # the first sample that is predicted
    length: int = eqx.field(static=True)

    def __call__(
        self, x: Float[Array, "samples outputs *columns"]
    ) -> Float[Array, "samples outputs *columns"]:
        """The part of `x` that its past does not predict, output by output."""
        ones = (1,) * (x.ndim - 2)
        seen = jnp.fft.rfft(x, self.length, axis=0)
        spectrum = self.spectrum.reshape(*self.spectrum.shape, *ones)
        rest = jnp.fft.irfft(seen * spectrum, self.length, axis=0)[: len(x)]
        rest -= jnp.einsum("tho,ho...->to...", self.memory, x[: self.memory.shape[1]])
        predicted = jnp.arange(len(x))[:, None] >= self.start[None]
        return jnp.where(predicted.reshape(*predicted.shape, *ones), rest, 0.0)


def make_whitener(models: Sequence[NoiseModel], samples: int) -> Whitener:
    """The whitener of a record's outputs; shocks keep their size."""
    from scipy.fft import next_fast_len
    from scipy.signal import lfilter

    length = int(next_fast_len(2 * samples, real=True) or 2 * samples)
    heads = np.eye(samples, min(LONGEST, samples))
    spectra, memories = [], []
    for model in models:
        from_rest = np.asarray(lfilter(model.denominator, model.numerator, heads, axis=0))
        spectra.append(np.fft.rfft(from_rest[:, 0], length))
        memories.append(from_rest - shocks_of(heads, model))
    return Whitener(
        jnp.asarray(np.stack(spectra, axis=1)),
        jnp.asarray(np.stack(memories, axis=2)),
        jnp.asarray([model.order[0] for model in models]),
        length,
    )


def white(outputs: int) -> list[NoiseModel]:
    """Noise models that predict nothing."""
    return [NoiseModel(np.ones(1), np.ones(1), 1.0) for _ in range(outputs)]
