"""Responses over frequency, measured and modelled, and what lies between them."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxquad.identify import as_sampled
from jaxquad.models import evaluate_response, Model
from jaxquad.spectra import FrequencyResponse

from ._labels import few_ticks, plain_ticks, Style
from ._panels import arrange, legend_of, stacked


COHERENT = 0.6  # magnitude-squared coherence from which a frequency is commonly used
_LINES = ["-", "--", "-.", ":"]
_MARKS = ["x", "+", "^", "s"]


class _Curve(NamedTuple):
    omega: Float[np.ndarray, " frequencies"]  # rad/s
    magnitude: Float[np.ndarray, " frequencies"]  # dB
    phase: Float[np.ndarray, " frequencies"]  # deg
    coherence: Float[np.ndarray, " frequencies"]
    error: Float[np.ndarray, " frequencies"]  # 1 sigma: relative, and in rad

    @property
    def good(self) -> Bool[np.ndarray, " frequencies"]:
        return self.coherence >= COHERENT


def bode(
    frf: FrequencyResponse,
    models: Model | Mapping[str, Model] | None = None,
    *,
    others: Mapping[str, FrequencyResponse] | None = None,
    pair: tuple[str, str] | None = None,
    title: str = "",
) -> Figure:
    """Draw magnitude, phase and coherence of a measured response, beside models.

    The grey band holds 95 % of the random error. Points whose coherence is below 0.6 are faint and
    have no band. As the paper's Figure 5.

    **Arguments:**

    - `frf`: the measured response.
    - `models`: a model with `frequency_response(omega)`, or several by the text of the legend. They
        are drawn as the record's samples show them, with the hold of its input.
    - `others`: further estimates of the same response, by the text of the legend.
    - `pair`: names of output and input; by default the first of each.
    - `title`: above the figure.

    **Raises:** ValueError for an unknown `pair`.
    """
    o, i = _position(frf, pair)
    figure, axes = stacked(3)
    measured = _curve(frf, o, i)
    _draw_measured(axes, measured, f"{frf.method} estimate")
    for k, (name, other) in enumerate((others or {}).items()):
        _draw_other(axes, _beside(_curve(other, *_position(other, pair)), measured), name, k)
    if not isinstance(models, Mapping):
        models = {"model": models} if models is not None else {}
    for k, (name, each) in enumerate(models.items()):
        drawn = _model_curve(as_sampled(each, frf), measured, o, i)
        _draw_model(axes, _beside(drawn, measured), name, k)
    _scale(axes, measured)
    _label(axes, f"{frf.output_names[o]} / {frf.input_names[i]}")
    arrange(figure, axes, (2.1, 2.1, 1.1), above=0.45, title=title, legend=legend_of(axes[:1]))
    return figure


def _position(frf: FrequencyResponse, pair: tuple[str, str] | None) -> tuple[int, int]:
    if pair is None:
        return 0, 0
    output, source = pair
    if output not in frf.output_names or source not in frf.input_names:
        raise ValueError(
            f"no response {pair}: outputs are {frf.output_names}, inputs {frf.input_names}"
        )
    return frf.output_names.index(output), frf.input_names.index(source)


def _curve(frf: FrequencyResponse, o: int, i: int) -> _Curve:
    coherence = np.asarray(frf.coherence)[:, o, i]
    angle = np.angle(np.asarray(frf.response)[:, o, i])
    omega, error = np.asarray(frf.omega), np.asarray(frf.random_error)[:, o, i]
    return _Curve(omega, frf.magnitude_db[:, o, i], _phase(angle, coherence), coherence, error)


def _phase(
    angle: Float[np.ndarray, " frequencies"], coherence: Float[np.ndarray, " frequencies"]
) -> Float[np.ndarray, " frequencies"]:
    """Degrees, unwrapped over coherent points only: one noisy point would turn all after it."""
    place, good = np.arange(angle.size), coherence >= COHERENT
    if not good.any():
        return np.degrees(angle)
    near = np.interp(place, place[good], np.unwrap(angle[good]))
    phase = np.degrees(near + np.angle(np.exp(1j * (angle - near))))
    return phase - 360 * np.round((np.median(phase[good]) + 180) / 360)


def _model_curve(model: Model, measured: _Curve, o: int, i: int) -> _Curve:
    omega = np.geomspace(measured.omega[0], measured.omega[-1], 300)
    response = model_response(model, omega)[:, o, i]
    phase = np.degrees(np.unwrap(np.angle(response)))
    one, none = np.ones_like(omega), np.zeros_like(omega)
    return _Curve(omega, 20 * np.log10(np.abs(response)), phase, one, none)


_AT_ONCE = 512  # frequencies of a program, so that two curves of a model share it


def model_response(
    model: Model, omega: Float[np.ndarray, " frequencies"]
) -> Complex[np.ndarray, "frequencies outputs inputs"]:
    """The response of a model at frequencies in rad/s."""
    padded = np.pad(omega, (0, -omega.size % _AT_ONCE), mode="edge").reshape(-1, _AT_ONCE)
    parts = [np.asarray(_response(model, each)) for each in padded]
    return np.concatenate(parts)[: omega.size]


@eqx.filter_jit
def _response(
    model: Model, omega: Float[Array | np.ndarray, " frequencies"]
) -> Complex[Array, "frequencies outputs inputs"]:
    return evaluate_response(model, jnp.asarray(omega))


def _beside(curve: _Curve, measured: _Curve) -> _Curve:
    """The curve on the same 360 deg branch as the measurement's coherent points."""
    good = measured.good if measured.good.any() else slice(None)
    omega = measured.omega[good]
    difference = np.interp(omega, curve.omega, curve.phase) - measured.phase[good]
    return curve._replace(phase=curve.phase - 360 * np.round(np.median(difference) / 360))


def _draw_measured(axes: Sequence[Axes], curve: _Curve, name: str) -> None:
    omega, good = curve.omega, curve.good
    decibels = 20 / np.log(10) * curve.error
    for axis, level, error in (
        (axes[0], curve.magnitude, decibels),
        (axes[1], curve.phase, np.degrees(curve.error)),
    ):
        if good.any():
            reach = np.where(good, 1.96 * error, np.nan)
            low, high = level - reach, level + reach
            axis.fill_between(omega, low, high, color="0.75", lw=0, label="95 % band")
            axis.plot(omega[good], level[good], "o", ms=3.5, color="0.15", label=name)
        if not good.all():
            label = f"{name}, coherence below {COHERENT}"
            axis.plot(omega[~good], level[~good], "o", ms=3, mfc="none", mec="0.7", label=label)
    axes[2].plot(omega, curve.coherence, "o-", ms=2.5, lw=0.8, color="0.15")


def _draw_other(axes: Sequence[Axes], curve: _Curve, name: str, k: int) -> None:
    mark, good = _MARKS[k % len(_MARKS)], curve.good
    style: Style = dict(ls="none", marker=mark, ms=5, mew=0.9, color="tab:red", label=name)
    axes[0].plot(curve.omega[good], curve.magnitude[good], **style)
    axes[1].plot(curve.omega[good], curve.phase[good], **style)
    axes[2].plot(curve.omega, curve.coherence, ls=":", marker=mark, ms=3, lw=0.8, color="tab:red")


def _draw_model(axes: Sequence[Axes], curve: _Curve, name: str, k: int) -> None:
    style: Style = dict(ls=_LINES[k % len(_LINES)], lw=1.6, color="tab:blue", label=name)
    axes[0].plot(curve.omega, curve.magnitude, **style)
    axes[1].plot(curve.omega, curve.phase, **style)


def _scale(axes: Sequence[Axes], curve: _Curve) -> None:
    """Axes that show every coherent point and the models, whatever the other points do."""
    if not curve.good.any():
        return
    for axis, level in ((axes[0], curve.magnitude), (axes[1], curve.phase)):
        lines = [line.get_ydata() for line in axis.get_lines() if line.get_linestyle() != "None"]
        shown = np.concatenate([level[curve.good], *lines])
        margin = 0.06 * np.ptp(shown) + 1
        axis.set_ylim(shown.min() - margin, shown.max() + margin)


def _label(axes: Sequence[Axes], name: str) -> None:
    for axis, text in zip(axes, (f"|{name}|, dB", "phase, deg", "coherence"), strict=True):
        axis.set_ylabel(text)
        axis.grid(True, color="0.9", lw=0.5)
        few_ticks(axis.yaxis, 5)
    axes[2].set_yticks((0, 0.5, 1))
    axes[2].axhline(COHERENT, color="0.4", lw=0.8, ls="--")
    axes[2].text(0.995, COHERENT + 0.02, f"{COHERENT}", ha="right", va="bottom", fontsize=8,
                 color="0.3", transform=axes[2].get_yaxis_transform())  # fmt: skip
    axes[2].set(ylim=(0, 1.02), xscale="log", xlabel="frequency, rad/s")
    turn = 2 * np.pi
    functions = (lambda omega: omega / turn, lambda hertz: hertz * turn)
    hertz = axes[0].secondary_xaxis("top", functions=functions)
    hertz.set_xlabel("frequency, Hz")
    for axis in (axes[2].xaxis, hertz.xaxis):
        plain_ticks(axis)


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


def residual_figure(found: Residuals) -> Figure:
    """Draw residuals over frequency, with the band that holds 95 % of them if the model is right.

    Points whose coherence is below 0.6 are faint.
    """
    figure, panels = stacked(2)
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
    panels[1].set(xscale="log", xlabel="frequency, rad/s")
    panels[1].set_xlim(found.omega[0] / 1.05, found.omega[-1] * 1.05)
    plain_ticks(panels[1].xaxis)
    arrange(figure, panels, (1.6, 1.6))
    return figure
