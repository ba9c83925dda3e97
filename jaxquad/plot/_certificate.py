from collections.abc import Sequence
from textwrap import wrap

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxquad.tuning import Certificate, QUANTITIES, Quantity

from ._labels import draw_limit, marks, plain_ticks, raise_powers


_TOPS = {"sensitivity_peak": 30.0}  # where the picture ends: more is as good as unstable


def certificate_figure(
    certificate: Certificate,
    *,
    quantities: Sequence[str] = ("itae", "sensitivity_peak"),
    designs: Sequence[str] | None = None,
    title: str = "",
) -> Figure:
    """Draw every member of a certificate over its inertia: stability, then further quantities.

    Linearly unstable members have a cross, and no Ms or margin. Limits are dashed lines.

    **Arguments:**

    - `certificate`: see `jq.certify`.
    - `quantities`: names of `jaxquad.tuning`, a panel for each.
    - `designs`: the names of those that are drawn; all by default.
    - `title`: by default the verdict, and what fails.

    **Raises:** ValueError for unknown designs, and for more than there are marks.
    """
    names = tuple(certificate.designs) if designs is None else tuple(designs)
    unknown = [name for name in names if name not in certificate.designs]
    if unknown:
        raise ValueError(f"no designs {unknown}: choose from {list(certificate.designs)}")
    heights = [0.28 * len(names) + 0.1, *(2.7 for _ in quantities)]
    figure = Figure(figsize=(7.5, 1.5 + sum(heights)), layout="constrained")
    panels = list(figure.subplots(len(heights), 1, sharex=True, height_ratios=heights))
    place, label = _inertia(certificate)
    _stability(panels[0], certificate, names, place)
    for panel, quantity in zip(panels[1:], quantities, strict=True):
        _members(panel, certificate, quantity, names, place)
    panels[-1].set_xlabel(label)
    _finish(figure, panels)
    failed = [str(each) for each in certificate.verdicts if each.holds is False]
    lines = [title] if title else [str(certificate).splitlines()[0], *failed]
    figure.suptitle("\n".join(part for line in lines for part in wrap(line, 95)), fontsize=9)
    return figure


def _inertia(certificate: Certificate) -> tuple[np.ndarray, str]:
    """Of each member; of several axes the geometric mean."""
    inertia = certificate.facts["inertia"]
    mean = lambda x: np.exp(np.mean(np.log(x), axis=0))
    if certificate.nominal is None:
        return mean(inertia), "inertia J of the member, kg m$^2$"
    return mean(inertia / certificate.nominal[:, None]), "inertia of the member, J / J0"


def _stability(
    panel: Axes, certificate: Certificate, names: Sequence[str], place: np.ndarray
) -> None:
    """A row for each design: a cross for an unstable member, a dot for a stable one."""
    labels = []
    for row, name in enumerate(names):
        unstable = certificate.designs[name].unstable
        if unstable is None:
            labels.append(f"{name}: not known")
            continue
        labels.append(f"{name}: {100 * np.mean(unstable):.3g} % unstable")
        dots, crosses = place[~unstable], place[unstable]
        panel.plot(dots, np.full(dots.size, row), ".", color="0.7", ms=3)
        panel.plot(crosses, np.full(crosses.size, row), "x", color="black", ms=4, mew=0.8)
    panel.set_yticks(range(len(names)), labels, fontsize=8)
    panel.set_ylim(len(names) - 0.5, -0.5)
    panel.tick_params(axis="y", length=0)


def _members(
    panel: Axes, certificate: Certificate, quantity: str, names: Sequence[str], place: np.ndarray
) -> None:
    shown, top = QUANTITIES[quantity], _TOPS.get(quantity, np.inf)
    lowest = []
    for name, style in reversed(marks(names).items()):
        design = certificate.designs[name]
        values = np.array([shown.number(x) for x in design.of(quantity)])
        known = np.isfinite(values)
        height = np.minimum(values, top)
        order = 3 if name == names[0] else 2
        panel.plot(place[known], height[known], ls="none", label=name, zorder=order, **style)
        if design.unstable is not None and (cross := known & design.unstable).any():
            panel.plot(place[cross], height[cross], "x", ms=5, mew=0.8, color="black", zorder=4,
                       label="linearly unstable")  # fmt: skip
        lowest.append(np.min(height[known], initial=np.inf))
    for distance in certificate.distances:
        if distance.quantity == quantity:
            text = f"{distance.over} {distance.sense} {shown.text(distance.bound)}"
            draw_limit(panel, shown.number(distance.bound), raise_powers(text))
    panel.set_yscale("log" if min(lowest) > 0 and not shown.decibels else "linear")
    panel.set_ylabel(_label(shown, top))


def _label(shown: Quantity, top: float) -> str:
    unit = f", {raise_powers(shown.unit)}" if shown.unit else ""
    return f"{shown.title}{unit}" + (
        f" (above {top:g} drawn at {top:g})" if np.isfinite(top) else ""
    )


def _finish(figure: Figure, panels: Sequence[Axes]) -> None:
    named: dict[str, Artist] = {}
    for panel in panels[1:]:
        panel.grid(True, which="major", color="0.9", lw=0.5)
        handles, labels = panel.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    panels[-1].set_xscale("log")
    for axis in [panels[-1].xaxis, *(panel.yaxis for panel in panels[1:])]:
        if axis.get_scale() == "log":
            subs = (1, 2, 3, 5) if axis is panels[-1].xaxis else (1, 2, 5)
            plain_ticks(axis, subs)
    crosses = [name for name in named if name == "linearly unstable"]
    order = [name for name in named if name not in crosses][::-1] + crosses
    figure.legend([named[name] for name in order], order, loc="outside lower center", ncols=3,
                  fontsize=9)  # fmt: skip
