from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure

from jaxquad.records import Record

from ._labels import short_names, unit_label, visible


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


def record_figure(record: Record, channels: Sequence[tuple[str, str]] | None = None) -> Figure:
    """Draw the channels of a record over time, stacked; angles in degrees.

    A long channel is drawn through its extremes, so that no peak is lost.

    **Arguments:**

    - `record`: what was flown.
    - `channels`: pairs of role and name, see `channels_of`; by default all references, inputs and
      outputs.
    """
    channels = channels_of(record) if channels is None else channels
    figure = Figure(figsize=(6.5, 0.7 + 1.35 * len(channels)), layout="constrained")
    panels = figure.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
    labels = short_names([name for _, name in channels])
    for panel, (role, name), label in zip(panels, channels, labels, strict=True):
        scale, unit = unit_label(visible(record.unit(name))[:12])
        values = record.channel(name)
        kept = extremes(values)
        panel.plot(record.time[kept], scale * values[kept], color=_COLOURS[role], lw=0.7)
        panel.set_ylabel(unit.removeprefix(", "))
        panel.set_title(f"{role}: {label}", loc="left", fontsize=9, pad=3)
        panel.grid(True, color="0.9", lw=0.5)
        panel.margins(x=0)
    panels[-1].set_xlabel("time, s")
    figure.align_ylabels(panels)
    return figure
