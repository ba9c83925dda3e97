"""Curves and records over time; spectra over time, or over another channel."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from jaxquad.records import clock_start, Record

from ._panels import (
    add_hertz,
    arrange,
    AxesLike,
    few_ticks,
    legend_of,
    LINES,
    Panels,
    raise_powers,
    short_names,
    stacked,
    Style,
    unit_label,
    visible,
)


Places = Int[np.ndarray, " kept"]
_COLUMNS = 1200  # more than a screen shows of a figure's width
ROWS = 12  # channels that one figure holds
_COLOURS = {"reference": "tab:green", "input": "tab:blue", "output": "0.15"}


def extremes(values: Float[np.ndarray, " samples"], columns: int = _COLUMNS) -> Places:
    """The places of the least and the largest value in each of `columns` parts of a signal.

    All places of a short signal. A curve through them loses no peak, however long the signal is.

    **Arguments:**

    - `values`: the signal.
    - `columns`: the number of parts.

    **Returns:** the places, in order of time.
    """
    size = -(-values.size // columns)
    if size <= 2:
        return np.arange(values.size)
    full = values.size // size
    blocks = values[: full * size].reshape(full, size)
    places = np.stack([blocks.argmin(axis=1), blocks.argmax(axis=1)], axis=1)
    kept = (np.sort(places, axis=1) + size * np.arange(full)[:, None]).reshape(-1)
    rest = values[full * size :]
    ends = [rest.argmin(), rest.argmax()] if rest.size else []
    return np.unique([*kept, *(full * size + k for k in ends)])


def channels_of(record: Record) -> list[tuple[str, str]]:
    """Role and name of every channel: references, inputs, outputs."""
    roles = {
        "reference": record.reference_names,
        "input": record.input_names,
        "output": record.output_names,
    }
    return [(role, name) for role, names in roles.items() for name in names]


def record_figure(
    record: Record,
    channels: Sequence[tuple[str, str]] | None = None,
    *,
    ax: AxesLike = None,
    title: str = "",
) -> Panels:
    """Draw the channels of a record over time, stacked; angles in degrees.

    A long channel is drawn through its extremes, so that no peak is lost.

    **Arguments:**

    - `record`: what was flown.
    - `channels`: pairs of role and name, see `channels_of`; by default all references, inputs and
      outputs.
    - `ax`: axes to draw into, one for each channel.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.
    """
    channels = channels_of(record) if channels is None else channels
    panels = stacked(len(channels), ax)
    labels = short_names([name for _, name in channels])
    for panel, (role, name), label in zip(panels, channels, labels, strict=True):
        scale, unit = unit_label(visible(record.unit(name))[:12])
        values = record.channel(name)
        kept = extremes(values)
        time = record.time[kept] - clock_start(record.time)
        panel.plot(time, scale * values[kept], color=_COLOURS[role], lw=0.7)
        panel.set_ylabel(unit.removeprefix(", "))
        panel.set_title(f"{role}: {label}", loc="left", fontsize=9, pad=3, y=1.0)
        few_ticks(panel.yaxis, 4)
        panel.yaxis.set_offset_position("right")  # of a power of ten, else on the title
        panel.grid(True, color="0.9", lw=0.5)
        panel.margins(x=0)
    panels[-1].set_xlabel("time, s")
    return arrange(panels, [1.0] * len(panels), above=0.2, gap=0.35, title=title)


_TARGET: Style = {"color": "0.75", "ls": "-", "lw": 4.0, "zorder": 1}


def histories(
    time: Float[ArrayLike, " samples"],
    panels: Mapping[str, Mapping[str, Float[ArrayLike, " samples"]]],
    *,
    target: str | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    ax: AxesLike = None,
    title: str = "",
) -> Panels:
    """Draw curves over time in stacked panels; they differ in their lines as well as in colour.

    **Arguments:**

    - `time`: in s.
    - `panels`: the curves by name for each panel, by the text of its vertical axis, such as
      "roll, deg". A name has the same line in all panels. Values that are not finite are left out.
    - `target`: the name of a set-point or a truth, drawn behind the others as a wide grey line.
    - `limits`: of vertical axes, by their text.
    - `ax`: axes to draw into, one for each panel.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.

    **Raises:** ValueError for more curves than there are lines, and for limits of an unknown panel.
    """
    names = list(dict.fromkeys(name for curves in panels.values() for name in curves))
    others = [name for name in names if name != target]
    if len(others) > len(LINES):
        raise ValueError(
            f"{len(others)} curves are too many to be distinguished, {len(LINES)} is the most: "
            f"split {others} over several figures"
        )
    style = dict(zip(others, LINES, strict=False)) | ({target: _TARGET} if target else {})
    unknown = [text for text in limits or {} if text not in panels]
    if unknown:
        raise ValueError(f"limits for {unknown}, but the panels are {list(panels)}")
    axes = stacked(len(panels), ax)
    for axis, (text, curves) in zip(axes, panels.items(), strict=True):
        for name, values in curves.items():
            shown = np.asarray(values, float)
            axis.plot(time, np.where(np.isfinite(shown), shown, np.nan), label=name, **style[name])
        axis.set_ylabel(text)
        axis.grid(True, color="0.92", lw=0.5)
        axis.margins(x=0)
        axis.set_ylim((limits or {}).get(text, axis.get_ylim()))
    axes[-1].set_xlabel("time, s")
    heights = [2.1 if len(axes) > 1 else 2.5] * len(axes)
    return arrange(axes, heights, title=title, legend=legend_of(axes), handle_length=3.5)


_SEGMENTS = 60  # over a record, where nothing else is said
_SHORTEST, _LONGEST = 64, 4096  # samples of a window
_BINS = 40  # of another channel
_RANGE = 60.0  # dB that are drawn
_BAR = 0.16  # inches, of the scale of colours


def spectrogram(
    record: Record,
    channel: str | None = None,
    *,
    over: str = "time",
    window: float | None = None,
    ax: AxesLike = None,
    title: str = "",
) -> Panels:
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
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`, of one; the colours are in dB of (unit)^2 per Hz.

    **Raises:** `RecordError` (a ValueError) for unknown channels, ValueError for a `window` that is
    longer than the record or shorter than 16 samples.
    """
    name = record.output_names[0] if channel is None else channel
    scale, unit = unit_label(visible(record.unit(name))[:12])
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
        other, text = unit_label(visible(record.unit(over))[:12])
        edges, label = other * edges, f"{short_names([over])[0]}{text}"
    panels = stacked(1, ax)
    [panel] = panels
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
    few_ticks(panel.yaxis, 6)
    add_hertz(panel, "right")
    colours = raise_powers(f"dB of ({unit.removeprefix(', ') or 'unit'})^2/Hz")
    if not panels.new:
        panels.figure.colorbar(drawn, ax=panel, label=colours, pad=0.13)
    panel.set_xlabel(label)
    panel.set_title(short_names([name])[0], loc="left", fontsize=9, pad=3)
    if panels.new:
        bar = panels.figure.add_axes((0, 0, 1, 1), label="scale")
        panels.figure.colorbar(drawn, cax=bar, label=colours)
        arrange(panels, [3.4], width=7.4, right=1.75, above=0.1, title=title)
        left, low, across, high = panel.get_position().bounds
        width = panels.figure.get_size_inches()[0]
        bar.set_position((left + across + 0.85 / width, low, _BAR / width, high))
    return panels
