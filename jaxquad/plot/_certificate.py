from collections.abc import Sequence
from textwrap import wrap

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes

from jaxquad.tuning import Certificate, QUANTITIES, Quantity

from ._labels import draw_limit, marks, plain_ticks
from ._names import raise_powers
from ._panels import arrange, Given, legend_of, Panels, stacked


_TOPS = {"sensitivity_peak": 30.0}  # where the picture ends: more is as good as unstable
_LETTER = 0.067  # inches, of a design's name


def certificate_figure(
    certificate: Certificate,
    *,
    quantities: Sequence[str] = ("itae", "sensitivity_peak"),
    designs: Sequence[str] | None = None,
    ax: Given = None,
    title: str = "",
) -> Panels:
    """Draw every member of a certificate over its inertia: stability, then further quantities.

    Linearly unstable members have a cross, and no Ms or margin. Limits are dashed lines.

    **Arguments:**

    - `certificate`: see `jq.certify`.
    - `quantities`: names of `jaxquad.tuning`, a panel for each.
    - `designs`: the names of those that are drawn; all by default.
    - `ax`: axes to draw into: one for the stability, one for each quantity.
    - `title`: by default the verdict, and what fails.

    **Returns:** `jq.plot.Panels`.

    **Raises:** ValueError for unknown designs, and for more than there are marks.
    """
    names = tuple(certificate.designs) if designs is None else tuple(designs)
    unknown = [name for name in names if name not in certificate.designs]
    if unknown:
        raise ValueError(f"no designs {unknown}: choose from {list(certificate.designs)}")
    heights = [0.28 * len(names) + 0.1, *(2.7 for _ in quantities)]
    panels = stacked(len(heights), ax)
    place, label = _inertia(certificate)
    _stability(panels[0], certificate, names, place)
    for panel, quantity in zip(panels[1:], quantities, strict=True):
        _members(panel, certificate, quantity, names, place)
    panels[-1].set_xlabel(label)
    named = _finish(panels)
    failed = [str(each) for each in certificate.verdicts if each.holds is False]
    lines = [title] if title else [str(certificate).splitlines()[0], *failed]
    title = "\n".join(part for line in lines for part in wrap(line, 95))
    longest = max(len(label.get_text()) for label in panels[0].get_yticklabels())
    left = max(0.9, 0.2 + _LETTER * longest)
    return arrange(panels, heights, width=6.4 + left, left=left, title=title, legend=named)


def _inertia(certificate: Certificate) -> tuple[np.ndarray, str]:
    """Of each member; of several axes the geometric mean."""
    inertia = certificate.facts["inertia"]
    mean = lambda x: np.exp(np.mean(np.log(x), axis=0))
    if certificate.nominal is None:
        return mean(inertia), raise_powers("inertia J of the member, kg m^2")
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


def _finish(panels: Sequence[Axes]) -> dict[str, Artist]:
    """Returns the legend."""
    panels[-1].set_xscale("log")
    for panel in panels[1:]:
        panel.grid(True, color="0.9", lw=0.5)
        if panel.get_yscale() == "log":
            plain_ticks(panel.yaxis)
    plain_ticks(panels[-1].xaxis)
    named = legend_of(panels[1:])
    crosses = [name for name in named if name == "linearly unstable"]
    order = [name for name in named if name not in crosses][::-1] + crosses
    return {name: named[name] for name in order}
