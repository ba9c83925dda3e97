"""The nominal loop and the worst members of a design, flown again sample by sample."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import PyTree

from jaxquad._core import as_array
from jaxquad.control import schedule_for_flight
from jaxquad.ensembles import Ensemble, Members
from jaxquad.loops import Loop
from jaxquad.simulation import Scenario, simulate, Simulation

from ._certificate import Certificate
from ._quantities import QUANTITIES
from ._tuned import Tuned


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
        found = simulate(members.loop(controller), members.flight(scenario))
        flights |= {text: _member(found, k) for k, text in enumerate(worst.values())}
    return flights


def _worst(certificate: Certificate, quantities: Sequence[str]) -> dict[int, str]:
    """The worst members, with the quantities in which they are."""
    unknown = [name for name in quantities if name not in certificate.design.by_axis]
    if unknown or not quantities:
        known = ", ".join(certificate.design.by_axis)
        raise ValueError(f"no quantities {unknown} in the certificate: choose from {known}")
    found: dict[int, list[str]] = {}
    for name in quantities:
        index = certificate.design.worst_member(name)
        if index is not None:
            found.setdefault(index, []).append(QUANTITIES[name].title)
    return {k: f"worst {' and '.join(names)} (member {k})" for k, names in found.items()}


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
    known = certificate.facts["assumed_inertia"].shape
    if members.assumed_inertia.shape != known:
        raise ValueError(
            f"the members have the shape {members.assumed_inertia.shape}, but the certificate was "
            f"made on {known}: give the loop and ensemble that it was made with"
        )
    return members


def _member(found: Simulation, k: int) -> Simulation:
    """One of an ensemble of simulations. Compiles nothing."""
    count = found.diverged.shape
    at = lambda x: as_array(np.asarray(x)[..., k])
    pick = lambda x: at(x) if x.shape[-1:] == count and x.ndim > 2 else x
    parts = {name: pick(part) for name, part in found.scenario.parts.items()}
    return Simulation(
        found.time, at(found.angle), at(found.measurement), at(found.command),
        at(found.saturated), {}, at(found.diverged), Scenario(**parts, dt=found.scenario.dt),
        found.dt,
    )  # fmt: skip


def _nominal(
    certificate: Certificate, loop: Loop, controller: PyTree, scenario: Scenario
) -> Simulation:
    inertia = certificate.nominal
    if inertia is None:
        inertia = np.exp(np.mean(np.log(certificate.facts["inertia"]), axis=1))
    return simulate(loop.with_controller(schedule_for_flight(controller, inertia)), scenario)
