"""Section 5.2: the roll axis identified from a sweep, as the paper asks and as it must be."""

from typing import NamedTuple

import numpy as np

import hover_roll
import jaxquad as jq
from hover_roll import COSTS, ESTIMATORS, gain_of, identify, SHEET, SWEEP, TRUTH

from .ledger import Claim, Reading


PAPER_INERTIA, PAPER_THRUST = 0.0492, 0.1170
PAPER_GAIN = SHEET.arm * PAPER_THRUST / PAPER_INERTIA
WIDE = np.geomspace(0.35, 100.0, 120)  # rad/s; the sweep ends at 12


class Roll(NamedTuple):
    """One flight, its responses, and what the fits make of them."""

    record: jq.Record
    wide: jq.spectra.FrequencyResponse  # joint, far beyond the sweep's band
    joint: jq.identify.Fit
    joint_gain: jq.identify.Combination
    direct_gain: jq.identify.Combination  # Eq. (13) and (14), as the paper uses them


def fly_and_fit(seed: int) -> Roll:
    flight = hover_roll.fly(SWEEP.signal[:, None], np.zeros(1), hover_roll.jax.random.key(seed))
    record = flight.record("roll", member=0)
    joint, direct = (
        jq.frequency_response(record, hover_roll.OMEGA, estimator=ESTIMATORS[name])
        for name in ("joint", "direct")
    )
    wide = jq.frequency_response(record, WIDE, estimator=ESTIMATORS["joint"])
    fit = identify(joint)
    direct_gain = gain_of(identify(direct, COSTS["Eq. (14)"]))
    return Roll(record, wide, fit, gain_of(fit), direct_gain)


def claims(roll: Roll) -> list[Claim]:
    return [_separate(roll), _accurate(roll), _fits(roll), _jitters(roll), _long_enough()]


def _separate(roll: Roll) -> Claim:
    lost = roll.joint.verdict.undetermined
    reading = Reading(
        "one sweep, J_x and K_t free",
        {"undetermined, of 2": float(len(lost))},
        roll.joint.identifiable,
    )
    text = "identification gives J_x = 0.0492 and K_t = 0.1170, individually"
    return Claim("5.2", text, "both are determined", (reading,))


def _accurate(roll: Roll) -> Claim:
    """Both errors that the paper names, and the one that it does not."""
    inertia = 100 * (PAPER_INERTIA / SHEET.inertia[0] - 1)
    thrust = 100 * (PAPER_THRUST / SHEET.thrust_coefficient - 1)
    ratio = 100 * (PAPER_GAIN / TRUTH - 1)
    readings = [
        Reading(
            "each number against the manual",
            {"J_x, %": inertia, "K_t, %": thrust},
            abs(inertia) < 11 and abs(thrust) < 1.65,  # "approximately"
        )
    ]
    for name, gain in (("the joint estimate", roll.joint_gain), ("H1 and (14)", roll.direct_gain)):
        found, error = 100 * (gain.value / TRUTH - 1), 100 * gain.standard_error / TRUTH
        numbers = {"the paper's, %": ratio, "here, %": found, "+-, %": error}
        assumption = f"L K_t / J_x, beside what {name} leaves"
        readings.append(Reading(assumption, numbers, abs(ratio) < 3 * error))
    text = "errors are small: about 10 % in J_x, 1.5 % in K_t"
    rule = "within a tenth of what is said, or within three standard errors"
    return Claim("5.2", text, rule, tuple(readings))


def _fits(roll: Roll) -> Claim:
    cost = identify(
        jq.frequency_response(roll.record, hover_roll.OMEGA, estimator=ESTIMATORS["joint"]),
        COSTS["Eq. (14)"],
    ).cost
    reading = Reading("cost (14), corrected, on 0.35 to 12 rad/s", {"J": cost}, cost < 100)
    text = "Figure 5: the model's response agrees with the measured one"
    return Claim("5.2", text, "J < 100, the textbook's bound", (reading,))


def _jitters(roll: Roll) -> Claim:
    """Where the response stops being good, against 50 Hz and 50 rad/s."""
    coherence = np.asarray(roll.wide.coherence)[:, 0, 0]
    good = np.asarray(roll.wide.omega)[coherence >= 0.6]
    end = float(good.max())
    numbers = {"good up to, rad/s": end, "the sweep's end, rad/s": float(SWEEP.omega_max)}
    hertz = Reading("50 Hz, as printed, of records at 50 Hz", numbers, end > 2 * np.pi * 25)
    radians = Reading("jitter begins where the sweep ends", numbers, end < 2 * SWEEP.omega_max)
    rule = "coherence stays above 0.6 that far, or fails within twice the sweep's end"
    return Claim("5.2", "good below 50 Hz, jitter above it", rule, (hertz, radians))


def _long_enough() -> Claim:
    [rule] = [r for r in jq.excitation.check_guidelines(SWEEP) if r.rule == "record length"]
    lengths = {"4 s": 4.0, "4 periods of 0.3 rad/s": 4 * 2 * np.pi / 0.3}
    readings = tuple(
        Reading(name, {"record, s": length, "rule, s": rule.limit}, length > 0.999 * rule.limit)
        for name, length in lengths.items()
    )
    return Claim("5.2", "T_rec >= 4", "that is the rule of four longest periods", readings)
