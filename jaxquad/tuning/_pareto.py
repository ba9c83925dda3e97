import dataclasses
import functools as ft
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from jaxquad.ensembles import Ensemble, Members
from jaxquad.identify import Free
from jaxquad.loops import Loop
from jaxquad.simulation import Scenario

from ._certificate import Certificate
from ._certify import certify
from ._cost import Progress, stack_copies
from ._design_result import DesignResult, DesignSummary, front_point, summarise_design
from ._lbfgs import LBFGS
from ._objective import Limit, Objective, Penalty
from ._parameters import build_design, find_bounds, select_coordinates
from ._phases import solve
from ._problem import DeviceChoice, make_problem, TimeSpan
from ._quantities import QUANTITIES
from ._tail import draw_or_take, tighten
from ._tune import judge_descent, require_kinds, stabilising_rate


def describe_front(pareto: "Pareto") -> str:
    """A line for each point, then for each peer."""
    shown = QUANTITIES[pareto.over]
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
        lines.append(
            _row(name, f"{level:.3g}", certificate.summaries[certificate.name], pareto.over)
        )
    for name, design in pareto.peers.items():
        lines.append(_row(name, "", summarise_design(design, independent=False), pareto.over))
    return "\n".join(lines)


def _row(name: str, level: str, row: DesignSummary, over: str) -> str:
    itae, peak = row.statistics["itae"], row.statistics.get("sensitivity_peak")
    worst = f"{peak.worst:.3g}" if peak is not None and row.unstable == 0 else "n/a"
    effort = row.statistics["activity_rate"].mean if over == "activity_rate" else None
    first = worst if effort is None else f"{effort:.4g}"
    share = "n/a" if row.unstable is None else f"{100 * row.unstable / row.members:.3g}"
    numbers = [f"{QUANTITIES['itae'].number(x):.4g}" for x in (itae.mean, itae.worst)]
    return f"  {name:<24}{level:>9}{first:>18}{numbers[0]:>15}{numbers[1]:>9}{worst:>10}{share:>13}"


_NAMES = {"activity": "activity_rate", "activity_rate": "activity_rate"} | {
    "sensitivity_peak": "sensitivity_peak"
}
_REACH = {"activity_rate": (0.1, 10.0), "sensitivity_peak": (0.65, 1.75)}  # times the knee
_WEIGHT = 4.0  # of the penalty that holds a point at its level


class Pareto(eqx.Module):
    """A front of designs between tracking and `over`, each with a certificate on fresh members.

    The points are ordered by the level at which `over` was held. `front` says which of them are
    stable for all members, and not dominated in both numbers by another such point. The confidence
    bound in a certificate holds for a point that was chosen beforehand: certify the point that you
    choose by it again, with another key.
    """

    over: str = eqx.field(static=True)
    levels: Float[np.ndarray, " points"]  # at which each point was held
    controllers: tuple[PyTree, ...]
    certificates: tuple[Certificate, ...]
    peers: dict[str, DesignResult]
    converged: Bool[np.ndarray, " points"]
    evaluations: Int[np.ndarray, " points"]  # gradients
    seconds: float = eqx.field(static=True)  # of the descent, without the certificates

    @property
    def tracking(self) -> Float[np.ndarray, " points"]:
        """Mean ITAE of the fresh members, rad s^2."""
        return np.array([front_point(c.design, self.over)[1] for c in self.certificates])

    @property
    def effort(self) -> Float[np.ndarray, " points"]:
        """The mean activity, or the worst Ms, which is infinite with an unstable member."""
        return np.array([front_point(c.design, self.over)[0] for c in self.certificates])

    @property
    def front(self) -> Bool[np.ndarray, " points"]:
        """Which points are stable for all members, and not dominated by another such point."""
        stable = np.array([certificate.stable for certificate in self.certificates])
        x, y = self.effort, self.tracking
        better = (x[:, None] <= x) & (y[:, None] <= y) & ((x[:, None] < x) | (y[:, None] < y))
        return stable & ~np.any(better & stable[:, None], axis=0)

    def content(self) -> dict[str, object]:
        """Every point's numbers, for `jaxquad.report.write_json`."""
        fields = vars(self) | {
            "effort": self.effort,
            "tracking": self.tracking,
            "front": self.front,
        }
        names = ("over", "levels", "effort", "tracking", "front", "converged", "evaluations")
        summaries = [c.summaries[c.name] for c in self.certificates]
        rows = [
            {**x.content(), "holds": c.holds}
            for x, c in zip(summaries, self.certificates, strict=True)
        ]
        summarise = ft.partial(summarise_design, independent=self.certificates[0].independent)
        peers = {name: summarise(x).content() for name, x in self.peers.items()}
        return {name: fields[name] for name in names} | {"points": rows, "peers": peers}

    def __str__(self) -> str:
        return describe_front(self)


def pareto(
    loop: Loop,
    ensemble: Ensemble | Members,
    scenario: Scenario,
    *,
    over: str = "activity",
    points: int = 8,
    levels: Sequence[float] | None = None,
    objective: Objective | None = None,
    limits: Sequence[Limit] = (),
    reserve: float = 0.03,
    peers: Mapping[str, PyTree] | None = None,
    free: Free = None,
    members: int = 64,
    fresh: int | Members = 256,
    method: LBFGS | None = None,
    key: Key[Array, ""] | None = None,
    progress: bool | None = None,
    devices: DeviceChoice = None,
) -> Pareto:
    """What better tracking costs: designs between little and much of `over`, tuned together.

    All points descend in lockstep on the same members, each with the objective and a penalty that
    holds `over` at its own level. Then each point gets a certificate.

    **Arguments:**

    - `loop`, `ensemble`, `scenario`: as for `jq.tune`.
    - `over`: "activity", squared changes of the command per second, or "sensitivity_peak".
    - `points`: how many designs.
    - `levels`: at which `over` is held, rising; by default to either side of the knee of the
        objective's penalty on it, which these penalties replace.
    - `fresh`: how many members each point is certified on, or those members.
    - The others: as for `jq.tune`.

    **Raises:**

    - `ValueError`: `over` is unknown, the levels do not rise, or as `jq.tune` does.
    """
    if over not in _NAMES:
        raise ValueError(f"no front over {over!r}: choose one of {', '.join(_NAMES)}")
    over, objective = _NAMES[over], Objective() if objective is None else objective
    method = LBFGS() if method is None else method
    require_kinds(loop, ensemble, scenario, objective, limits, method)
    levels_of = _levels(over, objective, points, levels)
    if isinstance(ensemble, Members) and not isinstance(fresh, Members):
        raise ValueError("the members to tune on are given: give fresh=, other members, too")
    key = jax.random.key(0) if key is None else key
    span, watched = TimeSpan.of(objective), Progress(progress)
    coordinates = select_coordinates(loop.controller, free)
    drawn = draw_or_take(loop, ensemble, members, key)
    problem = make_problem(loop.controller, drawn, scenario, span=span, devices=devices)
    tightened = tuple(tighten(limit, reserve) for limit in limits)
    solution = solve(
        coordinates, problem, np.tile(coordinates.start, (len(levels_of), 1)),
        _objectives(objective, over, levels_of), stack_copies(tightened, len(levels_of)),
        method=method, rate=stabilising_rate(objective), progress=watched,
    )  # fmt: skip
    seconds = watched.seconds
    designs = [build_design(coordinates, jnp.asarray(z)) for z in solution.z]
    others, count = (fresh, 0) if isinstance(fresh, Members) else (ensemble, fresh)
    certificates = [
        certify(
            loop.with_controller(design), others, scenario, limits=limits,
            peers={} if k else peers, members=count, key=key, devices=devices, **span._asdict(),
        )
        for k, design in enumerate(designs)
    ]  # fmt: skip
    certificates = [
        dataclasses.replace(
            one,
            convergence=judge_descent(
                solution, k, find_bounds(coordinates, solution.z[k], solution.gradient[k])
            ),
        )
        for k, one in enumerate(certificates)
    ]
    peer_designs = {name: x for name, x in certificates[0].designs.items() if name != "tuned"}
    certificates[0] = dataclasses.replace(
        certificates[0], designs={"tuned": certificates[0].design}
    )
    return Pareto(
        over, levels_of, tuple(designs), tuple(certificates), peer_designs, solution.converged,
        solution.evaluations, seconds,
    )  # fmt: skip


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
    values = np.asarray(levels, float)
    rising = np.all((values > 0) & (np.diff(values, prepend=0) > 0))
    if values.ndim != 1 or values.size < 2 or not rising:
        raise ValueError(f"levels are {levels}: give 2 or more above 0 that rise")
    return values


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
