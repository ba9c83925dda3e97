from typing import Any

import numpy as np

from jaxquad.identify import Verification
from jaxquad.records import Record


def overlay(check: Verification, *, title: str = "") -> Any:
    """Measured and simulated outputs over time, with the difference below each.

    Angles are drawn in degrees. Returns a `matplotlib.figure.Figure`.
    """
    from matplotlib.figure import Figure

    count = len(check.outputs)
    figure = Figure(figsize=(6.5, 4.5 if count == 1 else 3.2 * count + 0.6), layout="constrained")
    axes = figure.subplots(2 * count, 1, sharex=True, height_ratios=[3, 1.2] * count)
    shape = (check.time.size, count)
    measured, simulated = check.measured.reshape(shape), check.simulated.reshape(shape)
    for k, one in enumerate(check.outputs):
        _draw(axes[2 * k : 2 * k + 2], check.time, measured[:, k], simulated[:, k], one)
    axes[-1].set_xlabel("time, s")
    where = f", {check.band[0]:.3g}..{check.band[1]:.3g} rad/s" if check.band else ""
    numbers = (
        f"fit {check.fit_percent:.1f} %, variance accounted for {check.variance_percent:.1f} %, "
        f"TIC {check.tic:.3f}{where}"
    )
    figure.suptitle(f"{title}\n{numbers}" if title else numbers, fontsize=10)
    return figure


def _draw(axes: Any, time: np.ndarray, measured: np.ndarray, simulated: np.ndarray, one: Any):
    top, bottom = axes
    scale, unit = unit_label(one.unit)
    top.plot(time, scale * measured, color="0.15", lw=1.0, label="measured")
    model = {"color": "tab:blue", "lw": 1.6, "ls": "--", "label": "simulated, open loop"}
    top.plot(time, scale * simulated, **model)
    top.legend(loc="upper right", fontsize=9, ncols=2)
    top.set_ylabel(f"{one.name}{unit}")
    bottom.plot(time, scale * (measured - simulated), color="tab:red", lw=0.9)
    bottom.set_ylabel(f"difference{unit}")
    for axis in axes:
        axis.grid(True, color="0.9", lw=0.5)
        axis.margins(x=0)
    low, high = top.get_ylim()
    top.set_ylim(low, high + 0.15 * (high - low))


def record_figure(record: Record) -> Any:
    """References, inputs and outputs of a record over time, stacked; angles in degrees.

    Returns a `matplotlib.figure.Figure`.
    """
    from matplotlib.figure import Figure

    roles = {"reference": record.reference_names, "input": record.input_names}
    roles |= {"output": record.output_names}
    rows = [(role, name) for role, names in roles.items() for name in names]
    figure = Figure(figsize=(6.5, 0.8 + 1.5 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (role, name) in zip(axes, rows, strict=True):
        scale, unit = unit_label(record.unit(name))
        axis.plot(record.time, scale * record.channel(name), color="0.15", lw=0.7)
        axis.set_ylabel(f"{name}{unit}")
        axis.set_title(role, loc="left", fontsize=9, pad=3)
        axis.grid(True, color="0.9", lw=0.5)
        axis.margins(x=0)
    axes[-1].set_xlabel("time, s")
    return figure


def unit_label(unit: str) -> tuple[float, str]:
    """Factor and label of a unit as it is drawn."""
    if unit in ("rad", "rad/s"):
        return float(np.degrees(1.0)), ", " + unit.replace("rad", "deg")
    return 1.0, f", {unit}" if unit else ""
