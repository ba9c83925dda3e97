"""A band-pass without phase, as one factor for each frequency, for data and model alike."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad.records import Record


def band_gain(
    band: tuple[float, float] | None, record: Record
) -> Float[np.ndarray, " bins"] | None:
    """|H|^2 of a third-order Butterworth band-pass, forwards and backwards; None without a band.

    Raises ValueError for a band (rad/s) that does not rise or leaves the record's range.
    """
    if band is None:
        return None
    nyquist = np.pi / record.dt
    if np.shape(band) != (2,) or not 0 < band[0] < band[1] < nyquist:
        raise ValueError(
            f"band {band} rad/s must rise and lie between 0 and the Nyquist frequency {nyquist:.4g}"
        )
    from scipy.signal import butter, sosfreqz

    sections = butter(3, np.asarray(band) / nyquist, "bandpass", output="sos")
    turn = np.linspace(0, np.pi, record.samples)
    response = sosfreqz(sections, turn)[1]  # pyright: ignore
    return np.abs(response) ** 2


def filtered(
    x: Float[Array, " samples *columns"], gain: Float[Array, " bins"] | None
) -> Float[Array, " samples *columns"]:
    """`x` within the band; outside the record it continues mirrored through its two ends."""
    if gain is None:
        return x
    # A straight line is far below any band, and what is left after it starts and ends at 0.
    ones = (1,) * (x.ndim - 1)
    along = jnp.linspace(0.0, 1.0, len(x)).reshape(-1, *ones)
    level = x - x[:1] - along * (x[-1:] - x[:1])
    periodic = jnp.concatenate([level, -level[-2:0:-1]])
    spectrum = jnp.fft.rfft(periodic, axis=0)
    weighted = gain.reshape(-1, *ones).astype(spectrum.dtype) * spectrum
    return jnp.fft.irfft(weighted, len(periodic), axis=0)[: len(x)]
