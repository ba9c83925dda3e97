"""What was flown: curves over time, spectra; and what a pilot looks at: filters, steps, terms."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import ArrayLike, Float, Int
from matplotlib.axes import Axes

from jaxquad.identify import GainBand
from jaxquad.records import clock_start, Record

from . import _panels as lay
from ._panels import AxesLike, look_of, Panels, Style


Places = Int[np.ndarray, " kept"]
Samples = Float[np.ndarray, " samples"]
_COLUMNS = 1200  # more than a screen shows of a figure's width
ROWS = 12  # channels that one figure holds
_COLOURS = {"reference": "tab:green", "input": "tab:blue", "output": "0.15"}


def extremes(values: Float[np.ndarray, " samples"]) -> Places:
    """The places of the least and the largest value in each of 1200 parts of a signal, in order.

    All places of a short signal. A curve through them loses no peak, however long the signal is.
    """
    size = -(-values.size // _COLUMNS)
    if size <= 2:
        return np.arange(values.size)
    full = values.size // size
    blocks = values[: full * size].reshape(full, size)
    places = np.stack([blocks.argmin(axis=1), blocks.argmax(axis=1)], axis=1)
    kept = (np.sort(places, axis=1) + size * np.arange(full)[:, None]).reshape(-1)
    rest = values[full * size :]
    ends = [rest.argmin(), rest.argmax()] if rest.size else []
    return np.unique([*kept, *(full * size + k for k in ends)])


def plot_over_time(panel: Axes, time: Samples, values: Samples, style: Style) -> None:
    """A curve through its extremes; time stamps that are dates count from the first of them."""
    kept = extremes(values)
    panel.plot((time - clock_start(time))[kept], values[kept], **style)


def channels_of(record: Record) -> list[tuple[str, str]]:
    """Role and name of every channel: references, inputs, outputs."""
    names = (record.reference_names, record.input_names, record.output_names)
    return [(role, x) for role, of_role in zip(_COLOURS, names, strict=True) for x in of_role]


def record_figure(
    record: Record, channels: Sequence[tuple[str, str]] | None = None, *, ax: AxesLike = None,
    title: str = "",
) -> Panels:  # fmt: skip
    """Draw the channels of a record over time, stacked; angles in degrees.

    A long channel is drawn through its extremes, so that no peak is lost.

    **Arguments:**

    - `record`: what was flown.
    - `channels`: pairs of role and name, see `channels_of`; by default all references, inputs and
      outputs.
    - `ax`: axes to draw into, one for each channel.
    """
    channels = channels_of(record) if channels is None else channels
    panels = lay.stacked(len(channels), ax)
    labels = lay.short_names([name for _, name in channels])
    for panel, (role, name), label in zip(panels, channels, labels, strict=True):
        scale, unit = lay.unit_label(lay.visible(record.unit(name))[:12])
        line: Style = {"color": _COLOURS[role], "lw": 0.7}
        plot_over_time(panel, record.time, scale * record.channel(name), line)
        panel.set_ylabel(unit.removeprefix(", "))
        panel.set_title(f"{role}: {label}", loc="left", fontsize=9, pad=3, y=1.0)
        lay.few_ticks(panel.yaxis, 4)
        panel.yaxis.set_offset_position("right")  # of a power of ten, else on the title
        panel.grid(True, color="0.9", lw=0.5)
        panel.margins(x=0)
    panels[-1].set_xlabel("time, s")
    return lay.arrange(panels, [1.0] * len(panels), above=0.2, gap=0.35, title=title)


_TARGET: Style = {"color": "0.75", "ls": "-", "lw": 4.0, "zorder": 1}


def histories(
    time: Float[ArrayLike, " samples"],
    panels: Mapping[str, Mapping[str, Float[ArrayLike, " samples"]]], *, target: str | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None, ax: AxesLike = None, title: str = "",
) -> Panels:  # fmt: skip
    """Draw curves over time in stacked panels; they differ in their lines as well as in colour.

    **Arguments:**

    - `time`: in s.
    - `panels`: the curves by name for each panel, by the text of its vertical axis, such as
      "roll, deg". A name has the same line in all panels. Values that are not finite are left out.
    - `target`: the name of a set-point or a truth, drawn behind the others as a wide grey line.
    - `limits`: of vertical axes, by their text.
    - `ax`: axes to draw into, one for each panel.

    **Raises:** ValueError for more curves than there are lines, and for limits of an unknown panel.
    """
    names = dict.fromkeys(name for curves in panels.values() for name in curves if name != target)
    style = {name: look_of(k, name) for k, name in enumerate(names)}
    style |= {target: _TARGET | {"label": target}} if target else {}
    unknown = [text for text in limits or {} if text not in panels]
    if unknown:
        raise ValueError(f"limits for {unknown}, but the panels are {list(panels)}")
    axes = lay.stacked(len(panels), ax)
    for axis, (text, curves) in zip(axes, panels.items(), strict=True):
        for name, values in curves.items():
            shown = np.asarray(values, float)
            axis.plot(time, np.where(np.isfinite(shown), shown, np.nan), **style[name])
        axis.set_ylabel(text)
        axis.grid(True, color="0.92", lw=0.5)
        axis.margins(x=0)
        axis.set_ylim((limits or {}).get(text, axis.get_ylim()))
    axes[-1].set_xlabel("time, s")
    heights = [2.1 if len(axes) > 1 else 2.5] * len(axes)
    return lay.arrange(axes, heights, title=title, legend=lay.legend_of(axes), handle_length=3.5)


_SEGMENTS = 60  # over a record, where nothing else is said
_SHORTEST, _LONGEST = 64, 4096  # samples of a window
_BINS = 40  # of another channel
_RANGE = 60.0  # dB that are drawn
_BAR = 0.16  # inches, of the scale of colours


def spectrogram(
    record: Record, channel: str | None = None, *, over: str = "time", window: float | None = None,
    ax: AxesLike = None, title: str = "",
) -> Panels:  # fmt: skip
    """Draw the power spectral density of a channel over time, or over another channel.

    Over the throttle, motor harmonics are lines that rise with it, and resonances of the frame
    are horizontal.

    !!! example

        ```python
        jq.plot.spectrogram(record, "gyro_x", over="throttle")
        ```

    **Arguments:**

    - `record`: what was flown.
    - `channel`: the name of a channel; by default the first output.
    - `over`: "time", or the name of another channel: its values are averaged over each window, and
        the spectra over bins of these.
    - `window`: s, the length of a Hann window; they overlap by three quarters. By default about a
        fifteenth of the record, 64 to 4096 samples.
    - `ax`: axes to draw into; the scale of colours takes a part of it.

    **Returns:** `jq.plot.Panels`, of one; the colours are in dB of (unit)^2 per Hz.

    **Raises:** `RecordError` (a ValueError) for unknown channels, ValueError for a `window` that is
    longer than the record or shorter than 16 samples.
    """
    name = record.output_names[0] if channel is None else channel
    scale, unit = lay.unit_label(lay.visible(record.unit(name))[:12])
    if window is None:
        power = np.round(np.log2(np.clip(4 * record.samples / _SEGMENTS, _SHORTEST, _LONGEST)))
        samples = min(int(2**power), record.samples)
    else:
        samples = round(window / record.dt)
        if not 16 <= samples <= record.samples:
            raise ValueError(
                f"window is {window} s, {samples} samples: give 16 to {record.samples} samples, "
                f"{16 * record.dt:.4g} to {record.duration:.4g} s"
            )
    step, shape = max(samples // 4, 1), np.hanning(samples)
    windows = lambda values: np.lib.stride_tricks.sliding_window_view(values, samples)[::step]
    parts = windows(scale * record.channel(name))
    density = np.abs(np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * shape, axis=1)) ** 2
    density *= 2 * record.dt / np.sum(shape**2)
    omega = 2 * np.pi * np.fft.rfftfreq(samples, record.dt)[1:]
    with np.errstate(divide="ignore"):
        level = 10 * np.log10(density[:, 1:].T)  # dB, [frequencies, windows]
    if over == "time":
        begins = record.time[: len(parts) * step : step] - clock_start(record.time)
        middle = begins + 0.5 * samples * record.dt
        edges = np.append(middle, middle[-1] + step * record.dt) - 0.5 * step * record.dt
        label = "time, s"
    else:  # the mean power of the windows that belong to each bin of the other channel
        means = windows(record.channel(over)).mean(axis=1)
        edges = np.linspace(means.min(), means.max() + 1e-9 * (1 + np.ptp(means)), _BINS + 1)
        place = np.clip(np.digitize(means, edges) - 1, 0, _BINS - 1)
        power, level = 10 ** (level / 10), np.full((omega.size, _BINS), np.nan)
        for k in np.unique(place):
            level[:, k] = 10 * np.log10(power[:, place == k].mean(axis=1))
        other, text = lay.unit_label(lay.visible(record.unit(over))[:12])
        edges, label = other * edges, f"{lay.short_names([over])[0]}{text}"
    [panel] = panels = lay.stacked(1, ax)
    finite = level[np.isfinite(level)]
    top = float(np.percentile(finite, 99.8)) if finite.size else 0.0
    low = max(top - _RANGE, float(np.percentile(finite, 2)) if finite.size else -_RANGE)
    half = 0.5 * (omega[1] - omega[0])
    drawn = panel.pcolormesh(
        edges, np.append(omega - half, omega[-1] + half), level, cmap="viridis", vmin=low, vmax=top,
        rasterized=True,
    )  # fmt: skip
    panel.set_facecolor("0.9")  # nothing flew there
    panel.set_ylabel("frequency, rad/s")
    lay.few_ticks(panel.yaxis, 6)
    lay.add_hertz(panel, "right")
    colours = lay.raise_powers(f"dB of ({unit.removeprefix(', ') or 'unit'})^2/Hz")
    if not panels.new:
        panels.figure.colorbar(drawn, ax=panel, label=colours, pad=0.13)
    panel.set_xlabel(label)
    panel.set_title(lay.short_names([name])[0], loc="left", fontsize=9, pad=3)
    if panels.new:
        bar = panels.figure.add_axes((0, 0, 1, 1), label="scale")
        panels.figure.colorbar(drawn, cax=bar, label=colours)
        lay.arrange(panels, [3.4], width=7.4, right=1.75, above=0.1, title=title)
        left, low, across, high = panel.get_position().bounds
        width = panels.figure.get_size_inches()[0]
        bar.set_position((left + across + 0.85 / width, low, _BAR / width, high))
    return panels


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

    time: Samples  # s
    middle: Samples
    low: Samples
    high: Samples

    @property
    def overshoot(self) -> tuple[float, float]:
        """Of the median and of the worst, as shares of the step."""
        middle, high = (max(float(x.max()) - 1, 0.0) for x in (self.middle, self.high))
        return middle, high

    @property
    def half_way(self) -> float:
        """When the median is half way, in s."""
        return float(self.time[(self.middle >= 0.5).argmax()])

    @property
    def settled(self) -> float:
        """When the median stays within 5 % and the band of its end, in s, and a third more."""
        far = abs(self.middle - self.middle[-1]) > _SETTLED + (self.high - self.low) / 2
        last = np.flatnonzero(far)
        time = self.time[last[-1]] if last.size else self.time[-1]
        return float(min(4 / 3 * time, self.time[-1]))


_SETTLED = 0.05


class ThrottleCurve(NamedTuple):
    """A quantity over the throttle of 0 to 1, as a firmware takes it."""

    throttle: Float[np.ndarray, " points"]
    value: Float[np.ndarray, " points"]


class FlownAgain(NamedTuple):
    """A part of a flight as it was logged, and as law and plant fly it again: s and rad/s."""

    time: Samples
    setpoint: Samples
    rate: Samples
    again: Samples


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
    """Draw magnitude and delay of filters over the frequency, in two panels.

    `chains` are those that a signal passes one after the other, by the text of the legend.
    """
    level, delay = panels = lay.stacked(2, ax)
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
    below: str = "D term", ax: AxesLike = None, title: str = "",
) -> Panels:  # fmt: skip
    """Draw the gyro's noise and the D term's, before and behind filters.

    **Arguments:**

    - `gyro`: in (rad/s)^2/Hz, drawn in deg/s; `derivative`: in the command's unit squared per Hz.
      By the text of the legend; the same text has the same line in both.
    - `unit`: of the command.
    - `below`: what the lower panel shows, the D term or another part of the command.
    - `ax`: two axes to draw into.
    """
    panels = lay.stacked(2, ax)
    per = f"dB re 1 {unit} /√Hz" if unit else "dB /√Hz"  # a line of its own: the panels are low
    labels = ("gyro\ndB re 1 deg/s /√Hz", f"{below}\n{per}")
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
    steps: Mapping[str, StepBand], *, bands: str = "95 % of plants",
    measured: StepBand | None = None, ax: AxesLike = None, title: str = "",
) -> Panels:  # fmt: skip
    """Draw the rate after a step of 1, by the text of the legend, with what its `bands` are.

    What was `measured` has the band of its random error.
    """
    [panel] = panels = lay.stacked(1, ax)
    if measured is not None:
        panel.fill_between(
            measured.time, measured.low, measured.high, facecolor="0.85", lw=0,
            label="measured, 95 % random error",
        )  # fmt: skip
        panel.plot(measured.time, measured.middle, color="black", lw=1.0, ls=":", label="measured")
    for k, (name, band) in enumerate(steps.items()):
        look = look_of(k, name)
        panel.fill_between(
            band.time, band.low, band.high, facecolor=look["color"], alpha=0.22, lw=0,
            hatch=_HATCHES[k], edgecolor=look["color"], label=f"{name}, {bands}",
        )  # fmt: skip
        panel.plot(band.time, band.middle, **look)
    panel.axhline(1.0, color="0.4", lw=0.8, ls=":")
    panel.set(xlabel="time, s", ylabel="rate after a step of 1")
    shown = list(steps.values()) or ([] if measured is None else [measured])
    panel.set_xlim(0, max(band.settled for band in shown))
    return _finished(panels, (2.8,), title)


def again_figure(flight: FlownAgain, *, ax: AxesLike = None, title: str = "") -> Panels:
    """Draw a part of a flight in deg/s, logged and simulated, and below what is between them."""
    panels = lay.stacked(2, ax)
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
    """
    [panel] = panels = lay.stacked(1, ax)
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
    """Draw how large P, I, D and F were: bars of root mean squares in the unit of the command."""
    [panel] = panels = lay.stacked(1, ax)
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
    lay.few_ticks(panel.xaxis, 5)
    return lay.arrange(panels, (0.38 * len(names) + 0.2,), title=title)


def _finished(panels: Panels, heights: tuple[float, ...], title: str) -> Panels:
    for panel in panels:
        panel.grid(True, color="0.9", lw=0.5)
        if panel.get_xscale() == "log":
            lay.plain_ticks(panel.xaxis)
    return lay.arrange(
        panels, heights, title=title, legend=lay.legend_of(panels), handle_length=3.0
    )
