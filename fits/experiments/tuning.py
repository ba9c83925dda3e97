"""Tune a LADRC and a PID on one ensemble, certify them side by side, draw and export."""

import argparse
import dataclasses
import functools as ft
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

import jaxquad as jq
from jaxquad.plot import certificate_figure, convergence_figure, front_figure
from jaxquad.report import write_json
from jaxquad.tuning import KNOWN_INERTIA, peers


PID_NAME, FULL_NAME = "tuned PID", "full gains"


class Size(NamedTuple):
    """How much is flown."""

    members: int = 64  # that are tuned on
    fresh: int = 256  # that judge
    points: int = 6  # of the front; 0 without one
    others: bool = True  # whether a PID and a LADRC with full gains are tuned, too


QUICK = Size(members=16, points=0, others=False)


class Case(NamedTuple):
    """What is tuned, for whom, and by what it is judged."""

    loop: jq.Loop  # around the LADRC
    ensemble: jq.Ensemble
    flight: jq.simulation.Scenario
    objective: jq.Objective
    limits: tuple[jq.Limit, ...]
    pid: jq.control.ScheduledPID
    free: Sequence[str]  # of the LADRC with full gains
    half: Sequence[str]  # of its half-gain factors
    pid_free: Sequence[str]
    peers: Mapping[str, Any]  # that are not tuned
    reserve: float = 0.03  # by which limits are tightened: more for distributions with long tails


class Study(NamedTuple):
    """The tuned LADRC, whose certificate has all others as peers, and the others that are tuned."""

    ladrc: jq.tuning.Tuned
    pid: jq.tuning.Tuned | None
    full: jq.tuning.Tuned | None
    peers: dict[str, Any]

    @property
    def certificate(self) -> jq.tuning.Certificate:
        assert self.ladrc.certificate is not None
        return self.ladrc.certificate

    @property
    def verdict(self) -> str:
        return str(self.certificate).splitlines()[0]

    def __str__(self) -> str:
        return str(self.ladrc) if self.pid is None else f"{self.ladrc}\n\n{_beside(self)}"


def starts(
    plant: Any, span: tuple[float, float], *, limit: float, dt: float, wo: float = 30.0
) -> tuple[jq.control.ScheduledLADRC, jq.control.ScheduledPID]:
    """For one axis before tuning: by certainty equivalence over `span` times its inertia.

    The PID has about the filter of a LADRC whose `wo` is in rad/s.
    """
    gain, inertia = plant.torque_gain[0], plant.inertia[0]
    map = ft.partial(jq.control.certainty_equivalence, gain, inertia, span=span)
    ladrc = jq.LADRC(10.0, wo, gain / inertia, limit=limit, dt=dt)
    pid = jq.PID(49.0, 89.0, 8.0, measurement_filter=2.0 * max(wo, 50.0), limit=limit, dt=dt)
    return jq.control.ScheduledLADRC(ladrc, map()), jq.control.ScheduledPID(pid, map(factor=0.65))


def equivalent(loop: jq.Loop) -> dict[str, Any]:
    """Certainty equivalence with the gains of the paper, on the nominal plant."""
    assert isinstance(loop.plant, jq.DecoupledAxes)
    return {KNOWN_INERTIA: peers(loop.plant, dt=loop.dt)[KNOWN_INERTIA]}


def study(case: Case, size: Size, key: jax.Array) -> Study:
    """Tune the others first, so that they stand in the LADRC's certificate."""
    tuned = ft.partial(
        jq.tune, ensemble=case.ensemble, scenario=case.flight, objective=case.objective,
        limits=case.limits, reserve=case.reserve, members=size.members, key=key,
    )  # fmt: skip
    loop, scheduled = case.loop, case.loop.controller
    assert isinstance(scheduled, jq.control.ScheduledLADRC)
    around_pid = loop.with_controller(case.pid)
    pid = tuned(around_pid, free=case.pid_free, fresh=None) if size.others else None
    others = size.others and case.half  # without factors the design itself has full gains
    full = tuned(loop, free=case.free, fresh=None) if others else None
    named = {PID_NAME: pid, FULL_NAME: full}
    peers = {n: found.controller for n, found in named.items() if found} | dict(case.peers)
    free = [*case.free, *case.half]
    start = loop.with_controller(halved(scheduled, case.half))
    ladrc = tuned(start, free=free, fresh=size.fresh, peers=peers)
    return Study(ladrc, pid, full, peers)


def halved(start: jq.control.ScheduledLADRC, factors: Sequence[str]) -> jq.control.ScheduledLADRC:
    """With those factors at 0.5."""
    halves = {name.removeprefix("ladrc."): 0.5 for name in factors}
    return dataclasses.replace(start, ladrc=dataclasses.replace(start.ladrc, **halves))


def _beside(found: Study) -> str:
    """The tuned PID's numbers, and what the LADRC gains or loses against it."""
    pid, rows = found.pid, found.certificate.summaries
    assert pid is not None
    own, theirs = (rows[name].statistics for name in (found.certificate.name, PID_NAME))
    values = ", ".join(f"{name} {value:.4g}" for name, value in pid.values.items())
    ratio = 100 * (theirs["itae"].mean / own["itae"].mean - 1)
    both = lambda name, part: f"{getattr(theirs[name], part):.3g} ({getattr(own[name], part):.3g})"
    lines = [
        f"{PID_NAME}: {values}; cost {pid.cost:.5g} after {pid.evaluations} gradients",
        f"  mean ITAE {ratio:+.0f} % of the tuned LADRC's; in brackets the LADRC: mean overshoot"
        f" {both('overshoot', 'mean')} %,",
        f"  worst {both('overshoot', 'worst')} %, worst Ms {both('sensitivity_peak', 'worst')},"
        f" mean activity {both('activity_rate', 'mean')}/s",
    ]
    return "\n".join([*lines, *(f"  ! {remark}" for remark in pid.remarks)])


def front_of(
    case: Case, found: Study, size: Size, key: jax.Array, *, over: str
) -> jq.tuning.Pareto | None:
    """Tracking against `over` for the LADRC, beside all that its certificate has."""
    if not size.points:
        return None
    return jq.tuning.pareto(
        case.loop.with_controller(found.ladrc.controller), case.ensemble, case.flight, over=over,
        points=size.points,
        free=[*case.free, *case.half], objective=case.objective, peers=found.peers,
        members=size.members, fresh=size.fresh, key=key,
    )  # fmt: skip


def write(
    out: Path, found: Study, front: jq.tuning.Pareto | None, *, name: str, extra: Mapping[str, Any]
) -> list[str]:
    """JSON, figures and the C header of the LADRC; the names of the files."""
    tuned = {"LADRC": found.ladrc, "PID": found.pid, "LADRC, full gains": found.full}
    content = {
        "verdict": found.verdict,
        "tuned": {kind: _numbers(one) for kind, one in tuned.items() if one},
        **extra,
        "front": None if front is None else front.content(),
    }
    write_json(out / "result.json", content)
    write_json(out / "certificate.json", found.certificate.content())
    acts = bool(found.ladrc.active)
    rounds = "limits act: each new round of their multipliers is another cost" if acts else ""
    figures = {
        "certificate.png": certificate_figure(found.certificate),
        "convergence.png": convergence_figure(found.ladrc.history, title=rounds),
    }
    if front is not None:
        figures["front.png"] = front_figure(front, title=_title(front, found.certificate))
    for file, panels in figures.items():
        panels.figure.savefig(out / file, dpi=130)
    header = jq.export.write_c_header(out / f"{name}.h", found.ladrc.controller, name=name, axes=1)
    return ["result.json", "certificate.json", *figures, header.name]


def _title(front: jq.tuning.Pareto, certificate: jq.tuning.Certificate) -> str:
    """Names stable designs beyond a limit on Ms, where the picture does not show it."""
    bounds = [float(d.bound) for d in certificate.distances if d.quantity == "sensitivity_peak"]
    if front.over == "sensitivity_peak" or not bounds:
        return ""
    peaks = {
        name: row.statistics["sensitivity_peak"].worst
        for name, row in certificate.summaries.items()
        if not row.unstable
    }
    beyond = [f"{name} has {peak:.1f}" for name, peak in peaks.items() if peak > min(bounds)]
    title = f"ITAE of {certificate.members} fresh members; none is unstable on the front"
    return f"{title}\nbeyond the limit on Ms, {min(bounds):g}: {', '.join(beyond)}" * bool(beyond)


def _numbers(tuned: jq.tuning.Tuned) -> dict[str, Any]:
    names = ("values", "cost", "converged", "evaluations", "stabilising", "seconds", "remarks")
    return {name: getattr(tuned, name) for name in names}


def size_of(options: argparse.Namespace) -> Size:
    """What the command line asks for."""
    size = QUICK if options.quick else Size()
    asked = {"members": options.members, "fresh": options.fresh}
    return size._replace(**{name: count for name, count in asked.items() if count is not None})


def parser(description: str | None, out: str) -> argparse.ArgumentParser:
    """The options that the fits on tuning share."""
    made = argparse.ArgumentParser(description=description)
    made.add_argument("--seed", type=int, default=0, help="of the members, and of simulated noise")
    made.add_argument("--members", type=int, help="that are tuned on")
    made.add_argument("--fresh", type=int, help="that judge")
    made.add_argument(
        "--quick", action="store_true", help="few members, no other design tuned, no front"
    )
    made.add_argument("--out", type=Path, default=Path(out))
    return made
