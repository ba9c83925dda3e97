"""How often `jaxquad compare` is right: pairs of simulated Betaflight flights, of known gains.

    python tests/studies/compared.py [pairs of each kind]

Prints for each change of gains how often each verdict was given, of all and of each quantity.
"""

import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path

import jaxquad as jq
from jaxquad.autopilot import write_chirp_log


FLOWN = (45, 80, 30)
CHANGES = {
    "the same gains": FLOWN, "P + 20 %": (54, 80, 30), "D + 20 %": (45, 80, 36),
    "P doubled": (90, 80, 30), "D halved": (45, 80, 15),
}  # fmt: skip


def main(pairs: int) -> None:
    jq.enable_x64()
    jq.enable_compile_cache()
    settings, seed = jq.workflows.CompareSettings(axis="roll"), 0
    with tempfile.TemporaryDirectory() as folder:
        for name, gains in CHANGES.items():
            kinds, verdicts = Counter(), defaultdict(Counter)
            for _ in range(pairs):
                logs = []
                for pid in (FLOWN, gains):
                    logs.append(write_chirp_log(Path(folder) / f"{seed}.bfl", seed, roll=pid))
                    seed += 1
                result = jq.workflows.compare(logs[0], logs[1], settings)
                kinds[result.kind] += 1
                for quantity in result.axes["roll"].quantities:
                    verdicts[quantity.name][quantity.verdict] += 1
            print(f"{name}: {dict(kinds)}", flush=True)
            for quantity, counts in verdicts.items():
                print(f"  {quantity:<24} {dict(counts)}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 6)
