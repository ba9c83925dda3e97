from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxquad.tuning import Evaluation

from ._labels import draw_limit, Style


Count = Int[np.ndarray, " evaluations"]
Values = Float[np.ndarray, "evaluations starts"]
_LINES = ("-", "--", "-.", ":")
_LEAST = 1e-5  # of the cost above the best, that is drawn
_CLOSE = 0.01  # costs are logarithms: within 1 % of the optimum


def convergence_figure(history: Sequence[Evaluation], *, title: str = "") -> Figure:
    """Draw how a tune went, by gradient evaluation: cost above the best, share of stable members.

    While members are made stable (grey) nothing is flown, and there is no cost.

    **Arguments:**

    - `history`: `Tuned.history`; several starts have a line each.
    - `title`: above the figure.

    **Raises:** ValueError for an empty history.
    """
    if not history:
        raise ValueError("the history is empty: give that of a tune")
    count = np.arange(1, len(history) + 1)
    flying = np.array([one.phase == "optimise" for one in history])
    cost = np.where(flying[:, None], [np.atleast_1d(one.cost) for one in history], np.nan)
    stable = np.array([np.atleast_1d(one.stable) for one in history])
    figure = Figure(figsize=(6.5, 5.0), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1.6])
    _costs(top, count, cost)
    _shares(bottom, count, stable)
    _stabilising((top, bottom), count, flying)
    bottom.set_xlabel("gradient evaluation")
    bottom.xaxis.set_major_locator(MaxNLocator(integer=True))
    bottom.set_xlim(0.5, len(history) + 0.5)
    if cost.shape[1] > 1:
        figure.legend(*top.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    if title:
        figure.suptitle(title, fontsize=10)
    return figure


def _costs(panel: Axes, count: Count, cost: Values) -> None:
    best = np.nanmin(cost) if np.isfinite(cost).any() else 0.0
    above = np.maximum(cost - best, _LEAST)
    for k, line in enumerate(above.T):
        known = np.isfinite(line)
        least = np.minimum.accumulate(np.where(known, line, np.inf))[known]
        style: Style = {
            "color": f"{0.5 * k / max(1, above.shape[1]):.2f}",
            "ls": _LINES[k % len(_LINES)],
        }
        panel.plot(count[known], least, lw=1.4, label=f"start {k + 1}", **style)
        panel.plot(count[known], line[known], "o", ms=3, mfc="none", mew=0.8, color=style["color"])
    panel.set(yscale="log", ylabel="cost above the best")
    draw_limit(panel, _CLOSE, "1 %")
    panel.grid(True, which="major", color="0.9", lw=0.5)


def _shares(panel: Axes, count: Count, stable: Values) -> None:
    for k, line in enumerate(stable.T):
        known = np.isfinite(line)
        style: Style = {
            "color": f"{0.5 * k / max(1, stable.shape[1]):.2f}",
            "ls": _LINES[k % len(_LINES)],
        }
        panel.plot(count[known], 100 * line[known], drawstyle="steps-mid", lw=1.4, **style)
    panel.set(ylabel="stable members, %", ylim=(-4, 104))
    panel.grid(True, which="major", color="0.9", lw=0.5)


def _stabilising(
    panels: Sequence[Axes], count: Count, flying: Bool[np.ndarray, " evaluations"]
) -> None:
    end = count[~flying & (np.cumsum(flying) == 0)]
    if not end.size:
        return
    for panel in panels:
        panel.axvspan(0.5, end[-1] + 0.5, color="0.93", lw=0)
    panels[1].annotate(
        "grey: members are made stable", (0.0, 0.0), xycoords="axes fraction", xytext=(4, 6),
        textcoords="offset points", fontsize=8, color="0.3",
    )  # fmt: skip
