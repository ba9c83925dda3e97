"""Cases that are flown: every design through the same scenario, with the same noise."""

import warnings
from typing import Any

import jax
import numpy as np

from jaxquad.loops import Loop
from jaxquad.simulation import AuthorityWarning, simulate, Simulation

from .data import Case, Members, members_of, Numbers
from .designs import Belief, controller, Design
from .identification import identified
from .matching import Matched
from .members import linear_numbers
from .nominal import WIDTH
from .rigs import Rig, rig
from .rows import Row, with_loop, with_variation
from .signals import scenario_of
from .summary import flight_numbers, row_of


def fly(
    case: Case, suite: dict[str, Any], loops: dict[str, Matched], *, quick: bool, seed: int
) -> list[Row]:
    """The rows of a case."""
    members = members_of(case, quick=quick, seed=seed)
    rows: list[Row] = []
    for name in case.data.get("designs", list(loops)):
        numbers = design_numbers(case, members, suite, loops[name].design, seed)
        found = [
            row_of(case, members, group, loops[name], numbers, suite) for group in members.groups
        ]
        rows += [with_loop(row, loops[name]) for row in found]
    if "invariant" in case.data:
        rows = with_variation(rows, case.data["invariant"])
    order = {group.label: k for k, group in enumerate(members.groups)}
    return sorted(rows, key=lambda row: order[row.label])


def design_numbers(
    case: Case, members: Members, suite: dict[str, Any], design: Design, seed: int
) -> Numbers:
    """Every number of every member, flown `WIDTH` members at a time."""
    parts = []
    for first in range(0, members.count, WIDTH):
        chunk = chunk_of(members, first)
        count = min(WIDTH, members.count - first)
        key = key_of(case, seed, first)
        belief, truth = believed(case, chunk, suite)
        done = flown(case, chunk, suite, design, belief, truth, key)
        found = flight_numbers(case, done, suite["dt"])
        if "identify" in case.data:
            found |= identified(case, chunk, count, truth, done, suite)
        if case.data.get("linear"):
            found |= linear_numbers(case, chunk, suite, design, belief, done)
        parts.append({name: values[:count] for name, values in found.items()})
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def key_of(case: Case, seed: int, first: int) -> Any:
    """Of the noise of the members from the `first` on, the same for all designs."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), case.seed(seed)[1]), first)


def believed(case: Case, chunk: Members, suite: dict[str, Any]) -> tuple[Belief, Rig]:
    """What the controllers believe of the axes, and the rig as it is."""
    changes = {name: chunk.of(x) for name, x in case.data.get("overrides", {}).items()}
    truth = rig(suite["plants"][case.data["plant"]], WIDTH, changes)
    knows = case.data.get("knows", {})
    factor = chunk.of(knows.get("inertia_factor", 1.0))
    error = chunk.of(knows.get("error", 0.0)) * chunk.of(knows.get("miss", 0.0))
    # A lognormal error is one of its standard deviation while small, and never turns J negative.
    inertia = truth.inertia * (factor * np.exp(error))[None]
    nominal = truth.torque_gain / truth.inertia
    return Belief(truth.torque_gain, inertia, nominal, truth.limit, truth.volts), truth


def flown(
    case: Case,
    chunk: Members,
    suite: dict[str, Any],
    design: Design,
    belief: Belief,
    truth: Rig,
    key: Any,
) -> Simulation:
    """One design through the case."""
    second = case.data.get("second_gain", 1.0)
    law = controller(
        design, belief, dt=suite["dt"], knows_limit=case.data.get("knows_limit", True),
        second_gain=chunk.of(second), estimator=case.data.get("estimator"),
    )  # fmt: skip
    axes = len(truth.torque_gain)
    happening = scenario_of(case, chunk, dt=suite["dt"], axes=axes, key=key)
    bound = np.radians(suite["lost"])
    loop = Loop(truth.plant, law, dt=suite["dt"], bound=bound, **truth.options)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AuthorityWarning)  # the verdict says it
        return simulate(loop, happening)


def chunk_of(members: Members, first: int) -> Members:
    """`WIDTH` members from the `first` on, the last repeated to fill them up."""
    place = np.minimum(np.arange(first, first + WIDTH), members.count - 1)
    values = {name: x[place] for name, x in members.values.items()}
    return Members(WIDTH, values, [])
