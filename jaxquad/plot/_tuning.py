"""How a tune went, its certificate, its flights, and the front of several."""

from collections.abc import Mapping, Sequence
from textwrap import wrap

import numpy as np
from jaxtyping import PyTree
from matplotlib.ticker import MaxNLocator

from jaxquad.ensembles import Ensemble, Members
from jaxquad.loops import Loop
from jaxquad.records import AXES
from jaxquad.simulation import Scenario, Simulation
from jaxquad.tuning import (
    Certificate,
    Evaluation,
    front_point,
    Pareto,
    QUANTITIES,
    Tuned,
    worst_flights,
)

from . import _panels as lay
from ._flights import histories
from ._panels import AxesLike, Panels, Style


_LINES = ("-", "--", "-.", ":")
_LEAST = 1e-5  # of the cost above the best, that is drawn
_CLOSE = 0.01  # costs are logarithms: within 1 % of the optimum


def convergence_figure(
    history: Sequence[Evaluation], *, ax: AxesLike = None, title: str = ""
) -> Panels:
    """Draw how a tune went, by gradient evaluation: cost above the best, share of stable members.

    While members are made stable (grey) nothing is flown, and there is no cost.

    **Arguments:**

    - `history`: `Tuned.history`; several starts have a line each.
    - `ax`: two axes to draw into.

    **Raises:** ValueError for an empty history.
    """
    if not history:
        raise ValueError("the history is empty: give that of a tune")
    count = np.arange(1, len(history) + 1)
    flying = np.array([one.phase == "optimise" for one in history])
    cost = np.where(flying[:, None], [np.atleast_1d(one.cost) for one in history], np.nan)
    stable = np.array([np.atleast_1d(one.stable) for one in history])
    top, bottom = panels = lay.stacked(2, ax)
    best = np.nanmin(cost) if np.isfinite(cost).any() else 0.0
    above, starts = np.maximum(cost - best, _LEAST), cost.shape[1]
    for k in range(starts):
        style: Style = {"color": f"{0.5 * k / max(1, starts):.2f}", "ls": _LINES[k % len(_LINES)]}
        costs, flown = above[:, k], np.isfinite(above[:, k])
        least = np.minimum.accumulate(np.where(flown, costs, np.inf))[flown]
        top.plot(count[flown], least, lw=1.4, label=f"start {k + 1}", **style)
        top.plot(count[flown], costs[flown], "o", ms=3, mfc="none", mew=0.8, color=style["color"])
        running = np.isfinite(stable[:, k])
        shares = 100 * stable[running, k]
        bottom.plot(count[running], shares, drawstyle="steps-mid", lw=1.4, **style)
    top.set(yscale="log", ylabel="cost above the best")
    lay.plain_ticks(top.yaxis)
    lay.draw_limit(top, _CLOSE, "1 %")
    bottom.set(ylabel="stable members, %", ylim=(-4, 104))
    for panel in panels:
        panel.grid(True, color="0.9", lw=0.5)
    stabilising = count[~flying & (np.cumsum(flying) == 0)]
    if stabilising.size:
        for panel in panels:
            panel.axvspan(0.5, stabilising[-1] + 0.5, color="0.93", lw=0)
        bottom.annotate(
            "grey: members are made stable", (0.0, 0.0), xycoords="axes fraction", xytext=(4, 6),
            textcoords="offset points", fontsize=8, color="0.3",
        )  # fmt: skip
    bottom.set_xlabel("gradient evaluation")
    bottom.xaxis.set_major_locator(MaxNLocator(integer=True))
    bottom.set_xlim(0.5, len(history) + 0.5)
    legend = lay.legend_of([top]) if starts > 1 else None
    return lay.arrange(panels, (2.6, 1.4), title=title, legend=legend)


_TITLES = {"activity_rate": "mean activity", "sensitivity_peak": "worst Ms"}


def front_figure(pareto: Pareto, *, ax: AxesLike = None, title: str = "") -> Panels:
    """Draw a Pareto front: ITAE over activity or Ms on fresh members, with other designs beside it.

    A design with unstable members has a cross and their share; over Ms it stands at the right end.

    **Arguments:**

    - `pareto`: see `jaxquad.tuning`.
    - `title`: by default what is shown.
    """
    [panel] = panels = lay.stacked(1, ax)
    degrees, on = QUANTITIES["itae"].factor, pareto.front
    order = np.argsort(pareto.effort)
    front = order[on[order]]
    worst = np.array([c.summaries[c.name].statistics["itae"].worst for c in pareto.certificates])
    x, mean, top = pareto.effort, degrees * pareto.tracking, degrees * worst
    panel.plot(x[front], mean[front], "o-", color="black", ms=5, lw=1.4, label="front, mean")
    panel.plot(x[front], top[front], ":", color="black", lw=1.2, label="front, worst member")
    panel.fill_between(x[front], mean[front], top[front], color="0.92", lw=0)
    off = ~on & np.isfinite(x)
    if off.any():
        panel.plot(x[off], mean[off], "o", mfc="none", mec="0.5", ms=5, label="not on the front")
    points = [front_point(design, pareto.over) for design in pareto.peers.values()]
    efforts = [effort for effort, _ in points]
    # Where designs without a finite effort stand.
    edge = 1.6 * max((x for x in [*pareto.effort, *efforts] if np.isfinite(x)), default=1.0)
    styles = list(lay.marks(["front", *pareto.peers]).items())[1:]
    designs = pareto.peers.values()
    for (name, style), design, (effort, itae) in zip(styles, designs, points, strict=True):
        bold: Style = style | {"ms": 8.0, "mew": 1.4}
        x, y = min(effort, edge), QUANTITIES["itae"].number(itae)
        panel.plot(x, y, ls="none", label=name, **bold)
        if count := design.unstable_count:
            panel.plot(x, y, "x", color="black", ms=9, mew=1.2, zorder=4)
            text = f"{100 * count / design.members:.2g} % unstable"
            right: Style = {"ha": "right", "xytext": (-9, 0)}
            side = right if x >= edge else {"ha": "left", "xytext": (9, 0)}
            panel.annotate(
                text, (x, y), textcoords="offset points", va="center", fontsize=9, **side
            )
    if not np.all(np.isfinite(efforts)):
        panel.axvspan(edge / 1.15, edge * 1.15, color="0.95", lw=0, zorder=0)
        panel.annotate(
            "no Ms", (edge, 1.0), xycoords=("data", "axes fraction"), ha="center", va="top",
            xytext=(0, -4), textcoords="offset points", fontsize=8,
        )  # fmt: skip
    members, shown = pareto.certificates[0].members, QUANTITIES[pareto.over]
    unit = f", {lay.raise_powers(shown.unit)}" if shown.unit else ""
    panel.margins(x=0.12, y=0.1)
    panel.set(xscale="log", yscale="log", ylabel=f"ITAE, {lay.raise_powers('deg s^2')}")
    panel.set_xlabel(f"{_TITLES[pareto.over]} of the members{unit}")
    for axis in (panel.xaxis, panel.yaxis):
        lay.plain_ticks(axis)
    panel.grid(True, color="0.9", lw=0.5)
    stable = "none is unstable on the front" if on.any() else "no front"
    text = f"tracking against {shown.title}: {members} fresh members fly each design, {stable}"
    title = "\n".join(wrap(title or text, 95))
    return lay.arrange(panels, [3.4], width=7.0, title=title, legend=lay.legend_of(panels))


_TOPS = {"sensitivity_peak": 30.0}  # where the picture ends: more is as good as unstable
_LETTER = 0.067  # inches, of a design's name


def certificate_figure(
    certificate: Certificate, *, quantities: Sequence[str] = ("itae", "sensitivity_peak"),
    designs: Sequence[str] | None = None, ax: AxesLike = None, title: str = "",
) -> Panels:  # fmt: skip
    """Draw every member of a certificate over its inertia: stability, then further quantities.

    Linearly unstable members have a cross, and no Ms or margin. Limits are dashed lines.

    **Arguments:**

    - `certificate`: see `jq.certify`.
    - `quantities`: names of `jaxquad.tuning`, a panel for each.
    - `designs`: the names of those that are drawn; all by default.
    - `ax`: axes to draw into: one for the stability, one for each quantity.
    - `title`: by default the verdict, and what fails.

    **Raises:** ValueError for unknown designs, and for more than there are marks.
    """
    names = tuple(certificate.designs) if designs is None else tuple(designs)
    unknown = [name for name in names if name not in certificate.designs]
    if unknown:
        raise ValueError(f"no designs {unknown}: choose from {list(certificate.designs)}")
    heights = [0.28 * len(names) + 0.1, *(2.7 for _ in quantities)]
    panels = lay.stacked(len(heights), ax)
    inertia, label = certificate.facts["inertia"], "inertia J of the member, kg m^2"
    if certificate.nominal is not None:
        inertia, label = inertia / certificate.nominal[:, None], "inertia of the member, J / J0"
    place = np.exp(np.mean(np.log(inertia), axis=0))  # of several axes the geometric mean
    labels = []
    for row, name in enumerate(names):
        unstable = certificate.designs[name].unstable
        if unstable is None:
            labels.append(f"{name}: not known")
            continue
        labels.append(f"{name}: {100 * np.mean(unstable):.3g} % unstable")
        dots, crosses = place[~unstable], place[unstable]
        panels[0].plot(dots, np.full(dots.size, row), ".", color="0.7", ms=3)
        panels[0].plot(crosses, np.full(crosses.size, row), "x", color="black", ms=4, mew=0.8)
    panels[0].set_yticks(range(len(names)), labels, fontsize=8)
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    panels[0].tick_params(axis="y", length=0)
    for panel, quantity in zip(panels[1:], quantities, strict=True):
        shown, top = QUANTITIES[quantity], _TOPS.get(quantity, np.inf)
        lowest = []
        for name, style in reversed(lay.marks(names).items()):
            design = certificate.designs[name]
            values = np.array([shown.number(x) for x in design.of(quantity)])
            finite = np.isfinite(values)
            height = np.minimum(values, top)
            above = 3 if name == names[0] else 2
            panel.plot(place[finite], height[finite], ls="none", label=name, zorder=above, **style)
            if design.unstable is not None and (cross := finite & design.unstable).any():
                panel.plot(place[cross], height[cross], "x", ms=5, mew=0.8, color="black", zorder=4,
                           label="linearly unstable")  # fmt: skip
            lowest.append(np.min(height[finite], initial=np.inf))
        for distance in certificate.distances:
            if distance.quantity == quantity:
                text = f"{distance.over} {distance.sense} {shown.text(distance.bound)}"
                lay.draw_limit(panel, shown.number(distance.bound), lay.raise_powers(text))
        panel.set_yscale("log" if min(lowest) > 0 and not shown.decibels else "linear")
        unit = f", {lay.raise_powers(shown.unit)}" if shown.unit else ""
        cut = f" (above {top:g} drawn at {top:g})" if np.isfinite(top) else ""
        panel.set_ylabel(f"{shown.title}{unit}{cut}")
    panels[-1].set(xscale="log", xlabel=lay.raise_powers(label))
    for panel in panels[1:]:
        panel.grid(True, color="0.9", lw=0.5)
        if panel.get_yscale() == "log":
            lay.plain_ticks(panel.yaxis)
    lay.plain_ticks(panels[-1].xaxis)
    handles = lay.legend_of(panels[1:])
    crossed = [name for name in handles if name == "linearly unstable"]
    order = [name for name in handles if name not in crossed][::-1] + crossed
    failed = [str(verdict) for verdict in certificate.verdicts if verdict.holds is False]
    lines = [title] if title else [str(certificate).splitlines()[0], *failed]
    title = "\n".join(part for line in lines for part in wrap(line, 95))
    left = max(0.9, 0.2 + _LETTER * max(map(len, labels)))
    return lay.arrange(panels, heights, width=6.4 + left, left=left, title=title,
                   legend={name: handles[name] for name in order})  # fmt: skip


def flight(
    flown: PyTree, loop: Loop | None = None, ensemble: Ensemble | Members | None = None,
    scenario: Scenario | None = None, *, axis: str | int = 0,
    quantities: Sequence[str] = ("itae", "sensitivity_peak"), command_unit: str = "",
    ax: AxesLike = None, title: str = "",
) -> Panels:  # fmt: skip
    """Draw how a tuned design flies: angle, command and disturbing torque over time.

    The nominal loop, and the members of the certificate that are worst in some quantity, are flown
    again with the noise that was theirs.

    !!! example

        ```python
        tuned = jq.tune(loop, ensemble, flight)
        jq.plot.flight(tuned, loop, ensemble, flight)
        jq.plot.flight({"LADRC": jq.simulate(one, flight), "PID": jq.simulate(other, flight)})
        ```

    **Arguments:**

    - `flown`: a tuned design with its certificate; or a certificate, whose design is
        `loop.controller`; or simulations that were flown already, by name or one.
    - `loop`, `ensemble`, `scenario`: those that the design was tuned on. Where `jq.tune` was given
        fresh members, give these as `ensemble`.
    - `axis`: of a plant with several, by name or number.
    - `quantities`: names of `jaxquad.tuning` whose worst member is drawn.
    - `command_unit`: such as "V".
    - `ax`: three axes to draw into.

    **Raises:** ValueError for a design without certificate, for parts that are missing or that the
    certificate was not made with, for an unknown axis, and for ensembles of simulations.
    """
    if isinstance(flown, Simulation):
        flown = {"flown": flown}
    if isinstance(flown, Tuned | Certificate):
        if loop is None or ensemble is None or scenario is None:
            raise ValueError(
                "flight flies the members again: give flight(tuned, loop, ensemble, scenario), as "
                "they were given to jq.tune"
            )
        flown = worst_flights(flown, loop, ensemble, scenario, quantities=quantities)
    if not isinstance(flown, Mapping) or not flown:
        raise ValueError(
            f"flight cannot draw a {type(flown).__name__}: give what jq.tune or jq.certify "
            "returned with its loop, ensemble and scenario, or what jq.simulate returned"
        )
    many = [name for name, one in flown.items() if one.angle.ndim > 2]
    if many:
        raise ValueError(f"{many} are ensembles: simulate one member, or give a tuned design")
    first = next(iter(flown.values()))
    axes = first.angle.shape[1]
    names = AXES[:axes]
    if axis in names:
        k = names.index(str(axis))
    elif isinstance(axis, int) and 0 <= axis < axes:
        k = axis
    else:
        listed = ", ".join(names)
        raise ValueError(f"axis is {axis!r}: choose one of {listed}, or 0 to {axes - 1}")
    of = lambda x: np.asarray(x)[:, k]
    angles = {"set-point": np.degrees(of(first.reference))}
    angles |= {name: np.degrees(of(one.angle)) for name, one in flown.items()}
    torques = {name: of(one.disturbance) for name, one in flown.items()}
    torques = {  # the others only where they differ
        name: torque
        for place, (name, torque) in enumerate(torques.items())
        if place == 0 or np.any(torque != of(first.disturbance))
    }
    name = AXES[k] if axes <= len(AXES) else f"axis {k}"
    panels = {
        f"{name}, deg": angles,
        f"command{f', {command_unit}' if command_unit else ''}": {
            name: of(one.command) for name, one in flown.items()
        },
        "disturbance, N m": torques,
    }
    return histories(first.time, panels, target="set-point", ax=ax, title=title)
