"""The nominal loop and the worst members of a design, flown again sample by sample."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, PyTree

from jaxquad._core import as_array
from jaxquad.control import schedule_for_flight
from jaxquad.ensembles import Ensemble, Members
from jaxquad.loops import Loop
from jaxquad.simulation import Scenario, simulate, Simulation

from ._certificate import Certificate
from ._cost import Evaluation
from ._objective import Limit
from ._parameters import Coordinates
from ._phases import Solution
from ._quantities import QUANTITIES
from ._tail import Tail
from ._verdict import Bound, Verdict


_COST, _PLACE = 2e-3, 0.1  # within which two ends are one: of the cost, and in nepers


class Optimum(NamedTuple):
    """A point at which some of the starts ended; its cost is NaN if it was not stabilised."""

    cost: float
    z: Float[np.ndarray, " n"]
    values: dict[str, float]  # of the tuned numbers
    starts: tuple[int, ...]  # which of them led here; 0 is the controller as given
    converged: bool


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


def distinct_optima(solution: Solution, coordinates: Coordinates) -> tuple[Optimum, ...]:
    """The distinct points at which the starts ended, the best first."""
    optima: list[Optimum] = []
    cost, z = solution.cost, solution.z
    for k in np.argsort(np.where(np.isnan(cost), np.inf, cost), kind="stable"):
        same = [
            i for i, o in enumerate(optima)
            if abs(o.cost - cost[k]) < _COST and np.max(np.abs(o.z - z[k])) < _PLACE
        ]  # fmt: skip
        if same:
            old = optima[same[0]]
            optima[same[0]] = old._replace(starts=(*old.starts, int(k)))
        else:
            values, done = coordinates.values(z[k]), bool(solution.converged[k])
            optima.append(Optimum(float(cost[k]), z[k], values, (int(k),), done))
    return tuple(optima)


class LimitResult(NamedTuple):
    """How a limit ended on the members that were tuned on."""

    limit: Limit
    reached: float  # in the limit's unit
    met: bool
    active: bool  # the cost would be lower without it


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
        verdicts, rest = rest[:3], rest[3:]
        numbers = ", ".join(f"{name} {value:.4g}" for name, value in self.values.items())
        lines = [first, *map(str, verdicts), f"tuned: {numbers}", f"  {_describe_effort(self)}"]
        lines += [f"  {_describe_limit(one)}" for one in self.limits]
        lines += [f"  {describe_tail(self.tail)}"] if self.tail.searches else []
        lines += _describe_optima(self.minima) if len(self.minima) > 1 else []
        lines += [f"  ! {remark}" for remark in self.remarks]
        return "\n".join([*lines, *map(str, rest)])


_UNSEEN = tuple(
    Verdict(name, None, "not known without fresh members", "Give fresh=, how many to certify on")
    for name in ("STABILITY", "PERFORMANCE")
)


def _describe_effort(tuned: Tuned) -> str:
    ends = "converged" if tuned.converged else "not converged"
    return (
        f"cost {tuned.cost:.5g}, {ends} after {tuned.evaluations} gradients"
        f" ({tuned.stabilising} more of the linear loops, to stabilise) in {tuned.seconds:.1f} s"
    )


def _describe_limit(one: LimitResult) -> str:
    if not one.met:
        beyond = abs(one.reached - float(one.limit.bound))
        return (
            f"limit on {one.limit}: {one.reached:.4g} (by {beyond:.3g}) on the members tuned on, "
            "MISSED: it cannot be met together with the others"
        )
    state = "active" if one.active else "not active"
    return f"limit on {one.limit}: {one.reached:.4g} on the members tuned on, {state}"


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


def _describe_optima(minima: tuple[Optimum, ...]) -> list[str]:
    total = sum(len(o.starts) for o in minima)
    lines = [f"  {total} starts, {len(minima)} optima:"]
    for o in minima:
        cost = "not stabilised" if np.isnan(o.cost) else f"cost {o.cost:.5g}"
        lines.append(f"    {cost}, from {len(o.starts)} of the starts ({_list_starts(o.starts)})")
    return lines


def _list_starts(starts: tuple[int, ...]) -> str:
    shown = ", ".join(str(k) for k in starts[:8])
    return shown if len(starts) <= 8 else f"{shown}, ..."


def worst_flights(
    design: Tuned | Certificate,
    loop: Loop,
    ensemble: Ensemble | Members,
    scenario: Scenario,
    *,
    quantities: Sequence[str] = ("itae", "sensitivity_peak"),
) -> dict[str, Simulation]:
    """Fly the nominal loop, and the members of a certificate that are worst in some quantity.

    The members have the noise that was theirs.

    **Arguments:**

    - `design`: a tuned design with its certificate, or a certificate, whose design is
        `loop.controller`.
    - `loop`, `ensemble`, `scenario`: those that it was made with. Where it was made on given
        members, these are the `ensemble`.
    - `quantities`: names of `jaxquad.tuning`.

    **Returns:** simulations by what they are: "nominal", "worst ITAE (member 12)".

    **Raises:** ValueError for a design without certificate, for unknown quantities, and for parts
    that the certificate was not made with.
    """
    certificate = design.certificate if isinstance(design, Tuned) else design
    if certificate is None:
        raise ValueError(
            "the design has no certificate, so that its worst members are not known: tune with "
            "fresh=256, or simulate some members with jq.simulate"
        )
    controller = design.controller if isinstance(design, Tuned) else loop.controller
    worst = _worst(certificate, quantities)
    flights = {"nominal": _nominal(certificate, loop, controller, scenario)}
    if worst:
        members = _members(certificate, loop, ensemble).take(list(worst))
        flown = simulate(members.loop(controller), members.flight(scenario))
        flights |= {text: _member(flown, k) for k, text in enumerate(worst.values())}
    return flights


def _worst(certificate: Certificate, quantities: Sequence[str]) -> dict[int, str]:
    """The worst members, with the quantities in which they are."""
    unknown = [name for name in quantities if name not in certificate.design.by_axis]
    if unknown or not quantities:
        computed = ", ".join(certificate.design.by_axis)
        raise ValueError(f"no quantities {unknown} in the certificate: choose from {computed}")
    worst: dict[int, list[str]] = {}
    for name in quantities:
        index = certificate.design.worst_member(name)
        if index is not None:
            worst.setdefault(index, []).append(QUANTITIES[name].title)
    return {k: f"worst {' and '.join(names)} (member {k})" for k, names in worst.items()}


def _members(certificate: Certificate, loop: Loop, ensemble: Ensemble | Members) -> Members:
    if isinstance(ensemble, Members):
        members = ensemble
    else:
        data = certificate.provenance["key"]
        if data is None:
            raise ValueError(
                "the certificate was made on members that were given: give these as the ensemble"
            )
        key = jax.random.wrap_key_data(as_array(np.asarray(data, np.uint32)))
        members = ensemble.fresh(loop, certificate.members, key)
    shape = certificate.facts["assumed_inertia"].shape
    if members.assumed_inertia.shape != shape:
        raise ValueError(
            f"the members have the shape {members.assumed_inertia.shape}, but the certificate was "
            f"made on {shape}: give the loop and ensemble that it was made with"
        )
    return members


def _member(flights: Simulation, k: int) -> Simulation:
    """One of an ensemble of simulations. Compiles nothing."""
    count = flights.diverged.shape
    at = lambda x: as_array(np.asarray(x)[..., k])
    pick = lambda x: at(x) if x.shape[-1:] == count and x.ndim > 2 else x
    parts = {name: pick(part) for name, part in flights.scenario.parts.items()}
    return Simulation(
        flights.time, at(flights.angle), at(flights.measurement), at(flights.command),
        at(flights.saturated), {}, at(flights.diverged), Scenario(**parts, dt=flights.scenario.dt),
        flights.dt,
    )  # fmt: skip


def _nominal(
    certificate: Certificate, loop: Loop, controller: PyTree, scenario: Scenario
) -> Simulation:
    inertia = certificate.nominal
    if inertia is None:
        inertia = np.exp(np.mean(np.log(certificate.facts["inertia"]), axis=1))
    return simulate(loop.with_controller(schedule_for_flight(controller, inertia)), scenario)
