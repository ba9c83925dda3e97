from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxquad.spectra import FrequencyResponse

from ._bode import COHERENT, Model, model_response
from ._labels import plain_ticks


_SIGMAS = 1.96  # of a normal error, that hold 95 %
_OUTSIDE = 6.0  # standard errors, where the picture ends at least


class Residuals(NamedTuple):
    """Measured minus model, of one response, in units of its random error."""

    omega: Float[np.ndarray, " frequencies"]  # rad/s
    magnitude: Float[np.ndarray, " frequencies"]
    phase: Float[np.ndarray, " frequencies"]
    decibels: Float[np.ndarray, " frequencies"]  # the same in dB
    degrees: Float[np.ndarray, " frequencies"]  # and in deg
    coherent: Bool[np.ndarray, " frequencies"]

    @property
    def outside(self) -> float:
        """Share of the coherent points beyond 1.96 errors: 5 % if the model explains them."""
        return float(np.mean(np.abs(self._both) > _SIGMAS)) if self.coherent.any() else np.nan

    @property
    def rms(self) -> float:
        """Of the coherent points: 1 if the model explains them."""
        return float(np.sqrt(np.mean(self._both**2))) if self.coherent.any() else np.nan

    @property
    def _both(self) -> Float[np.ndarray, " points"]:
        return np.concatenate([self.magnitude[self.coherent], self.phase[self.coherent]])


def residuals_of(frf: FrequencyResponse, model: Model, output: int, source: int) -> Residuals:
    """The logarithm of measured over modelled response, whose parts are magnitude and phase.

    **Arguments:**

    - `frf`, `model`: the measured response, and a model with `frequency_response(omega)`.
    - `output`, `source`: places of output and input.
    """
    modelled = np.asarray(model_response(model, jnp.asarray(frf.omega)))[:, output, source]
    pair = (slice(None), output, source)
    with np.errstate(all="ignore"):
        difference = np.log(np.asarray(frf.response)[pair] / modelled)
        error = np.maximum(np.asarray(frf.random_error)[pair], 1e-7)
        size, angle = np.real(difference), np.imag(difference)
        known = np.isfinite(difference) & np.isfinite(error)
        coherent = known & (np.asarray(frf.coherence)[pair] >= COHERENT)
        decibels, degrees = 20 / np.log(10) * size, np.degrees(angle)
        omega = np.asarray(frf.omega)
        return Residuals(omega, size / error, angle / error, decibels, degrees, coherent)


def residual_figure(found: Residuals) -> Figure:
    """Draw residuals over frequency, with the band that holds 95 % of them if the model is right.

    Points whose coherence is below 0.6 are faint.
    """
    figure = Figure(figsize=(6.5, 4.0), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    for panel, values, text in (
        (panels[0], found.magnitude, "magnitude"),
        (panels[1], found.phase, "phase"),
    ):
        panel.axhspan(-_SIGMAS, _SIGMAS, color="0.87", lw=0)
        panel.axhline(0, color="0.4", lw=0.8)
        good, faint = found.coherent, ~found.coherent & np.isfinite(values)
        panel.plot(found.omega[faint], values[faint], "o", ms=3, mfc="none", mec="0.7")
        panel.plot(found.omega[good], values[good], "o", ms=3.5, color="0.15")
        reach = max(_OUTSIDE, 1.1 * np.max(np.abs(values[good]), initial=0.0))
        panel.set_ylim(-reach, reach)
        panel.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        panel.set_ylabel(f"{text} / error")
        panel.grid(True, which="both", color="0.93", lw=0.5)
    panels[1].set(xscale="log", xlabel="frequency, rad/s")
    panels[1].set_xlim(found.omega[0] / 1.05, found.omega[-1] * 1.05)
    plain_ticks(panels[1].xaxis)
    return figure
