"""Responses over frequency and in the complex plane, measured and modelled; poles and zeros."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Bool, Complex, Float
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection

from jaxquad.identify import Fit, linear_model
from jaxquad.models import Model

from . import _panels as lay
from ._panels import AxesLike, COHERENT, Panels, Style
from ._shown import analysed, Channels, Measured, Modelled, named_models, Shown, Thing


_MARKS = ["x", "+", "^", "s"]
_COLUMN = 4.6  # inches, of one input of several


Grid = Float[np.ndarray, " frequencies"]


class _Curve(NamedTuple):
    omega: Grid  # rad/s
    magnitude: Grid  # dB
    phase: Grid  # deg
    coherence: Grid
    decibels: Grid  # half of the 95 % band
    degrees: Grid
    good: Bool[np.ndarray, " frequencies"]  # used by the fit, or coherent


def bode(
    *shown: Thing, pair: tuple[str, str] | None = None,
    omega: Float[ArrayLike, " frequencies"] | None = None, ax: AxesLike = None, title: str = "",
) -> Panels:  # fmt: skip
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

    **Raises:** ValueError for an unknown `pair`, for things without a frequency response, and for
    more than there are lines or marks.
    """
    measured, modelled = responses = Shown.of(shown, "bode")
    channels = responses.channels
    places = channels.places(pair)
    columns, grid = len({i for _, i in places}), responses.frequencies(omega)
    of_models = [responses.response(entry.model, grid) for entry in modelled]
    rows = 3 if measured else 2
    panels = lay.stacked(rows * len(places), ax, columns=columns)
    for place, (o, i) in enumerate(places):
        first = place // columns * rows * columns + place % columns
        axes = panels[first : first + rows * columns : columns]  # of one pair, from top to bottom
        curves = [_measured_curve(response, o, i) for response in measured]
        curves += [
            _model_curve(entry, grid, response[:, o, i], o, i)
            for entry, response in zip(modelled, of_models, strict=True)
        ]
        _draw_pair(axes, measured, modelled, curves)
        _label(axes, channels, o, i, top=place < columns, bottom=place >= len(places) - columns)
    heights = [2.1, 2.1, 1.1][:rows] * (len(places) // columns)
    gaps = (([0.12] * (rows - 1) + [0.3]) * (len(places) // columns))[:-1]
    width = lay.WIDTH if columns == 1 else _COLUMN * columns
    legend = lay.legend_of(panels[:1])
    return lay.arrange(panels, heights, columns=columns, width=width, above=0.45, gap=gaps,
                   title=title, legend=legend, handle_length=2.6)  # fmt: skip


def _draw_pair(
    axes: Sequence[Axes], measured: Sequence[Measured], modelled: Sequence[Modelled],
    curves: Sequence[_Curve],
) -> None:  # fmt: skip
    """All curves, those of models last, on the 360 deg branch of the first one's good points, which
    the vertical axes show, as the models, whatever the other points do."""
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
            why = "not used" if response.used is not None else f"coherence below {COHERENT}"
            omega, good, name = first.omega, first.good, response.name
            for axis, (level, error) in zip(axes, _levels(first), strict=False):
                if good.any():
                    reach = np.where(good, error, np.nan)
                    low, high = level - reach, level + reach
                    axis.fill_between(omega, low, high, color="0.75", lw=0, label="95 % band")
                    axis.plot(omega[good], level[good], "o", ms=3.5, color="0.15", label=name)
                if not good.all():
                    faint: Style = {"mfc": "none", "mec": "0.7", "label": f"{name}, {why}"}
                    axis.plot(omega[~good], level[~good], "o", ms=3, **faint)
            axes[2].plot(omega, first.coherence, "o-", ms=2.5, lw=0.8, color="0.15")
            continue
        mark, good = _MARKS[(k - 1) % len(_MARKS)], curve.good
        style: Style = {"marker": mark, "color": "tab:red"}
        for axis, level in zip(axes, (curve.magnitude, curve.phase), strict=False):
            axis.plot(curve.omega[good], level[good], ls="none", ms=5, mew=0.9,
                      label=response.name, **style)  # fmt: skip
        axes[2].plot(curve.omega, curve.coherence, ls=":", ms=3, lw=0.8, **style)
    for k, (entry, curve) in enumerate(zip(modelled, models, strict=True)):
        look = lay.look_of(k, entry.name)
        for axis, (level, reach) in zip(axes, _levels(curve), strict=False):
            if entry.fit is not None and np.any(reach > 0):
                axis.fill_between(curve.omega, level - reach, level + reach, alpha=0.3, lw=0,
                                  color=look["color"], label=f"{entry.name}, 95 %")  # fmt: skip
            axis.plot(curve.omega, level, **look)
    both = axes[:2] if first.good.any() else ()
    levels = map(_levels, (first, *models))
    for axis, widest, (level, _), *of_models in zip(both, _WIDEST, *levels, strict=False):
        ends = [y + sign * np.minimum(reach, widest) for y, reach in of_models for sign in (-1, 1)]
        shown = np.concatenate([level[first.good], *ends])
        shown = shown[np.isfinite(shown)]
        margin = 0.06 * np.ptp(shown) + 1
        axis.set_ylim(shown.min() - margin, shown.max() + margin)


def _levels(curve: _Curve) -> tuple[tuple[Grid, Grid], tuple[Grid, Grid]]:
    """Magnitude and phase, each with half of its band."""
    return (curve.magnitude, curve.decibels), (curve.phase, curve.degrees)


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
    entry: Modelled, omega: Grid, response: Complex[np.ndarray, " frequencies"], o: int, i: int
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


_WIDEST = 6.0, 45.0  # dB and deg of a band that sets the limits of an axis
_LINE = 30  # letters that are as long as a panel is high


def _label(
    axes: Sequence[Axes], channels: Channels, o: int, i: int, *, top: bool, bottom: bool
) -> None:
    ratio, unit, size = channels.ratio(o, i), channels.unit(o, i), "magnitude, dB"
    if len(ratio) > _LINE:
        above, below = lay.short_names(ratio.split(" / ", 1))
        size = f"|{above} /\n{below}|, dB"
    elif ratio:
        size = f"|{ratio}|, dB"
    texts = (f"{size}\n({unit})" if unit else size, "phase, deg", "coherence")
    for axis, text in zip(axes, texts, strict=False):
        axis.set_ylabel(text)
        axis.grid(True, color="0.9", lw=0.5)
        lay.few_ticks(axis.yaxis, 5)
    if len(axes) > 2:
        _coherence_axis(axes[2])
    axes[0].set_xscale("log")
    for axis in axes:
        lay.plain_ticks(axis.xaxis)
    if bottom:
        axes[-1].set_xlabel("frequency, rad/s")
    if top:
        lay.add_hertz(axes[0])


def _coherence_axis(axis: Axes) -> None:
    axis.set_yticks((0, 0.5, 1))
    axis.set_ylim(0, 1.02)
    axis.axhline(COHERENT, color="0.4", lw=0.8, ls="--")
    axis.text(0.995, COHERENT + 0.02, f"{COHERENT}", ha="right", va="bottom", fontsize=8,
              color="0.3", transform=axis.get_yaxis_transform())  # fmt: skip


def coherence(
    *shown: Thing, pair: tuple[str, str] | None = None, ax: AxesLike = None, title: str = ""
) -> Panels:
    """Draw the coherence of measured responses over frequency.

    **Arguments:**

    - `shown`: measured responses, records or fits, as in `jq.plot.bode`.
    - `pair`: names of output and input; by default a panel for each pair.
    - `ax`: axes to draw into, one for each pair.

    **Raises:** ValueError for what was not measured, and for an unknown `pair`.
    """
    measured, modelled = responses = Shown.of(shown, "coherence")
    if not measured:
        names = ", ".join(entry.name for entry in modelled)
        raise ValueError(f"{names}: a model has no coherence; give a measured response or a record")
    channels = responses.channels
    places = channels.places(pair)
    panels = lay.stacked(len(places), ax)
    for panel, (o, i) in zip(panels, places, strict=True):
        for k, response in enumerate(measured):
            curve = _measured_curve(response, o, i)
            look: Style = lay.look_of(k, response.name) | {"lw": 1.2}
            panel.plot(curve.omega, curve.coherence, **look)
        panel.set_ylabel(f"coherence\n{channels.ratio(o, i)}")
        panel.grid(True, color="0.9", lw=0.5)
        _coherence_axis(panel)
    panels[-1].set(xscale="log", xlabel="frequency, rad/s")
    for panel in panels:
        panel.set_xscale("log")
        lay.plain_ticks(panel.xaxis)
    lay.add_hertz(panels[0])
    legend = lay.legend_of(panels[:1]) if len(measured) > 1 else None
    return lay.arrange(panels, [1.8] * len(places), above=0.45, title=title, legend=legend)


_POLES = ("x", "+", "1", "2", "3")
_ZEROS = ("o", "s", "^", "D", "v")
_DAMPING = (0.2, 0.4, 0.6, 0.8)  # lines behind the poles


def pzmap(*shown: Thing, ax: AxesLike = None, title: str = "") -> Panels:
    """Draw poles and zeros of models and fits, and the closed-loop poles of loops.

    The poles of a fit have 95 % intervals of their real and imaginary parts. Poles of a sampled
    loop are ln(z) / dt. Grey lines are those of equal damping.

    **Arguments:**

    - `shown`: models that `jq.verify` takes, fits, `jq.Loop`s or what `jq.analyse` returns; one by
        one, in lists, or in mappings from the texts of the legend.

    **Raises:** ValueError for what has no poles, such as a measured response, and for more than
    there are marks.
    """
    things = named_models(shown, "pzmap")
    [panel] = panels = lay.stacked(1, ax)
    for k, (name, thing) in enumerate(things.items()):
        if not isinstance(thing, Fit | Model):
            poles, zeros = analysed(name, thing, "pzmap").poles, np.empty(0)
        else:
            plant = linear_model(thing.model if isinstance(thing, Fit) else thing)
            poles, zeros = plant.poles, plant.zeros
        poles, colour = poles[np.isfinite(poles)], lay.look_of(k, name)["color"]
        style: Style = {"ls": "none", "color": colour, "ms": 9.0 - k, "mew": 1.8, "zorder": 3}
        panel.plot(np.real(poles), np.imag(poles), _POLES[k], label=f"{name}, poles", **style)
        if isinstance(thing, Fit):
            half = thing.pole_reach
            panel.errorbar(
                np.real(poles), np.imag(poles), np.imag(half), np.real(half), fmt="none",
                ecolor=colour, elinewidth=1.0, capsize=2.5, label=f"{name}, 95 %",
            )  # fmt: skip
        if zeros.size:
            label = f"{name}, zeros"
            panel.plot(np.real(zeros), np.imag(zeros), _ZEROS[k], mfc="none", label=label, **style)
    panel.axhline(0, color="0.6", lw=0.8, zorder=1)
    panel.axvline(0, color="0.6", lw=0.8, zorder=1)
    panel.margins(0.12)
    (left, right), (low, high) = panel.get_xlim(), panel.get_ylim()
    least = 0.1 * (right - left)  # else rounding of equal poles fills the picture
    low, high = min(low, -least), max(high, least)
    reach = 2 * max(abs(left), abs(low), abs(high))
    for damping in _DAMPING:
        root = np.sqrt(1 - damping**2)
        x, y = [-damping * reach, 0, -damping * reach], [root * reach, 0, -root * reach]
        panel.plot(x, y, color="0.88", lw=0.7, zorder=0)
    panel.set(xlim=(left, max(right, -0.05 * left)), ylim=(low, high))
    panel.set(xlabel="real part, rad/s", ylabel="imaginary part, rad/s")
    lay.add_hertz(panel, "right", "imaginary part, Hz")
    lay.few_ticks(panel.xaxis, 6)
    return lay.arrange(panels, [4.0], right=0.75, title=title, legend=lay.legend_of(panels))


_FAR, _NEAR = 3.0, 0.3  # beyond and below which a curve does not set the limits by itself
_ELLIPSES = 30  # of a model, along its curve


def nyquist(
    *shown: Thing, pair: tuple[str, str] | None = None,
    omega: Float[ArrayLike, " frequencies"] | None = None, ax: AxesLike = None, title: str = "",
) -> Panels:  # fmt: skip
    """Draw responses in the complex plane, with -1 and the unit circle.

    Of a loop it is L, broken at the command and closed as 1 + L = 0. Negative frequencies are thin.
    Ellipses are 95 % intervals of real and imaginary part: of measured points by their random
    error, of a fit with model error.

    **Arguments:**

    - `shown`, `omega`: as in `jq.plot.bode`.
    - `pair`: names of output and input; by default the first of each.

    **Raises:** as `jq.plot.bode`.
    """
    measured, modelled = responses = Shown.of(shown, "nyquist")
    channels, grid = responses.channels, responses.frequencies(omega)
    o, i = channels.places(pair)[0]
    [panel] = panels = lay.stacked(1, ax)
    sizes = []
    for k, response in enumerate(measured):
        frf = response.frf
        good = np.asarray(frf.coherence)[:, o, i] >= COHERENT
        values = np.asarray(frf.response)[good, o, i]
        reach = 1.96 * np.asarray(frf.random_error)[good, o, i]
        _ellipses(panel, values, reach, reach, "0.6")
        mark: Style = {"ms": 3.5, "color": "0.15", "mfc": "0.15" if k == 0 else "none"}
        panel.plot(np.real(values), np.imag(values), "o", label=response.name, **mark)
        sizes.append(np.abs(values))
    for k, entry in enumerate(modelled):
        values = responses.response(entry.model, grid)[:, o, i]
        look = lay.look_of(k, entry.name)
        panel.plot(np.real(values), np.imag(values), **look)
        thin: Style = look | {"lw": 0.6, "label": "_nolegend_"}
        panel.plot(np.real(values), -np.imag(values), **thin)
        sizes.append(np.abs(values))
        if entry.fit is not None:
            some = np.linspace(0, grid.size - 1, _ELLIPSES).astype(int)
            band = entry.fit.response_band(grid[some])
            size = band.decibels[:, o, i] * np.log(10) / 20
            turn = np.radians(band.degrees[:, o, i])
            _ellipses(panel, values[some], size, turn, look["color"])
    # Limits about 0, and -1 with the unit circle where the curve comes near.
    finite = np.concatenate(sizes)
    finite = finite[np.isfinite(finite)]
    largest = float(np.max(finite, initial=_NEAR))
    reach = 1.15 * (min(largest, _FAR) if np.min(finite, initial=1.0) < _FAR else largest)
    if largest > _NEAR and reach <= 1.15 * _FAR:
        reach = max(reach, 1.5)
        angle = np.linspace(0, 2 * np.pi, 181)
        panel.plot(np.cos(angle), np.sin(angle), ":", color="0.5", lw=0.8)
        panel.plot(-1, 0, "+", color="black", ms=11, mew=1.8, zorder=4)
    panel.axhline(0, color="0.6", lw=0.8, zorder=1)
    panel.axvline(0, color="0.6", lw=0.8, zorder=1)
    panel.set(xlim=(-reach, reach), ylim=(-reach, reach))
    panel.set_aspect("equal")
    unit, name = channels.unit(o, i), channels.ratio(o, i)
    text = f"{name}{f', {unit}' if unit else ''}"
    of = f" of {text}" if text else ""
    panel.set(xlabel=f"real part{of}", ylabel=f"imaginary part{of}")
    panel.grid(True, color="0.93", lw=0.5)
    return lay.arrange(panels, [4.6], width=5.8, title=title, legend=lay.legend_of(panels))


def _ellipses(
    panel: Axes, values: Complex[np.ndarray, " points"], size: Float[np.ndarray, " points"],
    turn: Float[np.ndarray, " points"], colour: str,
) -> None:  # fmt: skip
    """Half axes by relative changes of size, and by changes of angle in rad."""
    length = np.abs(values)
    drawn = EllipseCollection(
        2 * length * size, 2 * length * turn, np.degrees(np.angle(values)), units="xy",
        offsets=np.stack([np.real(values), np.imag(values)], axis=1),
        offset_transform=panel.transData, facecolor=colour, edgecolor="none", alpha=0.3, zorder=1,
    )  # fmt: skip
    panel.add_collection(drawn, autolim=False)
