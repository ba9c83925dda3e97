"""Make docs/performance.md, peers in the same run: python tests/benchmarks/page.py.

The machine has to be idle. Groups of pytest-benchmark become ratios of medians; the other
benchmarks print lines that are quoted as they are.
"""

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from textwrap import fill, wrap
from typing import NamedTuple

import first_answer


HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs" / "performance.md"


class Pair(NamedTuple):
    """A job of ours beside the peer's; names are those of the benchmarks."""

    job: str
    file: str
    ours: str
    peer: str
    beside: str


PAIRS = (
    Pair(
        "fit of 5 parameters to 60 frequencies, with covariance and verdict",
        "test_fit_speed.py",
        "test_fit_with_all_its_doubts",
        "test_scipy_least_squares",
        "scipy's solve alone",
    ),
    Pair(
        "1000 of these fits by `fit_batch`, values alone",
        "test_batch_speed.py",
        "test_ours",
        "test_scipy",
        "scipy's solves",
    ),
    Pair(
        "the same, with intervals and verdicts of all",
        "test_batch_speed.py",
        "test_ours_with_all_their_doubts",
        "test_scipy",
        "scipy's solves",
    ),
    Pair(
        "state-space fit, 20 parameters, with covariance and verdict",
        "test_state_space_speed.py",
        "test_fit_with_all_its_doubts",
        "test_scipy_least_squares",
        "scipy's solve alone",
    ),
    Pair(
        "output error, 22,500 samples, 4 parameters, with all doubts",
        "test_output_error_speed.py",
        "test_refine_with_all_its_doubts",
        "test_scipy_lfilter_and_lm",
        "scipy's solve alone",
    ),
    Pair(
        "frequency response with errors, 90 s at 250 Hz",
        "test_spectra_speed.py",
        "test_jaxquad_with_errors_and_their_covariance",
        "test_scipy_csd_welch_and_coherence",
        "scipy csd, welch, coherence",
    ),
    Pair(
        "composite of 5 windows, 3 inputs, 6 outputs",
        "test_composite_speed.py",
        "test_jaxquad",
        "test_zoom_fft",
        "scipy ZoomFFT, no errors",
    ),
    Pair(
        "the same",
        "test_composite_speed.py",
        "test_jaxquad",
        "test_zoom_fft_with_errors",
        "scipy ZoomFFT, with errors behind leakage",
    ),
    Pair("one loop of 10 s at 2 ms", "test_loop_speed.py", "test_ours_as_c", "test_c", "C"),
    Pair(
        "1000 of these loops",
        "test_loop_speed.py",
        "test_thousand_as_c",
        "test_thousand_c",
        "C, two threads",
    ),
    Pair(
        "1000 three-axis rigs with motors",
        "test_loop_speed.py",
        "test_thousand_rigs",
        "test_thousand_c",
        "C, two threads, a simpler model",
    ),
    Pair(
        "tune of wc, wo and six knots over 64 members, compiled",
        "test_tune_speed.py",
        "test_tune_with_everything_compiled",
        "test_scipy_with_the_same_objective",
        "scipy L-BFGS-B, the same objective",
    ),
)
PRINTED = (
    "test_ensemble_speed.py",
    "test_device_speed.py",
    "test_batch_of_logs.py",
)
HEAD = """\
# Performance

Made by `python tests/benchmarks/page.py` on an idle machine: {machine}.
Ours are public calls as the documents show them. Peers run in the same minutes on the same machine,
so read ratios; seconds move from machine to machine.

## Time to the first answer

Whole processes, the median of {rounds}: without compiled programs on disk (`JAXQUAD_CACHE=off`),
and the second time, with those that the first has left (the command line's default).

"""
ENGINE = """\
The first two lines are a loop written for `jq.simulation.run_ensemble` beside the same in C: the
engine alone, on one thread.
"""
TAIL = """
## On a GPU

Made by `python -m pytest tests/benchmarks/test_accelerator_speed.py -o addopts= -s` on one NVIDIA
H200, JAX 0.11: the loop of the AVX-512 lines above, 5000 samples, gradients for 12 parameters. The
gradient of the mean over a million loops is quicker as that of ten batches in turn: a batch has
memory for every fifth sample's numbers, from which the reverse pass goes on.

| loops | numbers | loop-steps/s | of the gradient | by batches of 100,000 |
|---|---|---|---|---|
| 100,000 | float32 | 4.14e10 | 1.03e10 | |
| 1,000,000 | float32 | 4.37e10 | 8.67e9 | 1.04e10 |
| 100,000 | float64 | 1.44e10 | 2.00e9 | |
"""
_OF_PYTEST = re.compile(r"benchmark: |Outliers: |OPS: ")  # lines that a plugin prints


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5, help="processes of each kind")
    rounds = parser.parse_args().rounds
    heads = ["job", "cold (s)", "processor (s)", "second time (s)", "processor (s)"]
    text = HEAD.format(machine=_machine(), rounds=rounds)
    text += _table(heads, first_answer.measured(rounds))
    text += "\n## Beside others\n\nMedians, warm.\n\n"
    heads = ["job", "here", "beside", "there", "there / here"]
    text += _table(heads, [row for pair in PAIRS if (row := _compared(pair))])
    text += f"\n## Ensembles, devices, logs\n\n{ENGINE}\n```text\n"
    text += "\n".join(line for file in PRINTED for line in _printed(file))
    hour = f"an hour at 1 kHz, 4 inputs, 6 outputs: {_run_script('long_record.py')}"
    text += f"\n{fill(hour, 110, subsequent_indent='    ')}\n```\n{TAIL}"
    PAGE.write_text(text)
    print(text)


def _machine() -> str:
    known = re.search(r"model name\s*:\s*(.*)", Path("/proc/cpuinfo").read_text())
    name = known[1] if known else platform.machine()
    return f"{os.cpu_count()} cores of {name}, Python {platform.python_version()}"


def _table(heads: list[str], rows: list[list[str]]) -> str:
    lines = [heads, ["---", *["---:"] * (len(heads) - 1)], *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


_KNOWN: dict[str, dict[str, float]] = {}


def _medians(file: str) -> dict[str, float]:
    """Seconds by benchmark of one file, which runs once; none where its peer is not here."""
    if file not in _KNOWN:
        with tempfile.TemporaryDirectory() as folder:
            told = Path(folder) / "told.json"
            _pytest(file, f"--benchmark-json={told}")
            found = json.loads(told.read_text())["benchmarks"] if told.stat().st_size else []
        _KNOWN[file] = {each["name"]: each["stats"]["median"] for each in found}
    return _KNOWN[file]


def _compared(pair: Pair) -> list[str]:
    medians = _medians(pair.file)
    if not {pair.ours, pair.peer} <= medians.keys():
        return []
    ours, there = medians[pair.ours], medians[pair.peer]
    return [pair.job, _seconds(ours), pair.beside, _seconds(there), f"{there / ours:.2g}"]


def _seconds(value: float) -> str:
    return f"{value:.2g} s" if value >= 1 else f"{1e3 * value:.3g} ms"


def _printed(file: str) -> list[str]:
    """The lines with figures that a benchmark prints, as wide as the page."""
    lines = _pytest(file, "-s").splitlines()
    kept = [line.lstrip(".") for line in lines if ": " in line and re.search(r"\d", line)]
    own = [line for line in kept if not _OF_PYTEST.search(line)]
    return [part for line in own for part in wrap(line, 110, subsequent_indent="    ")]


def _run_script(file: str) -> str:
    command = [sys.executable, str(HERE / file)]
    return subprocess.run(
        command, cwd=HERE.parents[1], capture_output=True, text=True
    ).stdout.strip()


def _pytest(file: str, *options: str) -> str:
    command = [sys.executable, "-m", "pytest", "-q", "-o", "addopts=", str(HERE / file), *options]
    ran = subprocess.run(command, cwd=HERE.parents[1], capture_output=True, text=True)
    if ran.returncode not in (0, 5):
        print(f"{file}: {ran.stdout[-1500:]}", file=sys.stderr)
    return ran.stdout


if __name__ == "__main__":
    main()
