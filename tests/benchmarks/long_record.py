"""An hour at 1 kHz, four inputs and six outputs: seconds and memory of its frequency response.

python tests/benchmarks/long_record.py --minutes 60
"""

import argparse
import resource
import time

import numpy as np
from scipy.signal import lfilter

import jaxquad as jq


RATE = 1000.0  # Hz
OMEGA = np.geomspace(0.5, 120.0, 80)  # rad/s


def flight(minutes: float) -> jq.Record:
    """Filtered white inputs through first-order paths, with noise of a tenth."""
    rng, samples = np.random.default_rng(0), int(minutes * 60 * RATE)
    u = np.stack([lfilter([0.02], [1, -0.98], rng.standard_normal(samples)) for _ in range(4)], 1)
    y = np.zeros((samples, 6))
    for output in range(6):
        mixed = u @ rng.standard_normal(4)
        y[:, output] = lfilter([0.01], [1, -0.99], mixed)
        y[:, output] += 0.1 * y[:, output].std() * rng.standard_normal(samples)
    return jq.Record(np.arange(samples) / RATE, u, y)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--composite", action="store_true", help="instead of the default estimator")
    options = parser.parse_args()
    jq.enable_x64()
    record = flight(options.minutes)
    before, began = _peak(), time.process_time()
    estimator = {"estimator": jq.spectra.Composite()} if options.composite else {}
    found = jq.frequency_response(record, OMEGA, **estimator)
    used = time.process_time() - began
    print(
        f"{options.minutes:g} min: {used:.1f} s of processor, {_peak():.1f} GB at the most "
        f"({before:.1f} GB with the record alone); coherence {np.median(found.coherence):.2f}"
    )


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


if __name__ == "__main__":
    main()
