"""What a limit on the tail costs: the tunes of docs/tuning.md beside scipy's exact optima.

    python tests/studies/tail_price.py

The objective of `jq.tune` is minimised by scipy's SLSQP with the limit on Ms as a constraint on
each of many members, and with none: cutting planes, no penalty and no multiplier of the library's.
Each optimum is flown by 1024 members that no tune saw, and 65,536 others tell how many are beyond.
"""

import argparse
import sys
from collections.abc import Callable
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
    coordinates_of,
    cost_at,
    ensemble,
    flight,
    linear_members,
    loop,
    objective,
    pose,
    STARTS,
)

import jaxquad as jq  # noqa: E402


PEAK, SLICE = 3.6, 2048
SMOOTHING = 1e-6  # 1/s, of the abscissa
FREE = ["ladrc.wc", "ladrc.wo", "map.values"]
START = loop(STARTS["certainty equivalence"])
COORDINATES = coordinates_of(START.controller, FREE)
ACTIVE, CYCLES = 256, 12  # members that the limit is kept on at once; how often others join them
SETTINGS = {  # the limit, and the slices of 2048 members that it is kept on
    "no limit": (PEAK, 0),
    "8192": (PEAK, 4),
    "24,576": (PEAK, 12),
    "24,576, 1 % tighter": (0.99 * PEAK, 12),
    "65,536": (PEAK, 32),
}


def cost_of(members) -> Callable:
    """The objective of flights: value, gradient, and the numbers of each member."""
    posed = pose(START.controller, members)
    return lambda z: cost_at(jnp.asarray(z)[None], COORDINATES, posed)


@eqx.filter_jit
def peaks(z, coordinates, loops):
    """ln Ms of every member."""
    found = loops.numbers(coordinates.controller_at(z), ["sensitivity_peak"], SMOOTHING)
    return jnp.log(jnp.max(found["sensitivity_peak"], axis=0))


@eqx.filter_jit
def slopes(z, coordinates, loops):
    return jax.jacfwd(peaks)(z, coordinates, loops)


def of_all(z, slices) -> np.ndarray:
    return np.stack([np.asarray(peaks(jnp.asarray(z), COORDINATES, x)) for x in slices])


def solve(cost, z, bound: float, drawn, slices, others) -> np.ndarray:
    """SLSQP, until no member of the slices is beyond the bound by more than 0.05 %."""
    known: list[tuple[int, int]] = []
    for _ in range(CYCLES if slices else 3):
        level = of_all(z, slices) - np.log(bound) if slices else np.full((1, 1), -np.inf)
        near = [(int(s), int(k)) for s, k in zip(*np.nonzero(level > -0.07), strict=True)]
        if known and level.max() < 5e-4:
            break
        near = sorted(near, key=lambda at: -level[at])[:60]
        known = list(dict.fromkeys([*known, *near]))[-ACTIVE:]
        z = _minimise(cost, z, np.log(bound), known, put_into(others, drawn, known))
    return z


def put_into(others, drawn, places):
    """The members at the places (slice, member) instead of the first of the others."""
    for s in sorted({s for s, _ in places}):
        rows = [k for k, (number, _) in enumerate(places) if number == s]
        worst = drawn[s].take([places[k][1] for k in rows])
        others = others.replaced(np.array(rows), linear_members(worst))
    return others


def _minimise(cost, z, bound: float, known, loops) -> np.ndarray:
    def value(z):
        found = cost(z)
        return float(found.value[0]), np.asarray(found.gradient[0])

    constraints, count = [], len(known)
    if count:
        level = lambda z: bound - np.asarray(peaks(jnp.asarray(z), COORDINATES, loops))[:count]
        slope = lambda z: -np.asarray(slopes(jnp.asarray(z), COORDINATES, loops))[:count]
        constraints = [{"type": "ineq", "fun": level, "jac": slope}]
    return minimize(
        value, z, jac=True, method="SLSQP", constraints=constraints,
        bounds=[(x - 0.25, x + 0.25) for x in z], options={"ftol": 1e-9, "maxiter": 100},
    ).x  # fmt: skip


class Row(NamedTuple):
    cost: float  # on the members that were tuned on
    fresh: float  # on others
    mean: float  # ITAE of these, deg s^2
    worst: float
    beyond: float  # of 65,536, per design

    def __str__(self) -> str:
        numbers = f"{self.mean:.2f} / {self.worst:.1f} | {self.cost:.4f} | {self.fresh:.4f}"
        return f"{numbers} | {self.beyond:.3g}"


def row_of(z, cost, fresh, test) -> Row:
    found = fresh(z)
    itae = np.degrees(np.asarray(found.numbers["itae"][0]))
    beyond = int(np.sum(of_all(z, test) > np.log(PEAK)))
    own = float(cost(z).cost[0])
    return Row(own, float(found.cost[0]), float(itae.mean()), float(itae.max()), beyond)


def tuned(key) -> np.ndarray:
    """z of a tune."""
    found = jq.tune(
        START, ensemble(), flight(), free=FREE, objective=objective(), key=key, fresh=None,
        limits=[jq.Limit("sensitivity_peak", at_most=PEAK)], progress=False,
    )  # fmt: skip
    print(f"{found.tail}, {found.evaluations} gradients", flush=True)
    return coordinates_of(found.controller, FREE).start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keys", type=int, default=4)
    count = parser.parse_args().keys
    draw = lambda key, n: ensemble().fresh(START, n, key)
    far = jax.random.key(4242)
    fold = jax.random.fold_in
    test = [linear_members(draw(fold(far, k), SLICE)) for k in range(32)]
    fresh = cost_of(draw(far, 1024))
    rows: dict[str, list[Row]] = {}
    for key in map(jax.random.key, range(count)):
        cost = cost_of(ensemble().draw(START, 64, key))
        drawn = [draw(fold(key, 2 + k), SLICE) for k in range(32)]
        searched = [linear_members(members) for members in drawn]
        others = linear_members(ensemble().draw(START, ACTIVE, fold(key, 1)))
        first = tuned(key)
        ends = {"`jq.tune`": first}
        for name, (bound, slices) in SETTINGS.items():
            ends[name] = solve(cost, first, bound, drawn[:slices], searched[:slices], others)
        for name, z in ends.items():
            rows.setdefault(name, []).append(row_of(z, cost, fresh, test))
            print(name, rows[name][-1], flush=True)
    print("| limit kept on | ITAE mean / worst | cost | on fresh members | of 65,536 beyond |")
    for name, found in rows.items():
        print(f"| {name} | {Row(*np.mean(found, axis=0))} |")


if __name__ == "__main__":
    main()
