from typing import Any

import numpy as np

from jaxquad.tuning import Judged, Pareto, place, SHOWN

from ._marks import marks, pretty


_TITLES = {"activity_rate": "mean activity", "sensitivity_peak": "worst Ms"}


def front_figure(pareto: Pareto, *, title: str = "") -> Any:
    """ITAE over what it costs, of fresh members: the front, its worst members, and the peers.

    A design with unstable members has a cross and its share of them; over Ms it stands at the right
    end. Returns a `matplotlib.figure.Figure`.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    panel = figure.subplots()
    _front(panel, pareto)
    edge = _edge(pareto)
    styles = list(marks(["front", *pareto.peers]).items())[1:]
    for (name, style), design in zip(styles, pareto.peers.values(), strict=True):
        _peer(panel, name, style, design, pareto.over, edge)
    if not all(np.isfinite(place(x, pareto.over)[0]) for x in pareto.peers.values()):
        _without(panel, edge)
    shown = SHOWN[pareto.over]
    unit = f", {pretty(shown.unit)}" if shown.unit else ""
    panel.margins(x=0.12, y=0.1)
    panel.set(xscale="log", yscale="log", ylabel=f"ITAE, {pretty('deg s^2')}")
    panel.set_xlabel(f"{_TITLES[pareto.over]} of the members{unit}")
    _ticks(panel)
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    figure.suptitle(title or _message(pareto), fontsize=10)
    return figure


def _message(pareto: Pareto) -> str:
    members, shown = pareto.certificates[0].members, SHOWN[pareto.over]
    what = f"tracking against {shown.title}: {members} fresh members fly each design"
    return f"{what}, none is unstable on the front" if pareto.front.any() else f"{what}, no front"


def _front(panel: Any, pareto: Pareto) -> None:
    degrees, on = SHOWN["itae"].scale, pareto.front
    order = np.argsort(pareto.effort)
    kept = order[on[order]]
    worst = np.array([c.rows[c.name].statistics["itae"].worst for c in pareto.certificates])
    x, mean, top = pareto.effort, degrees * pareto.tracking, degrees * worst
    panel.plot(x[kept], mean[kept], "o-", color="black", ms=5, lw=1.4, label="front, mean")
    panel.plot(x[kept], top[kept], ":", color="black", lw=1.2, label="front, worst member")
    panel.fill_between(x[kept], mean[kept], top[kept], color="0.92", lw=0)
    off = ~on & np.isfinite(x)
    if off.any():
        panel.plot(x[off], mean[off], "o", mfc="none", mec="0.5", ms=5, label="not on the front")


def _edge(pareto: Pareto) -> float:
    """Where designs without a finite effort stand."""
    known = [place(design, pareto.over)[0] for design in pareto.peers.values()]
    finite = [x for x in [*pareto.effort, *known] if np.isfinite(x)]
    return 1.6 * max(finite, default=1.0)


def _peer(panel: Any, name: str, style: Any, design: Judged, over: str, edge: float) -> None:
    effort, itae = place(design, over)
    x, y = min(effort, edge), SHOWN["itae"].number(itae)
    panel.plot(x, y, ls="none", label=name, **(style | {"ms": 8.0, "mew": 1.4}))
    count = design.unstable_count
    if count:
        panel.plot(x, y, "x", color="black", ms=9, mew=1.2, zorder=4)
        text = f"{100 * count / design.members:.2g} % unstable"
        side = {"ha": "right", "xytext": (-9, 0)} if x >= edge else {"ha": "left", "xytext": (9, 0)}
        panel.annotate(text, (x, y), textcoords="offset points", va="center", fontsize=9, **side)


def _without(panel: Any, edge: float) -> None:
    """The place of designs that have no Ms."""
    panel.axvspan(edge / 1.15, edge * 1.15, color="0.95", lw=0, zorder=0)
    panel.annotate("no Ms", (edge, 1.0), xycoords=("data", "axes fraction"), ha="center", va="top",
                   xytext=(0, -4), textcoords="offset points", fontsize=8)  # fmt: skip


def _ticks(panel: Any) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in (panel.xaxis, panel.yaxis):
        low, high = axis.get_view_interval()
        subs = (1, 2, 5) if high > 10 * low else (1, 1.5, 2, 3, 4, 5, 7)
        axis.set_major_locator(LogLocator(subs=subs))
        axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axis.set_minor_formatter(NullFormatter())
    panel.grid(True, which="major", color="0.9", lw=0.5)
