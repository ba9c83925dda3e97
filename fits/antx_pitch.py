"""Identify the pitch axis of a measured quadrotor: moment M to rate q, by way of the set-point x0.

The PRBS flight is fitted, the sweep flight verifies. The two logs of the ANT-X rig are not part of
this repository: JAXQUAD_DATA names the folder that holds `antx_pitch/`.
"""

import argparse
import functools as ft
import os
import time
from pathlib import Path

import numpy as np

import jaxquad as jq
from jaxquad.plot import bode, compare
from jaxquad.report import write_results


jq.enable_x64()

BAND = (2 * np.pi * 0.7, 2 * np.pi * 12.0)  # rad/s
OMEGA = np.geomspace(*BAND, 80)
SPECTRA = jq.spectra.LocalPolynomial(integrators=1, delay=0.024)
ESTIMATORS = {"joint": jq.spectra.JointInputOutput(SPECTRA), "direct": SPECTRA}
COSTS = {
    "maximum likelihood": jq.identify.MaximumLikelihood(),
    "Eq. (14)": jq.identify.CoherenceWeighted(),
}
START = jq.LaggedIntegrator(gain=200.0, lag=0.02, delay=0.01)
READ = ft.partial(
    jq.read,
    inputs="M",
    outputs="q",
    references="x0",
    sample_rate=250.0,
    units={"q": "rad/s", "x0": "m"},
)


def read_flights(folder: Path) -> tuple[jq.Record, jq.Record]:
    """The PRBS part of one flight and the sweep of the other."""
    prbs = READ(folder / "antx_log3_prbs.npz", start=50.0, stop=76.0)
    sweep = READ(folder / "antx_log2_sweep.npz", start=132.8, stop=158.0)
    return prbs, sweep


def late(fit: jq.identify.Fit, *, model_error: bool = True) -> jq.identify.Combination:
    total = lambda model: model.lag + model.delay
    return fit.derived(total, "T + tau", model_error=model_error)


def row(name: str, fit: jq.identify.Fit) -> str:
    """K, T, tau and T + tau with their standard errors, in ms where it is time."""
    cells = [f"{fit.values[0]:8.1f} +- {fit.standard_errors[0]:4.1f}"]
    pairs = [*zip(fit.values[1:], fit.standard_errors[1:], strict=True), late(fit)[1:3]]
    cells += [f"{1e3 * value:7.2f} +- {1e3 * error:4.2f}" for value, error in pairs]
    return f"  {name:<27}" + "".join(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(os.environ.get("JAXQUAD_DATA", "../shared/data")) / "antx_pitch"
    parser.add_argument("--data", type=Path, default=default, help="folder of the two logs")
    parser.add_argument("--out", type=Path, default=Path("results/antx_pitch"))
    options = parser.parse_args()
    if not options.data.is_dir():
        parser.error(f"no flight logs at {options.data}: set JAXQUAD_DATA or give --data")
    began = time.perf_counter()

    prbs, sweep = read_flights(options.data)
    frfs = {n: jq.frequency_response(prbs, OMEGA, estimator=e) for n, e in ESTIMATORS.items()}
    print(prbs, frfs["joint"], sep="\n")
    fits = {
        f"{name}, {cost}": jq.fit(START, frf, cost=weighing)
        for name, frf in frfs.items()
        for cost, weighing in COSTS.items()
    }
    best = fits["joint, maximum likelihood"]
    print(f"\nq / M = K exp(-tau s) / (s (T s + 1)), joint estimate:\n{best}\n")
    heads = ("K, rad/s^2", "T, ms", "tau, ms", "T + tau, ms")
    print(f"  {'estimate, cost':<27}" + "".join(f"{head:>15}" for head in heads))
    print("\n".join(row(name, fit) for name, fit in fits.items()))

    check = jq.verify(best.model, sweep, band=BAND)
    print(f"\nThe other flight: {check}")
    sums = {name: late(fit)._asdict() for name, fit in fits.items()}
    gains = {name: [float(f.values[0]), float(f.standard_errors[0])] for name, f in fits.items()}
    extra = {"late": sums, "gain": gains}
    write_results(options.out, fit=best, frf=frfs["joint"], check=check, extra=extra)
    panels = bode(frfs["joint"], {"identified": best.model}, {"direct": frfs["direct"]})
    panels.figure.savefig(options.out / "bode.png", dpi=130)
    compare(check).figure.savefig(options.out / "verification.png", dpi=130)
    seconds = time.perf_counter() - began
    print(f"\n{options.out}: result.json, bode.png, verification.png; {seconds:.1f} s")


if __name__ == "__main__":
    jq.enable_compile_cache()
    main()
