from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxquad.records import Record

from ._labels import short_names, visible
from ._overlay import unit_label


Places = Int[np.ndarray, " kept"]
_COLUMNS = 1200  # more than a screen shows of a figure's width
ROWS = 12  # channels that one figure holds
_COLOURS = {"reference": "tab:green", "input": "tab:blue", "output": "0.15"}


def extremes(values: Float[np.ndarray, " samples"], columns: int = _COLUMNS) -> Places:
    """Where each of `columns` stretches has its least and its largest value, in order of time.

    All places of a short signal. A curve through them loses no peak, however long it is.
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
    """Role and name of every channel: what was asked for, what was applied, what came out."""
    roles = {
        "reference": record.reference_names,
        "input": record.input_names,
        "output": record.output_names,
    }
    return [(role, name) for role, names in roles.items() for name in names]


def record_overview(record: Record, channels: Sequence[tuple[str, str]]) -> Any:
    """Channels of a record over time, stacked; of long ones the extremes; angles in degrees.

    `channels` are pairs of role and name. Returns a `matplotlib.figure.Figure`.
    """
    from matplotlib.figure import Figure

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
