"""How a tune went, and the front of several."""

from collections.abc import Sequence
from textwrap import wrap

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from jaxquad.tuning import DesignResult, Evaluation, front_point, Pareto, QUANTITIES

from ._labels import draw_limit, marks, plain_ticks, Style
from ._names import raise_powers
from ._panels import arrange, Given, legend_of, Panels, stacked


Count = Int[np.ndarray, " evaluations"]
Values = Float[np.ndarray, "evaluations starts"]
_LINES = ("-", "--", "-.", ":")
_LEAST = 1e-5  # of the cost above the best, that is drawn
_CLOSE = 0.01  # costs are logarithms: within 1 % of the optimum


def convergence_figure(
    history: Sequence[Evaluation], *, ax: Given = None, title: str = ""
) -> Panels:
    """Draw how a tune went, by gradient evaluation: cost above the best, share of stable members.

    While members are made stable (grey) nothing is flown, and there is no cost.

    **Arguments:**

    - `history`: `Tuned.history`; several starts have a line each.
    - `ax`: two axes to draw into.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.

    **Raises:** ValueError for an empty history.
    """
    if not history:
        raise ValueError("the history is empty: give that of a tune")
    count = np.arange(1, len(history) + 1)
    flying = np.array([one.phase == "optimise" for one in history])
    cost = np.where(flying[:, None], [np.atleast_1d(one.cost) for one in history], np.nan)
    stable = np.array([np.atleast_1d(one.stable) for one in history])
    panels = stacked(2, ax)
    top, bottom = panels
    _costs(top, count, cost)
    _shares(bottom, count, stable)
    _stabilising((top, bottom), count, flying)
    bottom.set_xlabel("gradient evaluation")
    bottom.xaxis.set_major_locator(MaxNLocator(integer=True))
    bottom.set_xlim(0.5, len(history) + 0.5)
    legend = legend_of([top]) if cost.shape[1] > 1 else None
    return arrange(panels, (2.6, 1.4), title=title, legend=legend)


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
    plain_ticks(panel.yaxis)
    draw_limit(panel, _CLOSE, "1 %")
    panel.grid(True, color="0.9", lw=0.5)


def _shares(panel: Axes, count: Count, stable: Values) -> None:
    for k, line in enumerate(stable.T):
        known = np.isfinite(line)
        style: Style = {
            "color": f"{0.5 * k / max(1, stable.shape[1]):.2f}",
            "ls": _LINES[k % len(_LINES)],
        }
        panel.plot(count[known], 100 * line[known], drawstyle="steps-mid", lw=1.4, **style)
    panel.set(ylabel="stable members, %", ylim=(-4, 104))
    panel.grid(True, color="0.9", lw=0.5)


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


_TITLES = {"activity_rate": "mean activity", "sensitivity_peak": "worst Ms"}


def front_figure(pareto: Pareto, *, ax: Given = None, title: str = "") -> Panels:
    """Draw a Pareto front: ITAE over activity or Ms on fresh members, with other designs beside it.

    A design with unstable members has a cross and their share; over Ms it stands at the right end.

    **Arguments:**

    - `pareto`: see `jaxquad.tuning`.
    - `ax`: axes to draw into.
    - `title`: by default what is shown.

    **Returns:** `jq.plot.Panels`.
    """
    panels = stacked(1, ax)
    [panel] = panels
    _front(panel, pareto)
    edge = _edge(pareto)
    styles = list(marks(["front", *pareto.peers]).items())[1:]
    for (name, style), design in zip(styles, pareto.peers.values(), strict=True):
        _peer(panel, name, style, design, pareto.over, edge)
    if not all(np.isfinite(front_point(x, pareto.over)[0]) for x in pareto.peers.values()):
        _without(panel, edge)
    shown = QUANTITIES[pareto.over]
    unit = f", {raise_powers(shown.unit)}" if shown.unit else ""
    panel.margins(x=0.12, y=0.1)
    panel.set(xscale="log", yscale="log", ylabel=f"ITAE, {raise_powers('deg s^2')}")
    panel.set_xlabel(f"{_TITLES[pareto.over]} of the members{unit}")
    _ticks(panel)
    title = "\n".join(wrap(title or _message(pareto), 95))
    return arrange(panels, [3.4], width=7.0, title=title, legend=legend_of(panels))


def _message(pareto: Pareto) -> str:
    members, shown = pareto.certificates[0].members, QUANTITIES[pareto.over]
    what = f"tracking against {shown.title}: {members} fresh members fly each design"
    return f"{what}, none is unstable on the front" if pareto.front.any() else f"{what}, no front"


def _front(panel: Axes, pareto: Pareto) -> None:
    degrees, on = QUANTITIES["itae"].factor, pareto.front
    order = np.argsort(pareto.effort)
    kept = order[on[order]]
    worst = np.array([c.summaries[c.name].statistics["itae"].worst for c in pareto.certificates])
    x, mean, top = pareto.effort, degrees * pareto.tracking, degrees * worst
    panel.plot(x[kept], mean[kept], "o-", color="black", ms=5, lw=1.4, label="front, mean")
    panel.plot(x[kept], top[kept], ":", color="black", lw=1.2, label="front, worst member")
    panel.fill_between(x[kept], mean[kept], top[kept], color="0.92", lw=0)
    off = ~on & np.isfinite(x)
    if off.any():
        panel.plot(x[off], mean[off], "o", mfc="none", mec="0.5", ms=5, label="not on the front")


def _edge(pareto: Pareto) -> float:
    """Where designs without a finite effort stand."""
    known = [front_point(design, pareto.over)[0] for design in pareto.peers.values()]
    finite = [x for x in [*pareto.effort, *known] if np.isfinite(x)]
    return 1.6 * max(finite, default=1.0)


def _peer(
    panel: Axes, name: str, style: Style, design: DesignResult, over: str, edge: float
) -> None:
    effort, itae = front_point(design, over)
    bold: Style = style | {"ms": 8.0, "mew": 1.4}
    x, y = min(effort, edge), QUANTITIES["itae"].number(itae)
    panel.plot(x, y, ls="none", label=name, **bold)
    count = design.unstable_count
    if count:
        panel.plot(x, y, "x", color="black", ms=9, mew=1.2, zorder=4)
        text = f"{100 * count / design.members:.2g} % unstable"
        side = {"ha": "right", "xytext": (-9, 0)} if x >= edge else {"ha": "left", "xytext": (9, 0)}
        panel.annotate(text, (x, y), textcoords="offset points", va="center", fontsize=9, **side)


def _without(panel: Axes, edge: float) -> None:
    """The place of designs that have no Ms."""
    panel.axvspan(edge / 1.15, edge * 1.15, color="0.95", lw=0, zorder=0)
    panel.annotate("no Ms", (edge, 1.0), xycoords=("data", "axes fraction"), ha="center", va="top",
                   xytext=(0, -4), textcoords="offset points", fontsize=8)  # fmt: skip


def _ticks(panel: Axes) -> None:
    for axis in (panel.xaxis, panel.yaxis):
        plain_ticks(axis)
    panel.grid(True, color="0.9", lw=0.5)
