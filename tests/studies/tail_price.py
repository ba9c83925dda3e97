"""What a limit on the tail costs: the tunes of docs/tuning.md beside scipy's exact optima.

    python tests/studies/tail_price.py

The objective of `jq.tune` is minimised by scipy's SLSQP with the limit on Ms as a constraint on
each of many members, and with none: cutting planes, no penalty and no multiplier of the library's.
Each optimum is flown by 1024 members that no tune saw, and 65,536 others tell how many are beyond.
"""

import argparse
import csv
import sys
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize


sys.path.append(str(Path(__file__).parents[1]))
jax.config.update("jax_enable_x64", True)

from tuning_case import (  # noqa: E402
    cost_at,
    ensemble,
    flight,
    loop,
    objective,
    peaks_at,
    start_of,
    STARTS,
)

import jaxquad as jq  # noqa: E402


PEAK, SLICE = 3.6, 2048
START = loop(STARTS["certainty equivalence"])
ACTIVE, CYCLES = 256, 12  # members that the limit is kept on at once; how often others join them
SETTINGS = {  # the limit, and the slices of 2048 members that it is kept on
    "no members": (PEAK, 0),
    "8192": (PEAK, 4),
    "24,576": (PEAK, 12),
    "24,576, 1 % tighter": (0.99 * PEAK, 12),
    "65,536": (PEAK, 32),
}
TUNED = "jq.tune, which searched 24,576"
HEAD = (
    "limit kept on",
    "ITAE mean / worst",
    "cost, tuned on",
    "cost, others",
    "of 65,536 others beyond",
)


@eqx.filter_jit
def fly(z, members, happens):
    """The objective of flights, and the ITAE of each member."""
    return cost_at(z, START.controller, members, happens)


@eqx.filter_jit
def value_and_slope(z, members, happens):
    cost = lambda z: cost_at(z, START.controller, members, happens)[0]
    return jax.value_and_grad(cost)(z)


@eqx.filter_jit
def peaks(z, members):
    """ln Ms of every member."""
    return jnp.log(peaks_at(z, START.controller, members)["sensitivity_peak"][0])


@eqx.filter_jit
def slopes(z, members):
    return jax.jacfwd(peaks)(z, members)


def of_all(z, slices) -> np.ndarray:
    return np.concatenate([np.asarray(peaks(jnp.asarray(z), x)) for x in slices])


def sliced(members) -> list:
    return [members.take(range(k, k + SLICE)) for k in range(0, members.size, SLICE)]


def solve(cost, z, bound: float, drawn, slices) -> np.ndarray:
    """SLSQP, until no member of the slices is beyond the bound by more than 0.05 %."""
    active: list[int] = []
    for _ in range(CYCLES if slices else 3):
        level = of_all(z, slices) - np.log(bound) if slices else np.full(1, -np.inf)
        near = [int(k) for k in np.argsort(-level)[:60] if level[k] > -0.07]
        if active and level.max() < 5e-4:
            break
        active = list(dict.fromkeys([*active, *near]))[-ACTIVE:]
        z = _minimise(cost, z, np.log(bound), len(active), drawn.take(filled(active)))
    return z


def filled(places: list[int]) -> list[int]:
    """So many that one compiled program does for all."""
    return [*places, *[0] * (ACTIVE - len(places))]


def _minimise(cost, z, bound: float, count: int, members) -> np.ndarray:
    constraints = []
    if count:
        level = lambda z: bound - np.asarray(peaks(jnp.asarray(z), members))[:count]
        slope = lambda z: -np.asarray(slopes(jnp.asarray(z), members))[:count]
        constraints = [{"type": "ineq", "fun": level, "jac": slope}]
    return minimize(
        cost, z, jac=True, method="SLSQP", constraints=constraints,
        bounds=[(x - 0.25, x + 0.25) for x in z], options={"ftol": 1e-9, "maxiter": 100},
    ).x  # fmt: skip


class Row(NamedTuple):
    cost: float  # on the members that were tuned on
    fresh: float  # on others
    mean: float  # ITAE of these, deg s^2
    worst: float
    beyond: float  # of 65,536, per design

    def cells(self) -> list[str]:
        itae = f"{self.mean:.2f} / {self.worst:.1f}"
        return [itae, f"{self.cost:.4f}", f"{self.fresh:.4f}", f"{self.beyond:.2g}"]


def row_of(z, members, fresh, test) -> Row:
    own = float(fly(jnp.asarray(z), *members)[0])
    cost, itae = fly(jnp.asarray(z), *fresh)
    itae = np.degrees(np.asarray(itae[0]))
    beyond = int(np.sum(of_all(z, test) > np.log(PEAK)))
    return Row(own, float(cost), float(itae.mean()), float(itae.max()), beyond)


def tuned(key) -> np.ndarray:
    """z of a tune."""
    found = jq.tune(
        START, ensemble(), flight(), objective=objective(), key=key, fresh=None,
        limits=[jq.Limit("sensitivity_peak", at_most=PEAK)], progress=False,
    )  # fmt: skip
    print(f"{found.tail}, {found.evaluations} gradients", file=sys.stderr, flush=True)
    return start_of(found.controller)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keys", type=int, default=4)
    count = parser.parse_args().keys
    draw = lambda key, n: ensemble().fresh(START, n, key)
    with_flight = lambda members: (members, members.flight(flight()))
    far = jax.random.key(4242)
    fold = jax.random.fold_in
    test = sliced(draw(fold(far, 1), 32 * SLICE))
    fresh = with_flight(draw(far, 1024))
    rows: dict[str, list[Row]] = {}
    for key in map(jax.random.key, range(count)):
        members = with_flight(ensemble().draw(START, 64, key))

        def cost(z, members=members):
            value, slope = value_and_slope(jnp.asarray(z), *members)
            return float(value), np.asarray(slope)

        drawn = draw(fold(key, 2), 32 * SLICE)
        searched = sliced(drawn)
        first = tuned(key)
        ends = {TUNED: first}
        for name, (bound, slices) in SETTINGS.items():
            ends[name] = solve(cost, first, bound, drawn, searched[:slices])
        for name, z in ends.items():
            rows.setdefault(name, []).append(row_of(z, members, fresh, test))
            print(name, *rows[name][-1].cells(), file=sys.stderr, flush=True)
    table = csv.writer(sys.stdout, lineterminator="\n")
    table.writerow(HEAD)
    for name in (*SETTINGS, TUNED):
        table.writerow([name, *Row(*np.mean(rows[name], axis=0)).cells()])


if __name__ == "__main__":
    main()
