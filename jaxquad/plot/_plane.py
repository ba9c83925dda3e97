"""Models in the complex plane: poles and zeros, and the curve of Nyquist."""

import numpy as np
from jaxtyping import ArrayLike, Complex, Float
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection

from jaxquad.identify import Fit, linear_model
from jaxquad.models import Model

from ._panels import (
    add_hertz,
    arrange,
    AxesLike,
    COHERENT,
    few_ticks,
    legend_of,
    look_of,
    Panels,
    stacked,
    Style,
)
from ._shown import (
    analysed,
    channels_shown,
    frequencies_of,
    measured_and_modelled,
    named_models,
    response_as_sampled,
    Thing,
)


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
    - `ax`: axes to draw into.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`, of one.

    **Raises:** ValueError for what has no poles, such as a measured response, and for more than
    there are marks.
    """
    things = named_models(shown, "pzmap")
    panels = stacked(1, ax)
    [panel] = panels
    for k, (name, thing) in enumerate(things.items()):
        if not isinstance(thing, Fit | Model):
            poles, zeros = analysed(name, thing, "pzmap").poles, np.empty(0)
        else:
            plant = linear_model(thing.model if isinstance(thing, Fit) else thing)
            poles, zeros = plant.poles, plant.zeros
        poles, colour = poles[np.isfinite(poles)], look_of(k, name)["color"]
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
    add_hertz(panel, "right", "imaginary part, Hz")
    few_ticks(panel.xaxis, 6)
    return arrange(panels, [4.0], right=0.75, title=title, legend=legend_of(panels))


_FAR, _NEAR = 3.0, 0.3  # beyond and below which a curve does not set the limits by itself
_ELLIPSES = 30  # of a model, along its curve


def nyquist(
    *shown: Thing,
    pair: tuple[str, str] | None = None,
    omega: Float[ArrayLike, " frequencies"] | None = None,
    ax: AxesLike = None,
    title: str = "",
) -> Panels:
    """Draw responses in the complex plane, with -1 and the unit circle.

    Of a loop it is L, broken at the command and closed as 1 + L = 0. Negative frequencies are thin.
    Ellipses are 95 % intervals of real and imaginary part: of measured points by their random
    error, of a fit with model error.

    **Arguments:**

    - `shown`, `omega`: as in `jq.plot.bode`.
    - `pair`: names of output and input; by default the first of each.
    - `ax`: axes to draw into.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`, of one.

    **Raises:** as `jq.plot.bode`.
    """
    measured, modelled = measured_and_modelled(shown, "nyquist")
    channels = channels_shown(measured, modelled)
    o, i = channels.places(pair)[0]
    grid = frequencies_of(measured, modelled, None if omega is None else np.asarray(omega, float))
    panels = stacked(1, ax)
    [panel] = panels
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
        values = response_as_sampled(entry, grid, measured)[:, o, i]
        look = look_of(k, entry.name)
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
    panel.set(xlabel=f"real part{f' of {text}' if text else ''}")
    panel.set(ylabel=f"imaginary part{f' of {text}' if text else ''}")
    panel.grid(True, color="0.93", lw=0.5)
    return arrange(panels, [4.6], width=5.8, title=title, legend=legend_of(panels))


def _ellipses(
    panel: Axes,
    values: Complex[np.ndarray, " points"],
    size: Float[np.ndarray, " points"],
    turn: Float[np.ndarray, " points"],
    colour: str,
) -> None:
    """Half axes by relative changes of size, and by changes of angle in rad."""
    length = np.abs(values)
    drawn = EllipseCollection(
        2 * length * size, 2 * length * turn, np.degrees(np.angle(values)), units="xy",
        offsets=np.stack([np.real(values), np.imag(values)], axis=1),
        offset_transform=panel.transData, facecolor=colour, edgecolor="none", alpha=0.3, zorder=1,
    )  # fmt: skip
    panel.add_collection(drawn, autolim=False)
