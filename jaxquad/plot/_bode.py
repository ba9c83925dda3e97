"""Responses over frequency, measured and modelled."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Bool, Complex, Float
from matplotlib.axes import Axes

from ._labels import add_hertz, few_ticks, look_of, plain_ticks, Style
from ._names import COHERENT, short_names
from ._panels import arrange, Given, legend_of, Panels, stacked, WIDTH
from ._shown import (
    Channels,
    channels_shown,
    frequencies_of,
    Measured,
    measured_and_modelled,
    Modelled,
    response_beside,
    Thing,
)


_MARKS = ["x", "+", "^", "s"]
_COLUMN = 4.6  # inches, of one input of several


class _Curve(NamedTuple):
    omega: Float[np.ndarray, " frequencies"]  # rad/s
    magnitude: Float[np.ndarray, " frequencies"]  # dB
    phase: Float[np.ndarray, " frequencies"]  # deg
    coherence: Float[np.ndarray, " frequencies"]
    decibels: Float[np.ndarray, " frequencies"]  # half of the 95 % band
    degrees: Float[np.ndarray, " frequencies"]
    good: Bool[np.ndarray, " frequencies"]  # used by the fit, or coherent


def bode(
    *shown: Thing,
    pair: tuple[str, str] | None = None,
    omega: Float[ArrayLike, " frequencies"] | None = None,
    ax: Given = None,
    title: str = "",
) -> Panels:
    """Draw magnitude, phase and coherence of measured responses and of models.

    The first measured response has points with a grey band that holds 95 % of its random error.
    Points that a fit did not use, or whose coherence is below 0.6, are grey and have no band. The
    model of a fit has a band of 95 %, model error included. Several inputs and outputs are a grid:
    an input for each column. As the paper's Figure 5.

    !!! example

        ```python
        jq.plot.bode(fit)
        jq.plot.bode(response, {"identified": fit, "data sheet": model}).figure.savefig("bode.png")
        ```

    **Arguments:**

    - `shown`: what to draw: models with `frequency_response(omega)`, measured responses, records,
        fits of `jq.fit`, loops (broken at the command); one by one, in lists, or in mappings from
        the texts of the legend. Models are drawn as a record's samples show them, with the hold of
        its input.
    - `pair`: names of output and input; by default all pairs.
    - `omega`: where models are drawn, in rad/s; by default where there are measurements, else
        about poles and zeros.
    - `ax`: axes to draw into, as many as panels: magnitude, phase and, with a measured response,
        coherence, from top to bottom; of several pairs row by row.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`, the axes.

    **Raises:** ValueError for an unknown `pair`, for things without a frequency response, and for
    more than there are lines or marks.
    """
    measured, modelled = measured_and_modelled(shown, "bode")
    channels = channels_shown(measured, modelled)
    places = channels.places(pair)
    columns = len({i for _, i in places})
    grid = frequencies_of(measured, modelled, None if omega is None else np.asarray(omega, float))
    beside = measured[0].frf if measured else None
    responses = [response_beside(each, grid, beside) for each in modelled]
    rows = 3 if measured else 2
    panels = stacked(rows * len(places), ax, columns=columns)
    for place in range(len(places)):
        axes = _block(panels, place, columns, rows)
        o, i = places[place]
        curves = [_measured_curve(each, o, i) for each in measured]
        drawn = [
            _model_curve(each, grid, found[:, o, i], o, i)
            for each, found in zip(modelled, responses, strict=True)
        ]
        _draw_pair(axes, list(zip(measured, curves, strict=True)),
                   list(zip(modelled, drawn, strict=True)))  # fmt: skip
        _label(axes, channels, o, i, top=place < columns, bottom=place >= len(places) - columns)
    heights = [2.1, 2.1, 1.1][:rows] * (len(places) // columns)
    gaps = (([0.12] * (rows - 1) + [0.3]) * (len(places) // columns))[:-1]
    width = WIDTH if columns == 1 else _COLUMN * columns
    legend = legend_of(_block(panels, 0, columns, rows)[:1])
    return arrange(panels, heights, columns=columns, width=width, above=0.45, gap=gaps,
                   title=title, legend=legend, handle_length=2.6)  # fmt: skip


def _block(panels: Panels, place: int, columns: int, rows: int) -> list[Axes]:
    """The panels of one pair, from top to bottom."""
    row, column = divmod(place, columns)
    return [panels[(row * rows + k) * columns + column] for k in range(rows)]


def _draw_pair(
    axes: Sequence[Axes],
    measured: Sequence[tuple[Measured, _Curve]],
    modelled: Sequence[tuple[Modelled, _Curve]],
) -> None:
    """All curves on the 360 deg branch of the first one."""
    first = next(curve for _, curve in [*measured, *modelled])
    for k, (each, curve) in enumerate(measured):
        if k == 0:
            _draw_measured(axes, curve, each)
        else:
            _draw_other(axes, _beside(curve, first), each.name, k - 1)
    for k, (each, curve) in enumerate(modelled):
        _draw_model(axes, _beside(curve, first), each, k)
    _scale(axes, first, [_beside(curve, first) for _, curve in modelled])


def _measured_curve(each: Measured, o: int, i: int) -> _Curve:
    frf = each.frf
    coherence = np.asarray(frf.coherence)[:, o, i]
    good = coherence >= COHERENT if each.used is None else np.asarray(each.used)[:, o, i]
    angle = np.angle(np.asarray(frf.response)[:, o, i])
    omega, error = np.asarray(frf.omega), 1.96 * np.asarray(frf.random_error)[:, o, i]
    decibels, degrees = 20 / np.log(10) * error, np.degrees(error)
    magnitude = frf.magnitude_db[:, o, i]
    return _Curve(omega, magnitude, _phase(angle, good), coherence, decibels, degrees, good)


def _phase(
    angle: Float[np.ndarray, " frequencies"], good: Bool[np.ndarray, " frequencies"]
) -> Float[np.ndarray, " frequencies"]:
    """Degrees, unwrapped over good points only: one noisy point would turn all after it."""
    place = np.arange(angle.size)
    if not good.any():
        return np.degrees(angle)
    near = np.interp(place, place[good], np.unwrap(angle[good]))
    phase = np.degrees(near + np.angle(np.exp(1j * (angle - near))))
    return phase - 360 * np.round((np.median(phase[good]) + 180) / 360)


def _model_curve(
    each: Modelled,
    omega: Float[np.ndarray, " frequencies"],
    response: Complex[np.ndarray, " frequencies"],
    o: int,
    i: int,
) -> _Curve:
    phase = np.degrees(np.unwrap(np.angle(response)))
    phase -= 360 * np.ceil((phase[0] - 91) / 360)  # begins above -270 deg, and at 90 deg at most
    none, one = np.zeros_like(omega), np.ones_like(omega)
    decibels, degrees = none, none
    if each.fit is not None:
        band = each.fit.response_band(omega)
        decibels, degrees = band.decibels[:, o, i], band.degrees[:, o, i]
    with np.errstate(divide="ignore"):
        magnitude = 20 * np.log10(np.abs(response))
    return _Curve(omega, magnitude, phase, one, decibels, degrees, one > 0)


def _beside(curve: _Curve, first: _Curve) -> _Curve:
    """The curve on the same 360 deg branch as the good points of the first one."""
    good = first.good if first.good.any() else slice(None)
    difference = np.interp(first.omega[good], curve.omega, curve.phase) - first.phase[good]
    return curve._replace(phase=curve.phase - 360 * np.round(np.median(difference) / 360))


def _draw_measured(axes: Sequence[Axes], curve: _Curve, each: Measured) -> None:
    omega, good, name = curve.omega, curve.good, each.name
    why = "not used" if each.used is not None else f"coherence below {COHERENT}"
    for axis, level, error in (
        (axes[0], curve.magnitude, curve.decibels),
        (axes[1], curve.phase, curve.degrees),
    ):
        if good.any():
            reach = np.where(good, error, np.nan)
            low, high = level - reach, level + reach
            axis.fill_between(omega, low, high, color="0.75", lw=0, label="95 % band")
            axis.plot(omega[good], level[good], "o", ms=3.5, color="0.15", label=name)
        if not good.all():
            label = f"{name}, {why}"
            axis.plot(omega[~good], level[~good], "o", ms=3, mfc="none", mec="0.7", label=label)
    axes[2].plot(omega, curve.coherence, "o-", ms=2.5, lw=0.8, color="0.15")


def _draw_other(axes: Sequence[Axes], curve: _Curve, name: str, k: int) -> None:
    mark, good = _MARKS[k % len(_MARKS)], curve.good
    style: Style = dict(ls="none", marker=mark, ms=5, mew=0.9, color="tab:red", label=name)
    axes[0].plot(curve.omega[good], curve.magnitude[good], **style)
    axes[1].plot(curve.omega[good], curve.phase[good], **style)
    axes[2].plot(curve.omega, curve.coherence, ls=":", marker=mark, ms=3, lw=0.8, color="tab:red")


def _draw_model(axes: Sequence[Axes], curve: _Curve, each: Modelled, k: int) -> None:
    style = look_of(k, each.name)
    for axis, level, reach in (
        (axes[0], curve.magnitude, curve.decibels),
        (axes[1], curve.phase, curve.degrees),
    ):
        if each.fit is not None and np.any(reach > 0):
            axis.fill_between(curve.omega, level - reach, level + reach, alpha=0.3, lw=0,
                              color=style["color"], label=f"{each.name}, 95 %")  # fmt: skip
        axis.plot(curve.omega, level, **style)


_WIDEST = 6.0, 45.0  # dB and deg of a band that sets the limits of an axis


def _scale(axes: Sequence[Axes], first: _Curve, models: Sequence[_Curve]) -> None:
    """Axes that show every good point and the models, whatever the other points do."""
    if not first.good.any():
        return
    magnitudes = [(each.magnitude, each.decibels) for each in models]
    phases = [(each.phase, each.degrees) for each in models]
    for axis, level, curves, widest in (
        (axes[0], first.magnitude, magnitudes, _WIDEST[0]),
        (axes[1], first.phase, phases, _WIDEST[1]),
    ):
        ends = [y + sign * np.minimum(reach, widest) for y, reach in curves for sign in (-1, 1)]
        shown = np.concatenate([level[first.good], *ends])
        shown = shown[np.isfinite(shown)]
        margin = 0.06 * np.ptp(shown) + 1
        axis.set_ylim(shown.min() - margin, shown.max() + margin)


def _label(
    axes: Sequence[Axes], channels: Channels, o: int, i: int, *, top: bool, bottom: bool
) -> None:
    unit = channels.unit(o, i)
    size = _size(channels.ratio(o, i))
    texts = (f"{size}\n({unit})" if unit else size, "phase, deg", "coherence")
    for axis, text in zip(axes, texts, strict=False):
        axis.set_ylabel(text)
        axis.grid(True, color="0.9", lw=0.5)
        few_ticks(axis.yaxis, 5)
    if len(axes) > 2:
        _coherence_axis(axes[2])
    axes[0].set_xscale("log")
    for axis in axes:
        plain_ticks(axis.xaxis)
    if bottom:
        axes[-1].set_xlabel("frequency, rad/s")
    if top:
        add_hertz(axes[0])


_LINE = 30  # letters that are as long as a panel is high


def _size(ratio: str) -> str:
    """The label of a magnitude, in two lines where the names are long."""
    if not ratio:
        return "magnitude, dB"
    if len(ratio) <= _LINE:
        return f"|{ratio}|, dB"
    above, below = short_names(ratio.split(" / ", 1))
    return f"|{above} /\n{below}|, dB"


def _coherence_axis(axis: Axes) -> None:
    axis.set_yticks((0, 0.5, 1))
    axis.set_ylim(0, 1.02)
    axis.axhline(COHERENT, color="0.4", lw=0.8, ls="--")
    axis.text(0.995, COHERENT + 0.02, f"{COHERENT}", ha="right", va="bottom", fontsize=8,
              color="0.3", transform=axis.get_yaxis_transform())  # fmt: skip


def coherence(
    *shown: Thing,
    pair: tuple[str, str] | None = None,
    ax: Given = None,
    title: str = "",
) -> Panels:
    """Draw the coherence of measured responses over frequency.

    **Arguments:**

    - `shown`: measured responses, records or fits, as in `jq.plot.bode`.
    - `pair`: names of output and input; by default a panel for each pair.
    - `ax`: axes to draw into, one for each pair.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.

    **Raises:** ValueError for what was not measured, and for an unknown `pair`.
    """
    measured, modelled = measured_and_modelled(shown, "coherence")
    if not measured:
        names = ", ".join(each.name for each in modelled)
        raise ValueError(f"{names}: a model has no coherence; give a measured response or a record")
    channels = channels_shown(measured, modelled)
    places = channels.places(pair)
    panels = stacked(len(places), ax)
    for panel, (o, i) in zip(panels, places, strict=True):
        for k, each in enumerate(measured):
            curve = _measured_curve(each, o, i)
            look: Style = look_of(k, each.name) | {"lw": 1.2}
            panel.plot(curve.omega, curve.coherence, **look)
        panel.set_ylabel(f"coherence\n{channels.ratio(o, i)}")
        panel.grid(True, color="0.9", lw=0.5)
        _coherence_axis(panel)
    finish_frequencies(panels)
    legend = legend_of(panels[:1]) if len(measured) > 1 else None
    return arrange(panels, [1.8] * len(places), above=0.45, title=title, legend=legend)


def finish_frequencies(panels: Panels) -> None:
    """A logarithmic axis in rad/s below, and in Hz above."""
    panels[-1].set(xscale="log", xlabel="frequency, rad/s")
    for panel in panels:
        panel.set_xscale("log")
        plain_ticks(panel.xaxis)
    add_hertz(panels[0])
