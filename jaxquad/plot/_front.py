import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxquad.tuning import DesignResult, front_point, Pareto, QUANTITIES

from ._labels import marks, plain_ticks, raise_powers, Style


_TITLES = {"activity_rate": "mean activity", "sensitivity_peak": "worst Ms"}


def front_figure(pareto: Pareto, *, title: str = "") -> Figure:
    """Draw a Pareto front: ITAE over activity or Ms on fresh members, with other designs beside it.

    A design with unstable members has a cross and their share; over Ms it stands at the right end.

    **Arguments:**

    - `pareto`: see `jaxquad.tuning`.
    - `title`: by default what is shown.
    """
    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    panel = figure.subplots()
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
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    figure.suptitle(title or _message(pareto), fontsize=10)
    return figure


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
        low, high = axis.get_view_interval()
        subs = (1, 2, 5) if high > 10 * low else (1, 1.5, 2, 3, 4, 5, 7)
        plain_ticks(axis, subs)
    panel.grid(True, which="major", color="0.9", lw=0.5)
