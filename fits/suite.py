"""Run the scenario suite S0 to S11: every controller, at matched Ms and activity.

The scenarios are data, in scenarios.toml. Prints the designs, which of them are matched, and one
table with a verdict on every pass mark; writes both with figures under results/suite.
`python fits/suite.py S3 S4` runs two of them, `--quick` fewer draws.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import jaxquad as jq
from experiments import figures
from experiments.data import Case, cases, load
from experiments.flights import fly
from experiments.loops import loop_rows, map_rows
from experiments.matching import match, Matched
from experiments.rows import markdown, matching_table, printed, require_marked_quantities, Row
from jaxquad.report import write_json


jq.enable_x64()

LEGEND = """\
A star marks a nominal loop that is not matched to the others. Activity is the rms of the command
b u per rad of white noise. ITAE, overshoot and ts are of the step, in its units; peak and rms of
the error under load; d-RMSE of the disturbance's estimate (KT/b0) z3. Numbers are means over the
members of a row that did not crash (rms: root mean squares; ts: the longest), "worst" is the
greatest ITAE, or the greatest peak without a step. "lost": all crashed; "never": does not settle.
"""

Loops = dict[str, dict[str, Matched]]  # by plant and design


def run(
    suite: dict[str, Any], wanted: tuple[str, ...] = (), *, quick: bool = False, seed: int = 0
) -> tuple[Loops, list[Row]]:
    """The matched designs of each plant that is needed, and the rows of all cases."""
    chosen = cases(suite, wanted)
    loops = {name: match(suite, name) for name in dict.fromkeys(c.data["plant"] for c in chosen)}
    rows: list[Row] = []
    for case in chosen:
        rows += rows_of(case, suite, loops[case.data["plant"]], quick=quick, seed=seed)
    return loops, rows


def rows_of(
    case: Case, suite: dict[str, Any], loops: dict[str, Matched], *, quick: bool, seed: int
) -> list[Row]:
    """The rows of one case."""
    if case.kind == "loop":
        rows = loop_rows(case, suite, loops)
    elif case.kind == "map":
        rows = map_rows(case, suite, loops)
    else:
        rows = fly(case, suite, loops, quick=quick, seed=seed)
    require_marked_quantities(rows)
    return rows


def counted(rows: list[Row]) -> str:
    """How many rows pass, and how many do not."""
    verdicts = [row.verdict.split(":")[0] for row in rows if row.shown]
    texts = {"pass": "pass", "FAIL": "fail", "infeasible": "are infeasible", "": "have no mark"}
    return ", ".join(f"{verdicts.count(key)} {text}" for key, text in texts.items())


def write(out: Path, loops: Loops, rows: list[Row], run_as: dict[str, Any]) -> None:
    """suite.json with every row, suite.md with those of the table.

    What is infinite or does not exist is null in JSON: see the verdict.
    """
    designs = [loop for plant in loops.values() for loop in plant.values()]
    named = [
        {"plant": x.plant, "design": x.design.name, "gains": x.design.gains, "matched": x.matched,
         "sensitivity_peak": x.sensitivity_peak, "activity": x.activity}
        for x in designs
    ]  # fmt: skip
    content = run_as | {"designs": named, "rows": [row.content() for row in rows]}
    write_json(out / "suite.json", content)
    parts = ["# Scenario suite", matching_table(designs, markup=True), LEGEND, markdown(rows)]
    (out / "suite.md").write_text("\n\n".join([*parts, counted(rows)]) + "\n")


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenarios", nargs="*", help="S0 to S11; all by default")
    parser.add_argument("--quick", action="store_true", help="fewer draws")
    parser.add_argument("--seed", type=int, default=0, help="noise, gusts and inertias")
    parser.add_argument("--out", type=Path, default=Path("results/suite"))
    return parser.parse_args()


def main(scenarios: list[str], quick: bool, seed: int, out: Path) -> None:
    began = time.perf_counter()
    suite = load()
    loops, rows = run(suite, tuple(scenarios), quick=quick, seed=seed)
    designs = [loop for plant in loops.values() for loop in plant.values()]
    print("\n\n".join([matching_table(designs), printed(rows), LEGEND, counted(rows)]))
    write(out, loops, rows, {"seed": seed, "quick": quick})
    drawn = figures.draw(suite, loops, rows, quick=quick, seed=seed)
    for name, figure in drawn.items():
        figure.savefig(out / name, dpi=130)
    names = ", ".join(["suite.json", "suite.md", *drawn])
    print(f"\n{out}: {names}; {time.perf_counter() - began:.1f} s")


if __name__ == "__main__":
    jq.enable_compile_cache()
    main(**vars(options()))
