"""What the paper says of inertia and b0, judged by the flight simulated here."""

import numpy as np

import jaxquad as jq

from .adaptation import Flight, PAPER
from .ledger import Claim, Reading
from .loops import END, INERTIA, ladrc, LEVER, rig, START, TORQUE_GAINS


DOMAIN = (1.0, 22.0)  # of delta in the printed map


def claims(flight: Flight) -> list[Claim]:
    return [_accurate(flight), _adapts(), _robust(), _feasible(0.2), _feasible(0.3)]


def _accurate(flight: Flight) -> Claim:
    paper = 100 * (PAPER / INERTIA - 1)
    readings = []
    for name in flight.inertia:
        errors = flight.errors(name)
        numbers = {"mean error, %": float(errors.mean()), "sd, %": float(errors.std())}
        holds = bool(np.sqrt(np.mean(errors**2)) <= abs(paper))
        readings.append(Reading(f"{name}, {errors.size} draws of gusts", numbers, holds))
    text = f"the inertia is identified online, to 0.0517 for 0.0552 ({paper:.1f} %)"
    return Claim("5.3", text, "the rms error is no more than the paper's", tuple(readings))


def printed_b0(delta: float) -> float:
    """Eq. (25) with equal triangles and rules i -> i; nan outside its domain."""
    low, high = DOMAIN
    return START + 24 / (high - low) * (delta - low) if low <= delta <= high else float("nan")


def _adapts() -> Claim:
    rules = {
        "(25), delta = J_ref / J^": printed_b0(INERTIA / PAPER),
        "(25), delta = J^ / J_ref": printed_b0(PAPER / INERTIA),
        "(25), delta = 3 / 1.6": printed_b0(START / END),
    }
    rules |= {f"b0 = KT / J^, {name}": gain / PAPER for name, gain in TORQUE_GAINS.items()}
    rules["b0 J^ constant, J^ at first half of J_ref"] = START * (INERTIA / 2) / PAPER
    readings = (
        Reading(name, {"last b0": b0}, bool(abs(b0 - END) < 0.05)) for name, b0 in rules.items()
    )
    text = "b0 goes from 3 to 1.6 as J^ goes to 0.0517"
    return Claim("5.3", text, "the last b0 is within 0.05 of 1.6", tuple(readings))


def _robust() -> Claim:
    """Stable ranges of the inertia, in units of the manual's."""
    window = jq.loops.gain_window(jq.Loop(rig(1.0), ladrc(1.0)), member=0)
    low, high = float(window.low), float(window.high)
    gain = 2 * LEVER / INERTIA
    fixed = {b0: (gain / b0 / high, gain / b0 / low) for b0 in (END, START)}
    ratio = np.geomspace(0.05, 20, 4000)  # J / J_ref
    rules = {
        "b0 proportional to 1 / J^": END / ratio,
        "(25), delta = J^ / J_ref": np.array([printed_b0(delta) for delta in ratio]),
        "(25), delta = J_ref / J^": np.array([printed_b0(1 / delta) for delta in ratio]),
    }
    readings = []
    for name, b0 in rules.items():
        held = np.where(np.isnan(b0), START, b0)
        r = gain / ratio / held
        stable = ratio[(r > low) & (r < high)]
        numbers = {"J/J_ref from": stable.min(), "to": stable.max()}
        numbers |= {"fixed 1.6 to": fixed[END][1], "fixed 3 to": fixed[START][1]}
        readings.append(
            Reading(name, numbers, bool(stable.max() > max(fixed[END][1], fixed[START][1])))
        )
    text = "adapting b0 makes the loop robust to a changing inertia"
    rule = "stable to a larger inertia than with b0 = 1.6 or 3 fixed"
    return Claim("5.3", text, rule, tuple(readings))


def _feasible(torque: float) -> Claim:
    allocation = jq.quanser_hover().allocation
    most = jq.simulation.authority(jq.quanser_hover(), jq.simulation.MotorDrive(allocation))
    limits = {
        "bias of 2 V, motors never reversed": float(most.forward[0]),
        "amplifiers of 24 V, motors reversed": float(most.torque[0]),
    }
    readings = (
        Reading(
            name, {"authority, N m": limit, "needed, V per motor": torque / (2 * LEVER)},
            limit >= torque,
        )
        for name, limit in limits.items()
    )  # fmt: skip
    text = f"the rig holds a disturbance of {torque} N m"
    return Claim("5.3", text, "the motors have that torque", tuple(readings))
