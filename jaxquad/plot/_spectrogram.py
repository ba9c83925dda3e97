"""The spectrum of a channel over time, or over another channel such as the throttle."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad.records import clock_start, Record

from ._labels import add_hertz, few_ticks
from ._names import raise_powers, short_names, unit_label, visible
from ._panels import arrange, Given, Panels, stacked


_SEGMENTS = 60  # over a record, where nothing else is said
_SHORTEST, _LONGEST = 64, 4096  # samples of a window
_BINS = 40  # of another channel
_RANGE = 60.0  # dB that are drawn
_BAR = 0.16  # inches, of the scale of colours


class _Spectrum(NamedTuple):
    across: Float[np.ndarray, " edges"]  # s, or the other channel
    omega: Float[np.ndarray, " frequencies"]  # rad/s
    level: Float[np.ndarray, "frequencies columns"]  # dB of a density per Hz; nan where unknown


def spectrogram(
    record: Record,
    channel: str | None = None,
    *,
    over: str = "time",
    window: float | None = None,
    ax: Given = None,
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
    samples = _window(record, window)
    found = _over_time(record, scale * record.channel(name), samples)
    label = "time, s"
    if over != "time":
        found = _over_channel(record, found, record.channel(over), samples)
        other, text = unit_label(visible(record.unit(over))[:12])
        found = found._replace(across=other * found.across)
        label = f"{short_names([over])[0]}{text}"
    panels = stacked(1, ax)
    _draw(panels, found, f"dB of ({unit.removeprefix(', ') or 'unit'})^2/Hz")
    panels[0].set_xlabel(label)
    panels[0].set_title(short_names([name])[0], loc="left", fontsize=9, pad=3)
    return panels if ax is not None else _with_room(panels, title)


def _window(record: Record, window: float | None) -> int:
    if window is None:
        wanted = 4 * record.samples / _SEGMENTS
        power = int(2 ** np.round(np.log2(np.clip(wanted, _SHORTEST, _LONGEST))))
        return min(power, record.samples)
    samples = round(window / record.dt)
    if not 16 <= samples <= record.samples:
        raise ValueError(
            f"window is {window} s, {samples} samples: give 16 to {record.samples} samples, "
            f"{16 * record.dt:.4g} to {record.duration:.4g} s"
        )
    return samples


def _over_time(record: Record, values: np.ndarray, samples: int) -> _Spectrum:
    step = max(samples // 4, 1)
    parts = np.lib.stride_tricks.sliding_window_view(values, samples)[::step]
    shape = np.hanning(samples)
    level = parts - parts.mean(axis=1, keepdims=True)
    power = np.abs(np.fft.rfft(level * shape, axis=1)) ** 2
    power *= 2 * record.dt / np.sum(shape**2)
    omega = 2 * np.pi * np.fft.rfftfreq(samples, record.dt)
    begins = record.time[: len(parts) * step : step] - clock_start(record.time)
    middle = begins + 0.5 * samples * record.dt
    edges = np.append(middle, middle[-1] + step * record.dt) - 0.5 * step * record.dt
    with np.errstate(divide="ignore"):
        return _Spectrum(edges, omega[1:], 10 * np.log10(power[:, 1:].T))


def _over_channel(
    record: Record, found: _Spectrum, other: Float[np.ndarray, " samples"], samples: int
) -> _Spectrum:
    """Mean powers of the windows that belong to each bin of the other channel."""
    step = max(samples // 4, 1)
    means = np.lib.stride_tricks.sliding_window_view(other, samples)[::step].mean(axis=1)
    edges = np.linspace(means.min(), means.max() + 1e-9 * (1 + np.ptp(means)), _BINS + 1)
    place = np.clip(np.digitize(means, edges) - 1, 0, _BINS - 1)
    power, level = 10 ** (found.level / 10), np.full((found.omega.size, _BINS), np.nan)
    for k in np.unique(place):
        level[:, k] = 10 * np.log10(power[:, place == k].mean(axis=1))
    return found._replace(across=edges, level=level)


def _draw(panels: Panels, found: _Spectrum, unit: str) -> None:
    [panel] = panels
    known = found.level[np.isfinite(found.level)]
    top = float(np.percentile(known, 99.8)) if known.size else 0.0
    low = max(top - _RANGE, float(np.percentile(known, 2)) if known.size else -_RANGE)
    half = 0.5 * (found.omega[1] - found.omega[0])
    edges = np.append(found.omega - half, found.omega[-1] + half)
    drawn = panel.pcolormesh(
        found.across, edges, found.level, cmap="viridis", vmin=low, vmax=top, rasterized=True
    )
    panel.set_facecolor("0.9")  # nothing flew there
    panel.set_ylabel("frequency, rad/s")
    few_ticks(panel.yaxis, 6)
    add_hertz(panel, "right")
    if panels.own:
        bar = panels.figure.add_axes((0, 0, 1, 1), label="scale")
        panels.figure.colorbar(drawn, cax=bar, label=raise_powers(unit))
    else:
        panels.figure.colorbar(drawn, ax=panel, label=raise_powers(unit), pad=0.13)


def _with_room(panels: Panels, title: str) -> Panels:
    arrange(panels, [3.4], width=7.4, right=1.75, above=0.1, title=title)
    left, low, across, high = panels[0].get_position().bounds
    width = panels.figure.get_size_inches()[0]
    bar = panels.figure.axes[-1]
    bar.set_position((left + across + 0.85 / width, low, _BAR / width, high))
    return panels
