"""From a measured flight to certified gains: pitch of the ANT-X quadrotor, one command.

The flight with binary noise of `antx_pitch.py` identifies moment M to rate q: K, lag and delay.
Noise alone lets the last two trade off; members are drawn with the model error included.
A scheduled LADRC on the pitch ANGLE (b0 = K at the flown inertia, straight to M, in place of the
test stand's two loops) is tuned on them and certified on fresh ones. Identified are K, lag and
delay; the spread of inertia, and of K with the battery, is assumed, and nothing of this has been
flown. Needs the logs: JAXQUAD_DATA names the folder that holds `antx_pitch/`. Writes JSON, figures
and a C header under results/tune_antx.
"""

import os
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxquad as jq
from antx_pitch import BAND, COSTS, ESTIMATORS, late, OMEGA, read_flights, START
from experiments.tuning import (
    Case,
    equivalent,
    front_of,
    parser,
    Size,
    size_of,
    starts,
    Study,
    study,
    write,
)


jq.enable_x64()

DT = 0.004  # s: M changes at every sample of the log
SPAN = (0.5, 2.0)  # of the inertia that was flown
WO = BAND[1]  # rad/s: noise is low, so that only what the model holds for can bound the observer
LIMIT = 1.0  # of M, which is normalised
EVENTS = (0.0, 1.5, 3.0, 4.5)  # s
# An inertia of 1 makes torques accelerations in rad/s^2: the flight tells K = KT / J alone.
ASSUMED: dict[str, Any] = {
    "inertia": jq.ensembles.LogUniform(*SPAN),
    "assumed_inertia": jq.ensembles.Normal(0.1),
    "torque_gain": jq.ensembles.Normal(0.05),
    "noise": np.radians(0.01),  # theta of the flight has 0.007 deg of white noise above 20 Hz
}
FREE, HALF = ("ladrc.wc", "map.values"), ("ladrc.feedback_factor",)
PID_FREE = ("pid.kp", "pid.ki", "pid.proportional_weight", "map.values")
LIMITS = (jq.Limit("sensitivity_peak", at_most=2.5), jq.Limit("overshoot", at_most=10.0))


def flight() -> jq.simulation.Scenario:
    """A step of 10 deg, a pulse of 10 rad/s^2, a step back by 15 deg, a sine of 5 rad/s^2."""
    return jq.scenario(
        duration=6.0,
        dt=DT,
        axes=1,
        reference=jq.Step(np.radians(10.0)) + jq.Step(np.radians(-15.0), at=EVENTS[2]),
        disturbance=jq.Pulse(10.0, width=0.3, at=EVENTS[1])
        + jq.simulation.Sine(5.0, period=1.0, at=EVENTS[3]),
    )


def own_activity(record: jq.Record) -> float:
    """Squared changes of M per second that the test stand's own controller made in the flight."""
    moment = np.asarray(record.inputs)[:, 0]
    return float(np.sum(np.diff(moment) ** 2) / (moment.size * DT))


def case_of(fit: jq.identify.Fit, activity: float) -> Case:
    posterior = jq.ensembles.Posterior(fit, recorded_dt=DT, believed=1.0, band=BAND)
    ensemble = jq.Ensemble(posterior, **ASSUMED)
    penalties = (
        jq.tuning.Penalty("activity_rate", knee=activity, weight=2.0),
        jq.tuning.Penalty("sensitivity_peak", knee=2.0, weight=3.0),
        jq.tuning.Penalty("abscissa", knee=-0.5, weight=5.0),
    )
    ladrc, pid = starts(posterior.plant, SPAN, limit=LIMIT, dt=DT, wo=WO)
    loop = jq.Loop(
        posterior.plant, ladrc, drive=jq.simulation.Saturation(LIMIT), delay=posterior.delay, dt=DT
    )
    objective = jq.Objective(penalties=penalties, events=EVENTS, load_start=EVENTS[1])
    others = equivalent(loop)
    return Case(loop, ensemble, flight(), objective, LIMITS, pid, FREE, HALF, PID_FREE, others, 0.1)


def crossovers(found: Study, plant: Any, fit: jq.identify.Fit) -> tuple[float, float]:
    """Of the tuned loop without errors, rad/s: |L| = 1, and the peak of |S|."""
    delay = max(float(fit.model.delay) - DT / 2, 0.0)
    controller = found.ladrc.controller.scheduled_at(plant.inertia)
    loop = jq.analyse(jq.Loop(plant, controller, delay=delay, dt=DT))
    return float(loop.crossover), float(loop.sensitivity_frequency)


def by_noise(fit: jq.identify.Fit) -> list[float]:
    """Standard errors in s of lag, delay and their sum, without the model's error."""
    return [*fit.noise_standard_errors[1:], late(fit, model_error=False).standard_error]


def described(
    fit: jq.identify.Fit,
    check: jq.identify.Verification,
    activity: float,
    case: Case,
    found: Study,
    front: Any,
) -> str:
    gain, error = fit.values[0], fit.standard_errors[0]
    later = late(fit)
    lag, delay, both = (1e3 * each for each in by_noise(fit))
    crossover, peak = crossovers(found, case.loop.plant, fit)
    low, high = BAND
    inside = "inside" if low < crossover and peak < high else "NOT inside"
    return f"""\
{found.verdict}

Identified from the PRBS flight: K = {gain:.1f} +- {error:.1f} rad/s^2, lag + delay = \
{1e3 * later.value:.2f} +- {1e3 * later.standard_error:.2f} ms
(lag {1e3 * fit.standard_errors[1]:.1f}, delay {1e3 * fit.standard_errors[2]:.1f} ms; \
by noise alone {lag:.2f}, {delay:.2f} and {both:.2f} ms: there the two trade off).
Members are drawn with the model error; the other flight: fit {check.fit_percent:.0f} %.
Assumed: inertia {SPAN[0]:g} to {SPAN[1]:g} times what was flown, \
known to the controller within 10 %; K uncertain by another 5 %; noise 0.01 deg;
M held for {1e3 * DT:g} ms, within +-1; activity below that of the flight, {activity:.2g}/s. \
Torques are per kg m^2, in rad/s^2.
The nominal loop crosses over at {crossover:.0f} rad/s and is most sensitive at {peak:.0f}, \
{inside} the identified band of {low:.1f} to {high:.0f} rad/s.
wo is held at the band's upper end: with noise this low, nothing but the model would bound it.
Not flown: the gains are for the test stand's attitude estimate and a model of 0.7 to 12 Hz.

{found}

{front or "(no front in a quick run)"}"""


def main(out: Path, seed: int, size: Size, data: Path) -> None:
    began = time.perf_counter()
    key = jax.random.key(seed)
    prbs, sweep = read_flights(data)
    frf = jq.frequency_response(prbs, OMEGA, estimator=ESTIMATORS["joint"])
    fit = jq.fit(START, frf, cost=COSTS["maximum likelihood"])
    check = jq.verify(fit.model, sweep, band=BAND)
    activity = own_activity(prbs)
    case = case_of(fit, activity)
    found = study(case, size, key)
    front = front_of(case, found, size, key, over="sensitivity_peak")
    print(described(fit, check, activity, case, found, front))
    extra = {
        "seed": seed,
        "size": size._asdict(),
        "identified": {
            "gain": [fit.values[0], fit.standard_errors[0]],
            "lag": [fit.values[1], fit.standard_errors[1]],
            "delay": [fit.values[2], fit.standard_errors[2]],
            "late": late(fit)._asdict(),
            "by_noise": by_noise(fit),
            "fit_percent_on_the_other_flight": check.fit_percent,
        },
        "assumed": {
            "inertia": SPAN,
            "assumed_inertia": 0.1,
            "torque_gain": 0.05,
            "activity": activity,
        },
        "crossover_and_peak": crossovers(found, case.loop.plant, fit),
    }
    files = write(out, found, front, name="antx_pitch", extra=extra)
    print(f"\n{out}: {', '.join(files)}; {time.perf_counter() - began:.1f} s")


if __name__ == "__main__":
    jq.enable_compile_cache()
    line = parser(__doc__, "results/tune_antx")
    default = Path(os.environ.get("JAXQUAD_DATA", "../shared/data")) / "antx_pitch"
    line.add_argument("--data", type=Path, default=default, help="folder of the two logs")
    given = line.parse_args()
    if not given.data.is_dir():
        sys.exit(f"skipped: no flight logs at {given.data}: set JAXQUAD_DATA or give --data")
    main(given.out, given.seed, size_of(given), given.data)
