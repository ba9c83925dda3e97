from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxquad.identify import Agreement, Verification

from ._labels import Style, unit_label
from ._record import extremes


Samples = Float[np.ndarray, " samples"]


def overlay(check: Verification, *, title: str = "") -> Figure:
    """Draw measured and simulated outputs over time, with their difference below each.

    Angles are in degrees. A long curve is drawn through its extremes, so that no peak is lost.

    **Arguments:**

    - `check`: see `jq.verify`.
    - `title`: above the figure, before the measures of agreement.
    """
    count = len(check.outputs)
    figure = Figure(figsize=(6.5, 4.5 if count == 1 else 3.2 * count + 0.6), layout="constrained")
    axes = list(figure.subplots(2 * count, 1, sharex=True, height_ratios=[3, 1.2] * count))
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


def _draw(
    axes: Sequence[Axes], time: Samples, measured: Samples, simulated: Samples, one: Agreement
) -> None:
    top, bottom = axes
    scale, unit = unit_label(one.unit)
    model = {"color": "tab:blue", "lw": 1.6, "ls": "--", "label": "simulated, open loop"}
    _plot(top, time, scale * measured, {"color": "0.15", "lw": 1.0, "label": "measured"})
    _plot(top, time, scale * simulated, model)
    top.legend(loc="upper right", fontsize=9, ncols=2)
    top.set_ylabel(f"{one.name}{unit}")
    _plot(bottom, time, scale * (measured - simulated), {"color": "tab:red", "lw": 0.9})
    bottom.set_ylabel(f"difference{unit}")
    for axis in axes:
        axis.grid(True, color="0.9", lw=0.5)
        axis.margins(x=0)
    low, high = top.get_ylim()
    top.set_ylim(low, high + 0.15 * (high - low))


def _plot(panel: Axes, time: Samples, values: Samples, style: Style) -> None:
    kept = extremes(values)
    panel.plot(time[kept], values[kept], **style)
