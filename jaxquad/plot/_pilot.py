"""What a pilot looks at: filters and their delay, spectra before and after them, steps, terms."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from jaxquad.identify import GainBand

from ._panels import (
    arrange,
    AxesLike,
    few_ticks,
    legend_of,
    look_of,
    Panels,
    plain_ticks,
    stacked,
)


_POINTS = 200
_LOWEST = 2.0  # Hz
_HATCHES = (None, "....", "////", "xxxx", "----")  # of bands, for those who see no colours
_SPAN = 70.0  # dB that a figure shows below the highest level


Frequencies = Float[np.ndarray, " frequencies"]


class Spectrum(NamedTuple):
    """A power spectral density, one-sided, per Hz."""

    hertz: Frequencies
    power: Frequencies


class StepBand(NamedTuple):
    """Step responses of many plants: their median, and between which 95 % of them lie."""

    time: Float[np.ndarray, " samples"]
    middle: Float[np.ndarray, " samples"]
    low: Float[np.ndarray, " samples"]
    high: Float[np.ndarray, " samples"]


class ThrottleCurve(NamedTuple):
    """A quantity over the throttle of 0 to 1, as a firmware takes it."""

    throttle: Float[np.ndarray, " points"]
    value: Float[np.ndarray, " points"]


class FlownAgain(NamedTuple):
    """A part of a flight as it was logged, and as law and plant fly it again: s and rad/s."""

    time: Float[np.ndarray, " samples"]
    setpoint: Float[np.ndarray, " samples"]
    rate: Float[np.ndarray, " samples"]
    again: Float[np.ndarray, " samples"]


@runtime_checkable
class Filters(Protocol):
    """Filters that a signal passes one after the other, as `jq.autopilot.FilterChain`."""

    @property
    def rate_hz(self) -> float: ...
    def response(self, frequency_hz: Any) -> Any: ...
    def delay_ms(self, frequency_hz: Any) -> Any: ...


def filters_figure(
    chains: Mapping[str, Sequence[Filters]], *, ax: AxesLike = None, title: str = ""
) -> Panels:
    """Draw magnitude and delay of filters over the frequency.

    **Arguments:**

    - `chains`: by the text of the legend, those that a signal passes one after the other.
    - `ax`: two axes to draw into.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.
    """
    panels = stacked(2, ax)
    level, delay = panels
    highest = min(chain.rate_hz for group in chains.values() for chain in group) / 2
    hertz = np.geomspace(_LOWEST, 0.98 * highest, _POINTS)
    for k, (name, group) in enumerate(chains.items()):
        response, late = np.ones(hertz.size, complex), np.zeros(hertz.size)
        for chain in group:
            response = response * np.asarray(chain.response(hertz))
            late = late + np.asarray(chain.delay_ms(hertz))
        level.plot(hertz, 20 * np.log10(np.abs(response)), **look_of(k, name))
        delay.plot(hertz, late, **look_of(k, name))
    low, high = level.get_ylim()
    level.set(xscale="log", ylabel="magnitude, dB", ylim=(max(low, high - _SPAN), high))
    delay.set(xscale="log", ylabel="delay, ms", xlabel="frequency, Hz")
    delay.set_ylim(min(0.0, delay.get_ylim()[0]), None)
    return _finished(panels, (1.9, 1.6), title)


def spectra_figure(
    gyro: Mapping[str, Spectrum], derivative: Mapping[str, Spectrum], *, unit: str = "",
    ax: AxesLike = None, title: str = "",
) -> Panels:  # fmt: skip
    """Draw the gyro's noise and the D term's, before and behind filters.

    **Arguments:**

    - `gyro`: in (rad/s)^2/Hz, drawn in deg/s; `derivative`: in the command's unit squared per Hz.
      By the text of the legend; the same text has the same line in both.
    - `unit`: of the command.
    - `ax`: two axes to draw into.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.
    """
    panels = stacked(2, ax)
    per = f"dB re 1 {unit} /√Hz" if unit else "dB /√Hz"  # a line of its own: the panels are low
    labels = ("gyro\ndB re 1 deg/s /√Hz", f"D term\n{per}")
    places = {name: k for k, name in enumerate(dict.fromkeys([*gyro, *derivative]))}
    for panel, spectra, label in zip(panels, (gyro, derivative), labels, strict=True):
        factor = np.degrees(1.0) ** 2 if panel is panels[0] else 1.0
        top = -np.inf
        for name, spectrum in spectra.items():
            shown = (spectrum.hertz >= _LOWEST) & (spectrum.power > 0)
            level = 10 * np.log10(factor * spectrum.power[shown])
            (line,) = panel.plot(spectrum.hertz[shown], level, **look_of(places[name], name))
            line.set_linewidth(1.2)
            top = max(top, float(level.max(initial=-np.inf)))
        if np.isfinite(top):
            panel.set_ylim(max(panel.get_ylim()[0], top - _SPAN), top + 4)
        panel.set_ylabel(label)
    panels[1].set_xlabel("frequency, Hz")
    for panel in panels:
        panel.margins(x=0.01)
    return _finished(panels, (2.0, 2.0), title)


def steps_figure(
    steps: Mapping[str, StepBand], *, label: str = "rate after a step of 1", ax: AxesLike = None,
    title: str = "",
) -> Panels:  # fmt: skip
    """Draw step responses with the band of the plants that are possible.

    **Arguments:**

    - `steps`: by the text of the legend.
    - `label`: of the vertical axis.
    - `ax`: axes to draw into.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.
    """
    panels = stacked(1, ax)
    [panel] = panels
    for k, (name, band) in enumerate(steps.items()):
        look = look_of(k, name)
        panel.fill_between(
            band.time, band.low, band.high, facecolor=look["color"], alpha=0.22, lw=0,
            hatch=_HATCHES[k], edgecolor=look["color"], label=f"{name}, 95 % of plants",
        )  # fmt: skip
        panel.plot(band.time, band.middle, **look)
    panel.axhline(1.0, color="0.4", lw=0.8, ls=":")
    panel.set(xlabel="time, s", ylabel=label)
    panel.margins(x=0)
    return _finished(panels, (2.8,), title)


def again_figure(flight: FlownAgain, *, ax: AxesLike = None, title: str = "") -> Panels:
    """Draw a part of a flight, logged and simulated, and what is between them.

    **Arguments:**

    - `flight`: in rad/s, drawn in deg/s.
    - `ax`: two axes to draw into.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.
    """
    panels = stacked(2, ax)
    setpoint, rate, again = (np.degrees(x) for x in flight[1:])
    panels[0].plot(flight.time, setpoint, color="0.6", lw=1.0, label="set-point")
    panels[0].plot(flight.time, rate, color="black", lw=1.2, label="rate, logged")
    panels[0].plot(flight.time, again, color="C0", lw=1.2, ls="--", label="rate, law and plant")
    panels[0].set_ylabel("deg/s")
    panels[1].plot(flight.time, rate - again, color="black", lw=0.8)
    panels[1].set(xlabel="time, s", ylabel="logged less\nsimulated, deg/s")
    for panel in panels:
        panel.margins(x=0)
    return _finished(panels, (2.4, 1.0), title)


def b0_figure(
    levels: GainBand, taken: Mapping[str, ThrottleCurve], *, curve: GainBand | None = None,
    ax: AxesLike = None, title: str = "",
) -> Panels:  # fmt: skip
    """Draw b0 over the throttle: of a log with its 95 % band, and as a firmware takes it.

    **Arguments:**

    - `levels`: gain / lag at the levels of throttle that were flown, in deg/s^3 per unit.
    - `taken`: by the text of the legend, what the ADRC takes for b0.
    - `curve`: gain / lag by the thrust curve; None where the log does not show it.
    - `ax`: axes to draw into.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.
    """
    panels = stacked(1, ax)
    [panel] = panels
    if curve is not None:
        look = look_of(0, "gain / lag of the log")
        panel.fill_between(
            curve.throttle, curve.low, curve.high, facecolor=look["color"], alpha=0.3, lw=0,
            label="gain / lag, 95 %",
        )  # fmt: skip
        panel.plot(curve.throttle, curve.value, **look)
    reach = [levels.value - levels.low, levels.high - levels.value]
    panel.errorbar(levels.throttle, levels.value, yerr=reach, fmt="none", ecolor="black", capsize=4)
    panel.plot(levels.throttle, levels.value, "o", ms=5, color="black", label="levels flown, 95 %")
    for k, (name, values) in enumerate(taken.items(), start=1):
        panel.plot(values.throttle, values.value, **look_of(k, name))
    panel.set(xlabel="throttle", ylabel="b0, deg/s³ per pidsum")
    panel.set_ylim(0, None)
    return _finished(panels, (2.8,), title)


def balance_figure(
    terms: Mapping[str, float], *, unit: str = "", ax: AxesLike = None, title: str = ""
) -> Panels:
    """Draw how large P, I, D and F were, as bars of their root mean squares.

    **Arguments:**

    - `terms`: root mean squares by name.
    - `unit`: of the command.
    - `ax`: axes to draw into.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.
    """
    panels = stacked(1, ax)
    [panel] = panels
    names, total = list(terms), sum(terms.values()) or 1.0
    places = np.arange(len(names))[::-1]
    panel.barh(places, [terms[name] for name in names], color="0.55", edgecolor="black", height=0.6)
    most = max(terms.values(), default=0.0) or 1.0
    for place, name in zip(places, names, strict=True):
        text = f"{terms[name]:.3g} ({100 * terms[name] / total:.0f} %)"
        panel.annotate(text, (terms[name], place), xytext=(5, 0), textcoords="offset points",
                       va="center", fontsize=9)  # fmt: skip
    panel.set_yticks(places, names)
    panel.set(xlim=(0, 1.3 * most), xlabel=f"root mean square{f', {unit}' if unit else ''}")
    few_ticks(panel.xaxis, 5)
    return arrange(panels, (0.38 * len(names) + 0.2,), title=title)


def _finished(panels: Panels, heights: tuple[float, ...], title: str) -> Panels:
    for panel in panels:
        panel.grid(True, color="0.9", lw=0.5)
        if panel.get_xscale() == "log":
            plain_ticks(panel.xaxis)
    return arrange(panels, heights, title=title, legend=legend_of(panels), handle_length=3.0)
