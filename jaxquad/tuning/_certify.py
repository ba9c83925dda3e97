"""Certificates of designs, what they are compared with, and their worst flights."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from jaxquad._core import __version__, as_array
from jaxquad.control import (
    certainty_equivalence,
    LADRC,
    Reference,
    schedule_for_flight,
    ScheduledLADRC,
)
from jaxquad.ensembles import Ensemble, Members, Posterior
from jaxquad.loops import Loop, Plant
from jaxquad.models import DecoupledAxes, Multirotor, QUANSER_HOVER
from jaxquad.simulation import (
    Authority,
    beyond_authority,
    find_authority,
    Scenario,
    simulate,
    Simulation,
)

from ._certificate import Certificate, find_ladrc, lag_remark, Provenance
from ._design_result import analyse_further, evaluate_design, member_facts
from ._objective import Limit, QUANTITIES
from ._problem import decouple, DeviceChoice, require_ensemble, require_same_rate, TimeSpan
from ._verdict import evaluate_attainable, measure_distances


if TYPE_CHECKING:
    from ._tune import Tuned


class _Idle(eqx.Module):
    def init(self, like: Float[Array, " axes *ensemble"]) -> None:
        return None

    def step(
        self, state: None, reference: Reference, measurement: Float[Array, " axes *ensemble"]
    ) -> tuple[None, Float[Array, " axes *ensemble"]]:
        return None, jnp.zeros_like(measurement)


def certify(
    loop: Loop, ensemble: Ensemble | Members, scenario: Scenario, *, limits: Sequence[Limit] = (),
    peers: Mapping[str, PyTree] | None = None, begun: PyTree | None = None, members: int = 256,
    linear_members: int | None = None, key: Key[Array, ""] | None = None,
    events: Sequence[float] = (), start: float = 0.0, stop: float | None = None,
    load_start: float | None = None, name: str = "tuned", devices: DeviceChoice = None,
) -> Certificate:  # fmt: skip
    """Evaluate a design on members that its tuner never saw, beside its peers.

    All designs fly on `members`. The linear loop of the design itself is analysed on many more,
    because its limits end in the tail of the ensemble: 256 members seldom show what happens to one
    in 1000. A payload counts in the linear loops with the most and the least of it, the worse of
    all.

    !!! example

        ```python
        certificate = jq.certify(loop.with_controller(tuned.controller), ensemble, flight,
                                 limits=[jq.Limit("sensitivity_peak", at_most=3.6)])
        print(certificate)
        ```

    **Arguments:**

    - `loop`: the design is `loop.controller`; the rest is nominal.
    - `ensemble`: `members` are drawn from it at random, each by itself, by `ensemble.fresh`.
        `jq.ensembles.Members` are taken as they are, and nothing may have been tuned on them.
    - `scenario`: all designs fly it with the same noise.
    - `limits`: what the design has to meet.
    - `peers`: other controllers to stand beside the design, by name.
    - `begun`: the controller that a tuning started from, whose error stands beside the design's.
    - `members`: how many are drawn to fly.
    - `linear_members`: how many further members have their linear loops analysed, rounded up to
        whole multiples of `members`; by default eight times as many as fly, at most 2048.
    - `key`: give the tuner's key, whose training members are other draws; `jax.random.key(0)` by
        default.
    - `events`: times in s at which ITAE's clock starts again and a new step begins.
    - `start`, `stop`, `load_start`, `devices`: see `jq.evaluate`; best as for the tuner.
    - `name`: of the design in the certificate.

    **Returns:**

    A `jq.tuning.Certificate`; `print` shows the verdicts first, then limits and a table.

    **Raises:**

    - `ValueError`: parts do not fit together, or a limit is on what is not computed.
    """
    key = jax.random.key(0) if key is None else key
    require_ensemble(ensemble)
    span, peers = TimeSpan(tuple(events), start, stop, load_start), peers or {}
    if name in peers:
        raise ValueError(f"a peer has the name {name!r} of the design itself: rename it")
    # Independent draws, as the bound of a share needs.
    given_members = isinstance(ensemble, Members)
    nominal = decouple(loop.plant)
    drawn = ensemble if given_members else ensemble.fresh(loop, members, key)
    require_same_rate(loop, drawn)
    flight = drawn.flight(scenario)
    evaluate = lambda design: evaluate_design(design, drawn, flight, span, devices)
    error_at_start = None if begun is None else evaluate(begun)
    others = {peer: evaluate(controller) for peer, controller in peers.items()}
    idle, design = evaluate(_Idle()), evaluate(loop.controller)
    further = None
    if isinstance(ensemble, Ensemble) and design.unstable is not None:  # it has a linear loop
        further = analyse_further(
            loop, ensemble, scenario, key, flown=drawn.size, count=linear_members
        )
    source: Provenance = {
        "members": drawn.size,
        "linear_members": 0 if further is None else further.design.members,
        "fresh": not given_members,
        "sampling": "given" if given_members else "random",
        "key": None if given_members else np.asarray(jax.random.key_data(key)).tolist(),
        "precision": str(drawn.assumed_inertia.dtype),
        "ensemble": None if given_members else str(ensemble).splitlines(),
        "device": jax.devices()[0].device_kind,
        "versions": {"jaxquad": __version__}
        | {name: version(name) for name in ("jax", "jaxlib", "numpy")},
        "controller": describe_controller(loop.controller),
    }
    alike = drawn.loop(loop.controller)
    authority = _find_authority(alike.plant, alike.drive, alike.controller)
    plants = ensemble.plants if isinstance(ensemble, Ensemble) else None
    certificate = Certificate(
        designs={name: design} | others,
        distances=measure_distances(design, limits, independent=not given_members, further=further),
        facts=member_facts(drawn),
        nominal=None
        if given_members
        else np.array(np.broadcast_to(nominal.inertia, nominal.shape)),
        provenance=source,
        remarks=(),
        idle=idle,
        start=error_at_start,
        error="itae" if np.any(np.asarray(flight.reference) != 0) else "rms",
        further=further,
        attainable=evaluate_attainable(loop.controller, drawn, flight, span, authority, devices),
        unsupported=tuple(_beyond_band(loop.controller, None if plants is None else plants.band)),
    )
    remarks = _remarks(certificate, loop.controller, drawn, flight, authority, plants)
    return dataclasses.replace(certificate, remarks=tuple(remarks))


_find_authority = eqx.filter_jit(find_authority)  # many small operations, as one program
_ROUNDED = 1.01  # by which a number may exceed what the record knows without a word


def _remarks(
    certificate: Certificate, controller: PyTree, drawn: Members, flight: Scenario,
    authority: Authority | None, plants: Posterior | None,
) -> Iterator[str]:  # fmt: skip
    missed = [x for x in certificate.distances if QUANTITIES[x.quantity].linear and not x.met]
    lag = lag_remark(controller, drawn.delay, decouple(drawn.plant).lag)
    if lag and (missed or not certificate.stable):
        yield lag
    if not isinstance(drawn.plant, DecoupledAxes | Multirotor):
        yield (
            f"the plant is a {type(drawn.plant).__name__}: what its linear loop, its drive and a "
            "disturbance do by themselves is computed from its linearise(axis)"
        )
    if not certificate.independent:
        yield "the members were given: whether the tuner saw them is not known"
    counts = {n: x.unstable_count for n, x in certificate.designs.items() if x.unstable_count}
    if counts:
        text = ", ".join(f"{count} of {n}" for n, count in counts.items())
        yield f"no Ms and no margins (n/a) over members that are unstable: {text}"
    for name, design in certificate.designs.items():
        if name != certificate.name and design.observer_instability:
            yield f"of {name}: {design.observer_instability}"
    yield from beyond_authority(authority, flight)
    if plants is None:
        return
    largest = plants.largest_command
    limit = np.inf if authority is None else float(np.max(np.asarray(authority.command)))
    if largest is not None and np.isfinite(limit) and limit > _ROUNDED * largest:
        yield (
            f"the limit of the command, {limit:.4g}, is {limit / largest:.2g} times the largest "
            f"command of the record, {largest:.3g}: the model is not known there. Lower the limit "
            f"to {largest:.2g}, or record larger commands"
        )


def _beyond_band(controller: PyTree, band: tuple[float, float] | None) -> Iterator[tuple[str, str]]:
    """The bandwidths of a LADRC that no data support, and what to do."""
    ladrc = find_ladrc(controller)
    if ladrc is None or band is None:
        return
    low, high = band
    for name in ("wc", "wo"):
        value = float(np.max(np.asarray(vars(ladrc)[name])))
        if value > _ROUNDED * high:
            yield (
                f"{name} = {value:.4g} rad/s lies beyond the identified band of {low:.3g} to "
                f"{high:.3g} rad/s ({low / (2 * np.pi):.3g} to {high / (2 * np.pi):.3g} Hz): no "
                "data support the model there",
                f"Hold {name} at {high:.2g} rad/s or below, or record to higher frequencies",
            )


def describe_controller(controller: PyTree) -> dict[str, object]:
    """The controller's class and numbers, by their places in it."""
    leaves = jax.tree_util.tree_leaves_with_path(eqx.filter(controller, eqx.is_array))
    numbers = {jax.tree_util.keystr(path)[1:]: np.asarray(x).tolist() for path, x in leaves}
    return {"class": type(controller).__name__, "numbers": numbers}


WC, WO = 10.0, 30.0  # rad/s, the paper's
KNOWN_INERTIA = "b0 = KT/J"  # the name of the design that knows the inertia
PAPER_B0 = (3.0, 1.6)  # before and after the paper's adaptation, rad/s^2 per V
# +u and -u on two motors: the one convention in which the paper's gains are stable
HOVER_GAIN = 2 * QUANSER_HOVER.arm * QUANSER_HOVER.thrust_coefficient / QUANSER_HOVER.inertia[0]


def paper_designs(plant: Plant, *, dt: float = 0.002) -> dict[str, LADRC]:
    """The paper's two LADRCs for a plant: 10 and 30 rad/s with b0 = 3, and with b0 = 1.6.

    On the roll axis of the Quanser Hover (b = 0.848 rad/s^2 per V) b0 is exactly that. On another
    plant or axis it has the same ratio to b: 3.54 and 1.89. Source: section 5 of the paper,
    docs/equations.md.

    **Arguments:**

    - `plant`: the nominal one, such as `loop.plant`, without an ensemble.
    - `dt`: the sample interval in s.

    **Returns:**

    The designs by name, for `peers=` of a tune or certificate.

    **Raises:**

    - `ValueError`: the plant is an ensemble, or has no linear form.
    """
    KT, J = _nominal_numbers(plant)
    b = KT / J
    designs = {}
    for b0 in PAPER_B0:
        scaled = b0 * b / HOVER_GAIN
        on_hover = np.allclose(scaled, b0, rtol=2e-3)
        name = f"paper b0 = {b0:g}" if on_hover else f"paper b0 = {b0 / HOVER_GAIN:.3g} b"
        designs[name] = LADRC(WC, WO, b0 * np.ones_like(b) if on_hover else scaled, dt=dt)
    return designs


def peers(plant: Plant, *, pid: PyTree | None = None, dt: float = 0.002) -> dict[str, PyTree]:
    """Designs to stand beside a tuned one in its certificate, by name.

    The paper's two, and "b0 = KT/J": the LADRC with the paper's bandwidths, 10 and 30 rad/s, whose
    b0 is exact for the inertia that the controller is given (certainty equivalence).

    **Arguments:**

    - `plant`, `dt`: as for `jq.tuning.paper_designs`.
    - `pid`: a PID tuned on the same ensemble, to add as "tuned PID".

    **Returns:**

    The designs by name.

    **Raises:**

    - `ValueError`: as `jq.tuning.paper_designs` does.
    """
    KT, J = _nominal_numbers(plant)
    # As a map of ln J, b0 = KT / J is straight: two knots, far apart, hold it everywhere.
    map = certainty_equivalence(KT, J, span=(1e-3, 1e3), knots=2)
    designs: dict[str, PyTree] = dict(paper_designs(plant, dt=dt))
    designs[KNOWN_INERTIA] = ScheduledLADRC(LADRC(WC, WO, KT / J, dt=dt), map)
    return designs if pid is None else designs | {"tuned PID": pid}


def _nominal_numbers(plant: Plant) -> tuple[Float[np.ndarray, " axes"], ...]:
    """KT in N m per unit of command and J in kg m^2, in NumPy."""
    axes = decouple(plant)
    if len(axes.shape) > 1:
        raise ValueError(
            f"the plant is an ensemble of {axes.shape[1:]}: give the nominal one, for whose "
            "gain the designs are made"
        )
    return np.broadcast_arrays(np.asarray(axes.torque_gain, float), np.asarray(axes.inertia))


def worst_flights(
    design: "Tuned | Certificate", loop: Loop, ensemble: Ensemble | Members, scenario: Scenario, *,
    quantities: Sequence[str] = ("itae", "sensitivity_peak"),
) -> dict[str, Simulation]:  # fmt: skip
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
    certificate, controller = design, loop.controller
    if not isinstance(certificate, Certificate):
        certificate, controller = certificate.certificate, certificate.controller
    if certificate is None:
        raise ValueError(
            "the design has no certificate, so that its worst members are not known: tune with "
            "fresh=256, or simulate some members with jq.simulate"
        )
    unknown = [name for name in quantities if name not in certificate.design.by_axis]
    if unknown or not quantities:
        computed = ", ".join(certificate.design.by_axis)
        raise ValueError(f"no quantities {unknown} in the certificate: choose from {computed}")
    worst: dict[int, list[str]] = {}
    for name in quantities:
        index = certificate.design.worst_member(name)
        if index is not None:
            worst.setdefault(index, []).append(QUANTITIES[name].title)
    inertia = certificate.nominal
    if inertia is None:
        inertia = np.exp(np.mean(np.log(certificate.facts["inertia"]), axis=1))
    nominal = loop.with_controller(schedule_for_flight(controller, inertia))
    flights = {"nominal": simulate(nominal, scenario)}
    if worst:
        members = _certified_flights(certificate, loop, ensemble).take(list(worst))
        flown = simulate(members.loop(controller), members.flight(scenario))
        for k, (member, names) in enumerate(worst.items()):
            flights[f"worst {' and '.join(names)} (member {member})"] = _member(flown, k)
    return flights


def _certified_flights(
    certificate: Certificate, loop: Loop, ensemble: Ensemble | Members
) -> Members:
    members, data = ensemble, certificate.provenance["key"]
    if isinstance(members, Ensemble):
        if data is None:
            raise ValueError(
                "the certificate was made on members that were given: give these as the ensemble"
            )
        key = jax.random.wrap_key_data(as_array(np.asarray(data, np.uint32)))
        members = members.fresh(loop, certificate.members, key)
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
