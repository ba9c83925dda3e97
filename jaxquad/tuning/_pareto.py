import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxquad.ensembles import Ensemble, Members
from jaxquad.identify import Free
from jaxquad.simulation import Scenario

from ._certificate import Certificate
from ._certify import certify
from ._checks import require_kinds
from ._copies import copies
from ._judged import Judged
from ._lbfgs import LBFGS
from ._objective import Limit, Objective, Penalty
from ._parameters import coordinates, design_at
from ._phases import solve
from ._problem import problem_of
from ._progress import Progress
from ._quantities import SHOWN
from ._row import row_of
from ._tune import _tightened, stabilising_rate


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


_NAMES = {"activity": "activity_rate", "activity_rate": "activity_rate"} | {
    "sensitivity_peak": "sensitivity_peak"
}
_REACH = {"activity_rate": (0.1, 10.0), "sensitivity_peak": (0.65, 1.75)}  # times the knee
_WEIGHT = 4.0  # of the penalty that holds a point at its level


class Pareto(eqx.Module):
    """Designs between tracking and `over`, each judged on fresh members with its own certificate.

    The points are ordered by the level about which `over` was held. `front` says which of them are
    stable for all members, and beaten in both numbers by no other such point; the rest is listed.
    The bound in a certificate holds for a point chosen beforehand: certify the one that you take
    because of it again, with another key.
    """

    over: str = eqx.field(static=True)
    levels: Float[np.ndarray, " points"]  # about which each point was held
    controllers: tuple[Any, ...]
    certificates: tuple[Certificate, ...]
    peers: dict[str, Judged]
    converged: Bool[np.ndarray, " points"]
    evaluations: Int[np.ndarray, " points"]  # gradients
    seconds: float = eqx.field(static=True)  # of the descent, without the certificates

    @property
    def tracking(self) -> Float[np.ndarray, " points"]:
        """Mean ITAE of the fresh members, rad s^2."""
        return np.array([place(c.design, self.over)[1] for c in self.certificates])

    @property
    def effort(self) -> Float[np.ndarray, " points"]:
        """Of `over`: the mean activity, or the worst Ms; inf with an unstable member."""
        return np.array([place(c.design, self.over)[0] for c in self.certificates])

    @property
    def front(self) -> Bool[np.ndarray, " points"]:
        """Which points are stable for all members, and not dominated by another such point."""
        stable = np.array([certificate.stable for certificate in self.certificates])
        x, y = self.effort, self.tracking
        better = (x[:, None] <= x) & (y[:, None] <= y) & ((x[:, None] < x) | (y[:, None] < y))
        return stable & ~np.any(better & stable[:, None], axis=0)

    def content(self) -> dict[str, Any]:
        """Every point's numbers, for `jaxquad.report.write_json`."""
        names = ("over", "levels", "effort", "tracking", "front", "converged", "evaluations")
        rows = [c.rows[c.name].content() | {"holds": c.holds} for c in self.certificates]
        known = self.certificates[0].independent
        peers = {n: row_of(x, independent=known).content() for n, x in self.peers.items()}
        return {name: getattr(self, name) for name in names} | {"points": rows, "peers": peers}

    def __str__(self) -> str:
        return front_text(self)


def pareto(
    controller: Any,
    ensemble: Ensemble | Members,
    scenario: Scenario,
    *,
    over: str = "activity",
    points: int = 8,
    levels: Sequence[float] | None = None,
    objective: Objective | None = None,
    limits: Sequence[Limit] = (),
    reserve: float = 0.03,
    peers: Mapping[str, Any] | None = None,
    free: Free = None,
    members: int = 64,
    fresh: int | Members = 256,
    method: LBFGS | None = None,
    key: Key[Array, ""] | None = None,
    progress: bool | None = None,
    devices: int | Sequence[Any] | None = None,
) -> Pareto:
    """What tracking costs: `points` designs between little and much of `over`, tuned at once.

    All points descend in lockstep on the same `members`, each with the `objective` and a penalty
    that holds `over` about its own one of `levels`: of "activity", squared changes of the command
    per second, or of "sensitivity_peak". It takes the place of the objective's penalty on that, of
    whose knee the levels go to either side if they are None. Then each point gets a certificate on
    `fresh` members. The other arguments are those of `tune`.
    Raises ValueError for an unknown `over`, for levels that do not rise, and as `tune` does.
    """
    if over not in _NAMES:
        raise ValueError(f"no front over {over!r}: choose one of {', '.join(_NAMES)}")
    over, objective = _NAMES[over], Objective() if objective is None else objective
    method = LBFGS() if method is None else method
    require_kinds(ensemble, objective, limits, method)
    held = _levels(over, objective, points, levels)
    if isinstance(ensemble, Members) and not isinstance(fresh, Members):
        raise ValueError("the members to tune on are given: give fresh=, other members, too")
    key = jax.random.key(0) if key is None else key
    span = {name: getattr(objective, name) for name in ("events", "start", "stop", "load_start")}
    free_ones, watched = coordinates(controller, free), Progress(progress)
    problem = problem_of(
        controller, _drawn(ensemble, members, key), scenario, **span, devices=devices
    )
    tightened = tuple(_tightened(limit, reserve) for limit in limits)
    found = solve(
        free_ones, problem, np.tile(free_ones.start, (len(held), 1)),
        _objectives(objective, over, held), copies(tightened, len(held)),
        method=method, rate=stabilising_rate(objective),
        progress=watched,
    )  # fmt: skip
    seconds = watched.seconds
    designs = [design_at(free_ones, jnp.asarray(z)) for z in found.z]
    judged_on, count = (fresh, 0) if isinstance(fresh, Members) else (ensemble, fresh)
    judge = lambda c, others: certify(
        c,
        judged_on,
        scenario,
        limits=limits,
        peers=others,
        members=count,
        key=key,
        **span,
        devices=devices,
    )
    certificates = [judge(c, {} if k else peers) for k, c in enumerate(designs)]
    others = {name: x for name, x in certificates[0].designs.items() if name != "tuned"}
    certificates[0] = dataclasses.replace(
        certificates[0], designs={"tuned": certificates[0].design}
    )
    return Pareto(
        over, held, tuple(designs), tuple(certificates), others, found.converged,
        found.evaluations, seconds,
    )  # fmt: skip


def place(design: Judged, over: str) -> tuple[float, float]:
    """Where a design stands beside a front: its effort and its mean ITAE."""
    values = design.of(over)
    if over != "sensitivity_peak":
        return float(np.mean(values)), float(np.mean(design.of("itae")))
    unstable = design.unstable is None or bool(design.unstable.any())
    return np.inf if unstable else float(np.max(values)), float(np.mean(design.of("itae")))


def _levels(
    over: str, objective: Objective, points: int, levels: Sequence[float] | None
) -> np.ndarray:
    if levels is None:
        knees = [float(p.knee) for p in objective.penalties if p.quantity == over]
        if points < 2 or not knees:
            raise ValueError(
                f"points is {points} and the objective has {len(knees)} penalties on {over}: for a "
                "front give 2 points or more and a penalty, or levels=[...]"
            )
        return np.geomspace(*_REACH[over], points) * knees[0]
    held = np.asarray(levels, float)
    if held.ndim != 1 or held.size < 2 or not np.all((held > 0) & (np.diff(held, prepend=0) > 0)):
        raise ValueError(f"levels are {levels}: give 2 or more above 0 that rise")
    return held


def _drawn(ensemble: Ensemble | Members, count: int, key: Key[Array, ""]) -> Members:
    return ensemble if isinstance(ensemble, Members) else ensemble.draw(count, key)


def _objectives(objective: Objective, over: str, levels: np.ndarray) -> Objective:
    """One for each level, stacked."""
    others = tuple(p for p in objective.penalties if p.quantity != over)
    mine = [
        eqx.tree_at(
            lambda o: o.penalties, objective, (*others, Penalty(over, level, _WEIGHT)),
            is_leaf=lambda x: x is objective.penalties,
        )
        for level in levels
    ]  # fmt: skip
    return jax.tree.map(lambda *x: jnp.stack(x), *mine)
