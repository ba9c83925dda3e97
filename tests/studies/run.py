"""The validation page from the beginning: healthy plants, tuned designs, the page.

    python tests/studies/run.py

Healthy plants run in two processes and continue where they were stopped. The other studies of this
folder keep their results; their commands are in those files.
"""

import subprocess
import sys
import time
from pathlib import Path


HERE = Path(__file__).parent
STEPS = (
    ["healthy.py", "--draws", "1200", "--workers", "2"],
    ["tuned.py"],
    ["page.py"],
)


def main() -> None:
    for script, *options in STEPS:
        began = time.perf_counter()
        subprocess.run([sys.executable, str(HERE / script), *options], check=True)
        print(f"{script}: {(time.perf_counter() - began) / 60:.1f} minutes", flush=True)


if __name__ == "__main__":
    main()
