"""Gains tuned by gradient through the closed loops of an ensemble, with a certificate."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from jaxquad._core import as_array
from jaxquad.ensembles import Ensemble, Members
from jaxquad.identify import Free
from jaxquad.loops import Loop
from jaxquad.simulation import Scenario

from ._certificate import Certificate, lag_remark
from ._certify import certify
from ._cost import (
    Beyond,
    Evaluation,
    Listener,
    rank_beyond,
    stack_copies,
    Tail,
    take_members,
)
from ._design_result import certified_members
from ._objective import Limit, Objective, QUANTITIES
from ._problem import Bound, build_design, decouple, DeviceChoice
from ._tuner import ADDED, GUARDS, Method, Tuner
from ._verdict import covers, Verdict, with_further


_COST, _PLACE = 2e-3, 0.1  # within which two ends are one: of the cost, and in nepers


class Optimum(NamedTuple):
    """A point at which some of the starts ended; its cost is NaN if it was not stabilised."""

    cost: float
    z: Float[np.ndarray, " n"]
    values: dict[str, float]  # of the tuned numbers
    starts: tuple[int, ...]  # which of them led here; 0 is the controller as given
    converged: bool

    def __str__(self) -> str:
        cost = "not stabilised" if np.isnan(self.cost) else f"cost {self.cost:.5g}"
        shown = ", ".join(map(str, self.starts[:8])) + ", ..." * (len(self.starts) > 8)
        return f"{cost}, from {len(self.starts)} of the starts ({shown})"


def scatter_starts(
    start: Float[np.ndarray, " n"], count: int, scatter: float, seed: int
) -> Float[np.ndarray, "starts n"]:
    """The start itself, and others about it: normal by `scatter` (nepers), a Latin hypercube."""
    from scipy.special import ndtri

    if not isinstance(count, int) or count < 1 or not 0 < scatter < np.inf:
        raise ValueError(
            f"starts is {count} with a scatter of {scatter}: give 1 for the controller as it is, "
            "or more, and a scatter above 0"
        )
    if count == 1:
        return start[None]
    rng = np.random.default_rng(seed)
    cells = np.stack([rng.permutation(count - 1) for _ in range(start.size)], axis=1)
    deviates = ndtri((cells + rng.uniform(0.01, 0.99, cells.shape)) / (count - 1))
    return np.concatenate([start[None], start + scatter * deviates])


def distinct_optima(tuner: Tuner) -> tuple[Optimum, ...]:
    """The distinct points at which the starts ended, the best first."""
    optima: list[Optimum] = []
    cost, z = tuner.cost, tuner.z
    for k in np.argsort(np.where(np.isnan(cost), np.inf, cost), kind="stable"):
        same = [
            i for i, o in enumerate(optima)
            if abs(o.cost - cost[k]) < _COST and np.max(np.abs(o.z - z[k])) < _PLACE
        ]  # fmt: skip
        if same:
            old = optima[same[0]]
            optima[same[0]] = old._replace(starts=(*old.starts, int(k)))
        else:
            values, done = tuner.coordinates.values(z[k]), bool(tuner.converged[k])
            optima.append(Optimum(float(cost[k]), z[k], values, (int(k),), done))
    return tuple(optima)


class LimitResult(NamedTuple):
    """How a limit ended on the members that were tuned on."""

    limit: Limit
    reached: float  # in the limit's unit
    met: bool
    active: bool  # the cost would be lower without it

    def __str__(self) -> str:
        text = f"limit on {self.limit}: {self.reached:.4g}"
        if self.met:
            return f"{text} on the members tuned on, {'active' if self.active else 'not active'}"
        return (
            f"{text} (by {abs(self.reached - float(self.limit.bound)):.3g}) on the members tuned "
            "on, MISSED: it cannot be met together with the others"
        )


class Tuned(eqx.Module):
    """A tuned controller, and what is known of it.

    `str()` begins with three verdicts: `stability` and `performance` on fresh members, and the
    `convergence` of the tuning. Only where all of them hold the design may be flown. `certificate`
    is None if no fresh members were asked for. `limits` and `minima` are on the members that were
    tuned on. `evaluations` counts gradients through the flights of all members, `stabilising` those
    of the linear loops alone that came before. `tail` says how many members were searched for
    those beyond a limit, how many of these were tuned on, too, and which certificate this one is.
    """

    controller: PyTree
    certificate: Certificate | None
    stabilised: bool  # every member that was tuned on
    converged: bool
    cost: float
    values: dict[str, float]  # of the tuned numbers
    limits: tuple[LimitResult, ...]
    minima: tuple[Optimum, ...]  # at which the starts ended, the best first
    bounds: tuple[Bound, ...]  # the tuned numbers that stand at the end of what is allowed
    convergence: Verdict
    evaluations: int
    stabilising: int
    history: tuple[Evaluation, ...]
    seconds: float  # of the descent, compilation included, without the certificate
    remarks: tuple[str, ...]
    tail: Tail = Tail()  # of the ensemble, searched for members beyond limits

    @property
    def active(self) -> tuple[Limit, ...]:
        """The limits without which the cost would be lower."""
        return tuple(one.limit for one in self.limits if one.active)

    @property
    def stability(self) -> Verdict:
        """Whether all fresh members are stable and within the limits."""
        return _UNSEEN[0] if self.certificate is None else self.certificate.stability

    @property
    def performance(self) -> Verdict:
        """Whether the design is of use on the fresh members, against doing nothing."""
        return _UNSEEN[1] if self.certificate is None else self.certificate.performance

    @property
    def verdicts(self) -> tuple[Verdict, Verdict, Verdict]:
        """Stability, performance and convergence."""
        return self.stability, self.performance, self.convergence

    @property
    def holds(self) -> bool:
        """Whether all three verdicts hold: only then the design may be flown."""
        return all(verdict.holds is True for verdict in self.verdicts)

    def __str__(self) -> str:
        first, *rest = ["NOT CERTIFIED: no fresh members were asked for", *self.verdicts]
        if self.certificate is not None:
            first, *rest = str(self.certificate).splitlines()
        numbers = ", ".join(f"{name} {value:.4g}" for name, value in self.values.items())
        lines = [
            first,
            *map(str, rest[:3]),
            f"tuned: {numbers}",
            f"  cost {self.cost:.5g}, {'converged' if self.converged else 'not converged'} after "
            f"{self.evaluations} gradients ({self.stabilising} more of the linear loops, to "
            f"stabilise) in {self.seconds:.1f} s",
            *(f"  {one}" for one in self.limits),
        ]
        lines += [f"  {describe_tail(self.tail)}"] if self.tail.searches else []
        if len(self.minima) > 1:
            count = sum(len(o.starts) for o in self.minima)
            lines.append(f"  {count} starts, {len(self.minima)} optima:")
            lines += [f"    {optimum}" for optimum in self.minima]
        lines += [f"  ! {remark}" for remark in self.remarks]
        return "\n".join([*lines, *map(str, rest[3:])])


_UNSEEN = tuple(
    Verdict(name, None, "not known without fresh members", "Give fresh=, how many to certify on")
    for name in ("STABILITY", "PERFORMANCE")
)


def describe_tail(tail: Tail) -> str:
    flights = f" and {tail.flown} flights" if tail.flown else ""
    loops = f"{tail.searched} further linear loops" if tail.searched else "further members"
    text = f"limits: {loops}{flights} searched, "
    text += f"{tail.added} of the worst added to those tuned on" if tail.added else "none beyond"
    if tail.certificates < 2:
        return text
    return (
        f"{text}; this is certificate {tail.certificates}, on members of its own, because the one "
        "before found some beyond a limit, which are tuned on, too: read its 95 % as "
        f"{100 - 5 * tail.certificates} %"
    )


def tune(
    loop: Loop, ensemble: Ensemble | Members, scenario: Scenario, *,
    objective: Objective | None = None, limits: Sequence[Limit] = (), reserve: float = 0.03,
    free: Free = None, members: int = 64, fresh: int | Members | None = 256, starts: int = 1,
    scatter: float = 0.4, method: Method | None = None, peers: Mapping[str, PyTree] | None = None,
    key: Key[Array, ""] | None = None, progress: bool | None = None,
    listener: Listener | None = None, devices: DeviceChoice = None,
) -> Tuned:  # fmt: skip
    """Tune a controller by gradient through the closed loops of all members of an ensemble at once.

    First the slowest pole of every member is moved to the left of the knee of the objective's
    penalty on the abscissa (-0.5 1/s without one), which needs no flights. Then the objective is
    minimised through their flights of the scenario. Limits are enforced by an augmented Lagrangian,
    those of the linear loop on 256 further members. Then others are searched for such as are beyond
    a limit that every member has to keep: 8192 linear loops, 2048 flights. The worst join those
    that the limit is kept on, and the descent goes on from where it ended, until a search of other
    members finds none, five times at most. Where the certificate still finds one, it is tuned on,
    too, and another certificate is made on members of its own: three at most. A design whose
    certificate fails is returned, too, and says so first.
    Source: docs/tuning.md.

    !!! example

        ```python
        loop = jq.Loop(plant, controller, drive=jq.simulation.Saturation(10.0), delay=0.004)
        ensemble = jq.Ensemble(
            inertia=jq.ensembles.LogUniform(0.5, 3.0), lag=jq.ensembles.Uniform(0.01, 0.04)
        )
        tuned = jq.tune(loop, ensemble, flight, limits=[jq.Limit("sensitivity_peak", at_most=3.6)])
        print(tuned)
        ```

    **Arguments:**

    - `loop`: what is nominal; `loop.controller` is the start. It has the method `linear`, as
        `jq.LADRC`, `jq.PID`, both of them scheduled, and the adaptive LADRC have.
    - `ensemble`: what varies, or members that were drawn from it.
    - `scenario`: what all members fly.
    - `objective`: what is minimised, see `jq.Objective`.
    - `limits`: bounds that the design has to keep.
    - `reserve`: by how much more limits are enforced than asked (0.03 is 3 %), because fresh
        members reach further than those that were tuned on. At most 1 % of it is left on limits
        that every member has to keep once the worst of a search are tuned on.
    - `free`: the numbers to tune, as in `jq.fit`; by default those that `controller.tunable()`
        names: wc, wo and b0 or the knots of its map, of a PID all gains that are not 0. Gains keep
        their sign; the knots of a `jq.control.InertiaMap` stay falling.
    - `members`: how many are drawn to tune on.
    - `fresh`: how many new members the certificate evaluates the design on, or those members; None
        makes no certificate.
    - `starts`, `scatter`: with several starts, others are scattered about the first (normal, by
        `scatter` nepers) and solved together; `Tuned.minima` lists where they ended, and the best
        is returned.
    - `method`: `jq.tuning.LBFGS` (by default) or `jq.tuning.GaussNewton`.
    - `peers`: controllers that stand beside the design in its certificate, by name.
    - `key`: of all draws; `jax.random.key(0)` by default.
    - `progress`: write a line per evaluation on stderr; by default if that is a terminal.
    - `listener`: is called with each `jq.tuning.Evaluation`.
    - `devices`: over which the members are split, see `jq.evaluate`.

    **Returns:**

    A `jq.tuning.Tuned` with `.controller` and `.certificate`.

    **Raises:**

    - `ValueError`: parts do not fit together, or the controller is in single precision.
    """
    tuner = Tuner(
        loop, ensemble, scenario, objective, limits, reserve=reserve, free=free, members=members,
        method=method, key=key, progress=progress, listener=listener, devices=devices,
    )  # fmt: skip
    require_fresh(fresh, tuner.drawn, peers)
    start = scatter_starts(tuner.coordinates.start, starts, scatter, seed=0)
    tuner.solve(
        start, stack_copies(tuner.objective, starts), fresh if isinstance(fresh, int) else _SIZE
    )
    # The lowest cost among the starts that are stable and miss limits least.
    missed = np.maximum(tuner.beyond, 0).sum(axis=1)
    cost = np.where(np.isnan(tuner.cost), np.inf, tuner.cost)
    best = int(np.lexsort((cost, np.where(missed > 5e-3, missed, 0.0), np.isinf(cost)))[0])
    seconds = tuner.progress.seconds
    others = fresh if isinstance(fresh, Members) else ensemble
    certificate, certificates = None, 0
    # None where none is asked for, or where nothing is left to draw it from.
    while isinstance(fresh, Members) or (fresh is not None and isinstance(ensemble, Ensemble)):
        tuner.progress.say("certificate on fresh members ...")
        salt = _AGAIN + certificates
        fresh_key = jax.random.fold_in(tuner.key, salt) if certificates else tuner.key
        certificate = certify(
            loop.with_controller(build_design(tuner.coordinates, as_array(tuner.z[best]))), others,
            scenario, limits=tuner.limits, peers=peers,
            members=0 if isinstance(fresh, Members) else fresh, begun=loop.controller,
            key=fresh_key, devices=devices, **tuner.span._asdict(),
        )  # fmt: skip
        certificates += 1
        if isinstance(fresh, Members) or isinstance(ensemble, Members):
            break  # members that are given have one certificate
        if not any(tuner.searches) or certificates == _CERTIFICATES:
            break
        worst = certified_beyond(
            certificate, certified_members(loop, ensemble, fresh_key, flown=fresh)
        )
        if not worst.added:
            break
        began = tuner.progress.seconds
        tuner.go_on(worst, best)
        seconds += tuner.progress.seconds - began
    return _tuned(tuner, certificate, certificates, best, seconds)


_SIZE = 256  # flights in a slice
_CERTIFICATES = 3  # at most
_AGAIN = 0xCE57  # folded into the key of certificates after the first


def certified_beyond(certificate: Certificate, drawn: Sequence[Members]) -> Beyond:
    """The members of a certificate that are beyond a limit, of those that flew and further ones."""
    missed = [x for x in certificate.distances if x.beyond and covers(x)]
    linear = [x for x in missed if QUANTITIES[x.quantity].linear]
    every = with_further(certificate.design, certificate.further)
    loops = [divmod(k, drawn[0].size) for k in rank_beyond(every, linear)]
    others = [x for x in missed if x not in linear]
    flown = [(0, k) for k in rank_beyond(certificate.design, others)]
    worst = take_members(drawn, loops[:ADDED]), take_members(drawn, flown[:GUARDS])
    return Beyond(*worst, len(loops) + len(flown))


_ACTIVE = 1e-3  # the multiplier's sum above which a limit costs something


_excess = eqx.filter_jit(Limit.excess)  # as one program


def _tuned(
    tuner: Tuner, certificate: Certificate | None, certificates: int, best: int, seconds: float
) -> Tuned:
    controller, limits = build_design(tuner.coordinates, as_array(tuner.z[best])), []
    for k, limit in enumerate(tuner.limits):  # as it was given, on the members that were tuned on
        excess = float(_excess(limit, as_array(tuner.result.limited[k][best])))
        reached = float(limit.bound) + limit.sign * excess
        active = float(np.asarray(tuner.multipliers[k])[best].sum()) > _ACTIVE
        limits.append(LimitResult(limit, reached, excess <= 0, active))
    bounds, convergence = tuner.judge(
        best, [f"{x.limit} cannot be met: {x.reached:.4g} at best" for x in limits if not x.met]
    )
    if certificate is not None:
        certificate = dataclasses.replace(certificate, convergence=convergence)
    return Tuned(
        controller=controller, certificate=certificate, bounds=bounds, convergence=convergence,
        stabilised=bool(tuner.stabilised[best]), converged=bool(tuner.converged[best]),
        cost=float(tuner.cost[best]), values=tuner.coordinates.values(tuner.z[best]),
        limits=tuple(limits), minima=distinct_optima(tuner),
        evaluations=int(tuner.evaluations[best]), stabilising=int(tuner.stabilising[best]),
        tail=tuner.tail._replace(certificates=certificates), history=tuple(tuner.progress.history),
        seconds=seconds, remarks=tuple(_remarks(tuner, controller, best, limits)),
    )  # fmt: skip


def _remarks(
    tuner: Tuner, controller: PyTree, index: int, limits: Sequence[LimitResult]
) -> Iterator[str]:
    slowest = np.asarray(tuner.result.numbers["abscissa"][index])
    if not tuner.stable[index]:
        count = int(np.sum(slowest >= 0))
        yield (
            f"{count} of the {slowest.size} members that were tuned on cannot be stabilised from "
            f"this start (slowest pole {slowest.max():+.3g} 1/s), so nothing was optimised: start "
            "with slower gains, or narrow the ensemble"
        )
    elif not tuner.stabilised[index]:
        yield f"the slowest pole of a member decays at only {-slowest.max():.3g} 1/s"
    if not all(one.met for one in limits) or not tuner.stable[index]:
        linear = tuner.problem.linear
        if remark := lag_remark(controller, linear.delay, decouple(linear.axes).lag):
            yield remark


def require_fresh(fresh: object, drawn: Members, peers: Mapping[str, PyTree] | None) -> None:
    """Raise ValueError for members that are tuned on, and for a peer of the design's name."""
    if "tuned" in (peers or {}):
        raise ValueError("a peer has the name 'tuned' of the design itself: rename it")
    if isinstance(fresh, Members):
        data = [np.asarray(jax.random.key_data(x.keys)) for x in (fresh, drawn)]
        mine, theirs = ({tuple(row) for row in x} for x in data)
        if mine & theirs:
            raise ValueError(
                f"{len(mine & theirs)} of the fresh members are those that are tuned on: a "
                "certificate needs others, as ensemble.fresh(loop, 256, key) draws them"
            )
