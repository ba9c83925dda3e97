"""Responses over frequency, measured and modelled."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Bool, Complex, Float
from matplotlib.axes import Axes

from ._panels import (
    add_hertz,
    arrange,
    AxesLike,
    COHERENT,
    few_ticks,
    legend_of,
    look_of,
    Panels,
    plain_ticks,
    short_names,
    stacked,
    Style,
    WIDTH,
)
from ._shown import (
    Channels,
    channels_shown,
    frequencies_of,
    Measured,
    measured_and_modelled,
    Modelled,
    response_as_sampled,
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
    ax: AxesLike = None,
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
    responses = [response_as_sampled(entry, grid, measured) for entry in modelled]
    rows = 3 if measured else 2
    panels = stacked(rows * len(places), ax, columns=columns)
    for place, (o, i) in enumerate(places):
        axes = _block(panels, place, columns, rows)
        curves = [_measured_curve(response, o, i) for response in measured]
        curves += [
            _model_curve(entry, grid, response[:, o, i], o, i)
            for entry, response in zip(modelled, responses, strict=True)
        ]
        _draw_pair(axes, measured, modelled, curves)
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
    measured: Sequence[Measured],
    modelled: Sequence[Modelled],
    curves: Sequence[_Curve],
) -> None:
    """All curves, those of models last, on the 360 deg branch of the first one's good points.

    The vertical axes show every good point and the models, whatever the other points do.
    """
    first = curves[0]
    good = first.good if first.good.any() else slice(None)
    same_branch = []
    for curve in curves:
        difference = np.interp(first.omega[good], curve.omega, curve.phase) - first.phase[good]
        turns = 360 * np.round(np.median(difference) / 360)
        same_branch.append(curve._replace(phase=curve.phase - turns))
    models = same_branch[len(measured) :]
    for k, (response, curve) in enumerate(zip(measured, same_branch, strict=False)):
        if k == 0:
            _draw_measured(axes, first, response)
            continue
        mark, good = _MARKS[(k - 1) % len(_MARKS)], curve.good
        style: Style = {"marker": mark, "color": "tab:red"}
        for axis, level in zip(axes, (curve.magnitude, curve.phase), strict=False):
            axis.plot(curve.omega[good], level[good], ls="none", ms=5, mew=0.9,
                      label=response.name, **style)  # fmt: skip
        axes[2].plot(curve.omega, curve.coherence, ls=":", ms=3, lw=0.8, **style)
    for k, (entry, curve) in enumerate(zip(modelled, models, strict=True)):
        look = look_of(k, entry.name)
        for axis, level, reach in (
            (axes[0], curve.magnitude, curve.decibels),
            (axes[1], curve.phase, curve.degrees),
        ):
            if entry.fit is not None and np.any(reach > 0):
                axis.fill_between(curve.omega, level - reach, level + reach, alpha=0.3, lw=0,
                                  color=look["color"], label=f"{entry.name}, 95 %")  # fmt: skip
            axis.plot(curve.omega, level, **look)
    if not first.good.any():
        return
    magnitudes = [(curve.magnitude, curve.decibels) for curve in models]
    phases = [(curve.phase, curve.degrees) for curve in models]
    for axis, level, of_models, widest in (
        (axes[0], first.magnitude, magnitudes, _WIDEST[0]),
        (axes[1], first.phase, phases, _WIDEST[1]),
    ):
        ends = [y + sign * np.minimum(reach, widest) for y, reach in of_models for sign in (-1, 1)]
        shown = np.concatenate([level[first.good], *ends])
        shown = shown[np.isfinite(shown)]
        margin = 0.06 * np.ptp(shown) + 1
        axis.set_ylim(shown.min() - margin, shown.max() + margin)


def _measured_curve(response: Measured, o: int, i: int) -> _Curve:
    """Its phase is unwrapped over good points only: one noisy point would turn all after it."""
    frf = response.frf
    coherence = np.asarray(frf.coherence)[:, o, i]
    good = coherence >= COHERENT if response.used is None else np.asarray(response.used)[:, o, i]
    angle = np.angle(np.asarray(frf.response)[:, o, i])
    phase = np.degrees(angle)
    if good.any():
        place = np.arange(angle.size)
        near = np.interp(place, place[good], np.unwrap(angle[good]))
        phase = np.degrees(near + np.angle(np.exp(1j * (angle - near))))
        phase = phase - 360 * np.round((np.median(phase[good]) + 180) / 360)
    omega, error = np.asarray(frf.omega), 1.96 * np.asarray(frf.random_error)[:, o, i]
    decibels, degrees = 20 / np.log(10) * error, np.degrees(error)
    return _Curve(omega, frf.magnitude_db[:, o, i], phase, coherence, decibels, degrees, good)


def _model_curve(
    entry: Modelled,
    omega: Float[np.ndarray, " frequencies"],
    response: Complex[np.ndarray, " frequencies"],
    o: int,
    i: int,
) -> _Curve:
    phase = np.degrees(np.unwrap(np.angle(response)))
    phase -= 360 * np.ceil((phase[0] - 91) / 360)  # begins above -270 deg, and at 90 deg at most
    decibels = degrees = np.zeros_like(omega)
    if entry.fit is not None:
        band = entry.fit.response_band(omega)
        decibels, degrees = band.decibels[:, o, i], band.degrees[:, o, i]
    with np.errstate(divide="ignore"):
        magnitude = 20 * np.log10(np.abs(response))
    one = np.ones_like(omega)
    return _Curve(omega, magnitude, phase, one, decibels, degrees, one > 0)


def _draw_measured(axes: Sequence[Axes], curve: _Curve, response: Measured) -> None:
    omega, good, name = curve.omega, curve.good, response.name
    why = "not used" if response.used is not None else f"coherence below {COHERENT}"
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


_WIDEST = 6.0, 45.0  # dB and deg of a band that sets the limits of an axis
_LINE = 30  # letters that are as long as a panel is high


def _label(
    axes: Sequence[Axes], channels: Channels, o: int, i: int, *, top: bool, bottom: bool
) -> None:
    ratio, unit, size = channels.ratio(o, i), channels.unit(o, i), "magnitude, dB"
    if len(ratio) > _LINE:
        above, below = short_names(ratio.split(" / ", 1))
        size = f"|{above} /\n{below}|, dB"
    elif ratio:
        size = f"|{ratio}|, dB"
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


def _coherence_axis(axis: Axes) -> None:
    axis.set_yticks((0, 0.5, 1))
    axis.set_ylim(0, 1.02)
    axis.axhline(COHERENT, color="0.4", lw=0.8, ls="--")
    axis.text(0.995, COHERENT + 0.02, f"{COHERENT}", ha="right", va="bottom", fontsize=8,
              color="0.3", transform=axis.get_yaxis_transform())  # fmt: skip


def coherence(
    *shown: Thing,
    pair: tuple[str, str] | None = None,
    ax: AxesLike = None,
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
        names = ", ".join(entry.name for entry in modelled)
        raise ValueError(f"{names}: a model has no coherence; give a measured response or a record")
    channels = channels_shown(measured, modelled)
    places = channels.places(pair)
    panels = stacked(len(places), ax)
    for panel, (o, i) in zip(panels, places, strict=True):
        for k, response in enumerate(measured):
            curve = _measured_curve(response, o, i)
            look: Style = look_of(k, response.name) | {"lw": 1.2}
            panel.plot(curve.omega, curve.coherence, **look)
        panel.set_ylabel(f"coherence\n{channels.ratio(o, i)}")
        panel.grid(True, color="0.9", lw=0.5)
        _coherence_axis(panel)
    panels[-1].set(xscale="log", xlabel="frequency, rad/s")
    for panel in panels:
        panel.set_xscale("log")
        plain_ticks(panel.xaxis)
    add_hertz(panels[0])
    legend = legend_of(panels[:1]) if len(measured) > 1 else None
    return arrange(panels, [1.8] * len(places), above=0.45, title=title, legend=legend)
