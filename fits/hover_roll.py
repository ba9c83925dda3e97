"""Identify the roll axis of the simulated Quanser 3 DOF Hover: the paper's section 5.2, done right.

A frequency sweep is injected into the stabilised test stand, with gusts and an 8192-count
encoder. Prints a table for a report and writes JSON and figures under results/hover_roll.
`--draws N` repeats the flight N times and counts how often the 95 % intervals hold the truth.
"""

import argparse
import atexit
import gc
import time
from pathlib import Path

import jax
import numpy as np

import jaxquad as jq
from jaxquad.plot import bode
from jaxquad.report import provenance, write_report, write_results


jq.enable_x64()

DT = 0.002  # s
ADDED = 0.0276  # kg m^2, known weights on the arms in the second run: half the stand's inertia
SHEET = jq.models.QUANSER_HOVER
TRUTH = SHEET.arm * SHEET.thrust_coefficient / SHEET.inertia[0]
OMEGA = np.geomspace(0.35, 12.0, 60)  # rad/s
SPECTRA = jq.spectra.LocalPolynomial(integrators=2, delay=0.02)
ESTIMATORS = {"joint": jq.spectra.JointInputOutput(SPECTRA), "direct": SPECTRA}
COSTS = {
    "maximum likelihood": jq.identify.MaximumLikelihood(),
    "Eq. (14)": jq.identify.CoherenceWeighted(),
}
# A wrong first guess.
START = jq.models.AttitudeAxis(L=SHEET.arm, K_t=0.2, J_x=0.1, lag=0.03)
SWEEP = jq.sweep(0.3, 12.0, duration=90.0, sample_rate=1 / DT, amplitude=3.0)
PULSES = jq.excitation.three_two_one_one(width=0.5, sample_rate=1 / DT, amplitude=3.0)


def fly(signals: np.ndarray, added: np.ndarray, key: jax.Array) -> jq.simulation.Simulation:
    """One run per column of `signals` (V), with its own added inertia and its own noise."""
    inertia = np.array(SHEET.inertia)[:, None] + np.outer([1.0, 0.0, 0.0], added)
    thrust, torque = SHEET.thrust_coefficient, SHEET.torque_coefficient
    allocation = jq.models.Allocation(SHEET.arm, thrust, torque)
    stand = jq.models.Multirotor(jq.models.Attitude(inertia), allocation, jq.models.MotorLag(0.02))
    gains = [TRUTH, TRUTH, torque / SHEET.inertia[2]]
    pilot = jq.control.place_pd(gains, natural_frequency=3.0, damping=0.8, dt=DT)
    scenario = jq.simulation.excite(
        signals, key=key, dt=DT, torque_noise=0.002, sensor_noise=np.radians(0.02)
    )
    drive, encoder = (
        jq.simulation.MotorDrive(allocation),
        jq.simulation.Encoder(SHEET.encoder_counts),
    )
    return jq.simulate(jq.Loop(stand, pilot, dt=DT, drive=drive, encoder=encoder), scenario)


def experiments(seed: int) -> list[jq.Record]:
    """The sweep, the sweep again with the added inertia, and a 3-2-1-1 for verification."""
    pulses = np.zeros_like(SWEEP.signal)
    pulses[: PULSES.signal.size] = PULSES.signal
    signals = np.stack([SWEEP.signal, SWEEP.signal, pulses], axis=1)
    flights = fly(signals, np.array([0.0, ADDED, 0.0]), jax.random.key(seed))
    records = [flights.record("roll", member=k) for k in range(3)]
    return [*records[:2], jq.records.trim(records[2], 0.0, PULSES.time[-1])]


def identify(
    frf: jq.spectra.FrequencyResponse, cost=COSTS["maximum likelihood"]
) -> jq.identify.Fit:
    return jq.fit(START, frf, free=("J_x", "K_t", "lag"), cost=cost)


def identify_both(
    frf: jq.spectra.FrequencyResponse, loaded: jq.spectra.FrequencyResponse
) -> jq.identify.Fit:
    """Two runs, the second under a known change of inertia: that tells J_x from K_t."""
    return jq.fit(
        START,
        (frf, loaded),
        free=("J_x", "K_t", "lag"),
        cost=COSTS["maximum likelihood"],
        conditions=(None, jq.identify.Changed("J_x", plus=ADDED)),
    )


def _gain(axis: jq.models.AttitudeAxis) -> jax.Array:
    return axis.gain


def gain_of(fit: jq.identify.Fit, *, model_error: bool = True) -> jq.identify.Combination:
    return fit.derived(_gain, "L K_t / J_x", model_error=model_error)


def draw_gains(
    draws: int, cases=tuple((name, cost) for name in ESTIMATORS for cost in COSTS), seed: int = 1
) -> dict[tuple[str, str], np.ndarray]:
    """L K_t / J_x, its standard error and that by the noise alone, over noise draws."""
    found, chunk = {case: [] for case in cases}, 25
    for first in range(0, draws, chunk):
        signals = np.repeat(SWEEP.signal[:, None], chunk, axis=1)
        flights = fly(signals, np.zeros(chunk), jax.random.key(seed + first))
        for member in range(min(chunk, draws - first)):
            record = flights.record("roll", member=member)
            frfs = {
                name: jq.frequency_response(record, OMEGA, estimator=ESTIMATORS[name])
                for name in {name for name, _ in cases}
            }
            for name, cost in cases:
                fit = identify(frfs[name], COSTS[cost])
                gain, alone = gain_of(fit), gain_of(fit, model_error=False)
                found[name, cost].append((gain.value, gain.standard_error, alone.standard_error))
    return {key: np.array(rows) for key, rows in found.items()}


def coverage_table(draws: int) -> tuple[str, dict]:
    """Bias, scatter, standard errors and coverage over noise draws."""
    lines = [
        f"{draws} noise draws, L K_t / J_x in per cent of the truth; by noise alone, and with",
        "model error: the mean standard error and the share of 95 % intervals that cover",
        f"{'estimate':<28}{'median error':>13}{'scatter':>9}{'noise':>8}{'covers':>8}"
        f"{'with model':>12}{'covers':>8}",
    ]
    summary = {}
    for (name, cost), rows in draw_gains(draws).items():
        error, whole, noise = rows[:, 0] / TRUTH - 1, rows[:, 1] / TRUTH, rows[:, 2] / TRUTH
        covers = [float(np.mean(np.abs(error) < 1.96 * each)) for each in (noise, whole)]
        numbers = float(np.median(error)), float(np.std(error))
        means = float(np.mean(noise)), float(np.mean(whole))
        columns = (*numbers, means[0], covers[0], means[1], covers[1])
        names = "median scatter noise noise_covers with_model with_model_covers".split()
        summary[f"{name}, {cost}"] = dict(zip(names, columns, strict=True))
        widths, places = (13, 9, 8, 8, 12, 8), (2, 2, 2, 1, 2, 1)
        cells = zip(columns, widths, places, strict=True)
        line = "".join(f"{100 * x:>{width}.{place}f}" for x, width, place in cells)
        lines.append(f"{name + ', ' + cost:<28}{line}")
    return "\n".join(lines), summary


def compare(frfs: dict[str, jq.spectra.FrequencyResponse]) -> str:
    """L K_t / J_x by every estimator and cost, beside the truth."""
    lines = [f"L K_t / J_x by estimator and cost; the simulated truth is {TRUTH:.5f} rad/s^2/V"]
    for name, frf in frfs.items():
        for cost, weighing in COSTS.items():
            gain = gain_of(identify(frf, weighing))
            error = f"{100 * (gain.value / TRUTH - 1):+.2f} %"
            numbers = f"{gain.value:9.4f} +- {gain.standard_error:.4f} {error:>10}"
            lines.append(f"  {name + ', ' + cost:<27}{numbers}")
    return "\n".join(lines)


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=0, help="noise draws of a coverage study")
    parser.add_argument("--seed", type=int, default=0, help="noise of the one flight shown")
    parser.add_argument("--out", type=Path, default=Path("results/hover_roll"))
    return parser.parse_args()


def main(out: Path, seed: int, draws: int) -> None:
    began = time.perf_counter()
    print(jq.excitation.check_guidelines(SWEEP), "\n")
    record, loaded, pulses = experiments(seed)
    frfs = {n: jq.frequency_response(record, OMEGA, estimator=e) for n, e in ESTIMATORS.items()}
    print(record, frfs["joint"], sep="\n")

    alone = identify(frfs["joint"])
    print(f"\nOne record, asked for J_x and K_t:\n{alone}\n\n{compare(frfs)}")
    second = jq.frequency_response(loaded, OMEGA, estimator=ESTIMATORS["joint"])
    both = identify_both(frfs["joint"], second)
    print(f"\nWith a second run under {ADDED} kg m^2 of added inertia; the truth is J_x = 0.0552,")
    print(f"K_t = 0.1188, lag = 0.02:\n{both}")
    check = jq.verify(both.model, pulses)
    print(f"\nA 3-2-1-1 that was not fitted: {check}")

    extra = {
        "truth": {"gain": TRUTH, "J_x": SHEET.inertia[0], "K_t": SHEET.thrust_coefficient},
        "one_record": [combination._asdict() for combination in alone.combinations],
    }
    if draws:
        table, extra["coverage"] = coverage_table(draws)
        print(f"\n{table}")
    write_results(out, fit=both, frf=frfs["joint"], check=check, extra=extra)
    panels = bode(frfs["joint"], {"identified": both.model}, {"direct": frfs["direct"]})
    panels.figure.savefig(out / "bode.png", dpi=130)
    jq.plot.compare(check).figure.savefig(out / "verification.png", dpi=130)
    loaded_name = f"with {ADDED} kg m^2 of added inertia"
    write_report(
        out / "report.html",
        fit=both,
        frf={"as it is": frfs["joint"], loaded_name: second},
        models={loaded_name: both.model.with_added_inertia(ADDED)},
        record={"as it is": record, loaded_name: loaded},
        checks={"3-2-1-1 that was not fitted": check},
        derived=[gain_of(both)],
        provenance=provenance(command=f"python fits/hover_roll.py --seed {seed} --draws {draws}"),
        title="Quanser 3 DOF Hover, roll (simulated)",
    )
    seconds = time.perf_counter() - began
    print(f"\n{out}: result.json, report.html, bode.png, verification.png; {seconds:.1f} s")


if __name__ == "__main__":
    jq.enable_compile_cache()
    gc.set_threshold(500_000, 10, 10)  # a tenth of the time would go to what lives on anyway
    atexit.register(gc.freeze)  # at the end, too
    given = vars(options())
    main(**given)
