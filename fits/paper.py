"""Reproduce the paper's sections 5.2 and 5.3, and keep a ledger of what stands.

Every claim is tried under every reading that the text leaves open, above all of what the command u
is. It reproduces if it holds under all of them, is conditional if it holds under some. Prints the
ledger and writes it with the figures under results/paper.
"""

import argparse
import time
from pathlib import Path

import jaxquad as jq
from jaxquad.report import write_json
from reproduction import (
    adaptation,
    disturbance,
    figures,
    inertia,
    roll as identification,
    steps,
    tracking,
)
from reproduction.ledger import Claim, markdown, printed, Reading
from reproduction.loops import TORQUE_GAINS


def together(step_claim: Claim, sine_claim: Claim) -> Claim:
    """Whether any reading of u serves the steps and the sine at once."""
    held = lambda claim, u: any(r.holds for r in claim.readings if r.assumption.startswith(u))
    readings = tuple(
        Reading(u, {"steps": float(held(step_claim, u)), "sine": float(held(sine_claim, u))},
                held(step_claim, u) and held(sine_claim, u))
        for u in TORQUE_GAINS
    )  # fmt: skip
    text = "one and the same rig shows the steps and the sine"
    return Claim("5.3", text, "both claims hold under that reading of u", readings)


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="noise of the two flights")
    parser.add_argument("--out", type=Path, default=Path("results/paper"))
    return parser.parse_args()


def main(out: Path, seed: int) -> None:
    began = time.perf_counter()
    roll, flight = identification.fly_and_fit(seed), adaptation.fly(seed)
    linear, pid = steps.linear_steps(), steps.pid_steps()
    rough, moving = steps.rough_steps(), steps.moving_steps()
    loops = disturbance.loaded_loops()
    tracked = tracking.claims(linear, pid, rough, moving)
    estimated = disturbance.claims(loops)
    claims = [*identification.claims(roll), *inertia.claims(flight), *tracked, *estimated]
    claims.append(together(tracked[2], estimated[2]))
    tables = [steps.table(linear | pid), disturbance.table(loops)]
    print("\n\n".join([*tables, printed(claims)]))

    out.mkdir(parents=True, exist_ok=True)
    (out / "ledger.md").write_text(markdown(claims) + "\n")
    write_json(out / "ledger.json", {"seed": seed, "claims": [c.content() for c in claims]})
    drawn = {
        5: figures.responses(roll),
        6: figures.inertias(flight),
        7: figures.gains(flight),
        8: figures.large_steps(linear, pid, moving),
        9: figures.small_steps(linear),
        10: figures.estimates(loops, "pulse, half of the period", 10),
        11: figures.estimates(loops, "sine", 11),
    }
    for number, panels in drawn.items():
        panels.figure.savefig(out / f"figure_{number}.png", dpi=130)
    seconds = time.perf_counter() - began
    print(f"\n{out}: ledger.md, ledger.json, figure_5.png to figure_11.png; {seconds:.1f} s")


if __name__ == "__main__":
    jq.enable_compile_cache()
    main(**vars(options()))
