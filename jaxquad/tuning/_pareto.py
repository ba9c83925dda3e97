"""What better tracking costs: a front of designs, tuned together."""

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
from ._descent import LBFGS
from ._design_result import DesignResult, summarise_design
from ._objective import Limit, Objective, Penalty, QUANTITIES
from ._problem import build_design, DeviceChoice
from ._tuner import Tuner


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
        summarise = ft.partial(summarise_design, independent=self.certificates[0].independent)
        names = ("over", "levels", "effort", "tracking", "front", "converged", "evaluations")
        return {name: getattr(self, name) for name in names} | {
            "points": [
                {**summarise(c.design).content(), "holds": c.holds} for c in self.certificates
            ],
            "peers": {name: summarise(x).content() for name, x in self.peers.items()},
        }

    def __str__(self) -> str:
        shown = QUANTITIES[self.over]
        over = f"{shown.title}{', ' + shown.unit if shown.unit else ''}"
        first = self.certificates[0]
        lines = [
            f"{np.sum(self.front)} of {len(self.controllers)} points are on the front of ITAE over "
            f"{over}, on {first.members} fresh members; up to {self.evaluations.max()} gradients "
            f"each, {self.seconds:.1f} s",
            f"  {'':<24}{'held at':>9}{over:>18}{'ITAE, deg s^2':>15}{'worst':>9}{'Ms worst':>10}"
            f"{'unstable, %':>13}",
        ]
        points = (self.levels, self.certificates, self.front, self.converged)
        rows = []
        for k, (level, certificate, on, done) in enumerate(zip(*points, strict=True), 1):
            marks = f"{'' if on else ', dominated'}{'' if done else ', not done'}"
            rows.append((f"{k}{marks}", f"{level:.3g}", certificate.design))
        rows += [(name, "", design) for name, design in self.peers.items()]
        for name, level, design in rows:
            row = summarise_design(design, independent=first.independent)
            itae, peak = row.statistics["itae"], row.statistics.get("sensitivity_peak")
            worst = f"{peak.worst:.3g}" if peak is not None and row.unstable == 0 else "n/a"
            by_effort = self.over == "activity_rate"
            effort = f"{row.statistics[self.over].mean:.4g}" if by_effort else worst
            share = "n/a" if row.unstable is None else f"{100 * row.unstable / row.members:.3g}"
            mean, most = (f"{QUANTITIES['itae'].number(x):.4g}" for x in (itae.mean, itae.worst))
            lines.append(
                f"  {name:<24}{level:>9}{effort:>18}{mean:>15}{most:>9}{worst:>10}{share:>13}"
            )
        return "\n".join(lines)


def front_point(design: DesignResult, over: str) -> tuple[float, float]:
    """Where a design stands beside a front: its effort and its mean ITAE.

    The effort is the mean of `over`, or the worst Ms, which is infinite with unstable members.
    """
    values = design.of(over)
    if over != "sensitivity_peak":
        return float(np.mean(values)), float(np.mean(design.of("itae")))
    unstable = design.unstable is None or bool(design.unstable.any())
    return np.inf if unstable else float(np.max(values)), float(np.mean(design.of("itae")))


def pareto(
    loop: Loop, ensemble: Ensemble | Members, scenario: Scenario, *, over: str = "activity",
    points: int = 8, levels: Sequence[float] | None = None, objective: Objective | None = None,
    limits: Sequence[Limit] = (), reserve: float = 0.03, peers: Mapping[str, PyTree] | None = None,
    free: Free = None, members: int = 64, fresh: int | Members = 256, method: LBFGS | None = None,
    key: Key[Array, ""] | None = None, progress: bool | None = None, devices: DeviceChoice = None,
) -> Pareto:  # fmt: skip
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
    if over not in ("activity", *_REACH):
        raise ValueError(f"no front over {over!r}: choose one of activity, {', '.join(_REACH)}")
    over = "activity_rate" if over == "activity" else over
    tuner = Tuner(
        loop, ensemble, scenario, objective, limits, reserve=reserve, free=free, members=members,
        method=method, key=key, progress=progress, listener=None, devices=devices,
    )  # fmt: skip
    levels_of = _levels(over, tuner.objective, points, levels)
    if isinstance(ensemble, Members) and not isinstance(fresh, Members):
        raise ValueError("the members to tune on are given: give fresh=, other members, too")
    others = tuple(p for p in tuner.objective.penalties if p.quantity != over)
    objectives = [  # by a penalty of its own for each level
        eqx.tree_at(
            lambda o: o.penalties, tuner.objective, (*others, Penalty(over, level, _WEIGHT)),
            is_leaf=lambda x: x is tuner.objective.penalties,
        )
        for level in levels_of
    ]  # fmt: skip
    start = np.tile(tuner.coordinates.start, (len(levels_of), 1))
    tuner.solve(start, jax.tree.map(lambda *x: jnp.stack(x), *objectives))
    seconds = tuner.progress.seconds
    designs = [build_design(tuner.coordinates, jnp.asarray(z)) for z in tuner.z]
    drawn, count = (fresh, 0) if isinstance(fresh, Members) else (ensemble, fresh)
    certificates = [
        certify(
            loop.with_controller(design), drawn, scenario, limits=limits,
            peers={} if k else peers, members=count, key=tuner.key, devices=devices,
            **tuner.span._asdict(),
        )
        for k, design in enumerate(designs)
    ]  # fmt: skip
    peer_designs = {name: x for name, x in certificates[0].designs.items() if name != "tuned"}
    certificates = [
        dataclasses.replace(one, designs={"tuned": one.design}, convergence=tuner.judge(k)[1])
        for k, one in enumerate(certificates)
    ]
    return Pareto(
        over, levels_of, tuple(designs), tuple(certificates), peer_designs, tuner.converged,
        tuner.evaluations, seconds,
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
