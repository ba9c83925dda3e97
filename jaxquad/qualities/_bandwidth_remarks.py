"""What a reader has to know about a bandwidth before using it."""

from typing import Any

import numpy as np

from ._basis import Basis
from ._text import degrees


def missing_bandwidth(result: Any) -> list[str]:
    """Why each number that is `nan` does not exist."""
    basis = result.basis
    reasons: list[str] = []
    for name, angle in (("phase_bandwidth", -135), ("omega_180", -180)):
        if not np.isfinite(getattr(result, name)) and bool(basis.finite):
            below = np.degrees(float(basis.start_phase)) <= angle
            how = (
                f"starts at {degrees(basis.start_phase, None)} already,"
                if below
                else f"does not fall to {angle} deg"
            )
            reasons.append(f"no {name}: the phase {how} {_reach(basis)}")
    if np.isfinite(result.omega_180) and not np.isfinite(result.gain_bandwidth):
        reasons.append("no gain_bandwidth: below w180 the magnitude is never 6 dB above that there")
    elif not np.isfinite(result.gain_bandwidth) and np.isfinite(result.phase_bandwidth):
        reasons.append("without w180 the bandwidth is at most the phase bandwidth")
    if np.isfinite(result.omega_180):
        top = float(2 * result.omega_180)
        if not np.isfinite(result.phase_delay):
            reasons.append(f"no phase_delay: 2 w180 is {top:.4g} rad/s, not {_reach(basis)}")
        elif not np.isfinite(result.phase_delay_fit):
            reasons.append("no phase_delay_fit: fewer than 3 frequencies from w180 to 2 w180")
    return reasons


def _reach(basis: Basis) -> str:
    unclear = float(basis.unclear)
    if np.isinf(unclear):
        return basis.where
    return (
        f"below {unclear:.4g} rad/s, from where it turns by more than 115 deg between neighbours: "
        "give more frequencies there, or choose others with omega="
    )


def doubtful_bandwidth(result: Any) -> list[str]:
    """What may be wrong with the numbers that exist."""
    doubts, start = [], float(result.basis.start_phase)
    given = start + (np.pi / 2 if result.quantity == "rate" else 0.0)
    if result.branch != "as given" and (abs(given) > np.radians(150) or start > np.radians(90)):
        doubts.append(
            f"the phase starts at {np.degrees(start):.4g} deg: if that is a turn off, say so with "
            "phase_at_start; if the sign of the input is opposite, turn it round"
        )
    if float(result.phase_crossings) > 1:
        doubts.append(
            f"the phase passes -135 or -180 deg {int(result.phase_crossings)} times: the lowest "
            "crossing counts"
        )
    if float(result.gain_crossings) > 1:
        doubts.append(
            f"the magnitude falls through the 6 dB level {int(result.gain_crossings)} times below "
            "w180: the gain bandwidth is the nearest, others are lower"
        )
    if bool(result.gain_bandwidth < result.phase_bandwidth):
        doubts.append(
            "gain-limited: ADS-33 warns of pilot-induced oscillation with attitude command"
        )
    apart = abs(float(result.gain_bandwidth) - float(result.phase_bandwidth))
    errors = result.standard_errors
    if apart < errors.get("gain_bandwidth", 0.0) + errors.get("phase_bandwidth", 0.0):
        doubts.append(
            "phase and gain bandwidth agree within their errors: the lesser is biased low"
        )
    return doubts
