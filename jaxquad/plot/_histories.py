"""Curves over time: a record, a simulation on it, any others."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from jaxquad.records import clock_start, Record

from ._labels import few_ticks, LINES, Style
from ._names import short_names, unit_label, visible
from ._panels import arrange, Given, legend_of, Panels, stacked


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
    whole = values.size // size
    blocks = values[: whole * size].reshape(whole, size)
    places = np.stack([blocks.argmin(axis=1), blocks.argmax(axis=1)], axis=1)
    kept = (np.sort(places, axis=1) + size * np.arange(whole)[:, None]).reshape(-1)
    rest = values[whole * size :]
    ends = [rest.argmin(), rest.argmax()] if rest.size else []
    return np.unique([*kept, *(whole * size + k for k in ends)])


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
    ax: Given = None,
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


_TARGET = {"color": "0.75", "ls": "-", "lw": 4.0, "zorder": 1}


def histories(
    time: Float[ArrayLike, " samples"],
    panels: Mapping[str, Mapping[str, Float[ArrayLike, " samples"]]],
    *,
    target: str | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    ax: Given = None,
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
    style = _styles(panels, target)
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


def _styles(
    panels: Mapping[str, Mapping[str, Float[ArrayLike, " samples"]]], target: str | None
) -> dict[str, Style]:
    names = list(dict.fromkeys(name for curves in panels.values() for name in curves))
    others = [name for name in names if name != target]
    if len(others) > len(LINES):
        raise ValueError(
            f"{len(others)} curves are too many to be distinguished, {len(LINES)} is the most: "
            f"split {others} over several figures"
        )
    return dict(zip(others, LINES, strict=False)) | ({target: _TARGET} if target else {})
