"""NUTS on `Fit.log_density` beside the default intervals, on plants of known truth.

    python tests/studies/posterior.py --draws 10

Records are those of `near_bounds.py`: a sweep of 40 s and white noise. BlackJAX's NUTS draws 1000
times after 300 steps of warm-up, without priors. An interval of NUTS reaches from the 2.5 % to the
97.5 % quantile; of a parameter whose default is a limit, from 0 to the 95 % quantile. Records of
which something is not determined have no density without a prior: they are counted. Seeds are
fixed; draws that are there already are not repeated.
"""

import argparse
import json
from pathlib import Path
from typing import Any, cast, NamedTuple

import blackjax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import result_files
from jaxtyping import Array, Float, Key
from near_bounds import Case, measured, Rate, ROOT

import jaxquad as jq


nuts, adapt = (cast(Any, part) for part in (blackjax.nuts, blackjax.window_adaptation))
WARMUP, DRAWS = 300, 1000
_LAGGED, _BAND = ("gain", "lag", "delay"), (0.4, 60.0)


class Plant(NamedTuple):
    case: Case
    judged: tuple[str, ...]  # parameters with a true value


def rate(
    truth: Rate,
    noise: float,
    free: tuple[str, ...] = _LAGGED,
    *,
    band: tuple[float, float] = _BAND,
    judged: tuple[str, ...] = (),
) -> Plant:
    """A plant at 100 Hz whose command is held; fits start a third off, leads and dampings at .01
    where they are 0."""
    numbers = {name: float(getattr(truth, name)) for name in Rate.__dataclass_fields__}
    start = {name: (1.3 * x or 0.01) if name in free else 0.0 for name, x in numbers.items()}
    case = Case(truth, Rate(**start), free, band, 100.0, (noise,))
    return Plant(case, judged or free)


PLANTS = {
    "lag .03, delay .01": rate(Rate(40.0, 0.03, 0.01), 0.02),
    "lag .1, delay .01": rate(Rate(40.0, 0.1, 0.01), 0.02),
    "lag .03, delay .05": rate(Rate(40.0, 0.03, 0.05), 0.05),
    "lag alone": rate(Rate(40.0, 0.05, 0.0), 0.1, ("gain", "lag")),
    "damping .5": rate(Rate(40.0, 0.03, 0.01, 0.0, 0.5), 0.02, (*_LAGGED, "damping")),
    "lead .1": rate(Rate(40.0, 0.03, 0.02, 0.1), 0.05, (*_LAGGED, "lead")),
    "band to 12 rad/s": rate(Rate(20.0, 0.2, 0.02), 0.02, band=(0.4, 12.0)),
    "delay 0": rate(Rate(40.0, 0.03, 0.0), 0.1),
    "nearly undetermined": rate(Rate(40.0, 0.03, 0.03), 0.15),
    "lacks a lead of .004": rate(Rate(40.0, 0.03, 0.01, 0.004), 0.02, judged=("gain",)),
}


@eqx.filter_jit
def sample(
    density: jq.identify.LogDensity,
    start: Float[Array, " parameters"],
    root: Float[Array, "parameters parameters"],
    key: Key[Array, ""],
) -> tuple[Array, Array]:
    """Coordinates, [draws, parameters], and the share of draws that diverged. Steps are in units of
    `root`, of about the posterior's covariance."""

    def scaled(steps: Float[Array, " parameters"]) -> Array:
        return density(start + root @ steps)

    warm, draw = jax.random.split(key)
    adaptation = adapt(nuts, scaled, is_mass_matrix_diagonal=False)
    (state, settings), _ = adaptation.run(warm, jnp.zeros_like(start), WARMUP)
    step = nuts(scaled, **settings).step

    def advance(state, key):
        state, info = step(key, state)
        return state, (state.position, info.is_divergent)

    steps, diverged = jax.lax.scan(advance, state, jax.random.split(draw, DRAWS))[1]
    return start + steps @ root.T, jnp.mean(diverged)


def root_of(fit: jq.identify.Fit) -> Float[Array, "parameters parameters"]:
    """Of the fit's covariance in its coordinates; a logarithm counts up to 1."""
    errors = np.sqrt(np.diagonal(fit.relative_covariance))
    correlation = fit.relative_covariance / np.outer(errors, errors)
    root = np.linalg.cholesky(correlation + 1e-6 * np.eye(errors.size))
    return jnp.asarray(np.minimum(errors, 1.0)[:, None] * root)


def draw(plant: Plant, seed: int) -> dict:
    """Both intervals of each judged parameter, with its truth."""
    case = plant.case
    fit = jq.fit(case.start, measured(case, seed), free=case.free)
    row = {"seed": seed, "intervals": [], "diverged": None}
    if not fit.identifiable:
        return row
    density, start = jq.identify.LogDensity(fit), jnp.asarray(fit.coordinates)
    places, diverged = sample(density, start, root_of(fit), jax.random.key(seed))
    values, row["diverged"] = np.asarray(jax.vmap(fit.parameters.values)(places)), float(diverged)
    limits = [bound.name for bound in fit.verdict.bounds]
    for name in plant.judged:
        mine = values[:, fit.names.index(name)]
        ends = (
            (0.0, np.quantile(mine, 0.95)) if name in limits else np.quantile(mine, [0.025, 0.975])
        )
        truth = float(getattr(case.truth, name))
        row["intervals"].append([name, truth, list(fit.interval(name)), list(map(float, ends))])
    return row


def summarise(rows: list[dict]) -> list:
    """Records, those without density, intervals, shares that hold, ratio of widths, divergences."""
    intervals = [one for row in rows for one in row["intervals"]]
    skipped = sum(row["diverged"] is None for row in rows)
    if not intervals:
        return [len(rows), skipped, 0, None, None, None, None, None]
    truth = np.array([one[1] for one in intervals])
    usual, drawn = (np.array([one[k] for one in intervals]) for k in (2, 3))
    hold = [100 * np.mean((x[:, 0] <= truth) & (truth <= x[:, 1])) for x in (usual, drawn)]
    ratios = (drawn[:, 1] - drawn[:, 0]) / (usual[:, 1] - usual[:, 0])
    diverged = np.mean([row["diverged"] for row in rows if row["diverged"] is not None])
    spread = f"{np.min(ratios):.2f} .. {np.max(ratios):.2f}"
    shares = [len(rows), skipped, len(intervals), *hold]
    return [*shares, float(np.median(ratios)), spread, 100 * float(diverged)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--plant", action="append", choices=list(PLANTS))
    parser.add_argument("--raw", type=Path, default=ROOT / "results" / "studies" / "posterior")
    given = parser.parse_args()
    given.raw.mkdir(parents=True, exist_ok=True)
    table, every = [], []
    for name in given.plant or list(PLANTS):
        path, rows = given.raw / f"{name.replace(' ', '-').replace('/', '')}.jsonl", []
        if path.exists():
            rows = [json.loads(line) for line in path.read_text().splitlines()]
        there = {row["seed"]: row for row in rows}
        for seed in range(given.draws):
            if seed not in there:
                there[seed] = draw(PLANTS[name], seed)
                with path.open("a") as file:
                    file.write(json.dumps(there[seed]) + "\n")
        mine = [there[seed] for seed in range(given.draws)]
        every += mine
        table.append([name, *summarise(mine)])
        print(table[-1], flush=True)
    if given.plant:
        return
    result_files.write(
        "posterior",
        {
            "title": "Intervals of NUTS beside the default ones",
            "command": f"python tests/studies/posterior.py --draws {given.draws}",
            "text": (
                "Ten rate plants of near_bounds.py's form, a sweep of 40 s, white noise; a held "
                "command at 100 Hz. BlackJAX's NUTS on Fit.log_density without priors, 300 steps "
                "of warm-up and 1000 draws."
            ),
            "columns": [
                "plant", "records", "without density", "intervals", "default holds %",
                "NUTS holds %", "width NUTS / default", "its range", "diverged %",
            ],
            "rows": [*table, ["all", *summarise(every)]],
            "notes": [
                "Without density: something is not determined, and no prior was given.",
                "Of the plant that lacks a lead, the gain alone is judged.",
            ],
        },
    )  # fmt: skip


if __name__ == "__main__":
    main()
