"""A Pareto front for print."""

from typing import Any

import numpy as np

from ._quantity_text import SHOWN
from ._row import row_of


def front_text(pareto: Any) -> str:
    """A line for each point, then for each peer."""
    shown = SHOWN[pareto.over]
    over = f"{shown.title}{', ' + shown.unit if shown.unit else ''}"
    members = pareto.certificates[0].members
    kept, count = int(np.sum(pareto.front)), len(pareto.controllers)
    lines = [
        f"{kept} of {count} points are on the front of ITAE over {over}, on {members} fresh "
        f"members; up to {pareto.evaluations.max()} gradients each, {pareto.seconds:.1f} s",
        f"  {'':<24}{'held at':>9}{over:>18}{'ITAE, deg s^2':>15}{'worst':>9}{'Ms worst':>10}"
        f"{'unstable, %':>13}",
    ]
    points = (pareto.levels, pareto.certificates, pareto.front, pareto.converged)
    for k, (level, certificate, on, done) in enumerate(zip(*points, strict=True)):
        name = f"{k + 1}{'' if on else ', dominated'}{'' if done else ', not done'}"
        lines.append(_row(name, f"{level:.3g}", certificate.rows[certificate.name], pareto.over))
    for name, design in pareto.peers.items():
        lines.append(_row(name, "", row_of(design, independent=False), pareto.over))
    return "\n".join(lines)


def _row(name: str, level: str, row: Any, over: str) -> str:
    itae, peak = row.statistics["itae"], row.statistics.get("sensitivity_peak")
    worst = f"{peak.worst:.3g}" if peak is not None and row.unstable == 0 else "n/a"
    effort = row.statistics["activity_rate"].mean if over == "activity_rate" else None
    first = worst if effort is None else f"{effort:.4g}"
    share = "n/a" if row.unstable is None else f"{100 * row.unstable / row.members:.3g}"
    numbers = [f"{SHOWN['itae'].number(x):.4g}" for x in (itae.mean, itae.worst)]
    return f"  {name:<24}{level:>9}{first:>18}{numbers[0]:>15}{numbers[1]:>9}{worst:>10}{share:>13}"
