"""The validation page from the beginning: all studies that have results, and the page.

    python tests/studies/run.py

Healthy plants, which take the longest, run in two processes and continue where they were stopped.
"""

import subprocess
import sys
import time
from pathlib import Path


HERE = Path(__file__).parent
STEPS = (
    ["healthy.py", "--draws", "400", "--workers", "2"],
    ["new_ground.py", "--plants", "1000"],
    ["coverage_short.py", "--draws", "200"],
    ["ringdown.py", "--draws", "40"],
    ["nonlinearity.py", "--draws", "100"],
    ["hold.py", "--draws", "200"],
    ["feedthrough.py", "--draws", "60"],
    ["model_error.py", "--draws", "40"],
    ["posterior.py", "--draws", "10"],
    ["refine.py", "--draws", "200"],
    ["tuned.py"],
    ["adrc.py", "--flights", "200"],
    ["page.py"],
)


def main() -> None:
    for script, *options in STEPS:
        began = time.perf_counter()
        subprocess.run([sys.executable, str(HERE / script), *options], check=True)
        print(f"{script}: {(time.perf_counter() - began) / 60:.1f} minutes", flush=True)


if __name__ == "__main__":
    main()
