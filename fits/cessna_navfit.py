"""Fit the pitch rate of a simulated Cessna to its elevator, as CIFER's NAVFIT did.

The X-Plane record, sampled at 20 to 50 ms, is not part of this repository: JAXQUAD_DATA names the
folder that holds `cessna_xplane/`. Prints CIFER's numbers beside ours.
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np

import jaxquad as jq
from jaxquad.identify import factors, fit_transfer_function
from jaxquad.plot import bode
from jaxquad.report import write_results


jq.enable_x64()

RATE = 40.0  # Hz; the record has 41.8 on average
BAND = (1.0, 30.0)  # rad/s
OMEGA = np.geomspace(*BAND, 50)
# Printed by CIFER 6.3: K (s + a) / ((s + p) (s^2 + 2 zeta omega s + omega^2)), and its cost.
PRINTED = {"gain": -7.02929, "zero": 2.8899, "pole": -89.093, "zeta": 0.6259, "omega": 6.1057}
PRINTED_COST = 2.943
CIFER = jq.TransferFunction(
    PRINTED["gain"] * np.array([1.0, PRINTED["zero"]]),
    np.convolve(
        [1.0, PRINTED["pole"]], [1.0, 2 * PRINTED["zeta"] * PRINTED["omega"], PRINTED["omega"] ** 2]
    ),
)


def read_sweep(path: Path) -> jq.Record:
    """Elevator and pitch rate on a uniform grid."""
    table = np.load(path)
    time, elevator, rate = table[:, 0], table[:, 1], np.radians(table[:, 4])
    channels = [
        jq.records.Channel("elevator", time, elevator),
        jq.records.Channel("q", time, rate, "rad/s"),
    ]
    grid, values = jq.records.resample(channels, RATE)
    return jq.Record(
        grid, values[:, :1], values[:, 1:], input_names="elevator", output_names="q",
        output_units="rad/s", source=path.name,
    )  # fmt: skip


def identify(record: jq.Record) -> tuple[jq.spectra.FrequencyResponse, jq.identify.Fit]:
    """The response by composite windows, and one zero over three poles without delay."""
    frf = jq.frequency_response(record, OMEGA, estimator=jq.spectra.Composite())
    cost = jq.identify.CoherenceWeighted()  # Eq. (14), CIFER's
    return frf, fit_transfer_function(frf, zeros=1, poles=3, delay=0.0, cost=cost)


def compared(fit: jq.identify.Fit) -> str:
    """CIFER's factors beside ours with their standard errors."""
    found = factors(fit)
    (zero,), (one, other) = found.zeros, found.poles
    far, pair = (one, other) if len(one.values) == 1 else (other, one)
    ours = [
        found.gain[1:3],
        *zip((*zero.values, *far.values, *pair.values),
             (*zero.standard_errors, *far.standard_errors, *pair.standard_errors), strict=True),
    ]  # fmt: skip
    lines = [f"  {'':<6}{'CIFER':>10}{'jaxquad':>11}{'std.err.':>10}"]
    for (name, printed), (value, error) in zip(PRINTED.items(), ours, strict=True):
        lines.append(f"  {name:<6}{printed:10.4f}{value:11.4f}{error:10.2g}")
    return "\n".join([*lines, f"  {'J':<6}{PRINTED_COST:10.3f}{fit.cost:11.3f}"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(os.environ.get("JAXQUAD_DATA", "../shared/data")) / "cessna_xplane"
    parser.add_argument("--data", type=Path, default=default, help="folder of the record")
    parser.add_argument("--out", type=Path, default=Path("results/cessna_navfit"))
    options = parser.parse_args()
    if not (files := sorted(options.data.glob("*.npy"))):
        parser.error(f"no record at {options.data}: set JAXQUAD_DATA or give --data")
    began = time.perf_counter()

    record = read_sweep(files[0])
    frf, fit = identify(record)
    print(record, frf, fit, factors(fit), "", compared(fit), sep="\n")
    extra = {"cifer": PRINTED | {"cost": PRINTED_COST}, "factors": str(factors(fit))}
    write_results(options.out, fit=fit, frf=frf, extra=extra)
    panels = bode(frf, {"identified": fit.model, "as CIFER printed": CIFER})
    panels.figure.savefig(options.out / "bode.png", dpi=130)
    seconds = time.perf_counter() - began
    print(f"\n{options.out}: result.json, bode.png; {seconds:.1f} s")


if __name__ == "__main__":
    jq.enable_compile_cache()
    main()
