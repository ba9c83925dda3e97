"""What a model leaves unexplained, over frequency and over time."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, PyTree
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from jaxquad.identify import as_sampled, Fit, model_response, Verification, verify
from jaxquad.models import Model
from jaxquad.records import clock_start, Record
from jaxquad.spectra import FrequencyResponse

from ._labels import add_hertz, few_ticks, plain_ticks
from ._names import COHERENT, unit_label
from ._panels import arrange, Given, Panels, stacked
from ._shown import channels_shown, Measured


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
    omega = np.asarray(frf.omega)
    modelled = model_response(as_sampled(model, frf), omega)[:, output, source]
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


def resid(
    model: PyTree,
    data: FrequencyResponse | Record | None = None,
    *,
    pair: tuple[str, str] | None = None,
    ax: Given = None,
    title: str = "",
) -> Panels:
    """Draw what a model leaves unexplained: of a response over frequency, of a record over time.

    Over frequency, measured minus model is in units of its random error, with the band that holds
    95 % of white ones; points whose coherence is below 0.6 are faint. Over time, each output has
    two panels: measured minus simulated, and its autocorrelation with the bound within which 95 %
    of the lags of white noise lie.

    !!! example

        ```python
        jq.plot.resid(fit)  # on the response that was fitted
        jq.plot.resid(fit, second_flight)
        ```

    **Arguments:**

    - `model`: a fit, or a model as `jq.verify` or `jq.fit` take it; or what is drawn already, a
        `jq.plot.Residuals` or a `jq.identify.Verification`.
    - `data`: a measured response or a record; by default the response of the fit.
    - `pair`: names of output and input of a measured response; by default the first of each.
    - `ax`: axes to draw into: two, of a record two for each output.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.

    **Raises:** ValueError for a model without data, and for an unknown `pair`.
    """
    if isinstance(model, Residuals):
        return _over_frequency(model, ax, title)
    if isinstance(model, Verification):
        return _over_time(model, ax, title)
    fitted = model.model if isinstance(model, Fit) else model
    if data is None and isinstance(model, Fit) and model.origin is not None:
        data = model.origin.frfs[0]
    if isinstance(data, Record):
        return _over_time(verify(fitted, data), ax, title)
    if data is None:
        raise ValueError(
            "resid needs what was measured: give a response or a record as the second argument"
        )
    [(o, i), *_] = channels_shown([Measured("", data)], []).places(pair)
    return _over_frequency(residuals_of(data, fitted, o, i), ax, title)


def _over_frequency(found: Residuals, ax: Given, title: str) -> Panels:
    panels = stacked(2, ax)
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
        panel.grid(True, color="0.93", lw=0.5)
        panel.set_xscale("log")
        plain_ticks(panel.xaxis)
    panels[1].set_xlabel("frequency, rad/s")
    panels[1].set_xlim(found.omega[0] / 1.05, found.omega[-1] * 1.05)
    add_hertz(panels[0])
    return arrange(panels, (1.6, 1.6), above=0.45, title=title)


def autocorrelation(values: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " lags"]:
    """The autocorrelation of a signal about its mean, at lags of 0 to a quarter of its samples."""
    centred = values - np.mean(values)
    spectrum = np.abs(np.fft.rfft(centred, 2 * values.size)) ** 2
    found = np.fft.irfft(spectrum)[: max(values.size // 4, 2)]
    return found / found[0] if found[0] > 0 else found


_LAGS = 400  # that are drawn


def _over_time(check: Verification, ax: Given, title: str) -> Panels:
    count, samples = len(check.outputs), check.time.size
    panels = stacked(2 * count, ax, shared=False)
    left = (check.measured - check.simulated).reshape(samples, count)
    dt = float(check.time[-1] - check.time[0]) / (samples - 1)
    for k, one in enumerate(check.outputs):
        scale, unit = unit_label(one.unit)
        top, bottom = panels[2 * k], panels[2 * k + 1]
        top.plot(check.time - clock_start(check.time), scale * left[:, k], color="tab:red", lw=0.8)
        top.set(ylabel=f"{one.name}, measured\nminus model{unit}", xlabel="time, s")
        _correlation(bottom, autocorrelation(left[:, k])[:_LAGS], dt, 1.96 / np.sqrt(samples))
        for panel in (top, bottom):
            panel.grid(True, color="0.92", lw=0.5)
            few_ticks(panel.yaxis, 5)
            panel.margins(x=0)
    return arrange(panels, [1.7, 1.5] * count, gap=0.55, title=title)


def _correlation(panel: Axes, found: Float[np.ndarray, " lags"], dt: float, bound: float) -> None:
    lags = dt * np.arange(found.size)
    panel.axhspan(-bound, bound, color="0.85", lw=0)
    panel.axhline(0, color="0.4", lw=0.8)
    panel.plot(lags, found, color="0.15", lw=1.0)
    outside = 100 * float(np.mean(np.abs(found[1:]) > bound))
    panel.text(0.99, 0.93, f"{outside:.0f} % of the lags outside (5 % if white)", fontsize=8,
               ha="right", va="top", transform=panel.transAxes)  # fmt: skip
    panel.set(xlabel="lag, s", ylabel="autocorrelation")
