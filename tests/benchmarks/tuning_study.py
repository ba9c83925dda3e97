"""Tunes of the case of docs/tuning.md from several starts, and a PID beside them.

Run with `python tests/benchmarks/tuning_study.py` from the repository's root: about two minutes.
"""

import sys
import time
from pathlib import Path

import jax
import numpy as np


sys.path.insert(0, str(Path(__file__).parent.parent))
jax.config.update("jax_enable_x64", True)

from tuning_case import (  # noqa: E402
    ensemble,
    equivalent,
    EVENTS,
    flat,
    flight,
    loop,
    objective,
    PRINTED,
    scheduled_pid,
    STARTS,
)

from jaxquad.tuning import certify, tune  # noqa: E402


KEY = jax.random.key(0)


def printed() -> None:
    """The designs of `tuning_case.PRINTED`, on 1024 members."""
    designs = {name: row[0] for name, row in PRINTED.items()}
    first, *others = designs
    judged = certify(
        loop(designs[first]), ensemble(), flight(), peers={n: designs[n] for n in others},
        name=first, events=EVENTS, members=1024, key=KEY,
    )  # fmt: skip
    print("ITAE deg s^2 mean/p95/worst, unstable %: found, printed")
    for name, row in judged.summaries.items():
        _, (mean, p95, worst), unstable = PRINTED[name]
        found = np.degrees(row.statistics["itae"][:3])
        share = 100 * (row.unstable or 0) / row.members
        print(
            f"{name:18s} {found[0]:6.1f} {found[1]:6.1f} {found[2]:6.1f} {share:5.1f}   "
            f"{mean:6.1f} {p95:6.1f} {worst:6.1f} {unstable:5.1f}"
        )


def tuned(name: str, controller, **options) -> None:
    begun = time.perf_counter()
    found = tune(
        loop(controller), ensemble(), flight(), objective=objective(), key=KEY, progress=False,
        **options,
    )  # fmt: skip
    seconds = time.perf_counter() - begun
    flown = np.array([np.nanmin(e.cost) for e in found.history if e.phase == "optimise"])
    assert found.certificate is not None
    values = found.certificate.summaries["tuned"].statistics
    itae, peak, overshoot = (values[q] for q in ("itae", "sensitivity_peak", "overshoot"))
    within = int(np.flatnonzero(flown < found.cost + 0.01)[0]) + 1
    print(
        f"{name:24s} cost {found.cost:8.5f}  {found.stabilising} + {found.evaluations} gradients, "
        f"{within} to 1 %  ITAE {np.degrees(itae.mean):.2f} / {np.degrees(itae.worst):.2f}  "
        f"Ms {peak.mean:.2f} / {peak.worst:.2f}  overshoot {overshoot.mean:.1f} %  "
        f"{seconds:.1f} s  {str(found).splitlines()[0]}"
    )


if __name__ == "__main__":
    printed()
    for start, design in STARTS.items():
        tuned(start, design)
    tuned("the paper's 3", flat(10.0, 30.0, 3.0))
    tuned("20/30", equivalent(20.0, 30.0))
    tuned("eight starts", STARTS["slow"], starts=8)
    tuned("scheduled PID", scheduled_pid(), starts=4)
